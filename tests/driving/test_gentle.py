"""Learnt among gentle waves only, then one leader stops in earnest."""

import math

import numpy as np
import pytest

from evofsm.driving import IDM, Body, Family, Leader, Scenario, guard_for_family, teach


def waves(numbers):
    """Of a leader who goes between a slow and a fast speed and brakes gently."""
    rng = np.random.default_rng(numbers.below("waves", 2**32))
    time, speed, found = 0.0, 0.0, []
    while time < 60.0:
        rates = {1: rng.uniform(0.8, 1.5), -1: rng.uniform(1.2, 2.4)}
        for wanted, hold in ((rng.uniform(15, 22), 3.5), (rng.uniform(5, 12), 2.5)):
            sign = 1 if wanted > speed else -1
            found.append((time, sign * rates[sign]))
            time += abs(wanted - speed) / rates[sign]
            found.append((time, 0.0))
            time, speed = time + hold, wanted
    return tuple(found)


def make(numbers, stops):
    leader = Leader(
        IDM(1.2, 25.0, 1.0, 1.0, 2.5),
        brake_time=numbers.between("leader.brake_time", 20.0, 50.0) if stops else math.inf,
        brake_decel=numbers.between("leader.brake_decel", 7.0, 8.0),
        waves=waves(numbers),
    )
    gap = numbers.between("scenario.initial_gap", 2.0, 20.0)
    hasty = IDM(2.25, 28.0, 0.8, 0.3, 2.0, lowest=-6.0, highest=2.5)
    return Scenario(leader, gap, duration=60.0, body=Body(-6.0, 2.5)), hasty


@pytest.mark.slow
def test_gentle_traffic_does_not_make_it_bold():
    gentle, stop = (
        Family("waves", "", lambda n, s=stops: make(n, s), -6.0, 2.5, decel=6.0, leader_decel=8.0)
        for stops in (False, True)
    )
    guard = guard_for_family(gentle)
    teach(guard, (gentle.draw(0, index) for index in range(30)))
    assert guard.judge.manoeuvres.gentle > 60
    guard.freeze()
    drives = teach(guard, (stop.draw(0, index, split="test") for index in range(40)))
    assert not any(drive.collided for drive in drives)
