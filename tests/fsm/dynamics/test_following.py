"""A machine with dynamics: what it observes and is told, they learn from, whole or not at all."""

import copy
import io
import pickle

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from evofsm.fsm.dynamics import regression
from evofsm.fsm.dynamics.dynamics import Dynamics
from evofsm.fsm.machine import EvolvingFSM
from evofsm.fsm.memory import leaves
from evofsm.fsm.observations import Missing


def saved(machine):
    file = io.BytesIO()
    machine.save(file)
    return file.getvalue()


def one_by_one(machine, Z, I, U, starts=(), failures=()):
    for t, (z, i, u) in enumerate(zip(Z, I.tolist(), U, strict=True)):
        if t in starts:
            machine.start_episode()
        machine.observe(z, failed=t in failures)
        if i >= 0 and t not in failures:
            machine.act(i, u)


@pytest.mark.parametrize("box", [True, False])
def test_a_batch_is_the_loop(cart, box):
    machine, Z, I, U = cart(box=box)
    twin = machine.copy()
    I[[20, 21]] = -1
    starts, failures = [0, 70], [69, 120]
    told = {"executed": U} if box else {}
    trace = machine.learn_many(Z, I, starts, failures, belief=True, **told)
    one_by_one(twin, Z, I, U if box else [None] * len(U), starts, failures)
    assert saved(machine) == saved(twin)
    assert machine.dynamics.n_episodes >= 3
    assert trace.belief.shape == (150, machine.n_states)
    np.testing.assert_allclose(trace.belief.sum(1), 1.0)


def test_every_way_to_learn_is_the_same(cart):
    machine, Z, I, U = cart()
    others = [machine.copy() for _ in range(3)]
    for z, i, u in zip(Z, I.tolist(), U.tolist(), strict=True):
        machine.observe(z)
        machine.act(i, u)
        others[0].learn_one(z, i, u)
        others[1].update(z, i, u)
        others[2].observe(z)
        others[2].act(0, -u)
        others[2].act(i, [u])  # it replaces the one before
    for other in others[:2]:
        assert saved(other) == saved(machine)
    for one, two in zip(others[2].dynamics.sums, machine.dynamics.sums, strict=True):
        np.testing.assert_array_equal(one, two)


def test_states_are_those_of_a_machine_without(cart):
    machine, Z, I, U = cart()
    without = EvolvingFSM(3, radius=0.5, max_states=6)
    machine.learn_many(Z, I, executed=U)
    without.learn_many(Z, I)
    for (name, one), (_, other) in zip(
        leaves(machine._trimmed()), leaves(without._trimmed()), strict=True
    ):
        if name != "onsets":
            np.testing.assert_array_equal(one, other, err_msg=name)


def test_the_dynamics_given_are_a_template():
    given_ = Dynamics(n_actions=2)
    machine = EvolvingFSM(2, dynamics=given_)
    machine.learn_one([0.0], 0)
    assert given_.n_variables == 0
    assert machine.dynamics.n_variables == 1
    another = EvolvingFSM(2, dynamics=machine.dynamics)  # goes on with what was learnt
    assert another.dynamics.n_variables == 1
    assert not another.dynamics.is_under_way


@pytest.mark.parametrize("twin", [copy.copy, copy.deepcopy, EvolvingFSM.copy])
def test_copies_go_on_alike_and_share_nothing(cart, twin):
    machine, Z, I, U = cart()
    machine.learn_many(Z[:80], I[:80], executed=U[:80])
    machine.dynamics.told = lambda z: bool(z[0] > 1e3)
    other, before = twin(machine), saved(machine)
    assert other.dynamics.told is machine.dynamics.told
    other.learn_many(Z[80:], I[80:], executed=U[80:])
    assert saved(machine) == before
    machine.learn_many(Z[80:], I[80:], executed=U[80:])
    assert saved(machine) == saved(other)


def test_another_process_goes_on_alike(cart):
    machine, Z, I, U = cart()
    machine.learn_many(Z[:80], I[:80], executed=U[:80])
    other = pickle.loads(pickle.dumps(machine))
    for each in (machine, other):
        each.learn_many(Z[80:], I[80:], executed=U[80:])
    assert saved(machine) == saved(other)


