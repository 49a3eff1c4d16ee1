"""Contracts: every class of ours keeps them, and a class that breaks a clause is found by it."""

import random
import sys
from dataclasses import dataclass, fields, replace
from itertools import count
from typing import ClassVar

import numpy as np
import pytest

from evofsm.checks.contracts import Broken
from evofsm.checks.kinds import Kind, kind_of, maker
from evofsm.checks.running import Case, Outcome, all_checks, cases, check
from evofsm.driving.drivers.acc import AdaptiveCruise
from evofsm.driving.drivers.function import FunctionController
from evofsm.driving.drivers.idm import IDM, ChangingIDM
from evofsm.driving.drivers.recorded import RecordedController
from evofsm.driving.revisers import AlwaysBrake, EnvelopeReviser, Unrevised
from evofsm.driving.risk.by_state import RiskByState
from evofsm.driving.risk.drac import DecelerationToAvoidCollision
from evofsm.driving.risk.fuzzy import FuzzySafety
from evofsm.driving.risk.headway import TimeHeadway
from evofsm.driving.risk.latent import LatentRisk
from evofsm.driving.risk.mttc import ModifiedTimeToCollision
from evofsm.driving.risk.picud import Picud
from evofsm.driving.risk.r157 import PerformanceModel
from evofsm.driving.risk.rss import ResponsibilitySensitiveSafety
from evofsm.driving.risk.ttc import TimeToCollision
from evofsm.fleet.batch import Fleet
from evofsm.fsm.actions import IntervalActions
from evofsm.fsm.dynamics.dynamics import Dynamics
from evofsm.fsm.machine import EvolvingFSM
from evofsm.fsm.model import FSMModel
from evofsm.fsm.states.edges import Edges
from evofsm.fsm.states.failure import FailureSplit
from evofsm.fsm.states.novelty import Novelty
from evofsm.fsm.states.paper import Paper
from evofsm.guard.learnt.risk import LearntRisk
from evofsm.guard.protocols import Proposal
from evofsm.guard.reviser import ActionReviser, Mode, Way

ACTIONS = IntervalActions(-2.5, 2.5, 0.3)
CALM, HASTY = IDM(1.0, 25.0, 2.0, 1.5, 2.0, lowest=-5.0), IDM(2.0, 28.0, 1.0, 0.5, 2.0)


def grown(cls=EvolvingFSM, **settings):
    machine = cls(n_actions=2, **settings)
    Z = np.cumsum(np.random.default_rng(0).normal(size=(60, 3)), axis=0)
    machine.learn_many(Z, np.arange(60) % 2)
    return machine


def revising(**options):
    return ActionReviser(LatentRisk(lowest=-2.5), ACTIONS, **options)


OURS = {
    "machine": EvolvingFSM,
    "machine that has learnt": grown(),
    "machine with few states": EvolvingFSM(2, max_states=4),
    "machine that leaves out": EvolvingFSM(2, belief_tolerance=1e-6),
    "machine with a range": EvolvingFSM(3, dynamics=Dynamics(-1.0, 1.0)),
    "machine with choices": EvolvingFSM(2, max_states=4, dynamics=Dynamics(n_actions=2)),
    "machine with two numbers": EvolvingFSM(3, dynamics=Dynamics([-1.0, 0.0], [1.0, 5.0])),
    "fleet": Fleet(EvolvingFSM(3), 3),
    "fleet with a range": Fleet(EvolvingFSM(3, dynamics=Dynamics(-1.0, 1.0, stretches=2)), 2),
    "model with choices": grown(dynamics=Dynamics(n_actions=2)).model(),
    "model": grown().model(names=["x", "y", "z"], dt=0.1),
    "paper": Paper(),
    "edges": Edges(),
    "novelty": Novelty(radius=1.5, scales=(2.0, 0.5), spread=0.7),
    "failure": FailureSplit(Novelty(radius=3.0), share=0.8),
    "ttc": TimeToCollision(),
    "mttc": ModifiedTimeToCollision(),
    "drac": DecelerationToAvoidCollision(),
    "headway": TimeHeadway(),
    "picud": Picud(),
    "rss": ResponsibilitySensitiveSafety.r157(),
    "r157": PerformanceModel.regulation(),
    "fuzzy": FuzzySafety(),
    "latent risk": LatentRisk(lowest=-2.5),
    "learnt risk": LearntRisk(0.25),
    "least risk": revising(),
    "least risk, in the shadow": revising(mode=Mode.SHADOW),
    "least risk of candidates": revising(way=Way.CHOOSE),
    "least risk by state": ActionReviser(RiskByState(LatentRisk(lowest=-2.5), grown()), ACTIONS),
    "envelope": EnvelopeReviser(TimeToCollision(), ACTIONS),
    "envelope of two rows": EnvelopeReviser(ModifiedTimeToCollision(), ACTIONS),
    "unrevised": Unrevised(ACTIONS),
    "always brake": AlwaysBrake(ACTIONS),
    "idm": CALM,
    "idm without bounds": HASTY,
    "changing idm": ChangingIDM(CALM, ((2.0, HASTY), (4.0, CALM))),
    "acc": AdaptiveCruise(30.0, 2.0, 1.1, lowest=-3.5, highest=2.0),
    "recorded": RecordedController([0.0, 1.0, 3.0], [1.5, -2.0, 0.0]),
    "function": FunctionController(lambda seen: -1.0 if seen[0] < 20.0 else 0.5),
}


