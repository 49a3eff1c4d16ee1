"""Is a risk of 30 % a failure in 30 of 100 cases? Two answers are held against what came.

What a machine counted, of going on as one drives; and what was rehearsed, of braking in full from
now on, which is tried: held-out runs are cut short at a random moment by full braking.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from evofsm.driving import (
    SAFETY_RULE,
    Draw,
    Family,
    KinematicWorld,
    LatentRisk,
    Unrevised,
    drive,
    guard_for_family,
    held_out,
    learnt_by,
    training,
    unrevised_guard,
)
from evofsm.fsm import EvolvingFSM
from evofsm.guard import Guard, make_usable
from studies.closed_loop.amounts import Amounts
from studies.counts import OutcomeCounts
from studies.scores import brier

#: Looked ahead [s].
HORIZON = 5.0
_BINS = 10
# Braking to standstill from any speed here takes less [s].
_STANDSTILL = 20.0


class Bin(NamedTuple):
    """Predictions of about the same height, and what came."""

    predicted: float  #: mean
    observed: float  #: share of failures
    cases: int


class Reliability(NamedTuple):
    """How well predicted probabilities fit what came."""

    what: str
    bins: tuple[Bin, ...]
    brier: float  #: mean squared error
    base_brier: float  #: the same for always predicting the share of failures
    cases: int
    failures: int

    @property
    def title(self) -> str:
        """What is predicted, and how well."""
        what = f"{self.what[:1].upper()}{self.what[1:]}"
        return f"{what}\nBrier {self.brier:.3f}, of the base rate {self.base_brier:.3f}"


def run_calibration(family: Family, plan: Amounts) -> dict[str, list[Any]]:
    """Learn from the unrevised controller, then hold both probabilities against held-out runs."""
    of_guard, risk = learnt_by(guard_for_family(family))
    reviser = Unrevised(family.actions)
    guard = Guard.of(reviser, interval=family.interval, machine=of_guard, judge=risk)
    counts = OutcomeCounts(family.actions.n_actions, HORIZON, family.interval)
    machine = EvolvingFSM(family.actions.n_actions, rule=SAFETY_RULE)
    for draw in training(family, plan.seed, 0, plan.side_train):
        driven = drive(guard, draw)
        machine.start_episode()
        for decision in driven.decisions:
            action = int(family.actions.encode(decision.revision.executed))
            step = machine.learn_one(decision.situation.observation, action)
            counts.learn(step.belief, action)
        counts.end_episode(failed=driven.collided)
    draws = held_out(family, plan.seed, plan.side_test)
    return {
        "reliabilities": [
            _as_driven(family, draws, machine, counts),
            _cautious(family, draws, of_guard, risk, np.random.default_rng([plan.seed, 7])),
        ]
    }


def _as_driven(
    family: Family, draws: Sequence[Draw], machine: EvolvingFSM, counts: OutcomeCounts
) -> Reliability:
    model = machine.model()
    predicted: list[float] = []
    came: list[bool] = []
    for draw in draws:
        driven = drive(unrevised_guard(family), draw)
        end = driven.time[-1]
        for decision in driven.decisions:
            left = end - decision.situation.time
            if not driven.collided and left < HORIZON:
                break  # what would have come is not known
            belief = model.recognise(decision.situation.observation)
            action = int(family.actions.encode(decision.revision.executed))
            predicted.append(counts.outcome(belief, action).probability)
            came.append(driven.collided and left <= HORIZON)
    what = f"counted: failure within {HORIZON:g} s, going on as driven"
    return reliability(what, predicted, came)


def _cautious(
    family: Family,
    draws: Sequence[Draw],
    machine: EvolvingFSM,
    learnt: LatentRisk,
    rng: np.random.Generator,
) -> Reliability:
    """Brake in full from a random moment on."""
    model = machine.model()
    steps = round(family.interval / draws[0].scenario.dt)
    predicted: list[float] = []
    came: list[bool] = []
    for draw in draws:
        risk = copy.deepcopy(learnt)
        begin = rng.uniform(1.0, draw.scenario.duration - 1.0)
        with KinematicWorld().open(draw.scenario) as road:
            while not road.over and road.time < begin:
                proposal = draw.controller.propose(road.observation, road.time)
                action = make_usable(proposal, family.actions).action
                risk.follow(road.observation, action)
                road.advance(action, steps)
            if road.over:
                continue
            observation = road.observation
            belief = model.recognise(observation)
            predicted.append(risk.probability(observation, family.actions.low, _STANDSTILL, belief))
            while not road.over and road.observation[1] > 0.0:
                road.advance(family.actions.low, steps)
            came.append(road.collided)
    return reliability("rehearsed: failure, braking in full from now on", predicted, came)


def reliability(what: str, predicted: Sequence[float], came: Sequence[bool]) -> Reliability:
    """Bins of equal width over [0, 1]; empty ones are left out."""
    p, y = np.array(predicted), np.array(came, dtype=np.float64)
    index = np.minimum((p * _BINS).astype(int), _BINS - 1)
    bins = tuple(
        Bin(float(p[index == i].mean()), float(y[index == i].mean()), int((index == i).sum()))
        for i in range(_BINS)
        if (index == i).any()
    )
    return Reliability(what, bins, brier(p, y), float(y.var()), len(y), int(y.sum()))
