"""How a machine, a model and a step look at the end of a notebook's cell: a small table of HTML."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

import numpy as np

from evofsm.fsm.validation import Floats, state_name

# More states than these have no row, and more variables no column.
_MOST_STATES, _MOST_VARIABLES = 12, 6


def machine_html(machine: Any) -> str:
    """A machine: its settings, its states, and where it is."""
    state, model = machine.state, machine.model()
    now = "no episode has begun" if state is None else f"now in {state_name(state)}"
    columns = _columns(model)
    if state is not None:
        columns["belief"] = _percent(machine.belief)
    return _html(machine, [*_about(model), now], columns, model.visits, state)


def model_html(model: Any) -> str:
    """A model: its states, and where each leads most often."""
    columns = _columns(model)
    if model.uses.any() and model.n_states > 1:
        matrix = model.averaged_matrix("observed")
        stays = matrix.diagonal()
        elsewhere = matrix - np.diag(stays)
        next_, shares = elsewhere.argmax(axis=1), _percent(elsewhere.max(axis=1))
        columns["stays"] = _percent(stays)
        columns["likeliest other next"] = [
            f"{state_name(int(i))} ({share})" for i, share in zip(next_, shares, strict=True)
        ]
    every = [] if model.dt is None else [f"an observation every {model.dt:g} s"]
    return _html(model, [*_about(model), *every], columns, model.visits)


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
    sizes = ((model.n_states, "state"), (model.n_actions, "action"))
    told = [f"{number:,} {thing}{'s' * (number != 1)}" for number, thing in sizes]
    settings = {name: value for name, value in model.settings.items() if name != "n_actions"}
    told += [f"{name} {value}" for name, value in settings.items()]
    return [*told, f"rule {model.rule}"]


def _columns(model: Any) -> dict[str, list[str]]:
    """Where the states lie, and how often each was seen."""
    m = model.n_variables
    heads = [model.labels.variable(j) for j in range(min(m, _MOST_VARIABLES))]
    if m > _MOST_VARIABLES:
        heads[-1] += f" (and {m - _MOST_VARIABLES} more)"
    columns = {
        head: [f"{number:.4g}".replace("-", "−") for number in values]
        for head, values in zip(heads, model.centers.T, strict=False)
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
    if present is not None:
        heaviest = [present, *(i for i in heaviest if i != present)]
    rows = [
        [state_name(i), *(cells[i] for cells in columns.values())]
        for i in sorted(heaviest[:_MOST_STATES])
    ]
    if len(weights) > len(rows):
        rows.append([f"… and {len(weights) - len(rows)} more", *[""] * len(columns)])
    head = f"<div><strong>{type(thing).__name__}</strong>: {escape(', '.join(about))}</div>"
    if not rows:
        return head
    heads = "".join(f"<th scope='col'>{escape(one)}</th>" for one in ("state", *columns))
    cells = "".join(
        f"<tr>{''.join(f'<td>{escape(cell)}</td>' for cell in row)}</tr>" for row in rows
    )
    return f"{head}<table><thead><tr>{heads}</tr></thead><tbody>{cells}</tbody></table>"