# Rules are checked within a machine of each besides; a machine's own contract need not be gone
# through for each of them here, where the tests of rules are.
def contracts():
    for name, thing in OURS.items():
        for case in cases(thing):
            if not case.name.startswith("machine: ") or name == "failure":
                yield pytest.param(case, id=f"{name}: {case}")


@pytest.mark.slow
@pytest.mark.parametrize("case", list(contracts()))
def test_what_we_have_keeps_its_contract(case):
    result = case()
    assert result.outcome is Outcome.PASSED or "it has no 'kernel'" in result.message


# -- A test of the tests: for each check, something that only lacks what it asks for --------------


class ChangesInputs(EvolvingFSM):
    def observe(self, z, **options):
        step = super().observe(z, **options)
        z[:] = 0.0
        return step


class ChangesBatches(EvolvingFSM):
    def learn_many(self, Z, I, *rest, **options):
        trace = super().learn_many(Z, I, *rest, **options)
        I[:] = 0
        return trace


class KeepsInputs(EvolvingFSM):
    kept = None

    def observe(self, z, **options):
        latest, self.kept = self.kept, z
        return super().observe(np.array(z if latest is None else latest), **options)


class SharesAnswers(EvolvingFSM):
    def observe(self, z, **options):
        step = super().observe(z, **options)
        if not hasattr(self, "shared"):
            self.shared = np.empty(100)
        self.shared[: len(step.belief)] = step.belief
        return step._replace(belief=self.shared[: len(step.belief)])


class PredictActs(EvolvingFSM):
    def predict(self, i, *rest):
        forecast = super().predict(i, *rest)
        if self.state is not None:
            self.act(i)
        return forecast


class PredictsTooSoon(EvolvingFSM):
    def predict(self, i, *rest):
        return super().predict(i, *rest) if self.n_states else np.ones(1)


class ForecastsAtStartFail(EvolvingFSM):
    def predict(self, i, *rest):
        return super().predict(i, *rest) * (1.0 if self.state is not None else 0.0)


class RowsTooLarge(EvolvingFSM):
    @property
    def transition_matrices(self):
        return super().transition_matrices * (1.0 + 1e-8)


class SurpriseInNats(EvolvingFSM):
    def observe(self, z, **options):
        step = super().observe(z, **options)
        return step._replace(surprise=-step.surprise - 0.1)


class StateOfLeast(EvolvingFSM):
    def observe(self, z, **options):
        step = super().observe(z, **options)
        return step._replace(state=int(step.belief.argmin()))


class Drawn(EvolvingFSM):
    def observe(self, z, **options):
        return super().observe(np.asarray(z) + random.random(), **options)


class Endless(EvolvingFSM):
    def start_episode(self):
        pass


