import copy
import pickle
import subprocess
import sys
import threading
from collections import Counter

import numpy as np
import pytest

import one_machine
from evofsm import Event, EvolvingFSM, Novelty, Paper

# -- Failure -----------------------------------------------------------------------------------


def test_what_led_to_failure_is_counted_by_hand():
    machine = EvolvingFSM(n_actions=3, radius=0.5, spread=1e-6)  # a belief is exactly 0 or 1
    machine.learn_many([[0.0], [0.0], [2.0], [1.0]], [-1, -1, -1, -1])
    assert machine.centers.tolist() == [[0.0], [1.0]]
    machine.start_episode()
    machine.learn_one([0.0], 1)
    machine.learn_one([1.0], 2)
    machine.learn_one([1.0], 0)
    machine.observe([0.0], failed=True)  # action 0 in state 1 led there
    machine.learn_one([0.0], 1)
    machine.fail()  # action 1 in state 0 led there
    assert machine.decisions.tolist() == [[0.0, 1.0], [2.0, 0.0], [0.0, 1.0]]
    assert machine.failures.tolist() == [[0.0, 1.0], [1.0, 0.0], [0.0, 0.0]]
    assert machine.endings.tolist() == [2.0, 0.0]
    assert machine.model().uses.tolist() == [1.0, 1.0, 1.0]  # `fail` teaches no transition


@pytest.mark.parametrize("end", [EvolvingFSM.fail, lambda m: m.observe([0.3, 0.1], failed=True)])
def test_after_a_failure_an_episode_begins(grown, end):
    end(grown)
    assert grown.state is None
    assert grown.belief.tolist() == [1.0 / grown.n_states] * grown.n_states
    with pytest.raises(ValueError, match="act before observe"):
        grown.act(0)
    with pytest.raises(ValueError, match="fail before observe: this episode"):
        grown.fail()
    changes = grown.model().changes.sum()
    assert np.isnan(grown.observe([0.2, 0.1]).surprise)
    assert grown.model().changes.sum() == changes


GIVEN = {
    "a list": lambda z: z.tolist(),
    "single precision": lambda z: z.astype(np.float32),
    "whole numbers": lambda z: z.astype(int),
    "with gaps": lambda z: np.column_stack([z, z])[:, 0],
    "read-only": lambda z: np.broadcast_to(z, z.shape),
    "another order of bytes": lambda z: z.astype(">f8"),
}


@pytest.mark.parametrize("given", GIVEN.values(), ids=GIVEN.keys())
def test_observations_of_any_kind_are_the_same(given, grown, snapshot):
    z = np.array([2.0, 1.0])
    plain, other = grown.copy(), grown.copy()
    for machine, observed in ((plain, z), (other, given(z))):
        machine.learn_one(observed, 1)
        machine.observe(observed)
    assert snapshot(plain) == snapshot(other)


def test_a_width_beyond_all_bounds_leaves_no_belief_to_states_that_are_not_there():
    for rule in (Novelty(radius=1e100, spread=1e100), Novelty(radius=1e100)):
        assert EvolvingFSM(1, rule=rule).observe([0.0]).belief.tolist() == [1.0]


def test_a_question_changes_nothing_and_its_answer_is_the_askers_own(grown, snapshot):
    before = snapshot(grown)
    for name in ("belief", "centers", "visits", "state_ids", "decisions", "transition_matrices"):
        getattr(grown, name)[...] = 7
    grown.predict(0, 50)[...] = 7
    model = grown.model()
    model.recognise([0.1, 0.2])
    model.propagate(grown.belief, 0, 3)
    grown.copy().learn_many(np.ones((4, 2)), [0] * 4)
    assert snapshot(grown) == before
    step = grown.learn_one([0.5, 0.2], 0)
    belief, predicted = step.belief.tolist(), step.predicted.tolist()
    grown.learn_one([-3.0, 1.0], 1)
    assert (step.belief.tolist(), step.predicted.tolist()) == (belief, predicted)


# -- Shared, interrupted, copied -------------------------------------------------------------------


@pytest.mark.slow
def test_threads_may_begin_at_once():
    program = """
from concurrent.futures import ThreadPoolExecutor
from evofsm import EvolvingFSM
with ThreadPoolExecutor(4) as threads:
    list(threads.map(lambda _: EvolvingFSM(1).learn_one([0.0], 0), range(4)))
"""
    subprocess.run([sys.executable, "-c", program], check=True)


@pytest.mark.parametrize("interval", [sys.getswitchinterval(), 1e-6])
def test_threads_on_one_machine_lose_no_observation(interval):
    one_machine.compile_all()
    assert one_machine.share(one_machine.growing(), 4, 100, interval) == 0


@pytest.mark.slow
@pytest.mark.parametrize("deed", one_machine.DEEDS)
def test_an_interrupt_at_any_line_leaves_a_whole_machine(deed):
    found = Counter(one_machine.harms(one_machine.DEEDS[deed]))
    assert found.total() >= 3
    assert set(found) == {""}


@pytest.mark.parametrize(
    "twin", [copy.copy, copy.deepcopy, lambda m: pickle.loads(pickle.dumps(m))]
)
def test_a_copy_goes_its_own_way_and_has_a_lock_of_its_own(grown, snapshot, twin):
    grown.site, before = "B", snapshot(grown)  # as a class of one's own adds
    with grown._lock:
        another = twin(grown)
        assert (another.site, snapshot(another)) == ("B", before)
        elsewhere = threading.Thread(target=another.learn_one, args=([0.1, 0.2], 0), daemon=True)
        elsewhere.start()
        elsewhere.join(20.0)
        assert not elsewhere.is_alive()
    assert snapshot(another) != before == snapshot(grown)


# -- With a limit on states, or a tolerance in beliefs ---------------------------------------------


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
