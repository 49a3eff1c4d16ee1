"""What is driven, as data: a leader ahead of whatever drives the follower."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from evofsm.drivers.idm import IDM


@dataclass(frozen=True)
class Leader:
    """A leader on a free road who, once, brakes in full until standstill.

    Parameters
    ----------
    driver : IDM
        How it drives before.
    brake_decel : float
        Deceleration of the full brake [m/s²], positive.
    brake_speed : float
        It brakes on reaching this speed [m/s] ...
    brake_time : float
        ... or at this time [s], whichever comes first.
    """

    driver: IDM
    brake_decel: float
    brake_speed: float = math.inf
    brake_time: float = math.inf

    def __post_init__(self) -> None:
        if not 0.0 < self.brake_decel < math.inf:
            raise ValueError(
                f"leader's brake_decel is {self.brake_decel}; it must be positive and finite"
            )
        for name in ("brake_speed", "brake_time"):
            if not getattr(self, name) >= 0.0:
                raise ValueError(f"leader's {name} is {getattr(self, name)}; it must be 0 or more")


@dataclass(frozen=True)
class Scenario:
    """Two cars on a straight road, from a given start until they collide or time is up.

    Parameters
    ----------
    leader : Leader
    initial_gap : float
        From bumper to bumper [m].
    duration : float
        Time that is driven at most [s].
    dt : float
        Time of a step [s].
    """

    leader: Leader
    initial_gap: float
    duration: float = 35.0
    dt: float = 0.01

    def __post_init__(self) -> None:
        for name in ("initial_gap", "duration", "dt"):
            value = getattr(self, name)
            if not 0.0 < value < math.inf:
                raise ValueError(f"scenario's {name} is {value}; it must be positive and finite")
        if self.duration < 2 * self.dt:
            raise ValueError(
                f"scenario's duration is {self.duration} and its dt {self.dt}; "
                "it must last two steps or more"
            )

    @property
    def times(self) -> NDArray[np.float64]:
        """(steps,) ndarray: when a full run is observed [s], as decimals: 0.07, not 7 * 0.01."""
        return np.round(np.arange(round(self.duration / self.dt)) * self.dt, 9)
