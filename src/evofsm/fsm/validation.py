"""Look at what users pass in, and refuse what cannot be right with the likely cause."""

from __future__ import annotations

import operator
from collections.abc import Mapping
from typing import Any, SupportsFloat, SupportsIndex

import numpy as np
from numpy.typing import ArrayLike, NDArray

from evofsm.store import LARGEST_OBSERVATION

# Cases, and failures among them.
_OUTCOMES = (("decisions", "failures"), ("episodes", "failed_soon"), ("tried", "failed_after"))


# NumPy is quicker for longer vectors.
_SHORT = 16


# -- States and actions are counted from 0 in code and data, and from 1 in what people read -------


def state_name(index: int) -> str:
    """A state as people read it, counted from 1, by its index from 0.

    >>> state_name(3)
    '#4'
    """
    return f"#{index + 1}"


def action_name(index: int) -> str:
    """An action as people read it, counted from 1 as in the paper, by its index from 0.

    >>> action_name(16)
    'a(17)'
    """
    return f"a({index + 1})"


# -- Settings and numbers -------------------------------------------------------------------------


def positive(name: str, value: SupportsFloat) -> float:
    """A positive, finite number."""
    try:
        number = float("nan") if isinstance(value, str) else float(value)
    except (TypeError, ValueError):
        number = float("nan")
    if not 0.0 < number < float("inf"):
        raise ValueError(f"{name} is {value!r}; it must be a positive, finite number")
    return number


def whole(name: str, value: SupportsIndex) -> int:
    """A positive integer."""
    try:
        number = operator.index(value)
    except TypeError:
        number = 0
    if number < 1:
        raise ValueError(f"{name} is {value!r}; it must be a positive integer")
    return number


def real_array(name: str, values: ArrayLike, ndim: int) -> NDArray[np.float64]:
    """A new array of real numbers with ``ndim`` axes, the last one not empty.

    What is masked is NaN there: no more than any other missing value may it be guessed.
    """
    array = _array(name, values)
    if array.dtype.kind not in "fiub":
        raise TypeError(
            f"{name} has dtype {array.dtype}; it must hold real numbers "
            "(is there a text, a None or a complex number among them?)"
        )
    if array.ndim != ndim or array.shape[-1] == 0:
        wanted = "(variables,)" if ndim == 1 else "(rows, variables)"
        raise ValueError(f"{name} has shape {array.shape}; it must be {wanted}, not empty")
    numbers = array.astype(np.float64)
    if (masked := _masked(values)) is not None:
        numbers[masked] = np.nan
    return numbers


def real_rows(name: str, values: ArrayLike) -> NDArray[np.float64]:
    """Rows of real numbers, without gaps in memory: those given where they are that already."""
    if not isinstance(values, np.ndarray) or values.dtype != np.float64:
        return real_array(name, values, ndim=2)
    if _is_masked(values):
        return real_array(name, values, ndim=2)
    if values.ndim != 2 or values.shape[1] == 0:
        return real_array(name, values, ndim=2)
    return np.ascontiguousarray(values)


def _array(name: str, values: ArrayLike) -> NDArray[Any]:
    try:
        return np.asarray(values)
    except ValueError:
        raise ValueError(f"{name}: rows have different lengths") from None


def _whole_array(name: str, values: ArrayLike) -> NDArray[Any]:
    masked = _masked(values)
    if masked is not None and masked.any():
        raise ValueError(f"{name} are masked in places; each one must be known")
    return _array(name, values)


def _is_masked(values: Any) -> bool:
    return type(values) is not np.ndarray and isinstance(values, np.ma.MaskedArray)


def _masked(values: ArrayLike) -> NDArray[np.bool_] | None:
    """Which entries a mask hides, in an array or in the rows of a list; None without a mask.

    NumPy itself takes the numbers under the mask, whatever they are.
    """
    rows = values if isinstance(values, list | tuple) else ()
    if _is_masked(values) or any(_is_masked(row) for row in rows):
        return np.ma.getmaskarray(np.ma.array(values))
    return None


