"""`evofsm inspect`, `explain` and `export`: what was learnt, of a situation, for other tools."""

from __future__ import annotations

import sys
import textwrap
from pathlib import Path
from typing import Annotated, Any, Literal

from evofsm.cli import options
from evofsm.cli.options import Json, ModeName, Saved, option

# What stands in the beginning of files of each format, and of each file of c99.
_MARKS = {"dot": "digraph evofsm", "prism": "// A machine of", "fmu": "modelDescription.xml"}
_MARKS_OF_C = {"h": "/* Exported by evofsm"} | dict.fromkeys(("hpp", "c"), "of different exports")
_UNTOLD = (
    "Which episodes failed is not known: nothing said so. From a log, evofsm learn "
    "--failed COLUMN or --failed 'gap<=0' says it."
)


def inspect(
    file: Saved,
    plot: Annotated[Path | None, option("File for a picture: PNG, PDF, SVG.")] = None,
    log: Annotated[str | None, option("A log to show beneath, of --plot.")] = None,
    as_json: Json = False,
) -> None:
    """Print what was learnt: states, the transitions that matter, where a guard's system fails.

    evofsm explain says what came of one situation.
    """
    from evofsm.cli import models
    from evofsm.cli.show import facts, print_json, show

    if log and plot is None:
        raise ValueError(f"--log {log} is to be shown beneath a picture: --plot states.png")
    model, header, guard = models.load_model(file)
    provenance = header.provenance
    if plot is not None:
        title = f"States of {file.name}" + (f" over {Path(log).name}" if log else "")
        rows = models.logged(log, model, provenance.get("read with", {}))
        models.draw(model, guard, plot, rows, title)
    experience = getattr(guard and guard.judge, "told_by_experience", None)
    pairs = [] if experience is None else [("experience", str(experience))]
    if as_json:
        head = {"file": file, "provenance": provenance, **dict(pairs)}
        print_json({**head, **models.model_document(model)})
        return
    of_file = [("file", str(file))]
    of_file += [("holds", f"a {header.kind}, written by evofsm {header.library}")]
    of_file += [*models.learnt_from(provenance), *models.model_facts(model), *pairs]
    show(facts("Model", of_file), *models.tables_of(model))


def explain(
    file: Saved,
    observation: Annotated[
        str | None, option("Its values, with commas: --observation=-9,14,14.")
    ] = None,
    state: Annotated[str | None, option("A state by its number, from 1; or all.")] = None,
    action: Annotated[int | None, option("What came of this action there, from 1.")] = None,
    as_json: Json = False,
) -> None:
    """Explain a situation, by its observation or state: what came of those like it.

    All numbers were counted, once for each episode that came to a state; intervals are of 90 %.
    That one action ended better than another does not say that it was the reason.
    """
    from evofsm.cli import models
    from evofsm.cli.show import print_json, say

    if (observation is None) == (state is None):
        raise ValueError("name one situation, by --observation or by --state")
    model, _, guard = models.load_model(file)
    index = None if action is None else _index("--action", action, model.n_actions)
    here = ""
    if observation is not None:
        values = _values(observation)
        if len(values) != model.n_variables:
            names = ", ".join(map(model.labels.variable, range(model.n_variables)))
            fault = f"has {len(values)} values; it needs {names}, in this order"
            raise ValueError(f"--observation {fault}")
        explanations = [model.explain(action=index, observation=values)]
        here = guard.told_here(values) if guard else ""
    else:
        is_each = state == "all"
        states = range(model.n_states) if is_each else [_index("--state", state, model.n_states)]
        explanations = [model.explain(k, index) for k in states]
    if as_json:
        documents = [models.situation_document(model, e) for e in explanations]
        print_json({"file": file, "situations": documents})
        return
    if not model.failures_told:
        print(textwrap.fill(_UNTOLD, 80))
    for explanation in explanations:
        say(textwrap.fill(f"{explanation.text} {here}", 80, subsequent_indent="   "))


def _index(option: str, number: object, count: int) -> int:
    """From what people count from 1."""
    digits = str(number).removeprefix("#")
    if not (digits.isdecimal() and 1 <= int(digits) <= count):
        raise ValueError(f"{option} is {number}; there are 1 to {count}")
    return int(digits) - 1


def _values(text: str) -> list[float]:
    from evofsm.fsm.validation import usable_array

    try:
        return list(usable_array("it", [float(value) for value in text.split(",")]))
    except ValueError:
        raise ValueError(f"--observation is {text!r}; write numbers, such as 9,24,24") from None


def export(
    file: Saved,
    to: Annotated[
        Literal["dot", "prism", "c99", "fmu"],
        option("Graph for Graphviz, process for PRISM and Storm; the guard in C, or as an FMU."),
    ],
    out: Annotated[Path | None, option("File to write, else printed; of c99 a folder.")] = None,
    prefix: Annotated[str | None, option("Of c99: how names begin. [default: evofsm]")] = None,
    mode: Annotated[ModeName | None, option("Of c99, fmu: act filters. [default: saved]")] = None,
    least: Annotated[
        float | None,
        option("Leave out what is less probable. [default: dot 0.001]", min=0.0, max=1.0),
    ] = None,
    evidence: Annotated[
        float | None, option("Leave out what was seen less often. [default: 1]", min=0.0)
    ] = None,
) -> None:
    """Write what was learnt, or driven, in the formats of other tools."""
    if out is not None:
        of_c = {out / f"{prefix or 'evofsm'}.{end}": mark for end, mark in _MARKS_OF_C.items()}
        options.refuse_foreign(of_c if to == "c99" else {out: _MARKS[to]})
    is_code = to in ("c99", "fmu")
    unfit: Any = {"--least": least, "--evidence": evidence} if is_code else {"--mode": mode}
    unfit |= {} if to == "c99" else {"--prefix": prefix}
    if names := [name for name, value in unfit.items() if value is not None]:
        raise ValueError(f"{names[0]} is of other formats than --to {to}")
    if is_code:
        from evofsm.cli.models import load_guard
        from evofsm.guard import Foresight, Mode
        from evofsm.guard.export import write_c99, write_fmu

        if out is None:
            raise ValueError(f"--to {to} prints nothing: name a file, of c99 a folder, by --out")
        path = file / "guard.evofsm" if file.is_dir() else file
        guard = load_guard(path)
        if isinstance(guard.judge, Foresight):
            why = "a guard where nobody acts (--action '') cannot be exported"
            raise ValueError(f"{file}: {why}; run `evofsm monitor` beside the machine")
        if mode and hasattr(guard.reviser, "mode"):
            guard.reviser.mode = Mode(mode)
        return write_c99(guard, out, prefix or "evofsm") if to == "c99" else write_fmu(guard, out)
    from evofsm import store
    from evofsm.cli import models
    from evofsm.driving import LatentRisk, dead_ends_of
    from evofsm.fsm.naming import visible
    from evofsm.io import graphs

    model, _, made_by = models.load_model(file)
    judge = made_by and made_by.judge
    style: dict[str, Any] = {"least": least, "evidence": evidence}
    if to == "dot" and isinstance(judge, LatentRisk):
        style["dead_ends"] = dead_ends_of(model, judge)
    arguments = {name: value for name, value in style.items() if value is not None}
    text = visible(getattr(graphs, f"to_{to}")(model, **arguments))
    if out is None:
        sys.stdout.write(text)
        return
    with store.replacing(out) as stream:
        stream.write(text.encode())
