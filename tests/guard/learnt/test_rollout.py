"""Which action passes by rollouts; benchmarks/c99.py holds these to their twins in C."""

import numpy as np
import pytest

from evofsm.guard.learnt import rollout
from evofsm.guard.learnt.backups import regulator
from evofsm.guard.learnt.rollout import CHANGED, FAILS, KEPT, NOTHING_PASSES, Model

STEPS, WALL = 20, 100.0
ACTION = 3  # index of the first one among the features: after 1, the variable, its latest change


def mover(choices=0):
    """One variable, moved by the action, or by the last of two choices; fails at a wall."""
    a = max(1, choices)
    weights = np.zeros((rollout.n_features(1, a, box=not choices), 1))
    weights[ACTION + a - 1] = 1.0
    one, none = np.ones(1), np.zeros(1)
    ends = {"lowest": -np.inf * one, "highest": np.inf * one}
    ends |= {"least": -9.0 * one, "most": 9.0 * one}
    units = {"origin": none, "reach": one, "mean": none, "inverse": one}
    wall = np.array([[FAILS, 0, 0, WALL, WALL, 1.0, 1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0]])
    told = {"forms": wall, "dead_ends": np.empty((0, 3)), "choices": choices}
    return Model(weights=weights, **ends, **units, **told)


def search_for(model, proposal, policies, margin=0.0, place=0.0, residuals=None, allowed=0):
    """What is found there, if nothing disturbs: how, the action, the backup, and what is left."""
    residuals = np.zeros((STEPS, 1, 1)) if residuals is None else residuals
    here, policies = np.array([place, 0.0, *[0.0] * len(proposal)]), np.array(policies)
    asked = here, policies, np.arange(len(policies)), residuals, 1.0, np.array(proposal)
    return rollout.search(model, *asked, margin, allowed)


def test_where_full_action_only_just_holds_nothing_passes():
    """No distance says that: it is as far from the wall as ever."""
    model = mover()
    model.weights[0] = 0.999  # what it withstands
    for margin, place, how in (
        (0.0, 80.0, KEPT),
        (0.25, 99.0, KEPT),
        (0.25, 99.74, NOTHING_PASSES),
    ):
        assert search_for(model, [-1.0], [[[-1.0, 0.0]]], margin, place)[0] == how


def test_what_is_refused_is_changed_by_no_more_than_it_takes():
    how, action, _, left = search_for(mover(), [1.0], [[[-1.0, 0.0]]], place=WALL - 0.2)
    assert how == CHANGED
    assert 0.0 < action[0] <= 0.2
    assert left == pytest.approx(0.2 - action[0])
    policies = [[[1.0, 0.0], [0.0, 0.0]]]
    how, action, _, _ = search_for(mover(choices=2), [0.0, 1.0], policies, place=WALL - 0.2)
    assert action.tolist() == [1.0, 0.0]


def test_where_nothing_passes_the_backup_that_lasts_longest_is_told_and_whether_all_are_alike():
    to, still, away = [[1.0, 0.0]], [[0.0, 0.0]], [[-0.1, 0.0]]
    model = mover()
    model.weights[0] = 0.5
    how, action, backup, apart = search_for(model, [1.0], [to, still, away], place=WALL - 2.0)
    assert (how, backup, action.tolist()) == (NOTHING_PASSES, 2, [-0.1])
    assert search_for(model, [1.0], [to, to], place=WALL - 2.0)[-1] < 0.02 < apart


def test_so_many_disturbances_need_not_be_survived_but_that_none_begins():
    pushed, doomed = np.zeros((STEPS, 1, 3)), mover()
    pushed[0, 0, 1:] = 5.0, 8.0
    doomed.weights[0] = 1.0
    asked = {"place": WALL - 3.0, "residuals": pushed}
    for model, allowed, how in (
        (mover(), 1, NOTHING_PASSES),
        (mover(), 2, KEPT),
        (doomed, 2, NOTHING_PASSES),
    ):
        found = search_for(model, [0.0], [[[0.0, 0.0]]], allowed=allowed, **asked)
        assert found[0] == how
        assert how != KEPT or found[-1] == pytest.approx(3.0)  # of those that are survived


def test_a_regulator_holds_two_unstable_axes_at_a_place_and_ends_where_costs_are_endless():
    A, B = np.eye(5), np.zeros((5, 2))
    A[[1, 3], [2, 4]], A[[2, 4], [1, 3]], B[[2, 4], [0, 1]] = 0.1, 0.2, 0.1
    away = np.eye(5)[1:]
    away[[0, 2], 0] = -1.0, 2.0  # at 1 and -2
    K = regulator(A, B, away.T @ away, 0.01, 200)
    x = np.array([1.0, 0.0, 0.0, 0.0, 0.0])
    for _ in range(400):
        x = A @ x + B @ K @ x
    assert np.allclose(x, [1.0, 1.0, 0.0, -2.0, 0.0], atol=0.3)
    assert np.isfinite(regulator(1e9 * A, B, away.T @ away, 0.01, 200)).all()
