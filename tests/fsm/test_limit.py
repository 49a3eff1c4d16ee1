"""Machines with a limit on their states, and with a tolerance in their beliefs."""

import numpy as np
import pytest

from evofsm import Event, EvolvingFSM, Novelty, Paper


def sharp(**settings):
    """A machine whose beliefs are 0 or 1, on a line."""
    rule = Novelty(radius=1.0, spread=1e-6)
    return EvolvingFSM(n_actions=2, learning_rate=0.5, rule=rule, **settings)


def learn(machine, points, actions=None):
    Z = np.array(points, dtype=float)[:, None]
    return machine.learn_many(Z, np.zeros(len(Z), int) if actions is None else actions)


def test_merged_states_have_the_evidence_of_both():
    machine = sharp(max_states=3)
    learn(machine, [0, 0, 0, 3, 3, 9, 0, 9, 3], [0, 0, 1, 0, 0, 0, 0, 0, -1])
    before = machine.model()
    step = machine.observe([50.0])
    assert step.event == Event.CREATED | Event.MERGED
    assert machine.centers.ravel().tolist() == [pytest.approx(9 / 7), 50.0, 9.0]  # 4 and 3 visits
    after = machine.model()
    assert step.state == 1
    assert after.visits.tolist() == [7, 1, 2]
    assert machine.decisions[:, 0].tolist() == (before.decisions[:, :2].sum(axis=1)).tolist()
    # A row of both, weighed by how often and how recently each was left.
    weights = before.origin_frequency[0, :2]
    row = weights @ before.transition_matrices[0, :2] / weights.sum()
    kept = 1.0 - 1e-3 / after.origin_frequency[0, 0]  # the newcomer's prior takes its share
    np.testing.assert_allclose(
        after.transition_matrices[0, 0],
        kept * np.array([row[:2].sum(), 0.0, row[2]]) + [0, 1 - kept, 0],
    )
    assert machine.state_ids.tolist() == [0, 3, 2]


def test_who_has_a_state_for_each_observation_is_warned():
    with pytest.warns(RuntimeWarning, match="Is a scale, or the radius, too small"):
        learn(sharp(), range(0, 9000, 9))


def test_a_newcomer_close_to_a_state_is_left_to_it():
    machine = sharp(max_states=2)
    learn(machine, [0, 9])
    step = machine.observe([1.5])  # closer to 0 than 0 is to 9
    assert (step.event, step.state, machine.n_states) == (Event.MERGED, 0, 2)
    assert machine.centers.ravel().tolist() == [0.0, 9.0]


@pytest.mark.parametrize("rule", [Novelty(radius=1.0, spread=0.5), Paper()])
@pytest.mark.parametrize("tolerance", [1e-3, 1e-6, 1e-9])
def test_a_tolerant_belief_is_that_close_to_the_exact_one(rule, tolerance):
    rng = np.random.default_rng(0)
    Z = np.abs(np.cumsum(rng.normal(scale=0.5, size=(2000, 2)), axis=0)) % 12.0
    I = np.repeat(rng.integers(0, 3, 200), 10)
    exact, tolerant = (EvolvingFSM(3, rule=rule, belief_tolerance=t) for t in (0.0, tolerance))
    a, b = (machine.learn_many(Z, I, belief=True) for machine in (exact, tolerant))
    assert a.n_states.tolist() == b.n_states.tolist()  # beliefs have no say in what is created
    assert np.abs(a.belief - b.belief).sum(axis=1).max() <= tolerance
    np.testing.assert_allclose(b.belief.sum(axis=1), 1.0)
    if isinstance(rule, Novelty):  # most states take no part
        assert (b.belief > 0).sum(axis=1).mean() < 0.6 * exact.n_states
