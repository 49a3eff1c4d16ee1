"""What is compared: the classic measures, and what is learnt from training runs.

Human drivers and cruise controls command nothing that we could see, so only watching is possible:
the acceleration that is learnt from is the one that was realised.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from evofsm.driving import SAFETY_RULE, BrakeWatch, LatentRisk, measures
from evofsm.fsm import EvolvingFSM, FSMModel, Novelty
from evofsm.fsm.arrays import NO_ACTION
from evofsm.guard import BELIEF_TOLERANCE, RiskMeasure
from studies.real.cases import INTERVAL, QUESTIONS, Case, Question, recent_acceleration

#: Hardest braking taken as possible; what cars could do was never shown [m/s²].
LOWEST = -6.0
# Of drivers' own braking manoeuvres so many are at least as hard as their everyday braking.
_EVERYDAY = 0.9
# Cases of the overall share that are added to those of a state, as `OutcomeCounts` does.
_LEAN = 2.0
# Closing rate [1/s], leader's acceleration [m/s²] and logarithm of the time headway in which a
# situation differs so much that it is another one.
_APPROACH_RULE = Novelty(radius=1.0, scales=(0.05, 0.7, 0.4))
# Below this speed a time headway says nothing [m/s].
_SLOWEST = 1.0
_RIDGE, _NEWTON_STEPS = 1e-3, 25

Scores = dict[Question, NDArray[np.float64]]


class Group(StrEnum):
    """What a measure was given."""

    FIXED = "fixed formula"
    NOW = "what is done now"
    LEARNT = "learnt from the training runs"
    OURS = "ours, learnt from the training runs"


@dataclass(frozen=True)
class Measure:
    """One of those compared."""

    name: str
    group: Group
    about: str


class StateShare(NamedTuple):
    """A state, and how often the event came after it in the training runs."""

    center: tuple[float, ...]  #: in the machine's units
    seconds: float  #: time spent in it [s], by belief
    share: float  #: of its decisions after which the event came


class Learnt(NamedTuple):
    """What one learner says of held-out cases."""

    scores: dict[str, list[Scores]]  #: by measure, one for each held-out case
    states: int = 0
    shares: tuple[StateShare, ...] = ()  #: the most dangerous states, of those that are named


FIXED: Mapping[str, RiskMeasure] = {
    "ttc": measures.TimeToCollision(),
    "mttc": measures.ModifiedTimeToCollision(),
    "drac": measures.DecelerationToAvoidCollision(),
    "headway": measures.TimeHeadway(),
    "picud": measures.Picud(),
    "rss-r157": measures.ResponsibilitySensitiveSafety.r157(),
    "fuzzy": measures.FuzzySafety(),
}

MEASURES = (
    Measure("ttc", Group.FIXED, "time to collision now"),
    Measure("mttc", Group.FIXED, "the same, if accelerations last"),
    Measure("drac", Group.FIXED, "braking that is needed now"),
    Measure("headway", Group.FIXED, "time headway now"),
    Measure("picud", Group.FIXED, "gap left if both brake now"),
    Measure("rss-r157", Group.FIXED, "safe distance minus gap"),
    Measure("fuzzy", Group.FIXED, "fuzzy safety model"),
    Measure("braking", Group.NOW, "the follower's braking over the latest 0.4 s"),
    Measure("leader-braking", Group.NOW, "the leader's braking over the latest 0.4 s"),
    Measure("logistic", Group.LEARNT, "logistic regression on what evofsm-approach observes"),
    Measure("evofsm", Group.OURS, "latent risk: a dead end, if the leader brakes now"),
    Measure("evofsm-everyday", Group.OURS, "latent risk, if braking is no harder than every day"),
    Measure("evofsm-paper", Group.OURS, "the paper's states, how often the event followed"),
    Measure("evofsm-states", Group.OURS, "states of gap and speeds, how often it followed"),
    Measure(
        "evofsm-approach",
        Group.OURS,
        "states of closing rate, leader's braking, headway; the same",
    ),
)


#: Names of those that are ours.
OURS = tuple(measure.name for measure in MEASURES if measure.group is Group.OURS)


def score_fixed(cases: Sequence[Case]) -> dict[str, list[NDArray[np.float64]]]:
    """Scores of what learns nothing: one series for each case, whatever is asked."""
    scores = {
        name: [measure.score(case.observations, INTERVAL) for case in cases]
        for name, measure in FIXED.items()
    }
    for name, speed in (("braking", 1), ("leader-braking", 2)):
        scores[name] = [-recent_acceleration(case.observations[:, speed]) for case in cases]
    return scores


# -- Latent risk ----------------------------------------------------------------------------------


def learn_risk(training: Sequence[Case], held_out: Sequence[Case]) -> Learnt:
    """Watch the training runs, and score held-out ones by the latent risk.

    Twice: braking as hard as is taken as possible, and no harder than drivers brake every day,
    which is learnt from their own manoeuvres.
    """
    risk = LatentRisk(LOWEST, INTERVAL)
    own: list[float] = []
    for case in training:
        speed = case.observations[:, 1]
        realised = np.append(np.diff(speed) / INTERVAL, 0.0)
        for row, acceleration in zip(case.observations, realised.tolist(), strict=True):
            risk.learn(row, acceleration)
        risk.start_episode()
        own += _manoeuvres(speed)
    everyday = float(np.quantile(own, 1.0 - _EVERYDAY)) if own else 1.0
    gentle = LatentRisk(-everyday, INTERVAL, own_brakes=1.0)
    gentle.manoeuvres = risk.manoeuvres
    return Learnt(
        {
            name: [_whatever_is_asked(one.score(case.observations)) for case in held_out]
            for name, one in (("evofsm", risk), ("evofsm-everyday", gentle))
        }
    )


def _manoeuvres(speed: NDArray[np.float64]) -> list[float]:
    """Decelerations of the braking manoeuvres in a series of speeds [m/s²]."""
    watch = BrakeWatch(INTERVAL)
    ended = [watch.see(0.0, v, v) for v in speed.tolist()]
    return [decel for decel in (*ended, watch.end()) if decel is not None]


def _whatever_is_asked(score: NDArray[np.float64]) -> Scores:
    return dict.fromkeys(QUESTIONS, score)


# -- States, and what followed in them ------------------------------------------------------------


class ComingByState:
    """How often each event followed within each horizon, by state.

    The direct estimate of `counts.OutcomeCounts` for one action, of all questions at
    once: states are recognised only once for them.

    Parameters
    ----------
    model : FSMModel
        Whose states they are.
    """

    def __init__(self, model: FSMModel) -> None:
        self.model = model
        self.cases = np.zeros((len(QUESTIONS), model.n_states))
        self.came = np.zeros((len(QUESTIONS), model.n_states))

    def learn(self, observations: NDArray[np.float64], case: Case) -> None:
        """Take in the decisions of a case, observed as the model's machine observes."""
        belief = self.model.recognise(observations)
        known = np.array([case.answers[question].known for question in QUESTIONS])
        came = np.array([case.answers[question].came for question in QUESTIONS])
        self.cases += known @ belief
        self.came += (known & came) @ belief

    def score(self, observations: NDArray[np.float64]) -> Scores:
        """Probability of each event within each horizon."""
        belief = self.model.recognise(observations)
        anywhere = (self.came.sum(axis=1) + 0.5) / (self.cases.sum(axis=1) + 1.0)
        came = belief @ self.came.T + _LEAN * anywhere
        return dict(zip(QUESTIONS, (came / (belief @ self.cases.T + _LEAN)).T, strict=True))

    def shares(self, question: Question) -> list[StateShare]:
        """All states, the most dangerous first."""
        place = QUESTIONS.index(question)
        cases, came = self.cases[place], self.came[place]
        anywhere = (came.sum() + 0.5) / (cases.sum() + 1.0)
        shares = (came + _LEAN * anywhere) / (cases + _LEAN)
        return [
            StateShare(
                tuple(self.model.centers[state].tolist()),
                float(cases[state] * INTERVAL),
                float(shares[state]),
            )
            for state in np.argsort(-shares, kind="stable")
        ]


