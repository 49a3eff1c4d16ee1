import numpy as np
import pytest

from evofsm.fsm.machine import EvolvingFSM
from evofsm.fsm.states.edges import Edges
from evofsm.fsm.step import Event


def outward(rule):
    """A dense cloud, and then observations farther and farther out."""
    machine = EvolvingFSM(n_actions=1, radius=1.0, rule=rule)
    cloud = np.random.default_rng(0).normal(0.0, 0.1, size=(200, 2))
    machine.learn_many(cloud, [0] * 200)
    return machine, [machine.observe([x, 0.0]).event for x in (3.0, 6.0, 9.0)]


def test_a_state_is_founded_at_the_edges_where_the_papers_rule_founds_none():
    assert outward(None)[1] == [Event.NONE] * 3
    machine, events = outward(Edges())
    assert events == [Event.CREATED] * 3
    assert machine.centers[-3:].tolist() == [[3.0, 0.0], [6.0, 0.0], [9.0, 0.0]]


def test_an_edge_within_the_radius_of_a_centre_founds_none():
    machine, _ = outward(Edges())
    assert machine.observe([10.0, 0.0]).event == Event.NONE  # at exactly the radius
    assert machine.observe([10.1, 0.0]).event == Event.CREATED


def test_what_lies_between_the_edges_is_judged_as_by_the_papers_rule():
    machine, _ = outward(Edges())
    assert machine.observe([4.5, 0.0]).event == Event.NONE


def test_an_edge_has_the_potential_of_its_observation():
    machine = EvolvingFSM(n_actions=1, radius=1.0, rule=Edges())
    cloud = np.random.default_rng(0).normal(0.0, 0.1, size=(200, 2))
    machine.learn_many(cloud, [0] * 200)
    assert machine.observe([3.0, 0.0]).event == Event.CREATED
    squared_distance = ((cloud.mean(axis=0) - [3.0, 0.0]) ** 2).sum()
    potential = 1.0 / (1.0 + squared_distance + cloud.var(axis=0).sum())
    assert machine.potentials[-1] == pytest.approx(potential)
