"""`evofsm export`."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, Any, Literal

from evofsm.cli.inspect import load_model
from evofsm.cli.options import ModeName, Saved, option


def export(
    file: Saved,
    to: Annotated[
        Literal["dot", "prism", "c99", "fmu"],
        option("Graph for Graphviz, process for PRISM and Storm; the guard in C, or as an FMU."),
    ],
    out: Annotated[Path | None, option("File to write, else printed; of c99 a folder.")] = None,
    prefix: Annotated[str, option("Of c99: how all names in it begin.")] = "evofsm",
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
    _refuse_learnt(out)
    if to in ("c99", "fmu"):
        from evofsm.guard import Foresight, Guard, Mode
        from evofsm.guard.export import write_c99, write_fmu

        if out is None:
            raise ValueError(f"--to {to} prints nothing: name a file, of c99 a folder, by --out")
        path = file / "guard.evofsm" if file.is_dir() else file
        guard = Guard.load(path, failed=lambda seen: False)
        if isinstance(guard.judge, Foresight):
            why = "a guard where nobody acts (--action '') cannot be exported"
            raise ValueError(f"{file}: {why}; run `evofsm monitor` beside the machine")
        if mode and hasattr(guard.reviser, "mode"):
            guard.reviser.mode = Mode(mode)
        return write_c99(guard, out, prefix) if to == "c99" else write_fmu(guard, out)
    from evofsm import store
    from evofsm.fsm.naming import visible
    from evofsm.io import graphs

    model, dead_ends = _learnt(file)
    style = {"least": least, "evidence": evidence, "dead_ends": dead_ends if to == "dot" else None}
    arguments = {name: value for name, value in style.items() if value is not None}
    text = visible(getattr(graphs, f"to_{to}")(model, **arguments))
    if out is None:
        sys.stdout.write(text)
        return
    with store.replacing(out) as stream:
        stream.write(text.encode())


def _refuse_learnt(out: Path | None) -> None:
    """Raise where a graph would take the place of what cannot be had again."""
    from evofsm.store import read_header

    if out is None or not out.is_file():
        return
    if not out.read_bytes().startswith(b"\x89MCAP"):  # as logs of runs do
        try:
            read_header(out)
        except ValueError:
            return
    raise ValueError(f"--out {out}: what was learnt or driven is kept there; it was left alone")


def _learnt(file: Path) -> tuple[Any, list[int] | None]:
    """The model, and its dead ends where the risk that was learnt with it is known."""
    from evofsm.driving import LatentRisk, dead_ends_of

    model, _, guard = load_model(file)
    judge = guard and guard.judge
    if not isinstance(judge, LatentRisk):
        return model, None
    return model, dead_ends_of(model, judge)
