"""How a machine, a model and a step look at the end of a notebook's cell: a small table of HTML."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

import numpy as np

from evofsm.fsm.validation import Floats, counted, state_name

# More states than these have no row.
_MOST_STATES = 12


def machine_html(machine: Any) -> str:
    """A machine: its settings, its states, and where it is."""
    state, model = machine.state, machine.model()
    now = "no episode has begun" if state is None else f"now in {state_name(state)}"
    belief = {} if state is None else {"belief": _percent(machine.belief)}
    return _html(machine, [*_about(model), now], _columns(model) | belief, model.visits, state)


def model_html(model: Any) -> str:
    """A model: its settings and its states."""
    every = [] if model.dt is None else [f"an observation every {model.dt:g} s"]
    return _html(model, [*_about(model), *every], _columns(model), model.visits)


def step_html(step: Any) -> str:
    """A step: what was recognised, what happened to the states, and whether it was foreseen."""
    is_foreseen = math.isfinite(step.surprise)
    surprise = f"surprise {step.surprise:.3f} bit" if is_foreseen else "nothing was forecast"
    about = [state_name(step.state), f"event {step.event.name}", surprise]
    if step.missing:
        about.append(f"not observed: variable {', '.join(map(str, step.missing))}")
    columns = {"belief": _percent(step.belief)}
    if len(step.predicted):
        columns["forecast"] = _percent(step.predicted)
    return _html(step, about, columns, step.belief, step.state)


def _about(model: Any) -> list[str]:
    told = [counted(model.n_states, "state"), counted(model.n_actions, "action")]
    settings = {name: value for name, value in model.settings.items() if name != "n_actions"}
    return [*told, *(f"{name} {value}" for name, value in settings.items()), f"rule {model.rule}"]


def _columns(model: Any) -> dict[str, list[str]]:
    """Where the states lie, and how often each was seen."""
    columns = {
        model.labels.variable(j): [f"{number:.4g}".replace("-", "−") for number in values]
        for j, values in enumerate(model.centers.T)
    }
    for name in ("visits", "episodes", "failed_soon", "endings"):
        if (counts := getattr(model, name)).any() or name == "visits":
            columns[name.replace("_", " ")] = [f"{count:,.0f}" for count in counts]
    return columns


def _percent(shares: Floats) -> list[str]:
    return ["< 0.1 %" if 0.0 < one < 0.0005 else f"{100.0 * one:.1f} %" for one in shares.tolist()]


def _html(
    thing: object,
    about: Sequence[str],
    columns: Mapping[str, Sequence[str]],
    weights: Floats,
    present: int | None = None,
) -> str:
    """A head, and a row for each of the states that weigh most, the present one among them."""
    heaviest = np.argsort(-weights, kind="stable").tolist()
    heaviest.sort(key=lambda i: i != present)
    rows = [
        [state_name(i), *(cells[i] for cells in columns.values())]
        for i in sorted(heaviest[:_MOST_STATES])
    ]
    if len(weights) > len(rows):
        rows.append([f"… and {len(weights) - len(rows)} more", *[""] * len(columns)])
    head = f"<div><strong>{type(thing).__name__}</strong>: {escape(', '.join(about))}</div>"
    if not rows:
        return head
    table = [
        f"<tr>{''.join(f'<{tag}>{escape(cell)}</{tag}>' for cell in row)}</tr>"
        for tag, row in (("th", ["state", *columns]), *(("td", row) for row in rows))
    ]
    return f"{head}<table>{''.join(table)}</table>"