def is_within(values: NDArray[np.float64], largest: float) -> bool:
    """Whether this is a short vector of numbers of at most that size: the quick way to ask it."""
    if values.ndim != 1 or not 0 < len(values) <= _SHORT:
        return False
    return all([-largest <= value <= largest for value in values.tolist()])  # noqa: C419


def refuse_unusable(name: str, values: NDArray[np.float64]) -> None:
    """Raise for the first entry that is not finite, or too large."""
    if (
        not values.size
        or is_within(values, LARGEST_OBSERVATION)
        or -LARGEST_OBSERVATION <= values.min() <= values.max() <= LARGEST_OBSERVATION
    ):
        return  # false of NaN
    usable = np.abs(values) <= LARGEST_OBSERVATION
    if not usable.all():
        place = tuple(int(k) for k in np.argwhere(~usable)[0])
        where = f"row {place[0]}, variable {place[1]}" if len(place) > 1 else f"variable {place[0]}"
        raise ValueError(
            f"{name}, {where}: {values[place]} cannot be used; every entry must be finite "
            f"and at most {LARGEST_OBSERVATION:g} in size (a missing sensor value?)"
        )


def refuse_unless_distribution(name: str, rows: NDArray[np.float64]) -> None:
    """Raise unless every row, along the last axis, has no entry below 0 and sums to 1."""
    if not ((rows >= 0.0).all() and (np.abs(rows.sum(axis=-1) - 1.0) < 1e-6).all()):
        raise ValueError(f"{name} is no distribution: entries must be 0 or more and sum to 1")


def refuse_more_failures(arrays: Mapping[str, NDArray[np.float64]]) -> None:
    """Raise where there are more failures than cases, in what has the outcomes by name."""
    for cases, failures in _OUTCOMES:
        if (arrays[failures] > arrays[cases]).any():
            raise ValueError(f"{failures} cannot be more than {cases}")


def check_action(i: SupportsIndex, n_actions: int) -> int:
    """An index of one of the actions."""
    try:
        index = operator.index(i)
    except TypeError:
        raise TypeError(
            f"action is {i!r}; it must be an integer index "
            "(IntervalActions.encode turns a number into one)"
        ) from None
    if not 0 <= index < n_actions:
        raise ValueError(
            f"action is {index}; there are actions 0 to {n_actions - 1}, which texts call "
            f"{action_name(0)} to {action_name(n_actions - 1)}"
        )
    return index


def check_state(state: Any, n_states: int) -> int:
    """An index of one of the states."""
    try:
        index = operator.index(state)
    except TypeError:
        raise TypeError(f"state is {state!r}; it must be an integer index, from 0") from None
    if not 0 <= index < n_states:
        raise ValueError(
            f"state is {index}; there are {n_states} states, from 0, which texts call "
            f"{state_name(0)}"
        )
    return index


def check_actions(indices: ArrayLike, rows: int, n_actions: int) -> NDArray[np.int64]:
    """An index for each row, or -1 for none."""
    actions = _whole_array("actions", indices)
    if actions.shape != (rows,):
        raise ValueError(f"actions have shape {actions.shape}; {rows} observations need ({rows},)")
    if rows and actions.dtype.kind not in "iu":
        raise TypeError(
            f"actions have dtype {actions.dtype}; they must be integer indices "
            "(IntervalActions.encode turns numbers into them)"
        )
    wrong = np.flatnonzero((actions < -1) | (actions >= n_actions))
    if len(wrong):
        raise ValueError(
            f"action in row {wrong[0]} is {actions[wrong[0]]}; "
            f"there are actions 0 to {n_actions - 1}, and -1 for none"
        )
    return actions.astype(np.int64)


def check_rows(name: str, numbers: ArrayLike, rows: int) -> NDArray[np.bool_]:
    """Mark the rows that are named."""
    given = _whole_array(name, numbers)
    if given.size and given.dtype.kind not in "iu":
        raise TypeError(f"{name} has dtype {given.dtype}; it must hold row numbers")
    wrong = given[(given < 0) | (given >= rows)]
    if wrong.size:
        raise ValueError(f"{name} names row {wrong[0]}, but there are {rows} rows")
    marked = np.zeros(rows, np.bool_)
    marked[given.astype(np.int64)] = True
    return marked
