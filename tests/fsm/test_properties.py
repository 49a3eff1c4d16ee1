"""What holds for every stream of observations."""

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from evofsm import Event, EvolvingFSM, Novelty
from one_machine import saved


@st.composite
def machines(draw, m, n_actions):
    told = {
        "distance_weight": draw(st.sampled_from([0.3, 0.85, 1.5])),
        "learning_rate": draw(st.sampled_from([0.01, 0.3, 0.9])),
        "prior_frequency": draw(st.sampled_from([1e-6, 1e-3, 1.0])),
    }
    limits = [{}, {"max_states": 1}, {"max_states": 2, "belief_tolerance": 1e-6}]
    told |= draw(st.sampled_from(limits))
    radius = draw(st.sampled_from([0.05, 0.3, 2.0]))
    spread = draw(st.sampled_from([0.05, 1.0, 3.0]))
    if draw(st.booleans()):
        scales = draw(st.sampled_from([(), (0.5, 3.0, 1.0)[:m]]))
        return EvolvingFSM(n_actions, rule=Novelty(radius, scales, spread), **told)
    return EvolvingFSM(n_actions, radius, spread=spread, **told)


@st.composite
def streams(draw, numbers=None):
    """A machine, observations on a coarse grid (so that many are equal), actions and episodes."""
    m, q = draw(st.integers(1, 3)), draw(st.integers(1, 4))
    if numbers is None:
        numbers = st.integers(-32, 32).map(lambda k: k / 8)
    rows = draw(st.lists(st.tuples(*[numbers] * m), min_size=1, max_size=50))
    I = draw(st.lists(st.integers(-1, q - 1), min_size=len(rows), max_size=len(rows)))
    starts, failures = (draw(st.sets(st.integers(0, len(rows) - 1), max_size=5)) for _ in range(2))
    machine = draw(machines(m, q))
    return machine, np.array(rows, dtype=float), np.array(I), sorted(starts), sorted(failures)


def assert_distribution(rows):
    assert (rows >= 0.0).all()
    np.testing.assert_allclose(rows.sum(axis=-1), 1.0, rtol=0, atol=1e-9)


def learn(machine, Z, I, starts=(), failures=()):
    """Learn a batch: a loop learns the same bit for bit, and what is learnt is sound."""
    loop, steps = machine.copy(), []
    trace = machine.learn_many(Z, I, starts, failures, belief=True)
    for row, (z, i) in enumerate(zip(Z, I, strict=True)):
        if row in starts:
            loop.start_episode()
        steps.append(loop.observe(z, failed=row in failures))
        if i >= 0 and row not in failures:
            loop.act(i)
    assert saved(machine) == saved(loop)
    assert trace.state.tolist() == [step.state for step in steps]
    assert trace.event.tolist() == [step.event for step in steps]
    assert trace.surprise.tobytes() == np.array([step.surprise for step in steps]).tobytes()
    assert_sound(machine, Z, trace)
    assert machine.endings.sum() == len(failures)


def assert_sound(machine, Z, trace):
    model = machine.model()
    for rows in (model.transition_matrices, model.marginal_matrix, machine.belief, trace.belief):
        assert_distribution(rows)
    for i in range(machine.n_actions):
        assert_distribution(machine.predict(i, 3))
    assert (model.origin_frequency >= 0.0).all()
    assert ((model.potentials > 0.0) & (model.potentials <= 1.0)).all()
    assert (model.failures <= model.decisions).all()
    if machine.max_states is not None:
        assert machine.n_states <= machine.max_states
        return
    assert (np.diff(trace.n_states, prepend=0) == (trace.event == Event.CREATED)).all()
    assert model.visits.tolist() == np.bincount(trace.state).tolist()
    assert model.created.tolist() == (np.flatnonzero(trace.event == Event.CREATED) + 1).tolist()
    assert model.recognise(Z[-1]).tobytes() == trace.belief[-1].tobytes()
    surprise = trace.surprise[~np.isnan(trace.surprise)]
    assert ((surprise >= 0.0) & (surprise <= 1.0)).all()
    assert model.decisions.sum() == pytest.approx(len(surprise))


@settings(max_examples=200)
@given(streams() | streams(numbers=st.floats(-1e100, 1e100)))
def test_a_batch_and_a_loop_are_the_same_and_what_is_learnt_is_sound(stream):
    learn(*stream)


@pytest.mark.parametrize("scale", [1e-300, 1e-160, 1e-150, 1e-9, 1e9, 1e99])
def test_that_holds_in_every_unit(scale):
    Z = np.random.default_rng(3).normal(size=(200, 2)) * scale
    learn(EvolvingFSM(n_actions=2, radius=0.3 * scale), Z, np.arange(200) % 2)


@settings(max_examples=60)
@given(streams(), st.sampled_from([1.0, -64.0, 2.0**20, -(2.0**40)]))
def test_shifting_all_observations_changes_no_belief(stream, offset):
    machine, Z, I, starts, _ = stream
    assume(machine.max_states is None)  # where states merge, centres are means, which round
    shifted = machine.copy()
    expected = machine.learn_many(Z, I, starts, belief=True)
    trace = shifted.learn_many(Z + offset, I, starts, belief=True)  # exact: a coarse grid
    for a, b in zip(trace, expected, strict=True):
        assert a.tobytes() == b.tobytes()
    assert (shifted.centers == machine.centers + offset).all()


def test_a_row_forgotten_for_long_is_learnt_anew_from_one_visit():
    machine = EvolvingFSM(n_actions=1, radius=0.5, learning_rate=0.5, spread=1e-6)
    machine.learn_many([[0.0], [0.1], [2.0], [1.0]], [0] * 4)
    machine.learn_many(np.ones((5000, 1)), [0] * 5000)
    assert machine.origin_frequency.tolist() == [[0.0, 1.0]]
    machine.learn_many([[0.0], [0.0]], [0, 0])
    assert machine.transition_matrices[0, 0].tolist() == [1.0, 0.0]


@given(st.floats(-1e100, 1e100), st.integers(1, 50))
def test_equal_observations_make_one_state_that_is_certain(value, rows):
    machine = EvolvingFSM(n_actions=1)
    trace = machine.learn_many(np.full((rows, 2), value), [0] * rows)
    assert machine.n_states == 1
    assert machine.belief.tolist() == [1.0]
    assert machine.centers.tolist() == [[value, value]]
    assert not trace.event[1:].any()  # as dense as the centre is not denser
    assert (trace.surprise[1:] == 0.0).all()