class Forgetful(EvolvingFSM):
    def start_episode(self):
        self._use(EvolvingFSM(self.n_actions)._buffer)


class Moving(EvolvingFSM):
    """A machine that learns how its system moves."""

    def __init__(self, n_actions):
        super().__init__(n_actions, dynamics=Dynamics(n_actions=n_actions))


class ForeseesNothing(Moving):
    def what_next(self, *arguments, **options):
        ahead = super().what_next(*arguments, **options)
        return ahead._replace(mean=np.nan * ahead.mean)


class MovesOn(Moving):
    def start_episode(self):
        super().start_episode()
        self._dynamics.observe(np.zeros(3))
        self._dynamics.act(self._dynamics.encode(0))

    def observe(self, z, **options):
        if self.state is None and self._dynamics.is_under_way:
            for _ in range(2):
                self._dynamics.observe(np.asarray(z))
                self._dynamics.act(self._dynamics.encode(0))
        return super().observe(z, **options)


class BatchBegins(EvolvingFSM):
    def learn_many(self, Z, I, *rest, **options):
        self.start_episode()
        return super().learn_many(Z, I, *rest, **options)


class CopyIsItself(EvolvingFSM):
    def copy(self):
        return self


class CopyBegins(EvolvingFSM):
    def copy(self):
        twin = super().copy()
        twin.start_episode()
        return twin


class FileForgetsAction(EvolvingFSM):
    def save(self, path):
        belief, self.kept = self.belief, None
        twin = super().copy()
        if belief.size:
            twin._memory.learnt.action[0] = -1
        EvolvingFSM.save(twin, path)


class OneActionForAll(EvolvingFSM):
    def act(self, i):
        super().act(i)
        super().act(0)


class Diary(EvolvingFSM):
    def observe(self, z, **options):
        self.__dict__.setdefault("diary", []).append(np.array(z))
        return super().observe(z, **options)


class Lenient(EvolvingFSM):
    def observe(self, z, **options):
        if isinstance(z, np.ndarray) and z.dtype.kind == "f":
            z = np.nan_to_num(z, posinf=1.0)
        return super().observe(z, **options)


class BeginsThenRefuses(EvolvingFSM):
    def observe(self, z, **options):
        if not np.all(np.isfinite(np.asarray(z, dtype=float))):
            self.start_episode()
        return super().observe(z, **options)


class BrokenFleet(Fleet):
    def __init__(self):
        super().__init__(EvolvingFSM(2), 3)


class FleetChangesInputs(BrokenFleet):
    def observe(self, Z, A=None, **options):
        step = super().observe(Z, A, **options)
        Z[:] = 0.0
        return step


class FleetMixesUp(BrokenFleet):
    def observe(self, Z, A=None, **options):
        return super().observe(Z, A[::-1].copy(), **options)


class FleetWakesAll(BrokenFleet):
    def observe(self, Z, A=None, **options):
        if len(Z) < len(self):
            self.start_episode()
        return super().observe(Z, A, **options)


class FleetBeginsThenRefuses(BrokenFleet):
    def observe(self, Z, A=None, **options):
        if not np.isfinite(Z).all():
            self.start_episode()
        return super().observe(Z, A, **options)


class FleetDiary(BrokenFleet):
    def observe(self, Z, A=None, **options):
        self.__dict__.setdefault("diary", []).append(Z.copy())
        return super().observe(Z, A, **options)


@dataclass(frozen=True, eq=False)
class BrokenModel(FSMModel):
    @classmethod
    def make(cls):
        model = grown().model()
        return cls(**{field.name: getattr(model, field.name) for field in fields(model)})


class Writable(BrokenModel):
    def __post_init__(self):
        super().__post_init__()
        object.__setattr__(self, "centers", np.array(self.centers))


class RecognisesTooMuch(BrokenModel):
    def recognise(self, z):
        return super().recognise(z) * 1.1


class SpoilsBelief(BrokenModel):
    def propagate(self, belief, *rest):
        forecast = super().propagate(belief, *rest)
        belief[0] = 0.0
        return forecast


class RollsRows(BrokenModel):
    def recognise(self, z):
        answer = super().recognise(z)
        return np.roll(answer, 1, axis=0) if answer.ndim == 2 else answer


