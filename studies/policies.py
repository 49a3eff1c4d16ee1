"""The revisers that are compared: ours and the baselines, in their groups."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum

from evofsm.driving.family import Draw, Family
from evofsm.driving.judge import LatentRisk
from evofsm.driving.measures import (
    FIXED_MEASURES,
    ResponsibilitySensitiveSafety,
    TimeHeadway,
    TimeToCollision,
)
from evofsm.driving.revisers import AlwaysBrake, EnvelopeReviser, Unrevised
from evofsm.guard import ActionReviser, Reviser, RiskMeasure


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


def oracle(family: Family, draw: Draw) -> Reviser:
    """Ours, told how hard this very leader will brake and how well the own brakes work."""
    risk = LatentRisk.given(
        family.actions.low, family.decel, draw.scenario.leader.brake_decel, family.interval
    )
    return ActionReviser(risk, family.actions)


def told_limits(family: Family, draw: Draw) -> Reviser:
    """Ours, told the true limits of the family instead of learning them."""
    risk = LatentRisk.given(family.actions.low, family.decel, family.leader_decel, family.interval)
    return ActionReviser(risk, family.actions)


def fixed_policies(family: Family) -> list[Policy]:
    """All that learn nothing, but for those that are tuned."""
    rss = ResponsibilitySensitiveSafety
    return [
        Policy("unrevised", Group.BOUND, lambda family, draw: Unrevised(family.actions)),
        Policy("always-brake", Group.BOUND, lambda family, draw: AlwaysBrake(family.actions)),
        Policy("oracle", Group.BOUND, oracle),
        *(envelope(name, Group.FIXED, measure) for name, measure in FIXED_MEASURES.items()),
        envelope("rss-matched", Group.MATCHED, rss.matched(family.decel, family.leader_decel)),
        Policy("evofsm-told", Group.MATCHED, told_limits),
    ]


#: What is tried in tuning, from bold to cautious.
TUNED_MEASURES: dict[str, tuple[RiskMeasure, ...]] = {
    "ttc-tuned": tuple(TimeToCollision(threshold) for threshold in (1.5, 2, 3, 4, 6, 8, 12)),
    "headway-tuned": tuple(TimeHeadway(t) for t in (0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 4.0)),
    "rss-tuned": tuple(
        ResponsibilitySensitiveSafety(0.25, 2.5, decel, leader_decel)
        for leader_decel in (4.0, 5.0, 6.0, 8.0, 10.0)
        for decel in (6.0, 5.0, 4.0, 3.0, 2.5, 2.0)
    ),
}
