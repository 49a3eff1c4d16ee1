"""What is driven, as data: a leader ahead of whatever drives the follower."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from evofsm.driving.drivers import IDM, refuse_others
from evofsm.fsm.validation import Floats


@dataclass(frozen=True)
class CutIn:
    """Another car moves in at a ``time`` [s]: from then on it is the leader.

    ``gap`` is from bumper to bumper from the follower to it [m], ``speed`` its speed [m/s].
    """

    time: float
    gap: float
    speed: float

    def __post_init__(self) -> None:
        refuse_others(self, "cut-in's", "gap", "time speed")


@dataclass(frozen=True)
class Leader:
    """A leader on a free road who, once, may brake in full until standstill."""

    driver: IDM  #: how it drives before
    brake_decel: float  #: deceleration of the full brake [m/s²], positive
    brake_speed: float = math.inf  #: it brakes on reaching this speed [m/s] ...
    brake_time: float = math.inf  #: ... or at this time [s], whichever comes first
    initial_speed: float = 0.0  #: [m/s]
    #: From a time [s] on it accelerates so [m/s²] instead of by ``driver``; in order of time.
    waves: tuple[tuple[float, float], ...] = ()
    cut_in: CutIn | None = None  #: another car that takes its place

    def __post_init__(self) -> None:
        refuse_others(self, "leader's", "brake_decel", "initial_speed")
        for name in ("brake_speed", "brake_time"):
            if not getattr(self, name) >= 0.0:
                raise ValueError(f"leader's {name} is {getattr(self, name)}; it must be 0 or more")
        times = [time for time, _ in self.waves]
        if times != sorted(times) or not np.isfinite(np.ravel(self.waves)).all():
            raise ValueError(f"leader's waves are {self.waves}; they must be finite, in order")


@dataclass(frozen=True)
class Body:
    """What the follower's body makes of a command.

    ``lowest`` and ``highest`` bound the realised acceleration [m/s²], ``delay`` is the time from a
    command to its effect [s], ``jerk`` the fastest change of the realised acceleration [m/s³].
    """

    lowest: float = -math.inf
    highest: float = math.inf
    delay: float = 0.0
    jerk: float = math.inf

    def __post_init__(self) -> None:
        if not self.lowest < self.highest:
            raise ValueError(f"body's bounds are [{self.lowest}, {self.highest}]; lowest is first")
        refuse_others(self, "body's", "", "delay")
        if not self.jerk > 0.0:
            raise ValueError(f"body's jerk is {self.jerk}; it must be positive")


@dataclass(frozen=True)
class Sensors:
    """How well the follower sees.

    Standard deviations of the noise on the gap [m] and on both speeds [m/s], the age of what is
    seen (``delay``, [s]) and the seed of the noise.
    """

    gap_noise: float = 0.0
    speed_noise: float = 0.0
    delay: float = 0.0
    seed: int = 0

    def __post_init__(self) -> None:
        refuse_others(self, "sensors'", "", "gap_noise speed_noise delay")


@dataclass(frozen=True)
class Behind:
    """A third car, at first ``gap`` [m] behind the follower, from bumper to bumper."""

    driver: IDM
    gap: float

    def __post_init__(self) -> None:
        refuse_others(self, "the car behind's", "gap")


@dataclass(frozen=True)
class Scenario:
    """Cars on a straight road, from a given start until two collide or time is up."""

    leader: Leader
    initial_gap: float  #: from bumper to bumper [m]
    duration: float = 35.0  #: time that is driven at most [s]
    dt: float = 0.01  #: time of a step [s]
    initial_speed: float = 0.0  #: of the follower, and of the car behind it [m/s]
    body: Body = field(default_factory=Body)
    sensors: Sensors = field(default_factory=Sensors)
    behind: Behind | None = None

    def __post_init__(self) -> None:
        refuse_others(self, "scenario's", "initial_gap duration dt", "initial_speed")
        if self.duration < 2 * self.dt:
            times = f"scenario's duration is {self.duration} and its dt {self.dt}"
            raise ValueError(f"{times}; it must last two steps or more")

    @property
    def times(self) -> Floats:
        """(steps,) ndarray: when a full run is observed [s], as decimals: 0.07, not 7 * 0.01."""
        return np.round(np.arange(self.steps(self.duration)) * self.dt, 9)

    def steps(self, seconds: float) -> int:
        """How many steps that is, rounded."""
        return round(seconds / self.dt)


def steps_between(interval: float, dt: float) -> int:
    """How many steps lie between two decisions; a ValueError where they are no multiple."""
    steps = round(interval / dt)
    if steps < 1 or not math.isclose(steps * dt, interval):
        fault = f"no multiple of the simulation's step of {dt:g} s"
        raise ValueError(f"the interval between decisions is {interval:g} s, which is {fault}")
    return steps
