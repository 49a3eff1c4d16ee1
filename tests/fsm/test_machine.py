import subprocess
import sys

import numpy as np
import pytest

from evofsm import EvolvingFSM, Novelty

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
    machine = EvolvingFSM(1, rule=Novelty(radius=1e100, spread=1e100))
    assert machine.observe([0.0]).belief.tolist() == [1.0]
    machine = EvolvingFSM(1, rule=Novelty(radius=1e100))
    assert machine.observe([0.0]).belief.tolist() == [1.0]


@pytest.mark.slow
def test_threads_may_begin_at_once():
    program = """
from concurrent.futures import ThreadPoolExecutor
from evofsm import EvolvingFSM
with ThreadPoolExecutor(4) as threads:
    list(threads.map(lambda _: EvolvingFSM(1).learn_one([0.0], 0), range(4)))
"""
    subprocess.run([sys.executable, "-c", program], check=True)


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
