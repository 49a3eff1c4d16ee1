"""The form in which a compiled world takes a driver: a kernel and its table of parameters."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

import numpy as np
from numba import types
from numpy.typing import NDArray

from evofsm.fsm import Function, compiled
from evofsm.guard import Proposal

#: ``kernel(parameters, time, gap, speed, leader_speed) -> acceleration``
DRIVER_KERNEL = types.float64(
    types.float64[:, ::1], types.float64, types.float64, types.float64, types.float64
)


def driver_kernel(function: Function) -> Function:
    """Compile such a kernel. It has a fixed signature, and so can be passed as a value."""
    return compiled(function, [DRIVER_KERNEL])


class Kernel(Protocol):
    """A compiled function from a situation to an acceleration."""

    def __call__(
        self,
        parameters: NDArray[np.float64],
        time: float,
        gap: float,
        speed: float,
        leader_speed: float,
        /,
    ) -> float:
        """Acceleration [m/s²]."""
        ...


@runtime_checkable
class CompiledController(Protocol):
    """A controller whose decisions a compiled world can take without calling Python."""

    kernel: Kernel

    @property
    def parameters(self) -> NDArray[np.float64]:
        """(rows, columns) ndarray, given to the kernel at every step."""
        ...

    def propose(self, observation: NDArray[np.float64], time: float = 0.0) -> Proposal:
        """As `evofsm.guard.protocols.Controller`, with the same result as the kernel."""
        ...
