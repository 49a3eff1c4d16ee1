"""Lags are left out where they foresaw failure that never came."""

import numpy as np
import pytest

from evofsm.fsm import Consequents, Dynamics
from evofsm.fsm.dynamics.ahead import are_misleading, misled_by_lags
from evofsm.fsm.dynamics.consequents import lags, n_features

STEPS = 10
LATEST = 2  # index of the latest change among the features: after 1 and the variable


def model(going_on):
    """One variable, of which so much of its latest change goes on."""
    weights = np.zeros((n_features(1, 1, box=True), 1))
    weights[LATEST] = going_on
    one, none = np.ones(1), np.zeros(1)
    return Consequents(
        weights=weights,
        origin=none,
        reach=9.0 * one,
        lowest=-np.inf * one,
        highest=np.inf * one,
        least=-9.0 * one,
        most=9.0 * one,
        sides=np.zeros((0, 4)),
        anew=none,
        mean=none,
        inverse=one,
        close=1e-9 * one,
        gains=one,
        choices=0,
    )


def misled(course, starts):
    Z, U = np.array(course, float)[:, None], np.zeros((len(course) - 1, 1))
    return misled_by_lags(model(1.0), model(0.0), Z, U, np.array(starts), STEPS, np.ones(1))


def test_what_stopped_is_missed_by_who_takes_it_to_go_on():
    moved_once = [0.0] + [3.0] * 30
    assert misled(moved_once, [1]) == 1.0  # no more, however far it is off
    assert misled(moved_once, [4, 9, 20]) == 0.0  # it rests: both foresee that


def test_what_goes_on_is_missed_by_who_takes_it_to_stop():
    assert misled(np.arange(31), range(1, 21)) == -1.0


def test_before_an_episode_nothing_moved():
    assert misled(np.arange(31), [0]) == 0.0


@pytest.fixture
def coasting(follow):
    """Learnt of what goes on for a while when it is pushed."""
    draw, dynamics = np.random.default_rng(0), Dynamics(-1.0, 1.0, horizon=STEPS)
    for _ in range(4):
        push, speed = draw.uniform(-1.0, 1.0, 60), 0.0
        course = [0.0]
        for one in push:
            speed = 0.9 * speed + 0.1 * one
            course.append(course[-1] + speed)
        follow(dynamics, np.array(course)[:, None], push)
    return dynamics


def test_lags_that_foresee_what_came_are_not_doubted(coasting):
    where = lags(1, 1)
    coasting.refute(np.arange(5, 40), STEPS)
    assert coasting.doubt_of_lags == 0.0
    assert np.abs(coasting.weights[where]).max() > 0.5


def test_lags_that_are_doubted_enough_are_left_out_until_they_foresee_again(coasting):
    where = lags(1, 1)
    coasting.doubt_of_lags = 1.0
    coasting.settle()
    assert are_misleading(coasting.doubt_of_lags)
    assert np.abs(coasting.weights[where]).max() < 1e-6
    coasting.refute(np.arange(5, 40), STEPS)
    assert np.abs(coasting.weights[where]).max() > 0.5


def test_steps_from_which_the_episode_did_not_go_on_for_so_long_say_nothing(coasting):
    coasting.doubt_of_lags = 0.5
    coasting.refute(np.array([55, 58]), STEPS)
    coasting.refute(np.array([], int), STEPS)
    assert coasting.doubt_of_lags == 0.5


def test_what_failed_in_the_end_speaks_for_no_lags(coasting):
    coasting.doubt_of_lags = 0.5
    coasting.latest = coasting.latest._replace(failed=True)
    coasting.refute(np.arange(5, 40), STEPS)
    assert coasting.doubt_of_lags == 0.5
