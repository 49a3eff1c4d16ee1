"""Backups: that together they help where one alone cannot."""

import numpy as np
import pytest

from evofsm.guard.learnt.backups import Backups


def backups(**options):
    random = np.random.default_rng(0)
    seen = random.normal(size=(30, 2)).cumsum(0)
    return Backups(seen, random.uniform(-1.0, 1.0, (29, 1)), choices=False, **options)


def value(policy):
    """In three situations it takes three gains; the third matters little."""
    gain = policy[0, 1]
    return np.maximum(0.0, 1.0 - np.abs(gain - np.array([2.0, -2.0, 0.0]))) * [1.0, 1.0, 0.1]


def evolved(episodes, **options):
    found, random = backups(**options), np.random.default_rng(1)
    for _ in range(episodes):
        found.evolve(value, random)
    return found


def test_together_they_help_in_every_situation():
    found = evolved(20)
    values = np.array([value(policy) for policy in found.policies])
    assert (values.max(0) > [0.9, 0.9, 0.09]).all()
    first, second = found.policies[found.ranks[:2], 0, 1]
    assert first * second < 0.0  # those are asked first that help in different ones


def test_those_come_first_that_add_most():
    found = evolved(20)
    assert (np.diff(found.scores[found.ranks]) <= 0.0).all()
    again = found.scores.copy()
    found.evolve(lambda policy: np.zeros(3), np.random.default_rng(2))
    assert not np.array_equal(found.scores, again)
    assert found.ranks.tolist() == list(range(len(found.policies)))  # of equals as they stood


@pytest.mark.parametrize("episodes", [1, 3])
def test_without_evolving_there_are_constant_ones_alone(episodes):
    found = evolved(episodes, evolving=False)
    assert len(found.policies) == found.n_constant == 3
    assert (found.policies[:, :, 1:] == 0.0).all()
