"""How the cars move: compiled once, and the same in every world.

A run is recorded in rows, one every ``dt``; the columns are those of `RUN_COLUMNS`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import types
from numpy.typing import NDArray

from evofsm.driving.drivers.idm import idm_kernel
from evofsm.driving.worlds.scenario import Scenario
from evofsm.fsm import compiled

#: What a row of the record holds.
RUN_COLUMNS = (
    *("gap", "v_follower", "v_leader", "gap_behind", "v_behind"),
    *("commanded", "realised", "a_leader", "a_behind"),
)
GAP, SPEED, LEADER_SPEED, GAP_BEHIND, SPEED_BEHIND = range(5)
COMMANDED, REALISED, LEADER_ACCELERATION, ACCELERATION_BEHIND = range(5, 9)


class Plan(NamedTuple):
    """A scenario as kernels take it, for one run."""

    times: NDArray[np.float64]  # (rows,)
    dt: float
    leader: NDArray[np.float64]  # (1, 9) parameters of its driver
    waves: NDArray[np.float64]  # (k, 2) from a time on, an acceleration
    brake: NDArray[np.float64]  # (4,) decel, speed, time, and 1 once it brakes
    cut_in: NDArray[np.float64]  # (3,) row, gap, speed
    body: NDArray[np.float64]  # (4,) lowest, highest, delay in steps, jerk times dt
    behind: NDArray[np.float64]  # (1, 9) parameters of the driver behind; (0, 9) for none


def plan_of(scenario: Scenario) -> Plan:
    """Tables of a scenario."""
    leader, body, cut_in = scenario.leader, scenario.body, scenario.leader.cut_in
    return Plan(
        times=scenario.times,
        dt=scenario.dt,
        leader=leader.driver.parameters,
        waves=np.array(leader.waves, dtype=np.float64).reshape(-1, 2),
        brake=np.array([leader.brake_decel, leader.brake_speed, leader.brake_time, 0.0]),
        cut_in=np.array(
            [scenario.steps(cut_in.time), cut_in.gap, cut_in.speed] if cut_in else [-1.0, 0.0, 0.0]
        ),
        body=np.array(
            [body.lowest, body.highest, scenario.steps(body.delay), body.jerk * scenario.dt]
        ),
        behind=scenario.behind.driver.parameters if scenario.behind else np.empty((0, 9)),
    )


TABLE, SERIES = types.float64[:, ::1], types.float64[::1]
PLAN = types.NamedTuple([SERIES, types.float64, TABLE, TABLE, SERIES, SERIES, SERIES, TABLE], Plan)


@compiled
def move(position: float, speed: float, acceleration: float, dt: float) -> tuple[float, float]:
    """Position and speed one step later (SUMO's ballistic update); no one drives backwards."""
    reached = max(0.0, speed + acceleration * dt)
    return position + 0.5 * (speed + reached) * dt, reached


@compiled
def is_over(record: NDArray[np.float64], row: int) -> bool:
    """Whether a run ends with this row: two cars have met, or it is the last."""
    return bool(record[row, GAP] <= 0.0 or record[row, GAP_BEHIND] <= 0.0 or row + 1 == len(record))


@compiled
def decide(plan: Plan, record: NDArray[np.float64], row: int, command: float) -> None:
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
    told = row - int(body[2])
    realised = record[told, COMMANDED] if told >= 0 else 0.0
    realised = min(max(realised, body[0]), body[1])
    if body[3] < np.inf:
        last = record[row - 1, REALISED] if row > 0 else 0.0
        realised = min(max(realised, last - body[3]), last + body[3])
    now[REALISED] = realised

    if len(plan.behind) > 0:
        now[ACCELERATION_BEHIND] = idm_kernel(
            plan.behind, time, now[GAP_BEHIND], now[SPEED_BEHIND], now[SPEED]
        )


@compiled
def advance(
    plan: Plan,
    record: NDArray[np.float64],
    positions: NDArray[np.float64],
    row: int,
    command: float,
    steps: int,
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