class FileDoublesWidth(BrokenModel):
    def save(self, path):
        FSMModel.save(replace(self, width=2.0 * self.width), path)


class AnswersNaN(BrokenModel):
    def recognise(self, z):
        return super().recognise(np.nan_to_num(z))


class NotFrozen:
    scales = ()

    table: ClassVar = {}


@dataclass
class Thawed(NotFrozen):
    width: float = 1.0


@dataclass(frozen=True)
class TellsOtherwise(Paper):
    counts: ClassVar = count(1)

    @property
    def table(self):
        return {**super().table, "distance_weight": float(next(self.counts))}


@dataclass(frozen=True)
class NegativeRadius(Paper):
    @property
    def table(self):
        return {**super().table, "radius": -1.0}


@dataclass(frozen=True)
class Unlisted(Paper):
    pass


class LastOnly(TimeToCollision):
    def score(self, observations, dt):
        return super().score(observations, dt)[-1:]


class ShiftsGaps(TimeToCollision):
    def score(self, observations, dt):
        observations[:, 0] -= 1.0
        return super().score(observations, dt)


@dataclass
class Remembers:
    asked: int = 0

    def score(self, observations, dt):
        self.asked += 1
        return TimeToCollision().score(observations, dt) + self.asked


class WorstOfAll(TimeToCollision):
    def score(self, observations, dt):
        scores = super().score(observations, dt)
        return np.full_like(scores, scores.max())


class ZeroOverZero(TimeToCollision):
    def score(self, observations, dt):
        return (observations[:, 1] - observations[:, 2]) / observations[:, 0]


class BlindOnceMet(TimeToCollision):
    def score(self, observations, dt):
        return np.where(observations[:, 0] <= 0.0, -1.0, super().score(observations, dt))


class TimeItself(TimeToCollision):
    def score(self, observations, dt):
        return np.asarray(observations[:, 0] / np.maximum(observations[:, 1], 1.0))


class NoThreshold(TimeToCollision):
    def score(self, observations, dt):
        return super().score(observations, dt) + 10.0


class TypeOfStep(TimeToCollision):
    def score(self, observations, dt):
        return super().score(observations, dt) + isinstance(dt, int)


class AnyWidth(TimeToCollision):
    def score(self, observations, dt):
        return -observations[:, 0]


class ScoreDiary(TimeToCollision):
    diary: ClassVar[list] = []

    def score(self, observations, dt):
        self.diary.append(observations.copy())
        return super().score(observations, dt)


class BrokenJudge(LatentRisk):
    def __init__(self):
        super().__init__(lowest=-2.5)


class RiskInPercent(BrokenJudge):
    def judge(self, situation, actions):
        judged = super().judge(situation, actions)
        return judged._replace(risk=100.0 * judged.risk, high=100.0 * judged.high)


class OneForAll(BrokenJudge):
    def judge(self, situation, actions):
        judged = super().judge(situation, actions)
        return judged._replace(risk=judged.risk[:1])


class RoundsObservation(BrokenJudge):
    def judge(self, situation, actions):
        situation.observation[:] = np.round(situation.observation)
        return super().judge(situation, actions)


class LearnsFromQuestions(BrokenJudge):
    asked = 0.0

    def judge(self, situation, actions):
        self.asked += len(actions) == 5  # not what a decision asks
        return super().judge(situation, actions)

    def sums(self, n_states):
        return super().sums(n_states) | {"asked": self.asked}


class DiceJudge(BrokenJudge):
    def sums(self, n_states):
        return super().sums(n_states) | {"dice": random.random()}


class LearnsFrozen(BrokenJudge):
    seen = 0.0

    def follow(self, observation, action):
        self.seen += 1.0
        super().follow(observation, action)

    def sums(self, n_states):
        return super().sums(n_states) | {"seen": self.seen}


class FileForgetsLearnt(BrokenJudge):
    def save(self, path, provenance=None):
        LatentRisk(lowest=-2.5).save(path, provenance)


