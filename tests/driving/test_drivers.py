"""Who drives: the Intelligent Driver Model."""

import math

import numpy as np
import pytest

from evofsm.driving.drivers import IDM, ChangingIDM

NORMAL = IDM(1.25, 25.0, 2.0, 1.5, 2.0)
HASTY = IDM(2.25, 28.0, 0.8, 0.3, 2.0, lowest=-4.0, highest=2.5)


def test_acceleration_follows_the_papers_equations():
    gap, speed, leader_speed = 30.0, 20.0, 15.0
    desired = 2.0 + 20.0 * 1.5 + 20.0 * 5.0 / (2.0 * math.sqrt(1.25 * 2.0))
    expected = 1.25 * (1.0 - (20.0 / 25.0) ** 4 - (desired / 30.0) ** 2)
    assert NORMAL.propose(np.array([gap, speed, leader_speed])).action == pytest.approx(expected)


@pytest.mark.parametrize("gap", [0.5, 0.0, -3.0])
def test_bounds_hold_also_at_and_after_a_collision(gap):
    assert HASTY.propose(np.array([gap, 20.0, 0.0])).action == -4.0


def test_free_road_gives_the_full_acceleration_at_rest_and_none_at_the_desired_speed():
    assert NORMAL.propose(np.array([math.inf, 0.0, 0.0])).action == 1.25
    assert NORMAL.propose(np.array([math.inf, 25.0, 0.0])).action == 0.0


def test_a_changing_driver_is_the_first_before_and_the_other_from_the_change_on():
    driver = ChangingIDM(HASTY, ((15.0, NORMAL),))
    situation = np.array([12.0, 10.0, 9.0])
    assert driver.propose(situation, 14.99).action == HASTY.propose(situation).action
    assert driver.propose(situation, 15.0).action == NORMAL.propose(situation).action


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"accel": 0.0}, "accel"),
        ({"decel": -2.0}, "decel"),
        ({"min_gap": -1.0}, "min_gap"),
        ({"desired_speed": math.nan}, "desired_speed"),
        ({"lowest": 3.0, "highest": 2.5}, "bounds"),
    ],
)
def test_impossible_parameters_are_refused_by_name(change, word):
    values = {"accel": 1.0, "desired_speed": 25.0, "min_gap": 2.0, "time_headway": 1.0}
    with pytest.raises(ValueError, match=word):
        IDM(**{**values, "decel": 2.0, **change})


@pytest.mark.parametrize("at", [math.nan, -1.0])
def test_a_driver_changes_at_a_time(at):
    with pytest.raises(ValueError, match="changes at"):
        ChangingIDM(NORMAL, ((at, HASTY),))
