"""The revisers that are compared: ours and the baselines, in their groups."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import ArrayLike

from evofsm.driving import Draw, EnvelopeReviser, Family, LatentRisk, Unrevised, measures
from evofsm.fsm import EvolvingFSM, wilson_bounds
from evofsm.guard import (
    ActionReviser,
    Judgement,
    Proposal,
    Reviser,
    Revision,
    RiskMeasure,
    Situation,
)

# States of a smaller belief are left out.
_LEAST_BELIEF = 1e-3


class AlwaysBrake(Unrevised):
    """Brakes in full always: no one is safer, or gets less far."""

    def revise(self, situation: Situation, proposal: Proposal) -> Revision:
        """Full braking."""
        kept = super().revise(situation, proposal)
        return kept._replace(executed=self.actions.low, advised=self.actions.low)


class Group(StrEnum):
    """What a policy was told."""

    BOUND = "bounds of the field"
    FIXED = "fixed constants"
    TUNED = "tuned on the training scenarios"
    MATCHED = "told the true limits"
    LEARNT = "learnt online"


@dataclass(frozen=True)
class Policy:
    """A reviser by name, made anew for each draw."""

    name: str
    group: Group
    make: Callable[[Family, Draw], Reviser]


def envelope(name: str, group: Group, measure: RiskMeasure) -> Policy:
    """Full braking where a measure calls for it."""
    return Policy(
        name, group, lambda family, draw: EnvelopeReviser(measure, family.actions, family.interval)
    )


def _told(family: Family, leader_decel: float) -> Reviser:
    """Ours, told limits instead of learning them; the oracle, those of this very leader."""
    low, brakes = family.actions.low, family.decel
    risk = LatentRisk(low, family.interval, decel=brakes, leader_decel=leader_decel)
    return ActionReviser(risk, family.actions)


class RiskByState:
    """Judges actions by the states that a situation is recognised as, weighed by the belief.

    Where states disagree, their standard deviation is added to their mean risk.
    """

    labels, fallback, lowest_first = LatentRisk.labels, LatentRisk.fallback, True

    def __init__(self, risk: LatentRisk, machine: EvolvingFSM) -> None:
        self.risk, self.machine = risk, machine
        self.why, self.trial = risk.why, risk.trial
        self.effective, self.refuse_unfit = risk.effective, risk.refuse_unfit

    def choose(self, *_: object) -> None:
        """Leave it to the reviser."""

    def judge(self, situation: Situation, accelerations: ArrayLike) -> Judgement:
        """Latent risk of each acceleration."""
        taking_part = np.flatnonzero(situation.belief >= _LEAST_BELIEF)
        if len(taking_part) == 0 or self.machine.n_states == 0:
            return self.risk.judge(situation, accelerations)
        weights, centers = situation.belief[taking_part], self.machine.centers[taking_part]
        critical = np.stack([self.risk.critical(center, accelerations) for center in centers])
        weights = weights / weights.sum()
        risks = self.risk.manoeuvres.harder(critical)
        risk = weights @ risks
        cautious = np.minimum(risk + np.sqrt(weights @ (risks - risk) ** 2), 1.0)
        evidence = float(len(self.risk.manoeuvres))
        bounds = [wilson_bounds(each, evidence + 1.0) for each in cautious.tolist()]
        low, high = np.transpose(bounds)
        return Judgement(cautious, low, high, weights @ critical, evidence, situation.seen)


def fixed_policies(family: Family) -> list[Policy]:
    """All that learn nothing, but for those that are tuned."""
    rss = measures.ResponsibilitySensitiveSafety.matched(family.decel, family.leader_decel)
    fixed = measures.FIXED_MEASURES.items()
    return [
        Policy("unrevised", Group.BOUND, lambda family, draw: Unrevised(family.actions)),
        Policy("always-brake", Group.BOUND, lambda family, draw: AlwaysBrake(family.actions)),
        Policy("oracle", Group.BOUND, lambda f, draw: _told(f, draw.scenario.leader.brake_decel)),
        *(envelope(name, Group.FIXED, measure) for name, measure in fixed),
        envelope("rss-matched", Group.MATCHED, rss),
        Policy("evofsm-told", Group.MATCHED, lambda f, draw: _told(f, f.leader_decel)),
    ]


#: What is tried in tuning, from bold to cautious.
TUNED_MEASURES: dict[str, tuple[RiskMeasure, ...]] = {
    "ttc-tuned": tuple(measures.TimeToCollision(t) for t in (1.5, 2, 3, 4, 6, 8, 12)),
    "headway-tuned": tuple(measures.TimeHeadway(t) for t in (0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 4.0)),
    "rss-tuned": tuple(
        measures.ResponsibilitySensitiveSafety(0.25, 2.5, decel, leader_decel)
        for leader_decel in (4.0, 5.0, 6.0, 8.0, 10.0)
        for decel in (6.0, 5.0, 4.0, 3.0, 2.5, 2.0)
    ),
}