class JudgeDiary(BrokenJudge):
    def judge(self, situation, actions):
        self.__dict__.setdefault("diary", []).append(np.array(actions))
        return super().judge(situation, actions)


class Driver:
    """Nothing is wrong with it."""

    lowest, highest = -3.0, 3.0

    def propose(self, observation, time=0.0):
        return Proposal(float(np.clip(0.1 * (observation[0] - 20.0), self.lowest, self.highest)))


class JustANumber(Driver):
    def propose(self, observation, time=0.0):
        return 0.0


class DividesByClosing(Driver):
    def propose(self, observation, time=0.0):
        return Proposal(observation[0] * -1.0)


class OutOfBounds(Driver):
    def propose(self, observation, time=0.0):
        return Proposal(-4.0 if observation[0] < 1.0 else 0.0)


class ChangesObservation(Driver):
    def propose(self, observation, time=0.0):
        observation[0] = 0.0
        return Proposal(0.0)


class KeepsObservation(Driver):
    kept = np.zeros(3)

    def propose(self, observation, time=0.0):
        before, self.kept = self.kept, observation
        return super().propose(before)


class Dice(Driver):
    def propose(self, observation, time=0.0):
        return Proposal(random.random())


class NeedsTime(Driver):
    def propose(self, observation, time):
        return super().propose(observation)


class OtherKernel(Driver):
    parameters = np.ones((1, 1))

    def kernel(self, parameters, time, gap, speed, leader_speed):
        return 0.0


class DriverDiary(Driver):
    def propose(self, observation, time=0.0):
        self.__dict__.setdefault("diary", []).append(observation.copy())
        return super().propose(observation)


class BrokenReviser(Unrevised):
    def __init__(self):
        super().__init__(ACTIONS)


class ExecutesAnything(BrokenReviser):
    def revise(self, situation, proposal):
        return super().revise(situation, proposal)._replace(executed=proposal.action)


class FailsOnNaN(BrokenReviser):
    def revise(self, situation, proposal):
        self.actions.encode(min(max(round(proposal.action), -2), 2))
        return super().revise(situation, proposal)


class ReportsExecuted(BrokenReviser):
    def revise(self, situation, proposal):
        revision = super().revise(situation, proposal)
        return revision._replace(proposed=revision.executed)


class NoReason(BrokenReviser):
    def revise(self, situation, proposal):
        return super().revise(situation, proposal)._replace(reason="")


class ChangesBelief(BrokenReviser):
    def revise(self, situation, proposal):
        situation.belief[:] = 0.0
        return super().revise(situation, proposal)


class KeepsSituation(BrokenReviser):
    kept = np.full(3, 30.0)

    def revise(self, situation, proposal):
        before, self.kept = self.kept, situation.observation
        revision = super().revise(situation, proposal)
        closing = before[0] > situation.observation[0]
        return revision._replace(executed=-2.5) if closing else revision


class NeverCalms(BrokenReviser):
    scared = False

    def revise(self, situation, proposal):
        self.scared |= bool(situation.observation[0] < 2.5)
        revision = super().revise(situation, proposal)
        return revision._replace(executed=-2.5) if self.scared else revision


class DiceReviser(BrokenReviser):
    def revise(self, situation, proposal):
        return super().revise(situation, proposal)._replace(executed=random.random())


class ReviserDiary(BrokenReviser):
    def revise(self, situation, proposal):
        self.__dict__.setdefault("diary", []).append(situation.observation.copy())
        return super().revise(situation, proposal)


