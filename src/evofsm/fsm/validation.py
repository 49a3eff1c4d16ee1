"""Look at what users pass in, and refuse what cannot be right with the likely cause."""

from __future__ import annotations

import operator
from collections.abc import Callable
from contextlib import suppress
from copy import copy
from operator import attrgetter
from typing import Any, SupportsFloat, SupportsIndex, TypeAlias, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from evofsm.store import LARGEST_OBSERVATION

Floats: TypeAlias = NDArray[np.float64]
_F = TypeVar("_F")

# NumPy is quicker for longer vectors.
_SHORT = 16
_ENCODE = "IntervalActions.encode turns a number into one"


# -- States and actions are counted from 0 in code and data, and from 1 in what people read -------


def state_name(index: int) -> str:
    """A state as people read it: #4 for 3."""
    return f"#{index + 1}"


def action_name(index: int) -> str:
    """An action as people read it, as in the paper: a(17) for 16."""
    return f"a({index + 1})"


def counted(number: int, noun: str) -> str:
    """Such as "1 episode" and "1,200 episodes"."""
    return f"{number:,} {noun}{'s' * (number != 1)}"


def check_index(what: str, i: Any, n: int, name: Callable[[int], str] = str) -> int:
    """An index of one of ``n`` things, which texts call by their ``name``."""
    try:
        index = operator.index(i)
    except TypeError:
        hint = "from 0" if what == "state" else f"from 0 ({_ENCODE})"
        raise TypeError(f"{what} is {i!r}; it must be an integer index, {hint}") from None
    if not 0 <= index < n:
        note = "" if name is str else f", which texts call {name(0)} to {name(n - 1)}"
        there = f"{what}s 0 to {n - 1}{note}" if n else f"no {what}s yet"
        raise ValueError(f"{what} is {index}; there are {there}")
    return index


def check_action(i: Any, n_actions: int) -> int:
    """An index of one of the actions."""
    return check_index("action", i, n_actions, action_name)


def function(name: str, value: _F, such_as: str) -> _F:
    """The function, or None; a TypeError for anything else."""
    if value is not None and not callable(value):
        raise TypeError(f"{name} is {value!r}; it must be a function, such as {name}={such_as}")
    return value


def setting(name: str, check: Callable[[str, Any], Any], doc: str) -> Any:
    """A property that is what ``check`` makes of what it is set to, or refuses."""

    def change(owner: Any, value: Any) -> None:
        setattr(owner, f"_{name}", check(name, value))

    return property(attrgetter(f"_{name}"), change, doc=doc)


def ask(name: str, function: Callable[..., Any], kind: Callable[[Any], _F], *at: Any) -> _F:
    """What a function that was given says, which may work in place, as what it has to be."""
    try:
        return kind(function(*map(copy, at)))
    except Exception as error:
        place = ", ".join(map(str, at))
        error.add_note(f"{name} was asked of {place}; it is asked near what was observed, too")
        raise


def positive(name: str, value: SupportsFloat) -> float:
    """A positive, finite number."""
    with suppress(TypeError, ValueError):
        if not isinstance(value, str) and 0.0 < float(value) < float("inf"):
            return float(value)
    raise ValueError(f"{name} is {value!r}; it must be a positive, finite number")


def number(name: str, value: object, hint: str = "") -> float:
    """A number, whatever its size; a text is none, though `float` would read "1.5"."""
    if isinstance(value, SupportsFloat):
        with suppress(TypeError, ValueError):
            return float(value)
    raise TypeError(f"{name} is {value!r}; it must be a number{hint}")


def truth(name: str, value: Any) -> bool:
    """True or False, NumPy's as well."""
    if np.ndim(value) or np.asarray(value).dtype != np.bool_:
        raise TypeError(f"{name} is {value!r}; it must be True or False, of one environment")
    return bool(value)


def probability(name: str, value: SupportsFloat) -> float:
    """A number between 0 and 1, neither included."""
    if positive(name, value) >= 1.0:
        raise ValueError(f"{name} is {value}; it must lie below 1")
    return float(value)


