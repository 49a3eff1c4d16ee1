"""Points on a line: SUMO's ballistic update in closed form, compiled.

For sweeps of many settings. SUMO is the referee: both agree within 1e-9 at every step.
"""

from __future__ import annotations

import math
from contextlib import AbstractContextManager, nullcontext

import numpy as np
from numba import types
from numpy.typing import NDArray

from evofsm.driving.drivers.compiled import DRIVER_KERNEL, CompiledController, Kernel
from evofsm.driving.worlds.motion import (
    GAP,
    LEADER_SPEED,
    PLAN,
    SERIES,
    SPEED,
    TABLE,
    Plan,
    advance,
    decide,
    is_over,
)
from evofsm.driving.worlds.road import Episode, Road, drive, refuse_non_number
from evofsm.driving.worlds.scenario import Scenario
from evofsm.fsm import compiled
from evofsm.guard import Controller


class KinematicWorld:
    """The closed-form world.

    A controller with a kernel (`compiled`) is driven without leaving compiled
    code; any other is asked once a step, with the same result.

    Examples
    --------
    >>> from evofsm.driving import IDM, Leader, Scenario
    >>> leader = Leader(IDM(1.2, 25.0, 1.0, 1.0, 2.5), brake_decel=9.0, brake_speed=24.2)
    >>> hasty = IDM(2.25, 28.0, 0.8, 0.3, 2.0, lowest=-4.0, highest=2.5)
    >>> episode = KinematicWorld().run(Scenario(leader, initial_gap=5.0), hasty)
    >>> episode.collided, round(float(episode.time[-1]), 2)
    (True, 31.49)
    """

    def open(self, scenario: Scenario) -> AbstractContextManager[Road]:
        """Put the cars on a road, for use in a ``with`` statement."""
        return nullcontext(_Road(scenario))

    def run(
        self, scenario: Scenario, controller: Controller, interval: float | None = None
    ) -> Episode:
        """Drive the scenario with ``controller`` in the follower.

        Parameters
        ----------
        scenario : Scenario
        controller : Controller
        interval : float, optional
            Time between two decisions [s], a whole number of steps; asked at every step if not
            given.
        """
        road = _Road(scenario)
        steps = 1 if interval is None else scenario.steps_between(interval)
        sees_it_all = road._noise is None and road._delay == 0
        if isinstance(controller, CompiledController) and sees_it_all:
            return road.run(controller, steps)
        return drive(road, controller, steps)


class _Road(Road):
    """The road in closed form."""

    def __init__(self, scenario: Scenario) -> None:
        super().__init__(scenario)
        behind = scenario.behind.gap if scenario.behind else math.inf
        self._positions = np.array([0.0, scenario.initial_gap, -behind])

    def advance(self, command: float, steps: int = 1) -> None:
        self.row = advance(self._plan, self._record, self._positions, self.row, command, steps)

    def run(self, controller: CompiledController, steps: int) -> Episode:
        """As `drive`, without leaving compiled code."""
        self.row = _drive_kernel(
            controller.kernel,
            controller.parameters,
            self._plan,
            self._record,
            self._positions,
            steps,
        )
        episode = self.episode()
        refuse_non_number(  # which ended the run
            episode.accelerations[-1], self.time, episode.record[-1, GAP]
        )
        return episode


def _drive(
    driver: Kernel,
    parameters: NDArray[np.float64],
    plan: Plan,
    record: NDArray[np.float64],
    positions: NDArray[np.float64],
    steps: int,
) -> int:
    """Ask a compiled driver every so many steps; returns the row in which it ended."""
    row = 0
    while True:
        now = record[row]
        command = driver(parameters, plan.times[row], now[GAP], now[SPEED], now[LEADER_SPEED])
        if is_over(record, row) or not np.isfinite(command):
            decide(plan, record, row, command)
            return row
        row = advance(plan, record, positions, row, command, steps)


# With its signature stated it is compiled once for all drivers.
_drive_kernel = compiled(
    _drive, types.int64(types.FunctionType(DRIVER_KERNEL), TABLE, PLAN, TABLE, SERIES, types.int64)
)
