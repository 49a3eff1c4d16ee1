"""The memory of a machine, for rooms that work on it themselves: fleets, merging, long logs.

Whoever does this keeps what `EvolvingFSM` promises: one stream at a time, and nothing half done.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from evofsm.fsm.learnt import Learnt
from evofsm.fsm.machine import EvolvingFSM
from evofsm.fsm.memory import Memory
from evofsm.fsm.step import Limit


class Inside:
    """The flat buffer of a machine, and what is done with it.

    Parameters
    ----------
    machine : EvolvingFSM

    Examples
    --------
    >>> inside = Inside(EvolvingFSM(n_actions=2))
    >>> len(inside.check([[0.0], [0.1]])), inside.buffer.dtype.name
    (2, 'float64')
    """

    def __init__(self, machine: EvolvingFSM) -> None:
        self.machine = machine

    @property
    def buffer(self) -> NDArray[np.float64]:
        """(N,) ndarray: all that the machine holds; another one after it has grown."""
        return self.machine._buffer

    @property
    def memory(self) -> Memory:
        """Views of the buffer, by name."""
        return self.machine._memory

    @property
    def limit(self) -> Limit:
        """Number of states that kernels are compiled for; None without one."""
        return self.machine._limit

    @property
    def capacity(self) -> int:
        """Number of states that there is room for."""
        return self.machine._capacity

    def check(self, observations: ArrayLike) -> NDArray[np.float64]:
        """(T, m) ndarray: rows that can be learnt, or an error that names the first that cannot."""
        rows = self.machine._check_observations(observations)
        if len(rows):
            self.machine._fit(rows[0])
        return rows

    def grow(self) -> None:
        """Make room for what the next step may need."""
        self.machine._grow()

    def use(self, buffer: NDArray[np.float64]) -> None:
        """Go on with another buffer."""
        self.machine._use(buffer)

    def trimmed(self) -> Learnt:
        """A copy of all that was learnt, without spare room."""
        return self.machine._trimmed()

    def holding(self, arrays: Mapping[str, NDArray[Any]]) -> EvolvingFSM:
        """Return a machine of the same settings that has learnt these arrays, by their names."""
        return self.machine._holding(arrays)
