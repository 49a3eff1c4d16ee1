"""How a machine, a model and a step look at the end of a notebook's cell: a small table of HTML."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evofsm.fsm.validation import state_name

# More states than these have no row, and more variables no column.
_MOST_STATES, _MOST_VARIABLES = 12, 6
_EVENTS = {
    "NONE": "the states stayed as they were",
    "MOVED": "the nearest state moved here",
    "CREATED": "a state was created here",
    "MERGED": "two states were merged",
    "RETIRED": "a state was given up",
}
_NOT_CREATED = "none was created: there are as many states as allowed, and the nearest is close"


def machine_html(machine: Any) -> str:
    """A machine: its settings, its states, and where it is."""
    state, model = machine.state, machine.model()
    now = "no episode has begun" if state is None else f"now in {state_name(state)}"
    columns = _columns(model)
    if state is not None:
        columns["belief"] = [_percent(share) for share in machine.belief]
    return _html(machine, [*_sizes(model), now], _settings(model), columns, model.visits, state)


def model_html(model: Any) -> str:
    """A model: its states, and where each leads most often."""
    about = _sizes(model)
    if model.dt is not None:
        about.append(f"an observation every {model.dt:g} s")
    columns = _columns(model)
    if model.uses.any() and model.n_states > 1:
        matrix = model.averaged_matrix("observed")
        stays = matrix.diagonal()
        elsewhere = matrix - np.diag(stays)
        columns["stays"] = [_percent(share) for share in stays]
        columns["likeliest other next"] = [
            f"{state_name(int(row.argmax()))} ({_percent(row.max())})" for row in elsewhere
        ]
    return _html(model, about, _settings(model), columns, model.visits)


def step_html(step: Any) -> str:
    """A step: what was recognised, what happened to the states, and whether it was foreseen."""
    surprise = "nothing was forecast"
    if math.isfinite(step.surprise):
        surprise = f"surprise {step.surprise:.3f} bit"
    names = (step.event.name or "NONE").split("|")
    happened = _NOT_CREATED if names == ["MERGED"] else ", ".join(_EVENTS[one] for one in names)
    details = ""
    if step.missing:
        which = ", ".join(map(str, step.missing))
        details = f"not observed: variable {which}; so nothing was learnt"
    columns = {"belief": [_percent(share) for share in step.belief]}
    if len(step.predicted):
        columns["forecast"] = [_percent(share) for share in step.predicted]
    about = [state_name(step.state), happened, surprise]
    return _html(step, about, details, columns, step.belief, step.state)


def _sizes(model: Any) -> list[str]:
    sizes = ((model.n_states, "state"), (model.n_actions, "action"))
    return [f"{number:,} {thing}{'s' * (number != 1)}" for number, thing in sizes]


def _settings(model: Any) -> str:
    told = [
        f"{name} {getattr(value, 'name', value)}"
        for name, value in model.settings.items()
        if name != "n_actions"
    ]
    return ", ".join([*told, f"rule {model.rule}"])


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
    columns["visits"] = [f"{count:,.0f}" for count in model.visits]
    for head, counts in (
        ("episodes", model.episodes),
        ("failed soon", model.failed_soon),
        ("failures ended here", model.endings),
    ):
        if counts.any():
            columns[head] = [f"{count:,.0f}" for count in counts]
    return columns


def _percent(share: float) -> str:
    return "< 0.1 %" if 0.0 < share < 0.0005 else f"{100.0 * share:.1f} %"


def _html(
    thing: object,
    about: Sequence[str],
    details: str,
    columns: Mapping[str, Sequence[str]],
    weights: NDArray[np.float64],
    present: int | None = None,
) -> str:
    """A head, and a row for each of the states that weigh most, the present one among them."""
    heaviest = np.argsort(-weights, kind="stable").tolist()
    if present is not None:
        heaviest.remove(present)
        heaviest.insert(0, present)
    rows = [
        [state_name(i), *(cells[i] for cells in columns.values())]
        for i in sorted(heaviest[:_MOST_STATES])
    ]
    if len(weights) > len(rows):
        rows.append([f"… and {len(weights) - len(rows)} more", *[""] * len(columns)])
    head = f"<strong>{escape(type(thing).__name__)}</strong>: {escape(', '.join(about))}"
    if details:
        head += f"<br><span style='opacity:.75'>{escape(details)}</span>"
    if not rows:
        return f"<div>{head}</div>"
    heads = "".join(f"<th scope='col'>{escape(one)}</th>" for one in ("state", *columns))
    cells = "".join(
        f"<tr>{''.join(f'<td>{escape(cell)}</td>' for cell in row)}</tr>" for row in rows
    )
    return f"<div>{head}</div><table><thead><tr>{heads}</tr></thead><tbody>{cells}</tbody></table>"
