"""An observation is learnt whole or not at all, whatever error or interrupt comes in between."""

from __future__ import annotations

from types import TracebackType
from typing import Any

import numpy as np


def held(thing: object) -> dict[str, Any]:
    """All that an object holds, by name; what is changed in place as it learns is copied.

    That are arrays, lists (but not what is in them), and named tuples of arrays.

    Examples
    --------
    >>> from evofsm import Dynamics
    >>> dynamics = Dynamics(n_actions=2)
    >>> before = held(dynamics)
    >>> dynamics.used[0, 0] = 7.0
    >>> before["used"][0, 0]
    np.float64(0.0)
    """
    return {name: _copied(value) for name, value in vars(thing).items()}


def _copied(value: Any) -> Any:
    if isinstance(value, np.ndarray | list):
        return value.copy()
    if isinstance(value, tuple) and value and isinstance(value[0], np.ndarray):
        return type(value)(*(v.copy() if isinstance(v, np.ndarray) else v for v in value))
    return value


class Whole:
    """Within it, an object learns; after an error or an interrupt it is as it was.

    Parameters
    ----------
    thing : object
        Holds what `held` copies.
    """

    __slots__ = ("_before", "_thing")

    def __init__(self, thing: object) -> None:
        self._thing = thing

    def __enter__(self) -> None:
        self._before = held(self._thing)

    def __exit__(
        self, kind: type[BaseException] | None, error: object, where: TracebackType | None
    ) -> None:
        if kind is not None:
            self._thing.__dict__ = self._before
