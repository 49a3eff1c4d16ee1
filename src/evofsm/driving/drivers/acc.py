"""Adaptive cruise control with a constant time gap, within explicit bounds.

The gap control that Milanés and Shladover (Transportation Research Part C 48, 2014,
doi:10.1016/j.trc.2014.09.001) identified in production cars, beside the speed control of Xiao,
Wang and van Arem (Transportation Research Record 2623, 2017, doi:10.3141/2623-01); the gains that
are preset are theirs. They switch between both by the range of the sensor; here the lower of the
two accelerations holds, which needs no memory and does not jump.
"""

from __future__ import annotations

import math
from dataclasses import astuple, dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from evofsm.driving.drivers.compiled import Kernel, driver_kernel
from evofsm.guard import Proposal


@driver_kernel
def acc_kernel(
    settings: NDArray[np.float64], time: float, gap: float, speed: float, leader_speed: float
) -> float:
    """The lower of speed control and gap control, within the bounds."""
    desired_speed = settings[0, 0]
    min_gap = settings[0, 1]
    time_headway = settings[0, 2]
    gap_gain = settings[0, 3]
    approach_gain = settings[0, 4]
    cruise_gain = settings[0, 5]
    cruise = cruise_gain * (desired_speed - speed)
    excess = gap - min_gap - time_headway * speed
    follow = gap_gain * excess + approach_gain * (leader_speed - speed)
    return float(min(max(min(cruise, follow), settings[0, 6]), settings[0, 7]))


@dataclass(frozen=True)
class AdaptiveCruise:
    """A car under adaptive cruise control: it keeps a time gap, or its set speed.

    With a leader ``a = gap_gain (gap - min_gap - time_headway v) + approach_gain (v_leader - v)``,
    on a free road ``a = cruise_gain (desired_speed - v)``; the lower one holds. The law is linear:
    it does not know how hard a leader may brake, and the bounds are all that limits it.

    Parameters
    ----------
    desired_speed : float
        Set speed [m/s].
    min_gap : float
        Gap at standstill [m].
    time_headway : float
        Time gap that is kept [s].
    gap_gain : float
        Of the gap's deviation [1/s²].
    approach_gain : float
        Of the difference of speeds [1/s].
    cruise_gain : float
        Of the set speed's deviation [1/s].
    lowest, highest : float
        Bounds of the acceleration that comes out [m/s²].

    Raises
    ------
    ValueError
        If a parameter is impossible.

    Examples
    --------
    >>> cruise = AdaptiveCruise(30.0, 2.0, 1.1, lowest=-3.5, highest=2.0)
    >>> cruise.propose(np.array([np.inf, 28.0, 0.0])).action  # a free road
    0.8
    >>> round(cruise.propose(np.array([20.0, 20.0, 18.0])).action, 3)  # too close, and closing
    -1.06
    >>> cruise.propose(np.array([5.0, 20.0, 0.0])).action
    -3.5
    """

    desired_speed: float
    min_gap: float
    time_headway: float
    gap_gain: float = 0.23
    approach_gain: float = 0.07
    cruise_gain: float = 0.4
    lowest: float = -math.inf
    highest: float = math.inf

    kernel: ClassVar[Kernel] = staticmethod(acc_kernel)

    def __post_init__(self) -> None:
        for name in ("desired_speed", "gap_gain", "cruise_gain"):
            if not 0.0 < getattr(self, name) < math.inf:
                raise ValueError(
                    f"ACC {name} is {getattr(self, name)}; it must be positive and finite"
                )
        for name in ("min_gap", "time_headway", "approach_gain"):
            if not 0.0 <= getattr(self, name) < math.inf:
                raise ValueError(
                    f"ACC {name} is {getattr(self, name)}; it must be finite, 0 or more"
                )
        if not self.lowest < self.highest:
            raise ValueError(f"ACC bounds are [{self.lowest}, {self.highest}]; lowest comes first")

    @cached_property
    def parameters(self) -> NDArray[np.float64]:
        """(1, 8) ndarray: the arguments in order."""
        return np.array([astuple(self)])

    def propose(self, observation: NDArray[np.float64], time: float = 0.0) -> Proposal:
        """Acceleration [m/s²] for ``[gap, v_follower, v_leader]``; the time does not matter."""
        return Proposal(self.kernel(self.parameters, time, *observation))
