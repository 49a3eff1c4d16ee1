"""Where cars drive: how they move, what is recorded of it, and the world in closed form.

The motion is SUMO's ballistic update, compiled once and the same in every world. A run is recorded
in rows, one every ``dt``; the columns are those of `RUN_COLUMNS`. SUMO is the referee: both worlds
agree within 1e-9 at every step.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from evofsm.driving.drivers import idm_kernel
from evofsm.driving.scenarios import Scenario, steps_between
from evofsm.fsm.kernels import compiled
from evofsm.fsm.validation import Floats
from evofsm.guard import Controller, Decision, Proposal

#: What a row of the record holds.
RUN_COLUMNS = (
    *("gap", "v_follower", "v_leader", "gap_behind", "v_behind"),
    *("commanded", "realised", "a_leader", "a_behind"),
)
GAP, SPEED, LEADER_SPEED, GAP_BEHIND, SPEED_BEHIND = range(5)
COMMANDED, REALISED, LEADER_ACCELERATION, ACCELERATION_BEHIND = range(5, 9)
#: Columns of the follower, the leader and the car behind.
SPEEDS = [SPEED, LEADER_SPEED, SPEED_BEHIND]
ACCELERATIONS = [REALISED, LEADER_ACCELERATION, ACCELERATION_BEHIND]
# Actions that differ by less are the same [m/s²].
_SAME_ACTION = 1e-9

Drives = Controller | Callable[[Floats], float | Proposal]


@dataclass(frozen=True, eq=False)
class Episode:
    """One run, a row every ``dt``; the last row of a collision is the first gap of 0 or less."""

    time: Floats  #: (T,) [s]
    record: Floats  #: (T, 9) the columns of `evofsm.driving.world.RUN_COLUMNS`
    decisions: tuple[Decision, ...] = ()  #: of the guard that it was driven under, if any

    @property
    def observations(self) -> Floats:
        """(T, 3) ndarray: gap [m], v_follower [m/s], v_leader [m/s], as they truly were."""
        return np.ascontiguousarray(self.record[:, [GAP, SPEED, LEADER_SPEED]])

    @property
    def accelerations(self) -> Floats:
        """(T,) ndarray: commanded to the follower after each row [m/s²]."""
        return self.record[:, COMMANDED].copy()

    @property
    def leader_accelerations(self) -> Floats:
        """(T,) ndarray: commanded to the leader after each row [m/s²]."""
        return self.record[:, LEADER_ACCELERATION].copy()

    @property
    def collided(self) -> bool:
        """Whether the run ended in a collision with the leader."""
        return bool(self.record[-1, GAP] <= 0.0)

    @property
    def rear_ended(self) -> bool:
        """Whether the car behind ran into the follower."""
        return bool(self.record[-1, GAP_BEHIND] <= 0.0)

    @property
    def proposed(self) -> Floats:
        """(D,) ndarray: what the controller wanted at each decision [m/s²]."""
        return np.array([decision.revision.proposed for decision in self.decisions])

    @property
    def executed(self) -> Floats:
        """(D,) ndarray: what was commanded at each decision [m/s²]."""
        return np.array([decision.revision.executed for decision in self.decisions])

    @property
    def changed(self) -> NDArray[np.bool_]:
        """(D,) ndarray: where the proposal was not executed, or was none that could be."""
        change = np.abs(self.executed - self.proposed)
        return np.asarray(~(change <= _SAME_ACTION))  # also true of NaN


class Plan(NamedTuple):
    """A scenario as kernels take it, for one run."""

    times: Floats  # (rows,)
    dt: float
    leader: Floats  # (1, 9) parameters of its driver
    waves: Floats  # (k, 2) from a time on, an acceleration
    brake: Floats  # (4,) decel, speed, time, and 1 once it brakes
    cut_in: Floats  # (3,) row, gap, speed
    body: Floats  # (4,) lowest, highest, delay in steps, jerk times dt
    behind: Floats  # (1, 9) parameters of the driver behind; (0, 9) for none

    @classmethod
    def of(cls, scenario: Scenario) -> Plan:
        """Tables of a scenario."""
        leader, body, cut_in = scenario.leader, scenario.body, scenario.leader.cut_in
        entry = [scenario.steps(cut_in.time), cut_in.gap, cut_in.speed] if cut_in else [-1, 0, 0]
        return cls(
            scenario.times,
            scenario.dt,
            leader.driver.parameters,
            np.array(leader.waves, dtype=np.float64).reshape(-1, 2),
            np.array([leader.brake_decel, leader.brake_speed, leader.brake_time, 0.0]),
            np.array(entry, dtype=np.float64),
            np.array(
                [body.lowest, body.highest, scenario.steps(body.delay), body.jerk * scenario.dt]
            ),
            scenario.behind.driver.parameters if scenario.behind else np.empty((0, 9)),
        )


@compiled
def move(position: float, speed: float, acceleration: float, dt: float) -> tuple[float, float]:
    """Position and speed one step later (SUMO's ballistic update); no one drives backwards."""
    next_speed = max(0.0, speed + acceleration * dt)
    return position + 0.5 * (speed + next_speed) * dt, next_speed


@compiled
def is_over(record: Floats, row: int) -> bool:
    """Whether a run ends with this row: two cars have met, or it is the last."""
    return bool(record[row, GAP] <= 0.0 or record[row, GAP_BEHIND] <= 0.0 or row + 1 == len(record))


@compiled
def decide(plan: Plan, record: Floats, row: int, command: float) -> None:
    """Write into a row what each car does until the next, the follower being told ``command``."""
    now, brake, body, time = record[row], plan.brake, plan.body, plan.times[row]
    if now[LEADER_SPEED] >= brake[1] or time >= brake[2]:
        brake[3] = 1.0
    if brake[3] == 1.0:
        now[LEADER_ACCELERATION] = -brake[0]
    elif len(plan.waves) > 0 and time >= plan.waves[0, 0]:
        wave = 0
        while wave + 1 < len(plan.waves) and plan.waves[wave + 1, 0] <= time:
            wave += 1
        now[LEADER_ACCELERATION] = plan.waves[wave, 1]
    else:
        now[LEADER_ACCELERATION] = idm_kernel(plan.leader, time, np.inf, now[LEADER_SPEED], 0.0)

    now[COMMANDED] = command
    command_row = row - int(body[2])
    acceleration = record[command_row, COMMANDED] if command_row >= 0 else 0.0
    acceleration = min(max(acceleration, body[0]), body[1])
    if body[3] < np.inf:
        last = record[row - 1, REALISED] if row > 0 else 0.0
        acceleration = min(max(acceleration, last - body[3]), last + body[3])
    now[REALISED] = acceleration

    if len(plan.behind) > 0:
        now[ACCELERATION_BEHIND] = idm_kernel(
            plan.behind, time, now[GAP_BEHIND], now[SPEED_BEHIND], now[SPEED]
        )


@compiled
def advance(
    plan: Plan, record: Floats, positions: Floats, row: int, command: float, steps: int
) -> int:
    """Some steps under one command, in closed form; returns the row reached.

    ``positions`` are those of the follower, the leader, and the car behind. Where the run is over
    no one moves any more.
    """
    for _ in range(steps):
        decide(plan, record, row, command)
        if is_over(record, row):
            break
        now, then = record[row], record[row + 1]
        row += 1
        dt = plan.dt
        positions[0], then[SPEED] = move(positions[0], now[SPEED], now[REALISED], dt)
        positions[1], then[LEADER_SPEED] = move(
            positions[1], now[LEADER_SPEED], now[LEADER_ACCELERATION], dt
        )
        if row == plan.cut_in[0]:
            positions[1], then[LEADER_SPEED] = positions[0] + plan.cut_in[1], plan.cut_in[2]
        then[GAP] = positions[1] - positions[0]
        then[GAP_BEHIND] = np.inf
        if len(plan.behind) > 0:
            positions[2], then[SPEED_BEHIND] = move(
                positions[2], now[SPEED_BEHIND], now[ACCELERATION_BEHIND], dt
            )
            then[GAP_BEHIND] = positions[0] - positions[2]
    return row


class Road:
    """Cars under way in one run of a scenario, in closed form.

    Whoever drives asks `observation`, then tells `advance` what to do. The run is `over` with the
    row in which two cars met, or with the last; `advance` then only records what was commanded.
    """

    def __init__(self, scenario: Scenario) -> None:
        self.scenario = scenario
        self.row = 0
        self.every = 1  #: steps from one decision to the next, for `step`
        self._plan = Plan.of(scenario)
        self._record = np.zeros((len(self._plan.times), len(RUN_COLUMNS)))
        sensors, size = scenario.sensors, (len(self._record), 3)
        deviation = np.array([sensors.gap_noise, sensors.speed_noise, sensors.speed_noise])
        noise = np.random.default_rng(sensors.seed)  # what the sensors add
        self._noise = noise.normal(scale=deviation, size=size) if deviation.any() else None
        self._delay = scenario.steps(sensors.delay)
        behind, start = scenario.behind, self._record[0]
        start[GAP], start[GAP_BEHIND] = scenario.initial_gap, behind.gap if behind else math.inf
        start[SPEED] = start[SPEED_BEHIND] = scenario.initial_speed
        start[LEADER_SPEED] = scenario.leader.initial_speed
        self._positions = np.array([0.0, start[GAP], -start[GAP_BEHIND]])

    def advance(self, command: float, steps: int = 1) -> None:
        """Drive some steps with this acceleration commanded to the follower [m/s²]."""
        self.row = advance(self._plan, self._record, self._positions, self.row, command, steps)

    @property
    def time(self) -> float:
        """Now [s]."""
        return float(self._plan.times[self.row])

    @property
    def observation(self) -> Floats:
        """(3,) ndarray: gap [m], v_follower [m/s], v_leader [m/s], as the follower sees them."""
        observation = self._record[max(0, self.row - self._delay), GAP : LEADER_SPEED + 1].copy()
        if self._noise is not None:
            observation = observation + self._noise[self.row]
            observation[1:] = np.maximum(observation[1:], 0.0)
        return observation

    @property
    def over(self) -> bool:
        """Whether the run ends with this row."""
        return is_over(self._record, self.row)

    @property
    def collided(self) -> bool:
        """Whether the follower has hit the leader."""
        return bool(self._record[self.row, GAP] <= 0.0)

    def episode(self, first: int = 0) -> Episode:
        """What was recorded so far, from a row on."""
        rows = slice(first, self.row + 1)
        return Episode(self._plan.times[rows], self._record[rows].copy())

    # -- As an environment for `evofsm.guard.run_episode` -----------------------------------------

    def reset(self, **_: Any) -> tuple[Floats, dict[str, Any]]:
        """The road as it is."""
        return self.observation, {"time": self.time}

    def step(self, action: float, /) -> tuple[Floats, float, bool, bool, dict[str, Any]]:
        """Drive on; of two collisions that end a run, running into the leader is a failure."""
        start, speed = self.time, self._record[self.row, SPEED]
        self.advance(action, self.every)
        seconds, failed = self.time - start, self.collided
        outcome = {
            "time": self.time,
            "failed": failed,
            "realised": (self._record[self.row, SPEED] - speed) / seconds if seconds else math.nan,
        }
        terminated = failed or bool(self._record[self.row, GAP_BEHIND] <= 0.0)
        return self.observation, 0.0, terminated, self.over and not terminated, outcome


class World:
    """A place to drive in: if not told otherwise in closed form, by SUMO's ballistic update."""

    def open(self, scenario: Scenario) -> AbstractContextManager[Road]:
        """Put the cars on a road, for use in a ``with`` statement."""
        return nullcontext(Road(scenario))

    def run(self, scenario: Scenario, controller: Drives, interval: float | None = None) -> Episode:
        """Drive the scenario with ``controller`` in the follower.

        It is asked every ``interval`` [s], a multiple of the scenario's step, or at every step. A
        proposal that is no finite number raises a ValueError.
        """
        steps = 1 if interval is None else steps_between(interval, scenario.dt)
        propose = getattr(controller, "propose", None) or (lambda seen, time: controller(seen))  # type: ignore[operator]
        over = False
        with self.open(scenario) as road:
            while not over:
                over, time, observation = road.over, road.time, road.observation
                proposal = propose(observation, time)
                command = float(proposal.action if isinstance(proposal, Proposal) else proposal)
                if not math.isfinite(command):
                    where = f"at {time:g} s, gap {observation[0]:g} m"
                    raise ValueError(f"controller proposed {command} {where}")
                road.advance(command, steps)
            return road.episode()


class KinematicWorld(World):
    """The world in closed form: points on a line."""