def test_onsets_are_counted_where_they_began(cart):
    machine, Z, I, U = cart(rows=150)
    _calm, *rest = cart(rows=95, seed=1)
    machine.learn_many(rest[0], rest[1], executed=rest[2])
    machine.start_episode()
    assert machine.onsets.sum() == 0  # it was not known what is ordinary
    for t, (z, i, u) in enumerate(zip(Z, I.tolist(), U, strict=True)):
        before = machine.onsets.sum()
        state = machine.state
        machine.learn_one(z, i, u)
        if machine.onsets.sum() > before and t == 101:  # the gust was from 100 on
            assert state is not None
            break
    else:
        pytest.fail("the gust was not noticed")
    assert machine.model().onsets.sum() == machine.onsets.sum()


def test_an_onset_in_a_state_just_given_up_is_counted_at_the_nearest(cart):
    machine, Z, I, U = cart()
    machine.learn_many(Z, I, executed=U)
    machine.start_episode()
    total = machine.onsets.sum()
    draw = np.random.default_rng(0)
    for t in range(60):  # each jump creates a state, for which another one is given up
        machine.learn_one(Z[t] + 40.0 * (t % 5 == 4) * draw.normal(size=2), int(I[t]), U[t])
    assert machine.onsets.sum() > total
    assert machine.n_states <= 6


def test_a_failure_ends_the_episode_of_both(cart):
    machine, Z, I, U = cart()
    machine.learn_many(Z[:50], I[:50], executed=U[:50])
    machine.observe([90.0, 0.0], failed=True)
    assert machine.dynamics.n_episodes == 1
    assert [(j, sign) for j, sign, _ in machine.dynamics.sides] == [(0, 1.0)]
    assert not machine.dynamics.is_under_way
    machine.learn_many(Z[:50], I[:50], executed=U[:50])
    machine.fail()
    assert machine.dynamics.n_episodes == 2
    assert len(machine.dynamics.failures) == 2
    assert not machine.dynamics.is_under_way


@pytest.mark.parametrize("missing", [Missing.HOLD, Missing.PARTIAL])
@pytest.mark.parametrize("failed", [False, True])
def test_an_incomplete_observation_is_a_gap(cart, missing, failed):
    machine, Z, I, U = cart()
    machine.learn_many(Z[:50], I[:50], executed=U[:50])
    machine.observe([np.nan, 0.0], missing=missing, failed=failed)
    assert not machine.dynamics.is_under_way
    assert not machine.dynamics.failures
    if not failed:
        machine.act(1, 0.0)
    seen = machine.dynamics.sums.counts[1]
    machine.learn_many(Z[50:53], I[50:53], executed=U[50:53])
    # Of three observations one transition has one after it.
    assert machine.dynamics.sums.counts[1] == seen + 1


def test_an_observation_without_an_action_before_it_is_a_gap(cart):
    machine, Z, I, U = cart()
    machine.learn_many(Z[:50], I[:50], executed=U[:50])
    machine.observe(Z[50])
    machine.observe(Z[51])
    assert machine.dynamics.n_episodes == 1
    assert len(machine.dynamics.under_way[0]) == 1


def test_what_is_executed_beyond_the_range_is_its_end(cart):
    machine, Z, I, U = cart()
    twin = machine.copy()
    machine.learn_many(Z, I, executed=3.0 * U)
    twin.learn_many(Z, I, executed=np.clip(3.0 * U, -1.0, 1.0))
    assert saved(machine) == saved(twin)


def test_of_choices_another_index_may_be_executed():
    machines = [EvolvingFSM(3, dynamics=Dynamics(n_actions=3)) for _ in range(2)]
    for machine, told in zip(machines, (2, None), strict=True):
        machine.observe([0.0])
        machine.act(2 if told is None else 1, told)
    one, other = (machine.dynamics.under_way[1] for machine in machines)
    np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize(
    ("do", "why"),
    [
        (lambda m: m.observe([np.nan, 0.0]), "finite"),
        (lambda m: m.observe([1e31, 0.0]), "at most 1e.30"),
        (lambda m: m.observe([0.0]), "variables"),
        (lambda m: m.learn_one([0.0, 0.0], 0), "executed is missing"),
        (lambda m: m.learn_one([0.0, 0.0], 0, np.nan), "executed"),
        (lambda m: m.learn_one([0.0, 0.0], 0, [0.0, 0.0]), "numbers"),
        (lambda m: m.learn_one([0.0, 0.0], 0, "fast"), "executed"),
        (lambda m: m.update(np.array([0.0, 0.0]), 0), "executed is missing"),
        (lambda m: m.update(np.array([2e30, 0.0]), 0, 0.0), "at most 1e.30"),
        (lambda m: m.act(0), "executed is missing"),
        (lambda m: m.act(5, 0.0), "action"),
        (lambda m: m.learn_many([[0.0, 0.0]] * 2, [0, 0]), "row 0: executed"),
        (lambda m: m.learn_many([[0.0, 0.0]] * 2, [0, 0], executed=[0.0]), "rows"),
        (lambda m: m.learn_many([[0.0, 0.0]] * 2, [0, 0], executed=[0.0, np.inf]), "row 1"),
        (lambda m: m.learn_many([[0.0, 0.0], [1e40, 0.0]], [0, 0], executed=[0, 0]), "1e.30"),
    ],
)
def test_what_is_refused_changes_neither(cart, do, why):
    machine, Z, I, U = cart()
    machine.learn_many(Z[:50], I[:50], executed=U[:50])
    before = saved(machine)
    with pytest.raises((ValueError, TypeError), match=why):
        do(machine)
    assert saved(machine) == before