BROKEN = {
    Kind.MACHINE: {
        "inputs_not_changed": [ChangesInputs, ChangesBatches],
        "inputs_not_kept": [KeepsInputs],
        "answers_stay": [SharesAnswers],
        "asking_changes_nothing": [PredictActs],
        "predicts_before_learning": [PredictsTooSoon, ForecastsAtStartFail],
        "rows_sum_to_1": [RowsTooLarge],
        "steps_are_sound": [SurpriseInNats, StateOfLeast],
        "is_deterministic": [Drawn],
        "an_episode_starts_anew": [Endless, Forgetful],
        "what_comes_next_is_told_in_numbers": [ForeseesNothing],
        "motion_is_not_learnt_across_episodes": [MovesOn],
        "a_batch_is_the_loop": [BatchBegins],
        "a_copy_is_independent": [CopyIsItself, CopyBegins],
        "a_file_keeps_it": [FileForgetsAction],
        "labels_of_actions_mean_nothing": [OneActionForAll],
        "memory_is_bounded": [Diary],
        "errors_leave_no_trace": [Lenient, BeginsThenRefuses],
    },
    Kind.FLEET: {
        "inputs_not_changed": [FleetChangesInputs],
        "equals_its_machines": [FleetMixesUp],
        "the_silent_stay": [FleetWakesAll],
        "errors_leave_no_trace": [FleetBeginsThenRefuses],
        "memory_is_bounded": [FleetDiary],
    },
    Kind.MODEL: {
        "is_frozen": [Writable.make],
        "rows_sum_to_1": [RecognisesTooMuch.make],
        "asking_changes_nothing": [SpoilsBelief.make],
        "many_are_one_by_one": [RollsRows.make],
        "a_file_keeps_it": [FileDoublesWidth.make],
        "refuses_what_cannot_be": [AnswersNaN.make],
    },
    Kind.RULE: {
        "is_frozen": [NotFrozen, Thawed],
        "telling_changes_nothing": [TellsOtherwise],
        "what_it_tells_is_usable": [NegativeRadius],
        "a_machine_takes_it": [Unlisted],
        "a_file_keeps_it": [Unlisted],
    },
    Kind.JUDGE: {
        "judges_each_action": [RiskInPercent, OneForAll],
        "inputs_not_changed": [RoundsObservation],
        "asking_changes_nothing": [LearnsFromQuestions],
        "is_deterministic": [DiceJudge],
        "following_learns_nothing": [LearnsFrozen],
        "a_file_keeps_it": [FileForgetsLearnt],
        "memory_is_bounded": [JudgeDiary],
    },
    Kind.MEASURE: {
        "one_score_a_row": [LastOnly],
        "inputs_not_changed": [ShiftsGaps],
        "asking_changes_nothing": [Remembers],
        "uses_only_earlier_rows": [WorstOfAll],
        "no_score_is_missing": [ZeroOverZero],
        "having_met_is_worst": [BlindOnceMet],
        "danger_is_in_order": [TimeItself],
        "calls_for_braking_when_it_must": [NoThreshold],
        "takes_a_number_as_dt": [TypeOfStep],
        "refuses_rows_of_another_width": [AnyWidth],
        "memory_is_bounded": [ScoreDiary],
    },
    Kind.CONTROLLER: {
        "proposes_numbers": [JustANumber, DividesByClosing],
        "keeps_its_bounds": [OutOfBounds],
        "inputs_not_changed": [ChangesObservation],
        "inputs_not_kept": [KeepsObservation],
        "is_deterministic": [Dice],
        "time_may_be_left_out": [NeedsTime],
        "its_kernel_agrees": [OtherKernel],
        "memory_is_bounded": [DriverDiary],
    },
    Kind.REVISER: {
        "executes_what_can_be": [ExecutesAnything],
        "copes_with_no_number": [FailsOnNaN],
        "reports_what_it_did": [ReportsExecuted, NoReason],
        "inputs_not_changed": [ChangesBelief],
        "inputs_not_kept": [KeepsSituation],
        "an_episode_starts_anew": [NeverCalms],
        "is_deterministic": [DiceReviser],
        "memory_is_bounded": [ReviserDiary],
    },
}
CAUGHT = [
    pytest.param(kind, name, thing, id=f"{kind.value}: {name}: {thing.__qualname__}")
    for kind, of_kind in BROKEN.items()
    for name, things in of_kind.items()
    for thing in things
]


def test_something_is_broken_for_every_check():
    assert {kind: list(of_kind) for kind, of_kind in BROKEN.items()} == {
        kind: [one.name for one in all_checks(kind)] for kind in Kind
    }


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "name", "thing"), CAUGHT)
def test_what_breaks_a_contract_is_caught_by_the_check_for_it(kind, name, thing):
    (one,) = [one for one in all_checks(kind) if one.name == name]
    result = Case(one, maker(thing, kind), name).result()
    assert result.outcome is Outcome.FAILED
    assert "Traceback" not in result.message
    assert "evofsm/checks/" not in result.message  # a clause said it, and no error happened to


