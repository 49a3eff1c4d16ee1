"""The paper's rule: evolving Takagi-Sugeno (eTS) clustering, Sections 2.2.1 and 2.2.2.

An observation creates a state where the data seen so far is denser than at every existing
centre, or moves the nearest centre there. The more data vary, the wider states are recognised.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

from evofsm.fsm.kernels import inner_kernel
from evofsm.fsm.states.clusters import (
    CREATED,
    MOVED,
    UNCHANGED,
    exceeds,
)
from evofsm.fsm.validation import whole

CODE = 0


@dataclass(frozen=True)
class Paper:
    """The paper's rule, with the machine's radius, distance_weight and spread.

    An observation that is denser than every centre moves the nearest one if that is closer than
    ``radius``, else it creates a state. The width of recognition is ``spread`` times the total
    variance of all observations.

    Parameters
    ----------
    memory : int, optional
        Number of observations after which older ones fade, so that densities and variances are
        those of the recent past: for regimes that change. Without it, as in the paper, all count
        alike, and the more were seen the less a new one changes.

    Raises
    ------
    ValueError
        If ``memory`` is no whole number of at least 2.

    Examples
    --------
    >>> from evofsm import EvolvingFSM
    >>> machine = EvolvingFSM(n_actions=1, radius=0.5, rule=Paper())
    >>> machine.learn_many([[0.0], [0.1], [2.0], [1.0]], [0, 0, 0, 0]).n_states
    array([1, 1, 1, 2])
    """

    memory: int | None = None
    scales: ClassVar[Sequence[float]] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "memory", check_memory(self.memory))

    @property
    def table(self) -> Mapping[str, float]:
        """What the kernel judges by, in place of the machine's settings."""
        return {"code": CODE, "memory": self.memory or math.inf}


def check_memory(memory: int | None) -> int | None:
    """A number of observations that are remembered; None for all of them."""
    if memory is not None and (memory := whole("memory", memory)) < 2:
        raise ValueError("memory is 1; of one observation nothing can be said to vary")
    return memory


@inner_kernel
def judge(potential: float, highest: float, squared_distance: float, radius: float) -> int:
    """Leave the states as they are, move the nearest, or create one."""
    if not exceeds(potential, highest):
        return UNCHANGED
    return MOVED if exceeds(radius * radius, squared_distance) else CREATED


@inner_kernel
def width(spread: float, variance: float) -> float:
    """Width of recognition; the paper leaves its var(z*) open."""
    return spread * variance