@pytest.mark.parametrize(
    ("dynamics", "error", "why"),
    [
        (Dynamics(n_actions=4), ValueError, "4 actions, but the machine has 3"),
        ("moves", TypeError, "must be Dynamics"),
        (Dynamics, TypeError, "must be Dynamics"),
    ],
)
def test_dynamics_of_another_system_are_refused(dynamics, error, why):
    with pytest.raises(error, match=why):
        EvolvingFSM(3, dynamics=dynamics)


def test_a_machine_takes_only_observations_like_those_of_its_dynamics(cart):
    machine, Z, I, U = cart()
    machine.learn_many(Z, I, executed=U)
    another = EvolvingFSM(3, dynamics=machine.dynamics)
    with pytest.raises(ValueError, match=r"3 variables, but dynamics learnt from 2"):
        another.observe([0.0, 0.0, 0.0])
    another.observe([0.0, 0.0])


class Interrupted(BaseException):
    pass


@pytest.mark.parametrize("name", ["learn_latest", "solve", "take_in"])
@pytest.mark.parametrize("at", [1, 2, 30])
def test_an_interrupt_leaves_dynamics_whole(cart, monkeypatch, name, at):
    machine, Z, I, U = cart()
    machine.learn_many(Z[:60], I[:60], executed=U[:60])
    kernel, calls = getattr(regression, name), []

    def stop(*arguments):
        found = kernel(*arguments)
        calls.append(None)
        if len(calls) == at:
            raise Interrupted
        return found

    monkeypatch.setattr(f"evofsm.fsm.dynamics.dynamics.{name}", stop)
    t, torn = 60, False
    while t < 100 and not torn:
        before = machine.dynamics.copy()
        try:
            machine.learn_one(Z[t], int(I[t]), U[t])
        except Interrupted:
            torn = True
            for one, two in zip(machine.dynamics.sums, before.sums, strict=True):
                np.testing.assert_array_equal(one, two)
            assert len(machine.dynamics.under_way[0]) == len(before.under_way[0])
        t += 1
    if torn:  # the machine saw one more: a gap to its dynamics
        episodes = machine.dynamics.n_episodes
        machine.learn_one(Z[t], int(I[t]), U[t])
        assert machine.dynamics.n_episodes == episodes + 1
    monkeypatch.undo()
    again = EvolvingFSM.load(io.BytesIO(saved(machine)))
    for each in (machine, again):
        each.learn_many(Z[t + 1 :], I[t + 1 :], executed=U[t + 1 :])
    assert saved(machine) == saved(again)


NUMBERS = st.one_of(
    st.integers(-24, 24).map(lambda k: k / 8),
    st.floats(-1e30, 1e30),
    st.sampled_from([0.0, -0.0, 5e-324, 1e-200, -1e30, 1e30]),
)
STEPS = st.tuples(
    st.tuples(NUMBERS, NUMBERS), st.integers(-1, 2), st.floats(-2.0, 2.0), st.integers(0, 9)
)


@pytest.mark.slow
@settings(max_examples=60)
@given(steps=st.lists(STEPS, min_size=1, max_size=60), cut=st.integers(0, 60))
def test_a_file_in_the_midst_of_anything_changes_nothing(steps, cut):
    machine = EvolvingFSM(3, radius=0.5, max_states=3, dynamics=Dynamics(-1.0, 1.0, horizon=6))
    other = machine.copy()
    for t, (z, i, u, what) in enumerate(steps):
        for each in (machine, other):
            each.observe(z, failed=what == 0)
            if i >= 0 and what != 0:
                each.act(i, u)
            if what == 1:
                each.start_episode()
        if t == cut:
            other = EvolvingFSM.load(io.BytesIO(saved(other)))
    assert saved(machine) == saved(other)
    for array in machine.dynamics.sums:
        assert np.isfinite(array).all()
    assert np.isfinite(machine.dynamics.weights).all()