@pytest.mark.slow
def test_a_driver_without_a_fault_passes_what_it_has():
    outcomes = {result.check: result.outcome for result in check(Driver)}
    assert outcomes.pop("its_kernel_agrees") is Outcome.SKIPPED
    assert set(outcomes.values()) == {Outcome.PASSED}


# -- Running them ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("thing", "kind"),
    [
        (EvolvingFSM, Kind.MACHINE),
        (Fleet, Kind.FLEET),
        (FSMModel, Kind.MODEL),
        (Paper, Kind.RULE),
        (LatentRisk, Kind.JUDGE),
        (ActionReviser, Kind.REVISER),
        (CALM, Kind.CONTROLLER),
        (lambda: CALM, Kind.CONTROLLER),
    ],
)
def test_the_kind_is_told_by_the_methods(thing, kind):
    assert kind_of(thing) is kind


def test_what_is_of_no_kind_or_cannot_be_made_is_refused():
    with pytest.raises(TypeError, match=r"has the methods of no kind: .*a controller has propose"):
        check(3)
    with pytest.raises(TypeError, match=r"IDM needs arguments \(accel, desired_speed.*--make"):
        check(IDM)


def test_a_case_raises_what_is_wrong():
    case = next(case for case in cases(Dice) if str(case) == "is_deterministic")
    with pytest.raises(Broken, match=r"is_deterministic: two controllers .*random number"):
        case()


def test_an_error_within_a_check_names_the_place():
    def fails(seen):
        raise ZeroDivisionError("by the gap")

    results = check(FunctionController(fails))
    failed = [result for result in results if result.outcome is Outcome.FAILED]
    assert all("ZeroDivisionError: by the gap (" in result.message for result in failed)
    assert "test_checks.py, line" in failed[0].message


def test_each_check_gets_a_copy_of_an_instance():
    machine = grown()
    before = machine.transition_matrices
    cases(machine)[0]()
    assert (machine.transition_matrices == before).all()


# -- The command ----------------------------------------------------------------------------------

MODULE = """
from evofsm.guard.protocols import Proposal

class Hasty:
    def __init__(self, action=1.0):
        self.action = action

    def propose(self, observation, time=0.0):
        return Proposal(self.action)
"""


@pytest.fixture
def run(tmp_path, monkeypatch):
    """Run `evofsm check` in a folder with a module of one's own."""
    from typer.testing import CliRunner

    from evofsm.__main__ import application

    (tmp_path / "own_driver.py").write_text(MODULE)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    monkeypatch.delitem(sys.modules, "own_driver", raising=False)
    return lambda *arguments: CliRunner().invoke(application(), ["check", *arguments])


@pytest.mark.slow
def test_the_command_checks_a_class_in_the_folder(run):
    result = run("own_driver:Hasty")
    assert result.exit_code == 0, result.output
    assert "contract of a controller" in result.output
    assert "8 checks: 7 passed, 1 skipped" in result.output
    assert max(map(len, result.output.splitlines())) <= 80


@pytest.mark.slow
def test_the_command_ends_with_1_and_says_what_is_wrong(run):
    result = run("own_driver:Hasty", "--make", "Hasty(float('nan'))", "--json")
    assert result.exit_code == 1
    assert '"outcome": "failed"' in result.output
    assert "it proposes nan at gap" in result.output


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["own_driver"], "names nothing; write module:Name"),
        (["own_driver:Calm"], "own_driver has no 'Calm'"),
        (["not_there:Calm"], "is it in this folder, or installed?"),
        (["own_driver:Hasty", "--kind", "car"], "--kind is 'car'; it must be one of machine"),
        (["own_driver:Proposal"], "has the methods of no kind"),
    ],
)
def test_the_command_refuses_what_it_cannot_check(run, arguments, message):
    result = run(*arguments)
    assert result.exit_code == 2
    assert message in " ".join((result.output + result.stderr).split())
