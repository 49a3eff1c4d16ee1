"""Where ours loses: found in the study's numbers, whatever they are."""

from __future__ import annotations

from collections.abc import Iterator
from enum import StrEnum
from itertools import pairwise, product
from typing import NamedTuple

from evofsm.driving import Group
from evofsm.evidence.closed_loop.comparison import (
    ROUNDING,
    Line,
    has_third_car,
    ours,
    standing,
    table_groups,
)
from evofsm.evidence.closed_loop.over_seeds import around_shift
from evofsm.evidence.closed_loop.study import SAFE_RATE, ClosedLoop

#: So many episodes after a shift collisions must be as rare as where it is safe.
RECOVERED_AFTER = 30


class What(StrEnum):
    """In what one may lose, and which numbers tell it."""

    BOTH = "collisions and mobility, both"  #: rate, mobility
    COLLISIONS = "collisions, at less mobility"  #: rate, mobility
    WORST_SEED = "collisions of our worst seed"  #: rate, mobility
    INTERVENTIONS = "interventions, at no more collisions"  #: share of decisions
    CHANGE = "mean change, at no more collisions"  #: [m/s²]
    JERK = "RMS jerk, at no more collisions"  #: [m/s³]
    REAR_ENDS = "rear-end collisions by the car behind"  #: number, episodes
    LEARNING = "collisions while learning"  #: number, episodes
    BECOMING_SAFE = "becoming safe"  #: seeds that did not, seeds, episodes
    SHIFT = "collisions around the shift"  #: rate
    AUROC = "AUROC for the dead end"  #: area, low, high
    BRIER = "Brier score"  #: score
    CASE_COLLIDES = "collision in a case of the paper"  #: the run's end [s]
    CASE_CHANGED = "changes in a case of the paper"  #: share of decisions, of late ones
    WORLDS = "collisions in both worlds"  #: number, episodes


class Loss(NamedTuple):
    """Something in which another does better than ours, or ours worse than it should."""

    what: What
    who: str  #: policy, measure or world; empty where ours is held against what it should do
    group: str
    theirs: tuple[float, ...]  #: empty where there are no numbers
    ours: tuple[float, ...]
    apart: bool | None = None  #: whether 95 % intervals do not meet; None where there are none
    loud: bool = False  #: whether it breaks what was asked for
    about: str | int = ""  #: which test, probability, case or other world


def losses(study: ClosedLoop) -> list[Loss]:
    """Every row and measure in which ours loses; empty where it is nowhere."""
    return [
        *_in_the_table(study),
        *_after_a_shift(study),
        *_in_separation(study),
        *_in_calibration(study),
        *_in_cases(study),
        *_between_worlds(study),
    ]


def _in_the_table(study: ClosedLoop) -> Iterator[Loss]:
    mine, worst = ours(study), ours(study, "worst seed")
    if mine is None or worst is None:
        return
    found = standing(study, mine)
    for line in found.better:
        yield _on_axes(What.BOTH, line, mine, loud=line.group == Group.FIXED)
    for line in found.rivals:
        if line in found.better:
            continue
        if line.collision_rate < mine.collision_rate - ROUNDING:
            yield _on_axes(What.COLLISIONS, line, mine)
        elif line.collision_rate < worst.collision_rate - ROUNDING:
            yield _on_axes(What.WORST_SEED, line, worst)
    for what, name in _PRICES.items():
        own = getattr(mine, name)
        for line in found.as_safe:
            if getattr(line, name) < own - ROUNDING:
                yield Loss(what, line.policy, line.group, (getattr(line, name),), (own,))
    if has_third_car(study):
        yield from _behind(study, mine)
    yield from _of_learning(study, mine)


# What safety costs; held against those who collide no more often.
_PRICES = {
    What.INTERVENTIONS: "intervention_rate",
    What.CHANGE: "mean_change",
    What.JERK: "jerk",
}


def _on_axes(what: What, line: Line, mine: Line, *, loud: bool = False) -> Loss:
    apart = line.collision_high < mine.collision_low
    if what == What.BOTH:
        apart = apart or line.mobility_low > mine.mobility_high
    theirs, own = ((one.collision_rate, one.mobility) for one in (line, mine))
    return Loss(what, line.policy, line.group, theirs, own, apart, loud)


def _behind(study: ClosedLoop, mine: Line) -> Iterator[Loss]:
    own = (mine.rear_ends, mine.episodes)
    for group, lines in table_groups(study):
        for line in lines:
            if not line.is_ours and line.rear_ends < mine.rear_ends:
                theirs = (line.rear_ends, line.episodes)
                yield Loss(What.REAR_ENDS, line.policy, group, theirs, own)


def _of_learning(study: ClosedLoop, mine: Line) -> Iterator[Loss]:
    if mine.train_collisions > 0.0:
        own = (mine.train_collisions, mine.train_episodes)
        yield Loss(What.LEARNING, "", "", (0.0, mine.train_episodes), own)
    if never := never_safe(study, mine):
        yield Loss(
            What.BECOMING_SAFE, "", "", (), (never, mine.seeds, mine.train_episodes), loud=True
        )


def never_safe(study: ClosedLoop, mine: Line) -> int:
    """How many learning seeds of all training were never as safe as is asked."""
    return sum(
        row.group == Group.LEARNT
        and row.train_episodes == mine.train_episodes
        and row.episodes_until_safe is None
        for row in study.rows
    )


def _after_a_shift(study: ClosedLoop) -> Iterator[Loss]:
    tested = list(around_shift(study))
    for after, own, theirs in tested:
        if theirs and own.median > theirs.median + ROUNDING:
            yield Loss(
                What.SHIFT,
                "rss-unchanged",
                "",
                (theirs.median,),
                (own.median,),
                loud=after >= RECOVERED_AFTER and own.median > SAFE_RATE,
                about=after,
            )


def _in_separation(study: ClosedLoop) -> Iterator[Loss]:
    mine = [one for one in study.separations if one.group == Group.LEARNT][:1]
    for own, other in product(mine, study.separations):
        if other.group != Group.LEARNT and other.auroc > own.auroc:
            yield Loss(
                What.AUROC,
                other.measure,
                other.group,
                (other.auroc, other.low, other.high),
                (own.auroc, own.low, own.high),
                other.low > own.high,
            )


def _in_calibration(study: ClosedLoop) -> Iterator[Loss]:
    for one in study.reliabilities:
        if one.brier >= one.base_brier:
            yield Loss(What.BRIER, "", "", (one.base_brier,), (one.brier,), about=one.what)


def _in_cases(study: ClosedLoop) -> Iterator[Loss]:
    for case in study.cases:
        if case.collided:
            yield Loss(What.CASE_COLLIDES, "", "", (), (case.end,), loud=True, about=case.name)
        elif not case.unrevised_collided and case.changed > 0.0:
            own = (case.changed, case.changed_late)
            yield Loss(What.CASE_CHANGED, "", "", (0.0, 0.0), own, about=case.name)


def _between_worlds(study: ClosedLoop) -> Iterator[Loss]:
    for one, other in pairwise(study.worlds):
        if one.collisions != other.collisions:
            theirs, own = ((w.collisions, w.episodes) for w in (one, other))
            yield Loss(What.WORLDS, one.world, "", theirs, own, about=other.world)
