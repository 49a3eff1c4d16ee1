"""Who drives the follower: the Intelligent Driver Model, within explicit bounds.

SUMO's own IDM brakes as hard as its ``emergencyDecel`` allows, and then never collides. What a
vehicle can really do is part of the question here, so the bounds are arguments.
"""

from __future__ import annotations

import math
from dataclasses import astuple, dataclass
from functools import cached_property
from typing import Any

import numpy as np

from evofsm.fsm.kernels import compiled
from evofsm.fsm.validation import Floats
from evofsm.guard import Proposal


def refuse_others(settings: object, whose: str, positive: str, not_negative: str = "") -> None:
    """Raise where a field is not positive and finite, or of others not 0 or more and finite."""
    for name in (*positive.split(), *not_negative.split()):
        value, may_be_zero = getattr(settings, name), name in not_negative.split()
        if not 0.0 <= value < math.inf or (value == 0.0 and not may_be_zero):
            must = "finite, 0 or more" if may_be_zero else "positive and finite"
            raise ValueError(f"{whose} {name} is {value}; it must be {must}")


@compiled
def idm_kernel(phases: Floats, time: float, gap: float, speed: float, leader_speed: float) -> float:
    """The paper's IDM equations, by the last phase that has begun."""
    now = 0
    while now + 1 < len(phases) and phases[now + 1, 0] <= time:
        now += 1
    accel, desired_speed, min_gap = phases[now, 1], phases[now, 2], phases[now, 3]
    time_headway, decel, exponent = phases[now, 4], phases[now, 5], phases[now, 6]
    approach_gap = speed * (speed - leader_speed) / (2.0 * math.sqrt(accel * decel))
    desired_gap = min_gap + max(0.0, speed * time_headway + approach_gap)
    # A gap of 0 or less is a collision, beyond the model: brake as hard as the bounds allow.
    interaction = (desired_gap / gap) ** 2 if gap > 0.0 else np.inf
    acceleration = accel * (1.0 - (speed / desired_speed) ** exponent - interaction)
    return float(min(max(acceleration, phases[now, 7]), phases[now, 8]))


class _Driver:
    @cached_property
    def parameters(self) -> Floats:
        """(k, 9) ndarray: of each phase its begin [s], then the arguments of `IDM` in order."""
        phases: Any = ((0.0, self),)
        if isinstance(self, ChangingIDM):
            phases = ((0.0, self.first), *self.changes)
        return np.array([[at, *astuple(driver)] for at, driver in phases])

    def propose(self, observation: Floats, time: float = 0.0) -> Proposal:
        """Acceleration [m/s²] for ``[gap, v_follower, v_leader]`` at ``time`` [s]."""
        return Proposal(idm_kernel(self.parameters, float(time), *map(float, observation)))


@dataclass(frozen=True)
class IDM(_Driver):
    """A car follower by the Intelligent Driver Model (Treiber, Hennecke, Helbing 2000).

    Examples
    --------
    >>> IDM(1.25, 25.0, 2.0, 1.5, 2.0).propose(np.array([np.inf, 0.0, 0.0])).action
    1.25
    >>> IDM(1.25, 25.0, 2.0, 1.5, 2.0, lowest=-4.0).propose(np.array([5.0, 20.0, 0.0])).action
    -4.0
    """

    accel: float  #: desired maximum acceleration [m/s²]
    desired_speed: float  #: on a free road [m/s]
    min_gap: float  #: at standstill [m]
    time_headway: float  #: desired [s]
    decel: float  #: comfortable deceleration [m/s²], positive
    exponent: float = 4.0  #: how acceleration falls off towards the desired speed
    lowest: float = -math.inf  #: bounds of the acceleration that comes out [m/s²]
    highest: float = math.inf

    def __post_init__(self) -> None:
        refuse_others(self, "IDM", "accel desired_speed decel exponent", "min_gap time_headway")
        if not self.lowest < self.highest:
            raise ValueError(f"IDM bounds are [{self.lowest}, {self.highest}]; lowest comes first")


@dataclass(frozen=True)
class ChangingIDM(_Driver):
    """One driver who drives by one IDM and, from given times on, by others.

    Examples
    --------
    >>> calm, hasty = IDM(1.0, 25.0, 2.0, 1.5, 2.0), IDM(2.0, 28.0, 1.0, 0.5, 2.0)
    >>> driver = ChangingIDM(calm, ((10.0, hasty), (12.0, calm)))
    >>> free_road = np.array([np.inf, 0.0, 0.0])
    >>> [driver.propose(free_road, time).action for time in (9.99, 10.0, 12.0)]
    [1.0, 2.0, 1.0]
    """

    first: IDM
    changes: tuple[tuple[float, IDM], ...]  #: when [s], and how from then on, in order of time

    def __post_init__(self) -> None:
        times = [at for at, _ in self.changes]
        if not all(at >= 0.0 for at in times) or times != sorted(times):
            raise ValueError(f"the driver changes at {times} s; it must be 0 or later, in order")
