"""Forecasts, worked out by hand on two states and two actions."""

import numpy as np
import pytest

from evofsm.fsm.machine import EvolvingFSM


@pytest.fixture
def machine():
    """States at 0 and 1, recognised so sharply that a belief is exactly 0 or 1.

    By hand P is [[1/2, 1/2], [5/6, 1/6]] of action 0, and [[5/14, 9/14], [1/2, 1/2]] of action 1.
    """
    machine = EvolvingFSM(
        n_actions=2, radius=0.5, learning_rate=0.5, prior_frequency=0.25, spread=1e-6
    )
    machine.learn_many([[0.0], [0.0], [2.0], [1.0]], [-1, -1, -1, 0])
    machine.learn_many([[0.0], [0.0], [1.0]], [1, 1, -1])
    return machine


@pytest.mark.parametrize(
    ("action", "horizon", "expected"),
    [
        (0, 1, [5 / 6, 1 / 6]),
        (1, 1, [1 / 2, 1 / 2]),
        (0, 2, [59 / 126, 67 / 126]),
        (0, 3, [1469 / 2646, 1177 / 2646]),
        (1, 2, [23 / 42, 19 / 42]),
    ],
)
def test_the_action_decides_the_first_step_and_all_alike_further_ones(
    machine, action, horizon, expected
):
    assert machine.belief.tolist() == [0.0, 1.0]
    np.testing.assert_allclose(machine.predict(action, horizon), expected, rtol=1e-14)


def test_at_the_start_of_an_episode_the_forecast_comes_from_the_uniform_belief(machine):
    machine.start_episode()
    assert machine.belief.tolist() == [0.5, 0.5]
    np.testing.assert_allclose(machine.predict(0), [2 / 3, 1 / 3], rtol=1e-15)
