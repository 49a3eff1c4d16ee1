"""What files hold that was learnt: models loaded, drawn, and told as tables and for JSON."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import RenderableType

from evofsm import store
from evofsm.cli.options import picture, quoted, reading_of, typed
from evofsm.cli.show import table
from evofsm.driving import FAMILIES, load_family
from evofsm.fsm import EvolvingFSM, FSMModel, IntervalActions, Labels
from evofsm.fsm.explanation import Explanation
from evofsm.guard import Foresight, Guard, LearntRisk
from evofsm.guard.learnt.failure import telling
from evofsm.io import read_traces
from evofsm.io.logs import Condition

# What folders of results hold, in the order in which it is looked for.
_MODELS = ("guard.evofsm", "model.evofsm")
# So many states are listed, those with most of the time, and so many transitions between them.
_STATES_LISTED, _PASSAGES = 20, 12
_ROWS_SHOWN = 20_000  # of a longer log so many rows are drawn


def load_guard(path: store.Place) -> Guard:
    """A guard that learns no more: a function of failures that it knew is not asked."""
    guard = Guard.load(path, failed=lambda seen: False)
    if isinstance(guard.judge, LearntRisk):
        guard.failed = None  # it only stood in
    return guard


def failure(text: str | None, names: Sequence[str]) -> Callable[[Any], bool] | None:
    """What says of an observation whether it fails; None where that takes other columns."""
    condition = Condition.parse(text or names[0])

    def failed(z: Any) -> bool:
        return bool(condition.holds_of(dict(zip(names, z, strict=True))))

    return failed if text and {term.column for term in condition.terms} <= {*names} else None


def load_learning(path: Path, text: str | None) -> Guard:
    """A guard that may learn on; one that knew failures by a function knows them by ``text``."""
    was_told = store.read_header(path).settings.get("failed")
    names = load_guard(path).variables if text and was_told else ()
    return Guard.load(path, failed=failure(text, names) if names else None)


def load_model(place: Path) -> tuple[FSMModel, store.Header, Guard | None]:
    """A model from wherever one was left, what its file says of itself, and the guard it is of."""
    if place.is_dir():
        path = next((place / name for name in _MODELS if (place / name).exists()), None)
        if path is None:
            raise FileNotFoundError(f"{place}: there is neither {' nor '.join(_MODELS)} in it")
        return load_model(path)
    header, guard, labels = store.read_header(place), None, Labels()
    if header.kind == "guard":
        guard = load_guard(place)
        machine, actions = guard.machine, getattr(guard.reviser, "actions", None)
        if machine is None:
            raise ValueError(f"{place}: this guard has no machine")
        labels = getattr(guard.judge, "labels", labels)._replace(dt=guard.interval)
        if isinstance(actions, IntervalActions):
            labels = labels._replace(actions=actions)
    elif header.kind == "machine":
        machine = EvolvingFSM.load(place)
    else:
        return FSMModel.load(place), header, None
    if not machine.n_states:
        raise ValueError(f"{place} has seen nothing yet: an episode has to be over")
    if (family := str(header.provenance.get("family"))) in FAMILIES:
        labels = load_family(family).labels
    return machine.model(**labels._asdict()), header, guard


def logged(log: str | None, model: FSMModel, read_with: Mapping[str, Any]) -> dict[str, Any]:
    """Rows of a log, some tens of thousands, and with which of them an episode failed."""
    if log is None:
        return {}
    rows, failed = list[Any](), list[Any]()
    options = {**read_with} if read_with else {"observe": quoted(model.names), "action": ""}
    for chunk in read_traces([log], reading_of(**options)):
        rows.append(chunk.observations)
        failed.append(chunk.fails)
    every, failures = np.concatenate(rows), np.concatenate(failed)
    is_shown = failures | (np.arange(len(every)) % (1 + len(every) // _ROWS_SHOWN) == 0)
    return {"rows": every[is_shown], "failed": failures[is_shown]}


def draw(model: FSMModel, guard: Guard | None, out: Path, logged: Any, title: str) -> None:
    """States in the plane of two variables, and what a guard has learnt of failure."""
    from evofsm import plot

    judge, order = guard and guard.judge, list[int]()
    if isinstance(judge, Foresight):
        rate = judge.alarm
        logged["alarm"] = () if rate is None else judge.where(rate)
        order = [] if rate is None else telling(judge.where(rate))
    away = (model.centers - np.median(model.centers, axis=0)) ** 2  # then what differs at failures
    order += np.argsort(-(model.endings @ away) / (away.sum(0) + 1e-12), kind="stable").tolist()
    with picture(out, 7.2, 5.0) as figure:
        figure.suptitle(title, x=0.01, ha="left")
        if guard is not None and isinstance(judge, LearntRisk):
            plot.experience(guard, figure.subplots())
        elif model.n_variables == 1:
            plot.graph(model, figure.subplots())
        else:
            first, second = [*dict.fromkeys(order)][:2]
            plot.states(model, figure.subplots(), variables=(first, second), ways=True, **logged)


def passages(model: FSMModel) -> list[dict[str, Any]]:
    """The transitions between states that were recognised most often.

    Their share is that of all steps from the state of origin; what was learnt is the probability
    per step that the matrices give, actions as often as they were used.
    """
    counts = model.changes - np.diag(np.diag(model.changes))
    steps = model.changes.sum(axis=1)
    learnt = model.averaged_matrix
    most_first = np.argsort(-counts, axis=None, kind="stable")[:_PASSAGES].tolist()
    places = (divmod(place, model.n_states) for place in most_first)
    return [
        {"origin": i, "target": j, "times": int(counts[i, j])}
        | {"share": float(counts[i, j] / steps[i]), "learnt": float(learnt[i, j])}
        for i, j in places
        if counts[i, j] > 0.0
    ]


def model_document(model: FSMModel) -> dict[str, Any]:
    """All that is printed of a model, for JSON; states and actions from 0."""
    states = zip(model.centers, model.visits.tolist(), model.created.tolist(), strict=True)
    intervals = [model.actions and model.actions.interval(r) for r in range(model.n_actions)]
    uses = enumerate(zip(intervals, model.uses.tolist(), strict=True))
    return {
        **{name: getattr(model, name) for name in ("dt", "names", "units", "failures_told")},
        "settings": dict(model.settings),
        "states": [
            {"state": i, "center": center, "visits": visits, "first_seen": int(row)}
            for i, (center, visits, row) in enumerate(states)
        ],
        "transitions": passages(model),
        "actions": [{"action": r, "interval": of, "uses": count} for r, (of, count) in uses],
    }


def tables_of(model: FSMModel) -> Iterator[RenderableType]:
    """Its states, and the transitions that matter."""
    total = max(float(model.visits.sum()), 1.0)
    stays = np.diag(model.changes) / np.maximum(model.changes.sum(axis=1), 1.0)
    heads = map(model.labels.variable, range(model.n_variables))
    centers = zip(*map(_aligned, model.centers.T), strict=True)
    numbers = zip(centers, model.visits.tolist(), model.created.tolist(), strict=True)
    states = [
        (f"#{i + 1}", *center, f"{visits / total:.1%}", f"{stays[i]:.3f}", f"{row:,.0f}")
        for i, (center, visits, row) in enumerate(numbers)
    ]
    title = "States (time: while it learnt; stays: share of its steps; first seen: at which row)"
    most = sorted(np.argsort(-model.visits, kind="stable")[:_STATES_LISTED].tolist())
    yield ""
    header = ("", *heads, "share of time", "stays", "first seen")
    yield table(title, header, [states[k] for k in most])
    if (rest := model.n_states - len(most)) > 0:
        share = 1.0 - float(model.visits[most].sum()) / total
        hint = "--json prints all, evofsm explain says what came of one"
        yield f"and {rest:,} more states, together {share:.1%} of the time ({hint})"
    yield ""
    transitions = passages(model)
    if not transitions:
        yield "The recognised state never changed."
        return
    rows = [
        (f"#{i + 1} → #{j + 1}", f"{times:,}", f"{share:.4f}", f"{learnt:.3f}")
        for i, j, times, share, learnt in map(dict.values, transitions)
    ]
    title = f"Transitions that matter: the {len(transitions)} most frequent"
    yield table(title, ("from → to", "times", "share", "learnt"), rows)
    yield (
        "\nTimes and share: of the steps from that state, as recognised. Learnt: probability per "
        "step that the matrices give. Where it is far above the share, beliefs are wide."
    )


def model_facts(model: FSMModel) -> list[tuple[str, str]]:
    """How much it has seen, of what, and how it was set."""
    settings = ", ".join(f"{name} {value:g}" for name, value in model.settings.items())
    step = "the step is not known" if model.dt is None else f"one every {model.dt:g} s"
    failures = f"{model.endings.sum():,.0f} episodes ended in one"
    ends = f"{model.labels.action(0)} to {model.labels.action(model.n_actions - 1)}"
    actions = f", under actions {ends}" * (model.n_actions > 1)
    return [
        ("observations", f"{model.visits.sum():,.0f}, {step}"),
        ("transitions", f"{model.uses.sum():,.0f}{actions}"),
        ("states", f"{model.n_states}, of {model.n_variables} variables"),
        ("settings", settings or "not known"),
        ("failures", failures if model.failures_told else "which there were is not known"),
    ]


def learnt_from(provenance: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """What a file says of where it comes from, line by line."""
    for name, value in provenance.items():
        if name in ("monitor", "failures") or value == {}:  # what one goes on from; stands below
            continue
        text = f"{value:,}" if isinstance(value, int) else str(value)
        if name == "files":
            more = f" and {len(value) - 3:,} more" if len(value) > 3 else ""
            text = ", ".join(file["name"] for file in value[:3]) + more
        if name == "read with":
            text = typed(value)
        is_amount = name in ("files", "rows", "episodes", "transitions")
        yield f"learnt from {name}" if is_amount else name, text


def _aligned(values: NDArray[np.float64]) -> list[str]:
    """Numbers with the same number of decimals, such that the largest has four digits."""
    largest = float(abs(values).max(initial=0.0))
    decimals = max(3 - math.floor(math.log10(largest)), 0) if largest > 0.0 else 2
    return [f"{value:.{decimals}f}" for value in values]


def situation_document(model: FSMModel, found: Explanation) -> dict[str, Any]:
    """All that is told of one situation, for JSON."""
    document = found._asdict()
    document["center"] = None if found.state is None else model.centers[found.state]
    for name in ("here", "action", "after_better"):
        if (tally := getattr(found, name)) is not None:
            document[name] = {**tally._asdict(), "interval": tally.interval}
    return document
