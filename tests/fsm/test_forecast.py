"""Direct forecasts: what they learn and refuse; and how far a forecast is from what came."""

from decimal import Decimal, localcontext

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from evofsm import EvolvingFSM, Forecasts, Novelty, jensen_shannon

RULE = Novelty(radius=0.9, spread=0.5)


@pytest.fixture(scope="module")
def walk():
    """A drive along a line, back and forth; the action tells the direction."""
    rng = np.random.default_rng(0)
    direction = np.repeat(rng.integers(0, 2, 400), 5)
    at = np.zeros(2000)
    for k, up in enumerate(direction[:-1]):
        at[k + 1] = np.clip(at[k] + (0.3 if up else -0.3), -4.0, 4.0)
    return at[:, None] + 0.02 * rng.normal(size=(2000, 1)), direction


@pytest.fixture(scope="module")
def machine(walk):
    machine = EvolvingFSM(n_actions=2, rule=RULE)
    machine.learn_many(*walk)
    return machine


@pytest.fixture(scope="module")
def taught(walk, machine):
    Z, actions = walk
    forecasts = Forecasts(n_actions=2, steps=[1, 5])
    forecasts.learn(machine.model(), Z[:1500], actions[:1500])
    return forecasts


def matrix(forecasts, action, steps):
    return forecasts.predict(np.eye(forecasts.n_states), action, steps)


@pytest.mark.parametrize("steps", [1, 5])
def test_held_out_rows_are_foreseen_better_than_by_persistence(taught, machine, walk, steps):
    Z, actions = walk
    beliefs = machine.model().recognise(Z[1500:])
    now, then = beliefs[:-steps], beliefs[steps:]
    predicted = taught.predict(now, actions[1500:-steps], steps)
    assert jensen_shannon(predicted, then).mean() < 0.8 * jensen_shannon(now, then).mean()


def test_states_created_later_are_taken_in(walk):
    Z, actions = walk
    machine = EvolvingFSM(n_actions=2, rule=RULE)
    forecasts = Forecasts(n_actions=2, steps=[1])
    counts = []
    for begin in range(0, 400, 20):
        rows = slice(begin, begin + 20)
        machine.learn_many(Z[rows], actions[rows])
        forecasts.learn(machine.model(), Z[rows], actions[rows])
        counts.append(forecasts.n_states)
    assert counts[0] < counts[-1] == machine.n_states
    np.testing.assert_allclose(matrix(forecasts, 0, 1).sum(axis=1), 1.0, atol=1e-9)


def test_what_was_counted_of_a_merged_state_is_not_said_of_the_one_in_its_place():
    machine = EvolvingFSM(1, rule=Novelty(1.0, spread=0.3), max_states=9)
    forecasts = Forecasts(1, [1])
    for lap in range(40):
        Z = 2.0 * lap + np.resize([0.0, 3.0, 6.0, 9.0], (80, 1))
        machine.learn_many(Z, [0] * 80, [0])
        forecasts.learn(machine.model(), Z, [0] * 80)
    now, then = (belief := machine.model().recognise(Z))[:-1], belief[1:]
    ours = jensen_shannon(forecasts.predict(now, 0, 1), then).mean()
    assert ours < 0.9 * jensen_shannon(now, then).mean()


def test_steps_and_questions_that_cannot_be_are_refused_and_change_nothing(taught, machine, walk):
    Z, actions = walk
    for steps, why in (([], "one or more"), ([2, 2], "each once"), ([0], "a positive integer")):
        with pytest.raises(ValueError, match=why):
            Forecasts(n_actions=2, steps=steps)
    before = matrix(taught, None, 1)
    with pytest.raises(ValueError, match="no horizon of 3 steps; there are 1, 5"):
        taught.predict(machine.belief, 0, 3)
    with pytest.raises(ValueError, match="actions 0 to 1"):
        taught.predict(machine.belief, 2, 1)
    with pytest.raises(ValueError, match="of another machine"):
        taught.predict([1.0], 0, 1)
    with pytest.raises(ValueError, match="actions"):
        taught.learn(machine.model(), Z[:10], actions[:9])
    with pytest.raises(ValueError, match="cannot be used"):
        taught.learn(machine.model(), [[np.nan]], [0])
    np.testing.assert_array_equal(before, matrix(taught, None, 1))


# -- Divergence ------------------------------------------------------------------------------------


@st.composite
def pairs(draw):
    n = draw(st.integers(1, 6))
    weights = st.lists(st.floats(0, 1), min_size=n, max_size=n).filter(lambda w: sum(w) > 1e-3)
    return [np.array(w) / sum(w) for w in (draw(weights), draw(weights))]


def exactly(p, q):
    """The definition, in 60 digits."""
    with localcontext(prec=60):
        terms = []
        for a, b in zip(map(Decimal, p), map(Decimal, q), strict=True):
            middle = (a + b) / 2
            terms += [x * (x / middle).ln() for x in (a, b) if x > 0]
        return float(sum(terms) / 2 / Decimal(2).ln())


@pytest.mark.parametrize("difference", [*np.geomspace(1e-7, 0.5, 60), 0.01, 0.1, 0.25])
def test_it_is_exact_from_nearly_equal_to_disjoint_distributions(difference):
    for center in (0.5, 0.25):
        p = [center + difference * center, 1 - center - difference * center]
        q = [center - difference * center, 1 - center + difference * center]
        assert jensen_shannon(p, q) == pytest.approx(exactly(p, q), rel=1e-12, abs=1e-15)


@given(pairs())
def test_it_is_symmetric_between_0_and_1_and_0_of_itself(pair):
    p, q = pair
    assert jensen_shannon(p, q) == pytest.approx(jensen_shannon(q, p), abs=1e-15)
    assert 0.0 <= jensen_shannon(p, q) <= 1.0
    assert jensen_shannon(p, p) == 0.0


@pytest.mark.parametrize(
    ("p", "q", "words"),
    [
        ([0.5, 0.5], [1.0], r"p has shape \(2,\) and q has shape \(1,\)"),
        (1.0, 1.0, "number of states on their last axis"),
        ([1.5, -0.5], [0.5, 0.5], "p is no distribution"),
        ([0.5, 0.5], [np.nan, 0.5], "q is no distribution"),
    ],
)
def test_what_is_no_pair_of_distributions_is_refused(p, q, words):
    with pytest.raises(ValueError, match=words):
        jensen_shannon(p, q)
