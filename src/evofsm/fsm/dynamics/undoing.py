"""An observation is learnt whole or not at all, whatever error or interrupt comes in between."""

from __future__ import annotations

from types import TracebackType
from typing import Any, TypeVar

import numpy as np

_Arrays = TypeVar("_Arrays", bound=tuple[Any, ...])


def side_by_side(arrays: _Arrays) -> _Arrays:
    """The same named tuple of arrays, which are now parts of one: that is copied at once.

    Examples
    --------
    >>> from typing import NamedTuple
    >>> Pair = NamedTuple("Pair", [("one", object), ("two", object)])
    >>> pair = side_by_side(Pair(np.zeros(2), np.ones((1, 2))))
    >>> pair.one.base
    array([0., 0., 1., 1.])
    """
    together = np.concatenate([np.ravel(array) for array in arrays])
    ends = np.cumsum([array.size for array in arrays]).tolist()
    parts = (
        together[end - array.size : end].reshape(array.shape)
        for array, end in zip(arrays, ends, strict=True)
    )
    return type(arrays)(*parts)


def held(thing: object) -> dict[str, Any]:
    """All that an object holds, by name, with arrays and lists of its own.

    What is in a list, or in other things, never changes in place.

    Examples
    --------
    >>> from evofsm import Dynamics
    >>> dynamics = Dynamics(n_actions=2)
    >>> before = held(dynamics)
    >>> dynamics.used[0, 0] = 7.0
    >>> before["used"].tolist()
    [[0.0, 0.0], [0.0, 0.0]]
    """
    return {name: _copied(value) for name, value in vars(thing).items()}


def _copied(value: Any) -> Any:
    if isinstance(value, np.ndarray | list):
        return value.copy()
    return side_by_side(value) if _is_side_by_side(value) else value


def _is_side_by_side(value: object) -> bool:
    return isinstance(value, tuple) and all(
        isinstance(part, np.ndarray) and part.base is not None for part in value
    )


class Whole:
    """Within it, an object learns; after an error or an interrupt it is as it was.

    Parameters
    ----------
    thing : object
        What changes in place in it, is in lists and in the arrays that are named.
    arrays : sequence of ndarray
        Some of its arrays.
    """

    __slots__ = ("_arrays", "_before", "_numbers", "_thing")

    def __init__(self, thing: object, *arrays: Any) -> None:
        self._thing = thing
        self._arrays = arrays

    def __enter__(self) -> None:
        self._numbers = [array.copy() for array in self._arrays]
        self._before = {
            name: value.copy() if type(value) is list else value
            for name, value in self._thing.__dict__.items()
        }

    def __exit__(
        self, kind: type[BaseException] | None, error: object, where: TracebackType | None
    ) -> None:
        if kind is not None:
            for array, numbers in zip(self._arrays, self._numbers, strict=True):
                array[:] = numbers
            self._thing.__dict__ = self._before
