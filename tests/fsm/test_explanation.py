"""What is counted of episodes, and what is said of it."""

from dataclasses import dataclass
from itertools import pairwise
from typing import ClassVar

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from evofsm import EvolvingFSM, Novelty, register_rule
from evofsm.fsm.explanation import Tally
from evofsm.fsm.proportions import FailureRecord, binomial_bounds, poisson_bounds, wilson_bounds


def by_hand(states, I, starts, failures, horizon, n):
    """The same counts, episode by episode, as their definitions have them."""
    cut = sorted({0, *starts.tolist(), *(failures + 1).tolist(), len(states)})
    counts = {"episodes": np.zeros(n), "failed_soon": np.zeros(n)}
    counts |= {"tried": np.zeros((3, n)), "failed_after": np.zeros((3, n))}
    for begin, end in pairwise(cut):
        failed = end - 1 in failures
        if end == len(states) and not failed:
            continue  # it is going on
        for state in set(states[begin:end]):
            counts["episodes"][state] += 1
            soon = [end - 1 - row <= horizon for row in range(begin, end) if states[row] == state]
            counts["failed_soon"][state] += failed and any(soon)
        taken = {(I[row], states[row], row) for row in range(begin, end - 1) if I[row] >= 0}
        for action, state in {(a, s) for a, s, _ in taken}:
            counts["tried"][action, state] += 1
            rows = [row for a, s, row in taken if (a, s) == (action, state)]
            soon = [end - 1 - row <= horizon for row in rows]
            counts["failed_after"][action, state] += failed and any(soon)
    return counts


@settings(max_examples=60)
@given(seed=st.integers(0, 10_000), horizon=st.sampled_from([1, 3, 8, None]))
def test_an_episode_counts_once_for_each_state_and_action(seed, horizon):
    """Rows over a few places, cut into episodes of which some fail."""
    rng = np.random.default_rng(seed)
    Z, I = rng.integers(0, 4, size=(60, 1)) * 10.0, rng.integers(-1, 3, size=60)
    starts, failures = (np.flatnonzero(rng.random(60) < 0.1) for _ in range(2))
    machine = EvolvingFSM(3, rule=Novelty(radius=1.0), failure_horizon=horizon)
    states = machine.learn_many(Z, I, starts, failures).state
    limit = np.inf if horizon is None else horizon
    told = by_hand(states.tolist(), I, starts, failures, limit, machine.n_states)
    for name, counts in told.items():
        for one in (machine, machine.model()):
            np.testing.assert_array_equal(getattr(one, name), counts, err_msg=name)


def test_of_a_single_action_none_is_better():
    machine = EvolvingFSM(1, rule=Novelty(radius=1.0))
    for fails in [False, True] * 10:  # in a row after which nothing is done
        rows = [[0.0], [4.0]] if fails else [[0.0], [4.0], [0.0]]
        machine.learn_many(rows, [0] * len(rows), [0], [1] * fails)
    said = machine.model().explain(1)
    assert (said.here[:2], said.better) == ((10, 20), None)


def test_where_states_were_joined_there_is_no_interval():
    machine = EvolvingFSM(1, rule=Novelty(radius=1.0), max_states=2)
    for episode in range(6):
        machine.start_episode()
        machine.learn_many([[0.0], [4.0]], [0, 0])
        if episode:
            machine.fail()
    machine.start_episode()
    machine.observe([50.0])  # the two of before are joined
    machine.start_episode()
    model = machine.model()
    (joined,) = np.flatnonzero(model.joined)
    text = model.explain(int(joined)).text
    assert "States were joined: an episode may count twice, and have been elsewhere." in text
    assert "%" not in text
    text = model.explain(observation=[4.0]).text  # seen six times
    assert text.startswith("Perhaps seen before states were joined: 2 from the nearest")


# -- What is said ----------------------------------------------------------------------------------


