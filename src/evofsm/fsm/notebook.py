"""How a machine, a model and a step look in a notebook: small tables of HTML.

Colours are those of the notebook, whether it is light or dark; styles stand inside the tags, so
nothing outside is touched; every text is escaped; a bar has its number beside it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from enum import Enum
from html import escape
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from evofsm.fsm.known import Known
from evofsm.fsm.numbering import state_name

# More rows than these are summed up in one.
_MOST_STATES = 12
# More variables than these are not shown.
_MOST_VARIABLES = 6

_LINE = "border:0;border-bottom:1px solid rgba(128,128,128,.4);padding:.2em .8em .2em 0;"
_TEXT = f"{_LINE}text-align:left;"
_NUMBER = f"{_LINE}text-align:right;white-space:nowrap;font-variant-numeric:tabular-nums;"

_EVENTS = {
    "NONE": "the states stayed as they were",
    "MOVED": "the nearest state moved here",
    "CREATED": "a state was created here",
    "MERGED": "two states were merged",
    "RETIRED": "a state was given up",
}
_NOT_CREATED = "none was created: there are as many states as allowed, and the nearest is close"


class Happened(Protocol):
    """What a `Step` says."""

    @property
    def belief(self) -> NDArray[np.float64]: ...  # noqa: D102
    @property
    def predicted(self) -> NDArray[np.float64]: ...  # noqa: D102
    @property
    def state(self) -> int: ...  # noqa: D102
    @property
    def surprise(self) -> float: ...  # noqa: D102
    @property
    def event(self) -> Enum: ...  # noqa: D102
    @property
    def missing(self) -> Sequence[int]: ...  # noqa: D102
    @property
    def explanation(self) -> str: ...  # noqa: D102


class _Column(NamedTuple):
    """A column of a table of states; the texts in it are not escaped yet."""

    head: str
    cells: Sequence[str]
    rest: str  #: of all states that have no row
    bars: NDArray[np.float64] | None = None  #: their lengths, as shares


def machine_html(machine: Known) -> str:
    """A machine: its settings, its states, and where it is.

    Parameters
    ----------
    machine : EvolvingFSM

    Returns
    -------
    str
        HTML for the inside of a page.

    Examples
    --------
    >>> from evofsm import EvolvingFSM
    >>> machine = EvolvingFSM(n_actions=2, radius=0.5)
    >>> trace = machine.learn_many([[0.0], [0.1], [2.0], [1.0]], [0, 0, 0, 0])
    >>> "2 states, 2 actions, now in #2" in machine_html(machine)
    True
    """
    state: int | None = getattr(machine, "state", None)
    now = "no episode has begun" if state is None else f"now in {state_name(state)}"
    shown = _most(machine.visits, state)
    columns = _columns(machine, shown)
    if state is not None:
        columns.append(_shares("belief", getattr(machine, "belief", np.ones(1)), shown))
    head = _head(machine, [*_counts(machine), now], _settings(machine))
    return _html(head, shown, machine.n_states, columns)


def model_html(model: Known) -> str:
    """A model: its states, and where each leads most often.

    Parameters
    ----------
    model : FSMModel

    Returns
    -------
    str
        HTML for the inside of a page.

    Examples
    --------
    >>> from evofsm import EvolvingFSM
    >>> machine = EvolvingFSM(n_actions=2, radius=0.5)
    >>> trace = machine.learn_many([[0.0], [0.1], [2.0], [1.0]], [0, 0, 0, 0])
    >>> "gap [m]" in model_html(machine.model(names=["gap"], units=["m"]))
    True
    """
    counts = list(_counts(model))
    if (dt := getattr(model, "dt", None)) is not None:
        counts.append(f"an observation every {dt:g} s")
    shown = _most(model.visits)
    columns = _columns(model, shown)
    if model.uses.any() and model.n_states > 1:
        columns += _transitions(model, shown)
    return _html(_head(model, counts, _settings(model)), shown, model.n_states, columns)


def step_html(step: Happened) -> str:
    """A step: what was recognised, what happened to the states, and whether it was foreseen.

    Parameters
    ----------
    step : Step

    Returns
    -------
    str
        HTML for the inside of a page.

    Examples
    --------
    >>> from evofsm import EvolvingFSM
    >>> step = EvolvingFSM(n_actions=1).observe([0.0])
    >>> "a state was created here" in step_html(step)
    True
    """
    surprise = "nothing was forecast"
    if math.isfinite(step.surprise):
        surprise = f"surprise {step.surprise:.3f} bit"
    shown = _most(step.belief)
    columns = [_shares("belief", step.belief, shown)]
    if len(step.predicted):
        columns.append(_shares("forecast", step.predicted, shown))
    details = _unseen(step.missing) or step.explanation
    head = _head(step, [state_name(step.state), _happened(step), surprise], details)
    return _html(head, shown, len(step.belief), columns)


# -- What is said -----------------------------------------------------------------------------


def _counts(model: Known) -> Iterable[str]:
    yield _some(model.n_states, "state")
    yield _some(model.n_actions, "action")


def _some(number: int, thing: str) -> str:
    return f"{number:,} {thing}{'' if number == 1 else 's'}"


def _settings(model: Known) -> str:
    told = [
        f"{name} {getattr(value, 'name', value)}"  # a member of an enumeration by its name
        for name, value in model.settings.items()
        if name != "n_actions"
    ]
    return ", ".join([*told, f"rule {model.rule}"])


def _happened(step: Happened) -> str:
    events = (step.event.name or "NONE").split("|")
    if events == ["MERGED"]:
        return _NOT_CREATED
    return ", ".join(_EVENTS[event] for event in events)


def _unseen(missing: Sequence[int]) -> str:
    if not missing:
        return ""
    which = ", ".join(str(variable) for variable in missing)
    return f"not observed: variable {which}; so nothing was learnt"


def _most(weights: NDArray[np.float64], present: int | None = None) -> list[int]:
    """The states that weigh most, and the present one, in the order of their numbers."""
    heaviest = np.argsort(-weights, kind="stable").tolist()
    if present is not None:
        heaviest.remove(present)
        heaviest.insert(0, present)
    return sorted(heaviest[:_MOST_STATES])


def _columns(model: Known, shown: Sequence[int]) -> list[_Column]:
    """Where the states lie, and how often each was seen."""
    columns = [
        _Column(head, [_value(model.centers[state, j]) for state in shown], "")
        for j, head in enumerate(_variables(model))
    ]
    columns.append(_numbers("visits", model.visits, shown))
    visits = float(model.visits.sum())
    columns.append(_shares("share", model.visits / max(visits, 1.0), shown, barred=False))
    if model.episodes.any():
        columns.append(_numbers("episodes", model.episodes, shown))
    if model.failed_soon.any():
        columns.append(_numbers("failed soon", model.failed_soon, shown))
    if model.endings.any():
        columns.append(_numbers("failures ended here", model.endings, shown))
    return columns


def variable_label(model: Known, variable: int) -> str:
    """Name and unit of a variable, as far as they are known.

    Parameters
    ----------
    model : EvolvingFSM or FSMModel
    variable : int
        Its index, from 0.

    Returns
    -------
    str

    Examples
    --------
    >>> from evofsm import EvolvingFSM
    >>> machine = EvolvingFSM(n_actions=1)
    >>> step = machine.observe([4.0, 10.0])
    >>> variable_label(machine, 1)
    'variable 1'
    >>> variable_label(machine.model(names=["gap", "speed"], units=["m", "m/s"]), 1)
    'speed [m/s]'
    """
    names, units = getattr(model, "names", ()), getattr(model, "units", ())
    name = names[variable] if names else f"variable {variable}"
    unit = units[variable] if units else ""
    return f"{name} [{unit}]" if unit else name


def _variables(model: Known) -> list[str]:
    """Heads of the columns of the centres."""
    m = model.n_variables
    heads = [variable_label(model, j) for j in range(min(m, _MOST_VARIABLES))]
    if m > _MOST_VARIABLES:
        heads[-1] += f" (and {m - _MOST_VARIABLES} more)"
    return heads


def _transitions(model: Known, shown: Sequence[int]) -> list[_Column]:
    """How likely each state stays, and which other one is likeliest next."""
    matrix = model.averaged_matrix("observed")
    elsewhere = matrix - np.diag(np.diag(matrix))
    likeliest = elsewhere.argmax(axis=1)
    nexts = [
        f"{state_name(likeliest[state])} ({_percent(elsewhere[state, likeliest[state]])})"
        for state in shown
    ]
    return [
        _Column("stays", [_percent(matrix[state, state]) for state in shown], ""),
        _Column("likeliest other next", nexts, ""),
    ]


def _numbers(head: str, values: NDArray[np.float64], shown: Sequence[int]) -> _Column:
    return _summed(head, values, shown, lambda value: f"{value:,.0f}")


def _shares(
    head: str, values: NDArray[np.float64], shown: Sequence[int], *, barred: bool = True
) -> _Column:
    column = _summed(head, values, shown, _percent)
    return column._replace(bars=values[list(shown)]) if barred else column


def _summed(
    head: str,
    values: NDArray[np.float64],
    shown: Sequence[int],
    show: Callable[[float], str],
) -> _Column:
    """A column whose last row is the sum of what has no row."""
    cells = [show(values[state]) for state in shown]
    return _Column(head, cells, show(np.delete(values, list(shown)).sum()))


def _value(number: float) -> str:
    return f"{number:.4g}".replace("-", "−")


def _percent(share: float) -> str:
    return "< 0.1 %" if 0.0 < share < 0.0005 else f"{100.0 * share:.1f} %"


# -- How it looks -----------------------------------------------------------------------------


def _head(thing: object, about: Sequence[str], details: str) -> str:
    head = f"<strong>{escape(type(thing).__name__)}</strong>: {escape(', '.join(about))}"
    return f"{head}<br><span style='opacity:.75'>{escape(details)}</span>" if details else head


def _html(head: str, shown: Sequence[int], n: int, columns: Sequence[_Column]) -> str:
    """A head, and a table with a row for each of the n states that is shown."""
    table = _table(shown, n, columns) if shown else ""
    return (
        f"<div style='max-width:100%;overflow-x:auto'><div style='margin:.3em 0'>{head}</div>"
        f"{table}</div>"
    )


def _table(shown: Sequence[int], n: int, columns: Sequence[_Column]) -> str:
    heads = "".join(
        f"<th scope='col' style='{_NUMBER}'>{escape(column.head)}</th>" for column in columns
    )
    rows = [
        _row(state_name(state), [_cell(column, row) for column in columns])
        for row, state in enumerate(shown)
    ]
    if n > len(shown):
        rows.append(_row(f"… and {n - len(shown)} more", [escape(each.rest) for each in columns]))
    return (
        "<table style='border-collapse:collapse;color:inherit;background:none'>"
        f"<thead><tr><th scope='col' style='{_TEXT}'>state</th>{heads}</tr></thead>"
        f"<tbody>{''.join(rows)}</tbody></table>"
    )


def _row(name: str, cells: Sequence[str]) -> str:
    inside = "".join(f"<td style='{_NUMBER}'>{cell}</td>" for cell in cells)
    return f"<tr><th scope='row' style='{_TEXT}'>{escape(name)}</th>{inside}</tr>"


def _cell(column: _Column, row: int) -> str:
    text = escape(column.cells[row])
    if column.bars is None:
        return text
    return (
        "<span aria-hidden='true' style='display:inline-block;width:6em;height:.7em;"
        "margin-right:.6em;text-align:left;background:rgba(128,128,128,.2)'>"
        f"<span style='display:block;width:{100.0 * column.bars[row]:.1f}%;height:100%;"
        f"background:currentColor;opacity:.7'></span></span>"
        f"<span style='display:inline-block;min-width:4.5em'>{text}</span>"
    )
