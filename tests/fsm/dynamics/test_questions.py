"""What a machine and its model say of how the system moves."""

import numpy as np
import pytest

from evofsm.fsm.dynamics.dynamics import Dynamics
from evofsm.fsm.machine import EvolvingFSM
from evofsm.fsm.memory import leaves
from evofsm.fsm.naming import Labels


@pytest.fixture
def driven(cart):
    """A machine in its third episode, after a gust in each of the first two."""
    machine, Z, I, U = cart()
    machine.learn_many(Z, I, [0], executed=U)
    for _, more, indices, pushes in (cart(seed=1), cart(rows=40, seed=2)):
        machine.learn_many(more, indices, [0], executed=pushes)
    return machine


def test_the_next_steps_are_those_that_come(cart, driven):
    _, Z, _, U = cart(rows=60, seed=5)
    driven.start_episode()
    for z, u in zip(Z[:40], U[:40], strict=True):
        driven.learn_one(z, 1, u)
    ahead = driven.what_next(U[39:50, None])
    assert ahead.mean.shape == ahead.spread.shape == (11, 2)
    np.testing.assert_allclose(ahead.mean, Z[40:51], atol=0.02)
    assert (np.diff(ahead.spread, axis=0)[:5] > 0.0).all()


def test_an_action_is_held_or_changes(driven):
    held = driven.what_next(0.5, 3)
    changing = driven.what_next([[0.5], [0.5], [0.5]])
    np.testing.assert_array_equal(held.mean, changing.mean)
    np.testing.assert_array_equal(driven.what_next([0.5], 3).mean, held.mean)
    assert driven.what_next(0.5).mean.shape == (1, 2)
    assert driven.what_next(0.5, 200).mean.shape == (200, 2)  # longer than any stretch


def test_indices_are_held_or_change(cart):
    machine, Z, I, _ = cart(box=False)
    machine.learn_many(Z, I)
    held, changing = machine.what_next(2, 3), machine.what_next([2, 2, 2])
    np.testing.assert_array_equal(held.mean, changing.mean)
    assert held.mean[-1, 1] > machine.what_next(0, 3).mean[-1, 1]  # it is pushed the other way


def test_remembered_gusts_widen_the_spread(driven):
    calm = driven.copy()
    calm.dynamics.keep([])
    assert (driven.what_next(0.0, 10).spread[-1] > calm.what_next(0.0, 10).spread[-1]).all()
    np.testing.assert_array_equal(driven.what_next(0.0).mean, calm.what_next(0.0).mean)


def test_it_can_be_asked_from_anywhere(driven):
    ahead = driven.what_next(0.0, 2, observation=[3.0, 0.0])
    np.testing.assert_allclose(ahead.mean, [[3.0, 0.0], [3.0, 0.0]], atol=0.1)


def test_a_model_says_what_its_machine_said(driven):
    model = driven.model(dt=0.25)
    for one, other in zip(model.what_next(0.5, 4), driven.what_next(0.5, 4), strict=True):
        np.testing.assert_array_equal(one, other)
    assert repr(model.may_begin(0, 0.25)) == repr(driven.may_begin(0, 0.25))
    assert repr(model.never_seen()) == repr(driven.never_seen())
    assert repr(model.onset_rates(0.25)) == repr(driven.onset_rates(0.25))


def test_what_may_begin_is_what_was_seen(driven):
    found = driven.may_begin()
    assert len(found.stretches) == len(driven.dynamics.stretches) > 0
    strongest = max(found.stretches, key=lambda one: one.size)
    assert strongest.size > 4.0
    assert strongest.change[1] > 0.1  # the gust: 6 steps of 0.06
    assert {one.episode for one in found.stretches} <= {0, 1}
    assert found.rate.onsets == driven.onsets.sum() >= 1
    assert found.rate.low <= found.rate.rate <= found.rate.high