def as_they_are(case: Case) -> NDArray[np.float64]:
    """Gap [m] and both speeds [m/s], as the paper observes."""
    return case.observations


def approach(case: Case) -> NDArray[np.float64]:
    """How the follower approaches: three quantities that danger hangs on, from what was seen.

    Returns
    -------
    (T, 3) ndarray
        Closing speed over gap [1/s], the inverse of the time to collision; the leader's
        acceleration over the latest 0.4 s [m/s²]; the natural logarithm of the time headway [s].
    """
    gap, speed, leader = case.observations.T
    return np.column_stack(
        [
            (speed - leader) / gap,
            recent_acceleration(leader),
            np.log(gap / np.maximum(speed, _SLOWEST)),
        ]
    )


class Observer(NamedTuple):
    """A machine that is to be, and what it observes."""

    observe: Callable[[Case], NDArray[np.float64]]
    rule: Novelty | None  #: None for the paper's


#: By measure.
OBSERVERS: Mapping[str, Observer] = {
    "evofsm-paper": Observer(as_they_are, None),
    "evofsm-states": Observer(as_they_are, SAFETY_RULE),
    "evofsm-approach": Observer(approach, _APPROACH_RULE),
}


def learn_states(
    name: str, named: Question, most: int, training: Sequence[Case], held_out: Sequence[Case]
) -> Learnt:
    """Grow states in the training runs, count what followed in them, and score held-out runs.

    Parameters
    ----------
    name : str
        One of `OBSERVERS`.
    named : Question
        By which the most dangerous states are chosen, ``most`` of them.
    training, held_out : sequence of Case
    """
    observe, rule = OBSERVERS[name]
    machine = EvolvingFSM(n_actions=1, rule=rule, belief_tolerance=BELIEF_TOLERANCE)
    for case in training:
        seen = observe(case)
        machine.learn_many(seen, np.full(len(seen), NO_ACTION), [0])
    counts = ComingByState(machine.model())
    for case in training:
        counts.learn(observe(case), case)
    scores = [counts.score(observe(case)) for case in held_out]
    return Learnt({name: scores}, machine.n_states, tuple(counts.shares(named)[:most]))


