import numpy as np
import pytest

from evofsm.fsm.machine import EvolvingFSM
from evofsm.fsm.states.failure import FailureSplit
from evofsm.fsm.states.novelty import Novelty
from evofsm.fsm.states.paper import Paper
from evofsm.fsm.step import Event


def machine_with(**settings):
    """One state at 0, which holds everything up to 10, in which there were four stays."""
    machine = EvolvingFSM(n_actions=2, rule=FailureSplit(Novelty(radius=10.0), **settings))
    machine.learn_many([[0.0], [1.0]] * 4, [0] * 8, [0, 2, 4, 6])
    assert machine.n_states == 1
    return machine


def fail_at(machine, z):
    machine.start_episode()
    return machine.observe([z], failed=True).event


def test_a_failure_in_a_mostly_safe_state_founds_one():
    machine = machine_with(distance=0.5)
    assert fail_at(machine, 4.0) == Event.CREATED
    assert machine.centers.tolist() == [[0.0], [4.0]]
    assert machine.endings.tolist() == [0.0, 1.0]


def test_a_safe_observation_at_the_same_place_founds_none():
    machine = machine_with(distance=0.5)
    assert machine.observe([4.0]).event == Event.NONE


def test_no_failure_founds_a_state_within_the_distance_of_a_centre():
    machine = machine_with(distance=0.5)
    assert [fail_at(machine, z) for z in (0.5, 0.51)] == [Event.NONE, Event.CREATED]


def test_a_state_is_split_only_while_fewer_stays_than_the_share_ended_in_failure():
    machine = machine_with(distance=0.5, share=0.4)
    for _ in range(4):
        assert fail_at(machine, 0.1) == Event.NONE
    assert fail_at(machine.copy(), 4.0) == Event.NONE  # 4 failures in 8 stays
    for _ in range(2):
        machine.start_episode()
        machine.observe([0.0])
    assert fail_at(machine.copy(), 4.0) == Event.NONE  # in 10 stays: exactly the share
    machine.start_episode()
    machine.observe([0.0])
    assert fail_at(machine.copy(), 4.0) == Event.CREATED  # in 11


def test_long_stays_count_once_each():
    machine = machine_with(distance=0.5)
    for _ in range(4):
        fail_at(machine, 0.1)
    machine.start_episode()
    machine.learn_many(np.zeros((100, 1)), [0] * 100)
    assert fail_at(machine.copy(), 4.0) == Event.CREATED  # 4 failures in 9 stays
    fail_at(machine, 0.1)
    assert fail_at(machine.copy(), 4.0) == Event.NONE  # 5 in 10


def test_a_failure_without_a_further_observation_splits_at_the_latest():
    machine = machine_with(distance=0.5)
    machine.start_episode()
    machine.observe([4.0])
    machine.act(1)
    machine.fail()
    assert machine.centers.tolist() == [[0.0], [4.0]]
    assert machine.endings.tolist() == [0.0, 1.0]
    assert machine.model().founded.tolist() == [1.0, 9.0]
    belief = np.exp(np.array([-16.0, 0.0]) / 100.0)
    np.testing.assert_allclose(machine.failures[1], belief / belief.sum())
    np.testing.assert_allclose(machine.transition_matrices.sum(axis=2), 1.0)


def test_a_failure_that_the_base_answers_is_left_to_it():
    machine = machine_with(distance=0.5)
    assert fail_at(machine, 11.0) == Event.CREATED
    assert machine.n_states == 2


def test_distance_is_measured_in_the_scales_of_the_base():
    rule = FailureSplit(Novelty(radius=10.0, scales=(4.0,)), distance=1.0)
    machine = EvolvingFSM(n_actions=1, rule=rule)
    machine.observe([0.0])
    assert [fail_at(machine.copy(), z) for z in (4.0, 4.1)] == [Event.NONE, Event.CREATED]
    assert rule.scales == (4.0,)


def test_many_splits_outgrow_the_first_room():
    rule = FailureSplit(Novelty(radius=1000.0), distance=0.5)
    machine = EvolvingFSM(n_actions=1, rule=rule)
    machine.observe([0.0])
    for k in range(1, 20):
        machine.start_episode()
        machine.observe([float(k)])
        machine.fail()
        for _ in range(3):  # safe from now on
            machine.start_episode()
            machine.observe([float(k)])
    assert machine.centers.ravel().tolist() == list(range(20))
    np.testing.assert_allclose(machine.transition_matrices.sum(axis=2), 1.0)


def test_the_settings_are_looked_at():
    with pytest.raises(ValueError, match=r"share is 1.5; it must be at most 1"):
        FailureSplit(share=1.5)
    with pytest.raises(ValueError, match=r"distance is 0.0; it must be a positive"):
        FailureSplit(distance=0.0)
    for base in (FailureSplit(), Novelty, "novelty", None):
        with pytest.raises(TypeError, match=r"base is .*; it must be another rule, as an object"):
            FailureSplit(base)
    assert FailureSplit(Paper()).base == Paper()
