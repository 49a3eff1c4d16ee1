"""The loop that drives a scenario on any road, and the record it leaves."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from evofsm.protocols import Controller
from evofsm.worlds.scenario import Scenario

#: The columns of an observation, and their units.
VARIABLES = ("gap", "v_follower", "v_leader")
UNITS = ("m", "m/s", "m/s")


@dataclass(frozen=True, eq=False)
class Episode:
    """One run, a row every ``dt``; the last row of a collision is the first gap of 0 or less."""

    time: NDArray[np.float64]  #: (T,) [s]
    observations: NDArray[np.float64]  #: (T, 3) gap [m], v_follower [m/s], v_leader [m/s]
    accelerations: NDArray[np.float64]  #: (T,) commanded to the follower after each row [m/s²]
    leader_accelerations: NDArray[np.float64]  #: (T,) commanded to the leader [m/s²]

    @property
    def realised(self) -> NDArray[np.float64]:
        """(T,) ndarray: what the follower did after each row [m/s²]; NaN after the last.

        It differs from what was commanded where the car came to a standstill.
        """
        change = np.diff(self.observations[:, 1], append=np.nan)
        return change / np.diff(self.time, append=np.nan)

    @property
    def collided(self) -> bool:
        """Whether the run ended in a collision."""
        return bool(self.observations[-1, 0] <= 0.0)


class World(Protocol):
    """A place to drive in."""

    def run(self, scenario: Scenario, controller: Controller) -> Episode:
        """Drive the scenario with ``controller`` in the follower."""
        ...


class Road(Protocol):
    """Two cars, moved one step at a time."""

    def observe(self) -> tuple[float, float, float]:
        """Gap [m], speed of the follower and of the leader [m/s]."""
        ...

    def advance(self, acceleration: float, leader_acceleration: float) -> None:
        """Move both cars by one step under these accelerations [m/s²]."""
        ...


def refuse_non_number(acceleration: float, time: float, gap: float) -> None:
    """Raise where a controller proposed NaN or infinity."""
    if not math.isfinite(acceleration):
        raise ValueError(f"controller proposed {acceleration} at {time:g} s, gap {gap:g} m")


def drive(road: Road, scenario: Scenario, controller: Controller) -> Episode:
    """Drive a scenario step by step, until time is up or the cars collide."""
    leader = scenario.leader
    times = scenario.times
    observations = np.empty((len(times), 3))
    accelerations = np.empty(len(times))
    leader_accelerations = np.empty(len(times))
    braking = False
    for row, time in enumerate(times.tolist()):
        observation = observations[row]
        observation[:] = gap, _, leader_speed = road.observe()
        acceleration = float(controller.propose(time, observation.copy()))
        refuse_non_number(acceleration, time, gap)
        braking = braking or leader_speed >= leader.brake_speed or time >= leader.brake_time
        if braking:
            leader_acceleration = -leader.brake_decel
        else:
            free_road = np.array([math.inf, leader_speed, 0.0])
            leader_acceleration = leader.driver.propose(time, free_road)
        accelerations[row] = acceleration
        leader_accelerations[row] = leader_acceleration
        if gap <= 0.0:
            break
        road.advance(acceleration, leader_acceleration)
    rows = row + 1
    return Episode(
        times[:rows], observations[:rows], accelerations[:rows], leader_accelerations[:rows]
    )
