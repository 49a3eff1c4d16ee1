"""Chains of states, against direct linear solves and runs drawn at random."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from evofsm.fsm import chains
from evofsm.fsm.machine import EvolvingFSM
from evofsm.fsm.model import FSMModel
from evofsm.fsm.rules import Novelty


@st.composite
def matrices(draw, least=1):
    """Transition matrices, most of them with zeros."""
    n = draw(st.integers(least, 9))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    weights = rng.random((n, n)) * (rng.random((n, n)) < draw(st.floats(0.1, 1.0)))
    weights[np.arange(n), rng.integers(0, n, n)] += 0.1
    return weights / weights.sum(axis=1, keepdims=True)


def model_of(P, visits=None, changes=None, endings=None):
    n = len(P)
    return FSMModel(
        centers=np.arange(float(n))[:, None],
        potentials=np.ones(n),
        width=1.0,
        transition_matrices=np.array([P]),
        origin_frequency=np.ones((1, n)),
        uses=np.ones(1),
        visits=np.ones(n) if visits is None else visits,
        changes=np.eye(n) if changes is None else changes,
        endings=np.zeros(n) if endings is None else endings,
    )


@given(matrices())
def test_what_leads_where_is_what_powers_say(P):
    some = np.linalg.matrix_power(np.eye(len(P)) + (P > 0.0), len(P)) > 0.0
    assert (chains.leads_to(P) == some).all()


@given(matrices())
def test_the_stationary_distribution_is_that_of_a_direct_solve(P):
    n = len(P)
    balance = np.vstack([P.T - np.eye(n), np.ones(n)])
    solution, _, rank, _ = np.linalg.lstsq(balance, np.append(np.zeros(n), 1.0))
    if not chains.leads_to(P).all(axis=0).any():
        with pytest.raises(ValueError, match="never meet"):
            chains.stationary(P)
        assert rank < n
        return
    shares = chains.stationary(P)
    np.testing.assert_allclose(shares, solution, atol=1e-9)
    assert (shares >= 0.0).all()


@pytest.mark.parametrize("rare", [1e-12, 1e-100, 1e-300])
def test_no_digit_is_lost_where_states_hardly_ever_change(rare):
    P = np.array([[1.0, rare, 0.0], [rare, 1.0, 2.0 * rare], [0.0, rare, 1.0]])
    np.testing.assert_allclose(chains.stationary(P), [0.25, 0.25, 0.5], rtol=1e-14)


@given(matrices(least=2), st.integers(0, 2**32 - 1))
def test_a_passage_takes_as_long_as_a_direct_solve_says(P, seed):
    n, target = len(P), seed % len(P)
    times = chains.passage_times(P, np.arange(n) == target)
    assert times[target] == 0.0
    others = np.arange(n) != target
    if np.isfinite(times).all():
        among = np.eye(n - 1) - P[np.ix_(others, others)]
        expected = np.linalg.solve(among, np.ones(n - 1))
        np.testing.assert_allclose(times[others], expected, rtol=1e-6)
    for i in np.flatnonzero(np.isinf(times)):  # it leads to a state from which no way leads there
        leads = chains.leads_to(np.where(np.arange(n)[:, None] == target, 0.0, P))
        assert (leads[i] & ~leads[:, target]).any()


@given(matrices(), st.integers(0, 2**32 - 1))
def test_the_committor_is_the_share_of_many_steps(P, seed):
    rng = np.random.default_rng(seed)
    goes_on, fails = rng.uniform(0.0, 0.9, len(P)), rng.uniform(0.0, 0.1, len(P))
    fails *= rng.random(len(P)) < 0.5
    share, passed = np.zeros(len(P)), np.eye(len(P))
    for _ in range(400):
        share += passed @ fails
        passed = passed @ (goes_on[:, None] * P)
    np.testing.assert_allclose(chains.committor(goes_on[:, None] * P, fails), share, atol=1e-9)


# -- Of models -------------------------------------------------------------------------------------


def test_a_dead_end_is_a_state_that_failure_is_certain_from():
    P = np.array([[0.0, 0.5, 0.5], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    changes = np.array([[0.0, 2.0, 2.0], [0.0, 2.0, 0.0], [0.0, 0.0, 2.0]])
    visits, endings = np.array([4.0, 4.0, 4.0]), np.array([0.0, 2.0, 0.0])
    model = model_of(P, visits, changes, endings)
    np.testing.assert_allclose(model.committor_forward(), [0.5, 1.0, 0.0])
    np.testing.assert_allclose(model.committor_forward(before=[1]), [0.0, 0.0, 0.0])
    np.testing.assert_allclose(model.committor_forward([2]), [0.5, 0.0, 1.0])
    np.testing.assert_allclose(model.committor_forward([2], action=0), [0.5, 0.0, 1.0])


def test_episodes_that_end_are_not_lost_to_failures_later_on():
    P = np.array([[0.0, 1.0], [0.0, 1.0]])
    changes = np.array([[0.0, 1.0], [0.0, 0.0]])  # of 4 episodes 3 ended in the first state
    model = model_of(P, np.array([4.0, 1.0]), changes, np.array([0.0, 1.0]))
    np.testing.assert_allclose(model.committor_forward(), [0.25, 1.0])


def test_without_a_failure_nothing_fails(grown):
    assert not grown.model().committor_forward().any()


@pytest.mark.parametrize(
    ("ask", "words"),
    [
        (lambda model: model.committor_forward([7]), "state is 7"),
        (lambda model: model.committor_forward(action=1), "action is 1"),
        (lambda model: model.committor_forward(policy="hold"), "policy is 'hold'"),
        (lambda model: model.mfpt([-1]), "state is -1"),
    ],
)
def test_what_there_is_not_is_not_asked_for(ask, words):
    with pytest.raises(ValueError, match=words):
        ask(model_of(np.full((2, 2), 0.5)))


def test_a_machine_is_asked_as_its_model_is():
    machine = EvolvingFSM(2, rule=Novelty(radius=0.5))
    Z = np.random.default_rng(0).uniform(0.0, 3.0, size=(200, 1))
    machine.learn_many(Z, [0, 1] * 100, episode_starts=[0, 50], failures=[49, 150])
    model = machine.model()
    for ask in (
        lambda known: known.committor_forward(),
        lambda known: known.committor_forward(action=1, before=[0]),
        lambda known: known.mfpt([0, 2]),
        lambda known: known.stationary_distribution("observed"),
        lambda known: known.recognise([[0.2], [2.0]]),
        lambda known: known.propagate(np.eye(known.n_states)[0], 1, 3, "observed"),
        lambda known: known.nearest([1.0]),
        lambda known: known.joint_frequency,
        lambda known: (known.width, known.failures_told, known.settings),
    ):
        np.testing.assert_equal(ask(machine), ask(model))