def whole(name: str, value: SupportsIndex) -> int:
    """A positive integer."""
    try:
        number = operator.index(value)
    except TypeError:
        number = 0
    if number < 1:
        raise ValueError(f"{name} is {value!r}; it must be a positive integer")
    return number


def real_array(name: str, values: ArrayLike, ndim: int, *, copy: bool = True) -> Floats:
    """Real numbers with ``ndim`` axes, the last one not empty; a new array unless told not to."""
    array = _array(name, values)
    if array.dtype.kind not in "fiub":
        hint = "is there a text, a None or a complex number among them?"
        raise TypeError(f"{name} has dtype {array.dtype}; it must hold real numbers ({hint})")
    if array.ndim != ndim or 0 in array.shape[-1:]:
        shape = "(variables,)" if ndim == 1 else "(rows, variables)"
        raise ValueError(f"{name} has shape {array.shape}; it must be {shape}, not empty")
    return np.array(array, np.float64, order="C", copy=copy or None)


def _array(name: str, values: Any) -> NDArray[Any]:
    """An array, NaN where a mask hides a number, which NumPy would take as it is."""
    if type(values) is np.ndarray:
        return values
    try:
        if isinstance(values, list | tuple) and any(map(np.ma.is_masked, values)):
            values = np.ma.array(values)
        if np.ma.is_masked(values):
            values = values.astype(np.float64).filled(np.nan)
        return np.asarray(values)
    except ValueError:
        raise ValueError(f"{name}: rows have different lengths") from None


def refuse_unusable(name: str, values: Floats) -> None:
    """Raise for the first entry that is not finite, or too large."""
    most = LARGEST_OBSERVATION
    if values.ndim == 1 and len(values) <= _SHORT:
        if all([-most <= value <= most for value in values.tolist()]):  # noqa: C419
            return
    elif not values.size or -most <= values.min() <= values.max() <= most:  # false of NaN
        return
    place = tuple(int(k) for k in np.argwhere(~(np.abs(values) <= most))[0])
    where = f"row {place[0]}, variable {place[1]}" if len(place) > 1 else f"variable {place[0]}"
    need = f"every entry must be finite and at most {most:g} in size (a missing sensor value?)"
    raise ValueError(f"{name}, {where}: {values[place]} cannot be used; {need}")


def usable_array(name: str, values: ArrayLike) -> Floats:
    """Real numbers in a new array with one axis, none of them infinite, NaN or too large."""
    refuse_unusable(name, array := real_array(name, values, 1))
    return array


def refuse_unless_distribution(name: str, rows: Floats) -> None:
    """Raise unless every row, along the last axis, has no entry below 0 and sums to 1."""
    if not ((rows >= 0.0).all() and (np.abs(rows.sum(axis=-1) - 1.0) < 1e-6).all()):
        raise ValueError(f"{name} is no distribution: entries must be 0 or more and sum to 1")


def check_actions(indices: ArrayLike, rows: int, n_actions: int) -> NDArray[np.int64]:
    """An index for each row, or -1 for none."""
    actions = _array("actions", indices)
    if actions.shape != (rows,):
        raise ValueError(f"actions have shape {actions.shape}; {rows} observations need ({rows},)")
    if rows and actions.dtype.kind not in "iu":
        need = f"they must be integer indices, none of them masked ({_ENCODE})"
        raise TypeError(f"actions have dtype {actions.dtype}; {need}")
    if len(wrong := np.flatnonzero((actions < -1) | (actions >= n_actions))):
        there = f"there are actions 0 to {n_actions - 1}, and -1 for none"
        raise ValueError(f"action in row {wrong[0]} is {actions[wrong[0]]}; {there}")
    return actions.astype(np.int64)


def check_rows(name: str, numbers: ArrayLike, rows: int) -> NDArray[np.bool_]:
    """Mark the rows that are named."""
    array = _array(name, numbers)
    if array.size and array.dtype.kind not in "iu":
        raise TypeError(f"{name} has dtype {array.dtype}; it must hold row numbers, none masked")
    if (wrong := array[(array < 0) | (array >= rows)]).size:
        raise ValueError(f"{name} names row {wrong[0]}, but there are {rows} rows")
    marks = np.zeros(rows, np.bool_)
    marks[array.astype(np.int64)] = True
    return marks
