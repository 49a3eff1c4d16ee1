"""Which action passes, and what is left of the distance to failure then."""

import numpy as np
import pytest

from evofsm.fsm import Consequents, Disturbances, Here
from evofsm.fsm.dynamics.consequents import n_features
from evofsm.guard.learnt.search import KEPT, NOTHING_PASSES, search

STEPS, WALL = 20, 100.0
ACTION = 3  # index of the first one among the features: after 1, the variable, its latest change


def mover(choices=0):
    """One variable, moved by the action, or by the last of two choices; fails at a wall."""
    a = max(1, choices)
    weights = np.zeros((n_features(1, a, box=not choices), 1))
    weights[ACTION + a - 1] = 1.0
    one, none = np.ones(1), np.zeros(1)
    return Consequents(
        weights=weights,
        origin=none,
        reach=one,
        lowest=-np.inf * one,
        highest=np.inf * one,
        least=-9.0 * one,
        most=9.0 * one,
        sides=np.array([[0.0, 1.0, WALL, 1.0]]),
        anew=none,
        mean=none,
        inverse=one,
        close=1e-9 * one,
        gains=one,
        choices=choices,
    )


def search_for(known, proposal, policy, margin, place=0.0):
    """How the proposal does there, if the policy follows and nothing disturbs; what is left."""
    none = np.zeros((1, 1))
    jumps = none - 1.0, none, np.zeros((1, 1, 1)), np.zeros((1, 1, 1, 2)), np.zeros((1, 1, 2))
    calm = Disturbances(np.zeros((1, STEPS, 1)), *jumps)
    here = Here(np.array([place]), np.zeros(1), np.zeros(len(policy)))
    world = (policy[None], np.zeros(1, int), calm, 1.0, margin, 0)
    how, _, left = search(known, here, np.array(proposal), *world, np.empty(len(policy)))
    return how, left


@pytest.mark.parametrize("margin", [0.0, 0.25, 8.0])
@pytest.mark.parametrize("to_wall", [True, False])
def test_the_larger_the_margin_the_less_a_backup_is_counted_on_to_do(margin, to_wall):
    policy = np.array([[5.0 if to_wall else -5.0, 0.0]])  # beyond both ends of the range
    used = 1.0 - 0.01 * margin
    how, left = search_for(mover(), [0.5], policy, margin)
    assert how == KEPT
    assert left == pytest.approx(WALL - 0.5 - (STEPS - 1) * used * to_wall)


def test_where_full_action_only_just_holds_nothing_passes():
    """No distance says that: it is as far from the wall as ever."""
    known = mover()
    known.weights[0] = 0.999  # what it withstands
    policy = np.array([[-1.0, 0.0]])
    assert search_for(known, [-1.0], policy, 0.0, place=80.0)[0] == KEPT
    assert search_for(known, [-1.0], policy, 0.25, place=99.0)[0] == KEPT
    assert search_for(known, [-1.0], policy, 0.25, place=99.74)[0] == NOTHING_PASSES


def test_of_choices_nothing_is_held_back():
    policy = np.array([[0.0, 0.0], [1.0, 0.0]])
    how, left = search_for(mover(choices=2), [0.0, 1.0], policy, 8.0)
    assert (how, left) == (KEPT, WALL - STEPS)
