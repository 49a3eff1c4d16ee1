import numpy as np
import pytest

from evofsm.driving.drivers.function import FunctionController
from evofsm.driving.drivers.idm import IDM
from evofsm.driving.worlds.kinematic import KinematicWorld
from evofsm.driving.worlds.scenario import Leader, Scenario
from evofsm.guard.protocols import Proposal

SEEN = np.array([12.0, 10.0, 9.0])


@pytest.mark.parametrize("answer", [1, 1.0, np.float32(1.0), np.array(1.0)])
def test_a_number_becomes_a_proposal(answer):
    proposal = FunctionController(lambda seen: answer).propose(SEEN)
    assert proposal == Proposal(1.0)
    assert type(proposal.action) is float


def test_a_proposal_is_handed_on_with_its_candidates():
    proposal = Proposal(1.0, (0.5, -1.0))
    assert FunctionController(lambda seen: proposal).propose(SEEN, 3.0) is proposal


def test_the_function_is_given_the_observation():
    assert FunctionController(lambda seen: seen[0] - seen[1]).propose(SEEN).action == 2.0


@pytest.mark.parametrize("answer", [None, "1.0", (1.0, ()), [1.0], np.array([1.0]), 1j])
def test_what_is_no_acceleration_is_refused_with_the_likely_cause(answer):
    with pytest.raises(TypeError, match="must return an acceleration"):
        FunctionController(lambda seen: answer).propose(SEEN)


def test_what_cannot_be_called_is_refused():
    with pytest.raises(TypeError, match="cannot be called"):
        FunctionController(1.0)


def test_it_drives_a_world():
    idm = IDM(1.25, 25.0, 2.0, 1.5, 2.0, lowest=-4.0)
    leader = Leader(IDM(1.2, 25.0, 1.0, 1.0, 2.5), brake_decel=5.0, brake_time=8.0)
    scenario = Scenario(leader, initial_gap=20.0, duration=12.0)
    asked = FunctionController(lambda seen: idm.propose(seen).action)
    world = KinematicWorld()
    assert np.array_equal(world.run(scenario, asked).record, world.run(scenario, idm).record)
