"""What breaks a contract is found by the check for it, and parts of ours keep theirs."""

import random
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import pytest

from evofsm import IntervalActions, Novelty, Paper
from evofsm.driving import IDM, EnvelopeReviser, LatentRisk, Unrevised
from evofsm.driving.measures import ModifiedTimeToCollision
from evofsm.guard import ActionReviser, LearntRisk, Mode, Proposal
from evofsm.guard.check import check_results, kind_of

ACTIONS = IntervalActions(-2.5, 2.5, 0.3)
CALM = IDM(1.0, 25.0, 2.0, 1.5, 2.0, lowest=-5.0)

OURS = [
    LearntRisk(0.25, n_actions=3),
    Paper,
    Novelty(radius=1.5, scales=(2.0, 0.5), spread=0.7),
    LatentRisk(lowest=-2.5),
    ActionReviser(LatentRisk(lowest=-2.5), ACTIONS),
    ActionReviser(LatentRisk(lowest=-2.5), ACTIONS, mode=Mode.SHADOW),
    EnvelopeReviser(ModifiedTimeToCollision(), ACTIONS),
    Unrevised(ACTIONS),
    CALM,
]


def failed(part):
    return [one for one in check_results(part) if not one.passed]


@pytest.mark.parametrize(
    "part", OURS, ids=[getattr(one, "__name__", type(one).__name__) for one in OURS]
)
def test_parts_of_ours_keep_their_contract(part):
    assert not failed(part)


def driver(answer):
    """A driver who answers an observation so."""
    return type("Driver", (), {"propose": lambda self, seen, time=0.0: answer(seen)})


class KeepsObservation:
    kept = np.zeros(3)

    def propose(self, observation, time=0.0):
        before, self.kept = self.kept, observation
        return Proposal(float(np.clip(0.1 * (before[0] - 20.0), -3.0, 3.0)))


def reviser(change):
    """One who changes a revision so, knowing the proposal."""

    class Changing(Unrevised):
        def revise(self, situation, proposal):
            return change(super().revise(situation, proposal), proposal.action)

    return Changing(ACTIONS)


class NeverCalms(Unrevised):
    scared = False

    def revise(self, situation, proposal):
        self.scared |= bool(situation.observation[0] < 2.5)
        revision = super().revise(situation, proposal)
        return revision._replace(executed=-2.5) if self.scared else revision


class RiskInPercent(LatentRisk):
    def judge(self, situation, actions):
        judged = super().judge(situation, actions)
        return judged._replace(risk=100.0 * judged.risk, high=100.0 * judged.high)


class ScalesInPlace(LatentRisk):
    def judge(self, situation, actions):
        actions *= 0.9
        return super().judge(situation, actions)


class LearnsFromQuestions(LatentRisk):
    asked = 0

    def judge(self, situation, actions):
        self.asked += len(actions) == 5  # a decision asks of other numbers of actions
        judged = super().judge(situation, actions)
        return judged._replace(risk=judged.risk * 0.99**self.asked, low=0.0 * judged.low)


class LearnsFrozen(LatentRisk):
    seen = 0

    def follow(self, observation, action):
        self.seen += 1
        super().follow(observation, action)

    def judge(self, situation, actions):
        judged = super().judge(situation, actions)
        return judged._replace(low=np.full(len(actions), 0.5**self.seen * judged.low))


class FileForgetsLearnt(LatentRisk):
    def save(self, path, provenance=None):
        LatentRisk(lowest=-2.5).save(path, provenance)


class NotFrozen:
    scales = ()
    table: ClassVar = {}


@dataclass
class Thawed(NotFrozen):
    width: float = 1.0


@dataclass(frozen=True)
class NegativeRadius(Paper):
    @property
    def table(self):
        return {**super().table, "radius": -1.0}


@dataclass(frozen=True)
class NotRegistered(Paper):
    pass


BROKEN = {
    "proposes_numbers": [driver(lambda seen: 0.0), driver(lambda seen: Proposal(-seen[0]))],
    "revises_what_is_proposed": [
        reviser(lambda revision, action: revision._replace(executed=action)),
        reviser(lambda revision, action: revision._replace(seen=round(action))),
        reviser(lambda revision, action: revision._replace(reason="")),
    ],
    "an_episode_starts_anew": [NeverCalms(ACTIONS)],
    "answers_hang_on_inputs_alone": [
        driver(lambda seen: seen.fill(0.0) or Proposal(0.0)),
        KeepsObservation,
        driver(lambda seen: Proposal(random.random())),
        ScalesInPlace(-2.5),
    ],
    "judges_each_action": [RiskInPercent(-2.5)],
    "learns_only_from_what_happens": [LearnsFromQuestions(-2.5), LearnsFrozen(-2.5)],
    "a_file_keeps_it": [FileForgetsLearnt(-2.5)],
    "is_frozen": [NotFrozen, Thawed],
    "a_machine_takes_it": [NegativeRadius, NotRegistered],
}


@pytest.mark.parametrize(
    ("name", "part"), [(name, part) for name, of in BROKEN.items() for part in of]
)
def test_what_breaks_a_contract_is_found_by_the_check_for_it(name, part):
    found = [one for one in failed(part) if one.check == name]
    assert found
    assert "guard/check.py, line" not in found[0].message  # the check says it, and did not stumble


def test_every_check_has_something_that_breaks_it():
    parts = (Paper, Unrevised(ACTIONS), CALM, LatentRisk(lowest=-2.5))
    assert {one.check for part in parts for one in check_results(part)} == BROKEN.keys()


def test_the_kind_is_told_by_the_methods():
    assert kind_of(lambda: CALM) == "controller"
    with pytest.raises(TypeError, match=r"has the methods of no kind: .*a controller has propose"):
        check_results(3)
    with pytest.raises(TypeError, match=r"IDM needs arguments \(accel, .*function that makes"):
        check_results(IDM)


def test_an_error_within_a_part_names_its_place():
    message = check_results(driver(lambda seen: 1 / 0))[0].message
    assert "ZeroDivisionError: division by zero (" in message
    assert "test_check.py, line" in message
