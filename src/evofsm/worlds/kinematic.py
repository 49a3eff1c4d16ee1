"""Two points on a line: SUMO's ballistic update in closed form, compiled.

For sweeps of many settings. SUMO is the referee: both agree within 1e-9 at every step.
"""

from __future__ import annotations

import numba
import numpy as np
from numba import types
from numpy.typing import NDArray

from evofsm.drivers.compiled import DRIVER_KERNEL, CompiledController, Kernel
from evofsm.protocols import Controller
from evofsm.worlds.episode import Episode, drive, refuse_non_number
from evofsm.worlds.scenario import Scenario


class KinematicWorld:
    """The closed-form world.

    A controller with a kernel (`evofsm.drivers.compiled`) is driven without leaving compiled
    code; any other is asked once a step, with the same result.

    Examples
    --------
    >>> from evofsm.drivers.idm import IDM
    >>> from evofsm.worlds.scenario import Leader, Scenario
    >>> leader = Leader(IDM(1.2, 25.0, 1.0, 1.0, 2.5), brake_decel=9.0, brake_speed=24.2)
    >>> hasty = IDM(2.25, 28.0, 0.8, 0.3, 2.0, lowest=-4.0, highest=2.5)
    >>> episode = KinematicWorld().run(Scenario(leader, initial_gap=5.0), hasty)
    >>> episode.collided, round(float(episode.time[-1]), 2)
    (True, 31.49)
    """

    def run(self, scenario: Scenario, controller: Controller) -> Episode:
        """Drive the scenario with ``controller`` in the follower."""
        if not isinstance(controller, CompiledController):
            return drive(_Road(scenario.initial_gap, scenario.dt), scenario, controller)
        leader = scenario.leader
        times = scenario.times
        record = np.empty((len(times), 5))
        rows = _drive(
            controller.kernel,
            controller.parameters,
            leader.driver.kernel,
            leader.driver.parameters,
            np.array([leader.brake_decel, leader.brake_speed, leader.brake_time]),
            scenario.initial_gap,
            scenario.dt,
            times,
            record,
        )
        record = record[:rows]
        refuse_non_number(record[-1, 3], times[rows - 1], record[-1, 0])  # which ended the run
        return Episode(
            times[:rows],
            np.ascontiguousarray(record[:, :3]),
            record[:, 3].copy(),
            record[:, 4].copy(),
        )


def _move(position: float, speed: float, acceleration: float, dt: float) -> tuple[float, float]:
    """Position and speed one step later; no one drives backwards."""
    reached = max(0.0, speed + acceleration * dt)
    return position + 0.5 * (speed + reached) * dt, reached


_move_kernel = numba.njit(cache=True)(_move)


class _Road:
    """The road as Python steps along it."""

    def __init__(self, initial_gap: float, dt: float) -> None:
        self.dt = dt
        self.position, self.speed = 0.0, 0.0
        self.leader_position, self.leader_speed = initial_gap, 0.0

    def observe(self) -> tuple[float, float, float]:
        return self.leader_position - self.position, self.speed, self.leader_speed

    def advance(self, acceleration: float, leader_acceleration: float) -> None:
        self.position, self.speed = _move(self.position, self.speed, acceleration, self.dt)
        self.leader_position, self.leader_speed = _move(
            self.leader_position, self.leader_speed, leader_acceleration, self.dt
        )


_SERIES = types.float64[::1]
_TABLE = types.float64[:, ::1]
_DRIVER = types.FunctionType(DRIVER_KERNEL)


@numba.njit(
    types.int64(
        *(_DRIVER, _TABLE, _DRIVER, _TABLE, _SERIES),
        *(types.float64, types.float64, _SERIES, _TABLE),
    ),
    cache=True,
)
def _drive(
    driver: Kernel,
    parameters: NDArray[np.float64],
    leader_driver: Kernel,
    leader_parameters: NDArray[np.float64],
    brake: NDArray[np.float64],
    initial_gap: float,
    dt: float,
    times: NDArray[np.float64],
    record: NDArray[np.float64],
) -> int:
    """`evofsm.worlds.episode.drive` for compiled drivers; answers the number of rows.

    A row of ``record`` holds the observation and both accelerations.
    """
    position, speed = 0.0, 0.0
    leader_position, leader_speed = initial_gap, 0.0
    braking = False
    rows = 0
    while rows < len(record):
        time = times[rows]
        gap = leader_position - position
        acceleration = driver(parameters, time, gap, speed, leader_speed)
        braking = braking or leader_speed >= brake[1] or time >= brake[2]
        if braking:
            leader_acceleration = -brake[0]
        else:
            leader_acceleration = leader_driver(leader_parameters, time, np.inf, leader_speed, 0.0)
        record[rows, 0] = gap
        record[rows, 1] = speed
        record[rows, 2] = leader_speed
        record[rows, 3] = acceleration
        record[rows, 4] = leader_acceleration
        rows += 1
        if gap <= 0.0 or not np.isfinite(acceleration):
            break
        position, speed = _move_kernel(position, speed, acceleration, dt)
        leader_position, leader_speed = _move_kernel(
            leader_position, leader_speed, leader_acceleration, dt
        )
    return rows
