"""What comes of episodes, and what was recorded."""

import numpy as np
import pytest

from evofsm.driving.cars import guard_for_cars, guard_for_family
from evofsm.driving.family import held_out, load_family
from evofsm.driving.trials import drive, outcome_of, reference_of, summarise, unrevised_guard

pytestmark = pytest.mark.usefixtures("compiled")

EMERGENCY = load_family("emergency")


def test_a_judge_that_there_is_not_is_refused():
    with pytest.raises(ValueError, match="no judge 'wise'; there are kinematic, learnt"):
        guard_for_family(EMERGENCY, judge="wise")


# -- What came of episodes ------------------------------------------------------------------------


def test_outcomes_compare_with_the_controller_alone():
    draws = held_out(EMERGENCY, 0, 3)
    alone = [reference_of(EMERGENCY, draw) for draw in draws]
    same = [drive(unrevised_guard(EMERGENCY), draw) for draw in draws]
    for one, base in zip(same, alone, strict=True):  # up to the leader's brake
        until = one.time <= one.time[base.until]
        way = np.trapezoid(one.observations[until, 1], one.time[until])
        assert base.distance == pytest.approx(way, rel=0.01)
    found = [outcome_of(*pair) for pair in zip(same, alone, strict=True)]
    assert [one.mobility for one in found] == [1.0, 1.0, 1.0]
    assert [one.changed for one in found] == [0, 0, 0]
    row = summarise("emergency", "unrevised", found, EMERGENCY.interval)
    assert row.collisions == sum(one.collided for one in same) == 3
    assert (row.collision_rate, row.mobility, row.mean_change) == (1.0, 1.0, 0.0)
    assert row.collision_low == pytest.approx(0.025 ** (1.0 / 3.0))  # Clopper and Pearson
    seconds = sum(len(one.decisions) for one in same) * EMERGENCY.interval
    assert row.hours == pytest.approx(seconds / 3600.0)


def test_nobody_drives_a_scenario_without_a_controller():
    scenario = EMERGENCY.draw(0, 0).scenario
    with pytest.raises(ValueError, match="nobody drives"):
        drive(unrevised_guard(EMERGENCY), scenario)
    with pytest.raises(ValueError, match="no multiple of the simulation's step"):
        drive(guard_for_cars(-2.5, 2.5, interval=0.123), EMERGENCY.draw(0, 0))
