"""A run on any road: what was recorded, what the follower sees of it, and who drives."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from evofsm.driving.worlds.motion import (
    COMMANDED,
    GAP,
    GAP_BEHIND,
    LEADER_ACCELERATION,
    LEADER_SPEED,
    RUN_COLUMNS,
    SPEED,
    SPEED_BEHIND,
    is_over,
    plan_of,
)
from evofsm.driving.worlds.scenario import Scenario
from evofsm.guard import Controller


@dataclass(frozen=True, eq=False)
class Episode:
    """One run, a row every ``dt``; the last row of a collision is the first gap of 0 or less."""

    time: NDArray[np.float64]  #: (T,) [s]
    record: NDArray[np.float64]  #: (T, 9) the columns of `evofsm.driving.worlds.motion.RUN_COLUMNS`

    @property
    def observations(self) -> NDArray[np.float64]:
        """(T, 3) ndarray: gap [m], v_follower [m/s], v_leader [m/s], as they truly were."""
        return np.ascontiguousarray(self.record[:, [GAP, SPEED, LEADER_SPEED]])

    @property
    def accelerations(self) -> NDArray[np.float64]:
        """(T,) ndarray: commanded to the follower after each row [m/s²]."""
        return self.record[:, COMMANDED].copy()

    @property
    def leader_accelerations(self) -> NDArray[np.float64]:
        """(T,) ndarray: commanded to the leader after each row [m/s²]."""
        return self.record[:, LEADER_ACCELERATION].copy()

    @property
    def realised(self) -> NDArray[np.float64]:
        """(T,) ndarray: what the follower did after each row [m/s²]; NaN after the last.

        It differs from what was commanded where the body could not follow, or the car came to a
        standstill.
        """
        change = np.diff(self.record[:, SPEED], append=np.nan)
        return change / np.diff(self.time, append=np.nan)

    @property
    def collided(self) -> bool:
        """Whether the run ended in a collision with the leader."""
        return bool(self.record[-1, GAP] <= 0.0)

    @property
    def rear_ended(self) -> bool:
        """Whether the car behind ran into the follower."""
        return bool(self.record[-1, GAP_BEHIND] <= 0.0)


class Road(ABC):
    """Cars under way in one run of a scenario, moved some steps at a time.

    Whoever drives asks `observation`, then tells `advance` what to do. The run is `over` with the
    row in which two cars met, or with the last; `advance` then only records what was commanded.
    """

    def __init__(self, scenario: Scenario) -> None:
        self.scenario = scenario
        self.row = 0
        self._plan = plan_of(scenario)
        self._record = np.zeros((len(self._plan.times), len(RUN_COLUMNS)))
        self._noise = _noise(scenario, len(self._record))
        self._delay = scenario.steps(scenario.sensors.delay)
        behind = scenario.behind
        start = self._record[0]
        start[GAP], start[GAP_BEHIND] = scenario.initial_gap, behind.gap if behind else math.inf
        start[SPEED] = start[SPEED_BEHIND] = scenario.initial_speed
        start[LEADER_SPEED] = scenario.leader.initial_speed

    @abstractmethod
    def advance(self, command: float, steps: int = 1) -> None:
        """Drive some steps with this acceleration commanded to the follower [m/s²]."""

    @property
    def time(self) -> float:
        """Now [s]."""
        return float(self._plan.times[self.row])

    @property
    def observation(self) -> NDArray[np.float64]:
        """(3,) ndarray: gap [m], v_follower [m/s], v_leader [m/s], as the follower sees them."""
        seen = self._record[max(0, self.row - self._delay), [GAP, SPEED, LEADER_SPEED]]
        if self._noise is not None:
            seen = seen + self._noise[self.row]
            seen[1:] = np.maximum(seen[1:], 0.0)
        return seen

    @property
    def over(self) -> bool:
        """Whether the run ends with this row."""
        return is_over(self._record, self.row)

    @property
    def collided(self) -> bool:
        """Whether the follower has hit the leader."""
        return bool(self._record[self.row, GAP] <= 0.0)

    @property
    def rear_ended(self) -> bool:
        """Whether the car behind has hit the follower."""
        return bool(self._record[self.row, GAP_BEHIND] <= 0.0)

    @property
    def realised(self) -> float:
        """What the follower did in the latest step [m/s²]; NaN before the first."""
        if self.row == 0:
            return math.nan
        now, before = self._record[self.row, SPEED], self._record[self.row - 1, SPEED]
        return float((now - before) / self.scenario.dt)

    def episode(self, first: int = 0) -> Episode:
        """What was recorded so far, from a row on."""
        rows = slice(first, self.row + 1)
        return Episode(self._plan.times[rows], self._record[rows].copy())


class World(Protocol):
    """A place to drive in."""

    def open(self, scenario: Scenario) -> AbstractContextManager[Road]:
        """Put the cars on a road, for use in a ``with`` statement."""
        ...

    def run(self, scenario: Scenario, controller: Controller) -> Episode:
        """Drive the scenario with ``controller`` in the follower, asked at every step."""
        ...


def drive(road: Road, controller: Controller, steps: int = 1) -> Episode:
    """Ask the controller every so many steps, until time is up or the cars collide."""
    over = False
    while not over:
        over = road.over
        observation, time = road.observation, road.time
        acceleration = float(controller.propose(observation, time).action)
        refuse_non_number(acceleration, time, observation[0])
        road.advance(acceleration, steps)
    return road.episode()


def refuse_non_number(acceleration: float, time: float, gap: float) -> None:
    """Raise where a controller proposed NaN or infinity."""
    if not math.isfinite(acceleration):
        raise ValueError(f"controller proposed {acceleration} at {time:g} s, gap {gap:g} m")


def _noise(scenario: Scenario, rows: int) -> NDArray[np.float64] | None:
    """(rows, 3) what the sensors add; None for nothing."""
    sensors = scenario.sensors
    if sensors.gap_noise == 0.0 and sensors.speed_noise == 0.0:
        return None
    deviation = np.array([sensors.gap_noise, sensors.speed_noise, sensors.speed_noise])
    return np.random.default_rng(sensors.seed).normal(scale=deviation, size=(rows, 3))