@pytest.fixture
def machine():
    """It learnt of two places, a far one and a close one."""
    machine = EvolvingFSM(2, rule=Novelty(radius=5.0))
    machine.learn_many([[60.0, 20.0, 20.0], [5.0, 20.0, 20.0]] * 3, [1, 0] * 3, [0, 2], [5])
    return machine


def test_what_is_new_is_said_to_be(machine):
    machine.start_episode()
    assert machine.explain().text == "Nothing was observed yet in this episode."
    machine.observe([200.0, 5.0, 5.0])
    found = machine.explain()
    assert "Never seen but in one observation." in found.text
    assert found.here == Tally(0, 0)
    machine.observe([200.0, 5.0, 5.0])
    text = machine.explain().text
    assert "No earlier episode that was counted came here (2 observations)." in text
    assert EvolvingFSM(1).model().explain([]).text == "Nothing was learnt yet."


@pytest.mark.parametrize(
    ("told", "error", "says"),
    [
        ({"situation": 2}, ValueError, "state is 2; there are states 0 to 1"),
        ({"situation": 0.5}, TypeError, "state is 0.5"),
        ({"situation": [1.0]}, ValueError, "the model has 2 states"),
        ({"situation": [0.5, 0.9]}, ValueError, "belief"),
        ({"situation": 0, "action": 2}, ValueError, "action is 2"),
        ({}, ValueError, "either a situation or an observation"),
        ({"situation": 0, "observation": [0]}, ValueError, "either a situation or an observation"),
        ({"observation": [0.0, 1.0]}, ValueError, "z has shape"),
        ({"observation": np.zeros((2, 3))}, ValueError, "2 observations; one"),
    ],
)
def test_what_cannot_be_explained_is_refused(machine, told, error, says):
    with pytest.raises(error, match=says):
        machine.model().explain(**told)


# -- Failures that nobody told of ------------------------------------------------------------------


def untold():
    machine = EvolvingFSM(1, rule=Novelty(radius=1.0))
    machine.learn_many([[0.0], [5.0]] * 3, [0] * 6, [0, 2, 4])
    machine.start_episode()
    return machine


def test_without_a_word_of_failures_none_are_said_to_be_rare():
    found = untold().model().explain(0, action=0)
    assert "how many failed is not known" in found.text
    assert "3 of which took a(1)" in found.text
    assert "0 of 3" not in found.text
    assert np.isnan(found.here.share)
    assert found.here.interval == (0.0, 1.0)
    assert found.better is None


@pytest.mark.parametrize(
    "tell",
    [
        lambda machine: machine.tell_of_failures(),
        lambda machine: machine.observe([0.0], failed=False),
        lambda machine: machine.learn_many([[0.0]], [0], failures=[]),
    ],
)
def test_failures_that_were_told_and_never_happened_are_counted_as_none(tell, reloaded):
    machine = untold()
    assert not machine.failures_told
    tell(machine)
    assert "0 of 3 (at most 64 %) failed later on" in machine.model().explain(0).text
    for one in (machine, machine.model()):
        assert reloaded(one).failures_told
    assert machine.copy().failures_told


# -- What was never seen ---------------------------------------------------------------------------


@dataclass(frozen=True)
class Own:
    scales: ClassVar = ()
    table: ClassVar = Novelty(radius=1.0, spread=9.0).table


register_rule("own", Own)


@pytest.mark.parametrize(
    ("rule", "seen", "never"),
    [
        (Novelty(radius=1.0, spread=9.0), 5.9, 6.1),  # its radius
        (Own(), 5.9, 6.1),
        (None, 8.6, 8.7),  # twice the root of the width, which is 3 times the variance
    ],
)
def test_what_lies_far_from_every_state_was_never_seen_whatever_the_belief(rule, seen, never):
    machine = EvolvingFSM(1, rule=rule)
    machine.learn_many([[0.0], [5.0]] * 20, [0] * 40, range(0, 40, 2), failures=[])
    model = machine.model()
    near, far = model.explain(observation=[seen]), model.explain(observation=[never])
    assert not near.never_seen
    assert "came here" in near.text
    assert far.never_seen
    assert far.text.startswith("Never seen, as far as the states tell")
    assert (far.here, far.visits, far.action) == (Tally(0, 0), 0, None)
    assert far.state == model.recognise([never]).argmax()