def test_of_a_state_its_own_onsets_are_told(driven):
    rates = [driven.may_begin(state, 0.25).rate for state in range(driven.n_states)]
    assert [rate.onsets for rate in rates] == driven.onsets.tolist()
    assert [rate.exposure for rate in rates] == (0.25 * driven.visits).tolist()
    shrunk = driven.onset_rates(0.25)
    assert shrunk.rate.shape == shrunk.low.shape == shrunk.high.shape == (driven.n_states,)
    assert (shrunk.low <= shrunk.rate).all()
    assert (shrunk.rate <= shrunk.high).all()


def test_what_was_never_seen_is_told_with_what_is_unlike(driven):
    assert driven.never_seen([1e3, 0.0]).variables == (0,)
    assert driven.never_seen([0.0, -1e3]).variables == (1,)
    inside = 0.5 * (driven.dynamics.lowest + driven.dynamics.highest)
    assert not driven.never_seen(inside).variables
    assert driven.never_seen([1e3, 0.0]).is_unseen
    driven.observe([1e3, 0.0])
    assert driven.never_seen().variables == (0,)


def test_a_question_changes_nothing(driven):
    before = [array.tobytes() for _, array in leaves(driven._trimmed())]
    moves = [array.tobytes() for array in driven.dynamics.sums]
    driven.what_next(0.0, 5)
    driven.may_begin()
    driven.onset_rates()
    driven.never_seen([0.0, 0.0])
    assert [array.tobytes() for _, array in leaves(driven._trimmed())] == before
    assert [array.tobytes() for array in driven.dynamics.sums] == moves


@pytest.mark.parametrize(
    ("ask", "why"),
    [
        (lambda m: m.what_next(0.0, 0), "steps"),
        (lambda m: m.what_next(np.nan), "executed"),
        (lambda m: m.what_next([0.0, 0.0]), "numbers"),
        (lambda m: m.what_next([[0.0], [0.0]], 3), "2 of them; 3 steps"),
        (lambda m: m.what_next(0.0, observation=[0.0]), "variables"),
        (lambda m: m.may_begin(99), "state"),
        (lambda m: m.may_begin(dt=0.0), "dt"),
        (lambda m: m.onset_rates(-1.0), "dt"),
        (lambda m: m.never_seen([np.nan, 0.0]), "finite"),
    ],
)
def test_what_cannot_be_asked_is_refused(driven, ask, why):
    with pytest.raises(ValueError, match=why):
        ask(driven)


def test_without_an_episode_there_is_no_present(driven):
    driven.start_episode()
    for ask in (lambda: driven.what_next(0.0), driven.never_seen):
        with pytest.raises(ValueError, match="nothing was observed yet in this episode"):
            ask()


def test_without_dynamics_it_says_so():
    machine = EvolvingFSM(2)
    machine.learn_one([0.0], 0)
    for known in (machine, machine.model()):
        for ask in ("may_begin", "onset_rates", "never_seen"):
            with pytest.raises(ValueError, match="nobody asked"):
                getattr(known, ask)()


def test_too_little_is_no_answer():
    machine = EvolvingFSM(2, dynamics=Dynamics(n_actions=2))
    machine.learn_one([0.0], 0)
    with pytest.raises(ValueError, match="too little"):
        machine.what_next(0)
    assert machine.may_begin().stretches == ()
    assert machine.never_seen().variables == (0,)  # nothing was survived yet


def test_an_explanation_says_how_often_a_disturbance_began(driven):
    labels = Labels(dt=0.25)
    for state in range(driven.n_states):
        text = driven.model(dt=0.25).explain(state).text
        times = {0: "No disturbance was noticed to begin here, in", 1: "here once in"}
        number = int(driven.onsets[state])
        assert times.get(number, f"here {number} times in") in text
        assert labels.duration(int(driven.visits[state])) in text
    without = EvolvingFSM(3, radius=0.5)
    without.learn_one([0.0, 0.0], 0)
    assert "disturbance" not in without.model().explain(0).text