# -- A plain learner, to be fair ------------------------------------------------------------------


def learn_logistic(training: Sequence[Case], held_out: Sequence[Case]) -> Learnt:
    """Logistic regression on `approach`, fitted for each question by Newton's method."""
    features = [approach(case) for case in training]
    every = np.concatenate(features)
    mean, spread = every.mean(axis=0), np.maximum(every.std(axis=0), 1e-9)
    design = [_with_one((rows - mean) / spread) for rows in features]
    tests = [_with_one((approach(case) - mean) / spread) for case in held_out]
    scores: list[Scores] = [{} for _ in held_out]
    for question in QUESTIONS:
        answers = [case.answers[question] for case in training]
        rows = np.concatenate([x[a.known] for x, a in zip(design, answers, strict=True)])
        came = np.concatenate([a.came[a.known] for a in answers])
        weights = _fit_logistic(rows, came)
        for test, found in zip(tests, scores, strict=True):
            found[question] = test @ weights
    return Learnt({"logistic": scores})


def _with_one(rows: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.column_stack([rows, np.ones(len(rows))])


def _fit_logistic(rows: NDArray[np.float64], came: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Weights with a small ridge, which keeps them finite where few events came."""
    weights = np.zeros(rows.shape[1])
    penalty = _RIDGE * max(float(came.sum()), 1.0) * np.eye(len(weights))
    for _ in range(_NEWTON_STEPS):
        share = 1.0 / (1.0 + np.exp(-np.clip(rows @ weights, -30.0, 30.0)))
        slope = rows.T @ (came - share) - penalty @ weights
        curve = (rows * (share * (1.0 - share))[:, None]).T @ rows + penalty
        step = np.linalg.solve(curve, slope)
        weights += step
        if np.abs(step).max() < 1e-8:
            break
    return weights