def test_what_came_after_an_action_is_part_of_what_came_here():
    machine = EvolvingFSM(2, rule=Novelty(radius=1.0))
    machine.observe([0.0, 0.0])
    for _ in range(20):  # in which nobody saw whole where it is taken
        machine.start_episode()
        machine.observe([0.0, np.nan], partial=True)
        machine.act(1)
        machine.observe([10.0, 0.0], failed=True)
    text = machine.model().explain(0, action=1).text
    assert "0 of 1 (at most 95 %) failed later on; none of them is known to have tried a(2)" in text


@pytest.mark.parametrize("horizon", [None, 2])
@pytest.mark.parametrize("blind", [1, 6])
def test_who_fails_after_a_sensor_fell_silent_has_failed(horizon, blind):
    """Of the latest observations, that of the failure too, one variable was not seen."""
    machine = EvolvingFSM(2, rule=Novelty(radius=1.0), failure_horizon=horizon)
    for _ in range(8):
        machine.start_episode()
        machine.learn_one([0.0, 0.0], 1)
        for k in range(blind):
            machine.observe([0.0, np.nan], partial=True, failed=k == blind - 1)
            if k < blind - 1:
                machine.act(1)
    model = machine.model()
    assert "8 of 8 (at least 68 %) after a(2)" in model.explain(0, action=1).text
    assert (model.failures[1, 0], model.decisions[1, 0]) == (8.0, 8.0 * blind)


# -- How often something begins, and how well that is known ----------------------------------------


@pytest.mark.parametrize(
    ("count", "of"), [(0, 1), (1, 3), (5, 5), (7, 10), (19, 4000), (30, 60), (1000, 4000)]
)
def test_intervals_of_shares_and_of_counts_are_those_of_beta_and_gamma_distributions(count, of):
    exact = stats.beta.ppf([0.05, 0.95], [count, count + 1], [of - count + 1, of - count])
    share, near = np.nan_to_num(exact, nan=count / of), 1e-9 if count < 20 else 0.011
    np.testing.assert_allclose(binomial_bounds(count, of), share, atol=near)
    exact = np.nan_to_num(stats.gamma.ppf([0.05, 0.95], [count, count + 1]))
    np.testing.assert_allclose(poisson_bounds(count), exact, rtol=1e-3)
    for wrong in (3, 1.02, -0.1):  # as a count for a share
        with pytest.raises(ValueError, match="share must lie between 0 and 1"):
            wilson_bounds(wrong, 10)


def test_failures_are_told_with_what_they_rest_on():
    assert str(FailureRecord(0, 9.0)) == "0 failures in 9 h: at most 0.34 per hour, 95 %, one-sided"
    text = str(FailureRecord(1, 0.0, 0.0, 1))
    assert text == "1 failure in 1 episode, 0 h, 0 km: nothing is known"
    assert str(FailureRecord(1, 0.00419, 0.2)).startswith("1 failure in 0.0041 h, 0.2 km: 240 per")
    text = str(FailureRecord(2, 120.7, 9000.0, 500))
    assert text.startswith("2 failures in 500 episodes, 120 h, 9,000 km: 0.017 per hour (0.0029 to")
    assert text.endswith("0.22 per 1,000 km (0.039 to 0.70), 90 %, two-sided")


def test_bounds_of_failures_are_rounded_outward():
    for failures in range(12):
        record = FailureRecord(failures, 7.3)
        said = str(record).partition(": ")[2]
        low, high = (0.0, said.split()[2]) if not failures else said.split("(")[1].split()[:3:2]
        low, high = float(low), float(str(high).rstrip("),"))
        exact = [bound / 7.3 for bound in poisson_bounds(failures)]
        assert low <= exact[0] <= exact[1] <= high <= 1.11 * exact[1]
