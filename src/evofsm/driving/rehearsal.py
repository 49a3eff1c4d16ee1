"""Rehearse what would happen: this action now, caution from then on, against a braking leader.

The follower does what is asked of it for one decision interval and then brakes in full; the leader
brakes from now on until it stands. The *critical deceleration* is the hardest braking of the leader
that ends without a collision. `foresee` asks what comes of an action if the leader goes on as it is
seen, and whether the gap is safe again some seconds later.
"""

from __future__ import annotations

from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from evofsm.fsm.kernels import compiled, kernel
from evofsm.fsm.validation import Floats

#: A leader who brakes harder is beyond physics; no critical deceleration is higher [m/s²].
HARDEST = 15.0

# Cars that touch, or overlap in what a sensor says, are taken to be so far apart [m].
_TOUCHING = 0.01
# Halvings of [0, HARDEST] in search of the critical deceleration: to 0.015 m/s².
_HALVINGS = 10

#: Below it a leader comes towards oneself; above, a sensor may show one that stands so [m/s].
ONCOMING = -1.0
#: Gap [m], speed of the follower and of the leader [m/s].
Three: TypeAlias = tuple[float, float, float]


class Body(NamedTuple):
    """What the follower is able to do, as far as is known, and what it was told."""

    decel: float  #: full braking that it realises [m/s²], positive
    lag: float  #: share of a decision interval in which the command before it still rules
    margin: float  #: smallest gap that counts as no collision [m]
    before: float  #: acceleration commanded last [m/s²]
    dt: float  #: time between two decisions [s]


@compiled
def critical_decelerations(
    observation: Three | Floats, accelerations: Floats, body: Body, critical: Floats
) -> None:
    """Write the critical deceleration under each acceleration that could be commanded now."""
    for k in range(len(accelerations)):
        low, high = 0.0, HARDEST
        if survives(observation, accelerations[k], body, high):
            critical[k] = HARDEST
            continue
        if not survives(observation, accelerations[k], body, low):
            critical[k] = 0.0
            continue
        for _ in range(_HALVINGS):
            middle = 0.5 * (low + high)
            if survives(observation, accelerations[k], body, middle):
                low = middle
            else:
                high = middle
        critical[k] = low


@compiled
def foresee(
    observation: Three | Floats,
    braking: float,
    accelerations: Floats,
    body: Body,
    worst: float,
    regain: float,
    hardest: float,
    found: NDArray[np.bool_],
) -> None:
    """Write what comes of accelerations if the leader goes on as it is seen: ``found`` (2, k).

    First whether full braking after each, if need be, avoids a collision with a leader that goes on
    ``braking`` so hard [m/s²]: whether the gap stays above the margin, or above half of what it is
    now, where that is less. Up to ``hardest`` full braking is as hard as what is asked, if that is
    harder. Then whether each, held for ``regain`` [s], has regained a gap above the margin in which
    who keeps the speed survives a leader that brakes by ``worst`` [m/s²].
    """
    gap, (speed, leader_speed) = observation[0], _speeds(observation)
    room = max(gap, _TOUCHING)
    near, margin = (room, speed, leader_speed), min(body.margin, 0.5 * room)
    leader_distance, leader_end_speed = _drive_on(leader_speed, -braking, regain)
    for k in range(len(accelerations)):
        full = max(body.decel, min(-accelerations[k], hardest))
        careful = Body(full, body.lag, margin, body.before, body.dt)
        found[0, k] = survives(near, accelerations[k], careful, braking)
        distance, end_speed = _drive_on(speed, accelerations[k], regain)
        then = (gap + leader_distance - distance, end_speed, leader_end_speed)
        later = Body(body.decel, body.lag, body.margin, accelerations[k], body.dt)
        found[1, k] = then[0] > body.margin and survives(then, 0.0, later, worst)


@kernel
def survives(
    observation: Three | Floats, acceleration: float, body: Body, leader_decel: float
) -> bool:
    """Whether no collision comes of ``acceleration`` now and full braking after it."""
    gap = observation[0] - body.margin
    speed, leader_speed = _speeds(observation)
    caution = -body.decel
    demand = max(acceleration, caution)
    last = max(body.before, caution) if body.lag > 0.0 else demand
    if speed <= 0.0 and max(demand, last) <= 0.0:
        return bool(observation[0] > 0.0)  # who stands, and stays, may be closer than the margin
    for _ in range(2):  # until full braking rules alone
        if gap <= 0.0 or (demand == caution and last == caution):
            break
        mean = body.lag * last + (1.0 - body.lag) * demand
        closing_speed, gain = speed - leader_speed, -leader_decel - mean
        if 0.0 < closing_speed < gain * body.dt:  # it is nearest within the interval, if ...
            leader_moves = leader_speed * gain > leader_decel * closing_speed
            if leader_moves and gap <= 0.5 * closing_speed * closing_speed / gain:
                return False
        distance, speed = _drive_on(speed, mean, body.dt)
        leader_distance, leader_speed = _drive_on(leader_speed, -leader_decel, body.dt)
        gap += leader_distance - distance
        last, demand = demand, caution
    # Both brake until they stand: the gap is smallest at the end, if it shrinks until then, ...
    if leader_decel >= body.decel or speed * leader_decel > leader_speed * body.decel:
        leader_distance = 0.5 * leader_speed * leader_speed / leader_decel
        gap_change = leader_distance - 0.5 * speed * speed / body.decel
        return bool(gap + min(gap_change, 0.0) > 0.0)
    closing_speed = max(speed - leader_speed, 0.0)  # ... or where they are as fast as each other
    return bool(gap - 0.5 * closing_speed * closing_speed / (body.decel - leader_decel) > 0.0)


@kernel
def _speeds(observation: Three | Floats) -> tuple[float, float]:
    """Own speed and the leader's; who comes towards oneself stands, approached so much faster."""
    speed, leader_speed = max(observation[1], 0.0), max(observation[2], 0.0)
    return speed - observation[2] * (observation[2] < ONCOMING), leader_speed


@kernel
def _drive_on(speed: float, acceleration: float, dt: float) -> tuple[float, float]:
    """Distance covered and speed reached in ``dt``; no one drives backwards."""
    end_speed = speed + acceleration * dt
    if end_speed >= 0.0:
        return 0.5 * (speed + end_speed) * dt, end_speed
    return -0.5 * speed * speed / acceleration, 0.0
