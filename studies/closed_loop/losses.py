"""Where ours loses: found in the study's numbers, whatever they are, and said in words."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import pairwise
from typing import NamedTuple

from evofsm.cli import number, part, percent, seeds_text, within
from studies.closed_loop.beside import Separation
from studies.closed_loop.comparison import (
    ROUNDING,
    Line,
    has_third_car,
    never_safe,
    ours,
    standing,
    table_groups,
)
from studies.closed_loop.machine import MACHINE
from studies.closed_loop.over_seeds import around_shift, cases_over_seeds, when
from studies.closed_loop.stages import SAFE_RATE
from studies.closed_loop.study import ClosedLoop
from studies.policies import Group

#: So many episodes after a shift collisions must be as rare as where it is safe.
RECOVERED_AFTER = 30
# What safety costs; held against those who collide no more often.
_PRICES: dict[str, tuple[str, Callable[[float], str]]] = {
    "interventions": ("intervention_rate", percent),
    "mean change": ("mean_change", lambda x: f"{number(x, 2)} m/s²"),
    "RMS jerk": ("jerk", lambda x: f"{number(x, 2)} m/s³"),
}


class Loss(NamedTuple):
    """Something in which another does better than ours, or ours worse than it should."""

    what: str
    who: str  #: with what it was told, or what ours is held against
    theirs: str
    ours: str
    apart: bool | None = None  #: whether 95 % intervals do not meet; None where there are none
    loud: bool = False  #: whether it breaks what was asked for


def losses(study: ClosedLoop) -> list[Loss]:
    """Every row and measure in which ours loses; empty where it is nowhere."""
    return [
        *_in_the_table(study),
        *_of_the_machine(study),
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
        fixed = line.group == Group.FIXED
        apart = line.mobility_low > mine.mobility_high
        yield _on_axes("collisions and mobility, both", line, mine, apart=apart, loud=fixed)
    for line in found.rivals:
        if line in found.better:
            continue
        if line.collision_rate < mine.collision_rate - ROUNDING:
            yield _on_axes("collisions, at less mobility", line, mine)
        elif line.collision_rate < worst.collision_rate - ROUNDING:
            yield _on_axes("collisions of our worst seed", line, worst)
    for what, (name, show) in _PRICES.items():
        own = getattr(mine, name)
        for line in found.as_safe:
            if (price := getattr(line, name)) < own - ROUNDING:
                yield Loss(f"{what}, at no more collisions", _told(line), show(price), show(own))
    if has_third_car(study):
        for line in (line for _, lines in table_groups(study) for line in lines):
            if not line.is_ours and line.rear_ends < mine.rear_ends:
                what = "rear-end collisions by the car behind"
                yield Loss(what, _told(line), _behind(line), _behind(mine))
    if mine.train_collisions > 0.0:
        own = f"{part(mine.train_collisions, mine.train_episodes)} episodes (median)"
        yield Loss("collisions while learning", "whatever does not learn", "0", own)
    if never := never_safe(study, mine):
        yield Loss(
            "becoming safe",
            f"the mark of {SAFE_RATE:.0%}",
            "reached by every seed",
            f"not reached by {never} of {seeds_text(mine.seeds)} in {mine.train_episodes:,} "
            "episodes",
            loud=True,
        )


def _of_the_machine(study: ClosedLoop) -> Iterator[Loss]:
    """In what ours that was told nothing but failures falls short of ours that was told more."""
    told, machine = ours(study), ours(study, policy=MACHINE)
    worst = ours(study, "worst seed", MACHINE)
    if told is None or machine is None or worst is None:
        return
    who = "evofsm"
    for what, line in (("median", machine), ("worst seed", worst)):
        if line.collision_rate > told.collision_rate + ROUNDING:
            yield Loss(
                f"collisions of {MACHINE}, {what}",
                who,
                percent(told.collision_rate),
                percent(line.collision_rate),
                told.collision_high < line.collision_low,
            )
    if machine.mobility < told.mobility - ROUNDING:
        apart = told.mobility_low > machine.mobility_high
        theirs, own = (number(line.mobility, 3) for line in (told, machine))
        yield Loss(f"mobility of {MACHINE}", who, theirs, own, apart)
    if machine.train_collisions > told.train_collisions:
        theirs, own = (part(one.train_collisions, one.train_episodes) for one in (told, machine))
        yield Loss(f"collisions while learning of {MACHINE} (median)", who, theirs, own)


def _told(one: Line | Separation) -> str:
    return f"{one.policy if isinstance(one, Line) else one.measure} ({one.group})"


def _behind(line: Line) -> str:
    return part(line.rear_ends, line.episodes)


def _on_axes(what: str, line: Line, mine: Line, *, apart: bool = False, loud: bool = False) -> Loss:
    theirs, own = (
        f"{percent(one.collision_rate)} at mobility {number(one.mobility, 3)}"
        for one in (line, mine)
    )
    return Loss(
        what, _told(line), theirs, own, apart or line.collision_high < mine.collision_low, loud
    )


def _after_a_shift(study: ClosedLoop) -> Iterator[Loss]:
    for after, own, theirs, _ in around_shift(study):
        if theirs and own.median > theirs.median + ROUNDING:
            yield Loss(
                f"collisions {when(after)}",
                "rss-unchanged",
                percent(theirs.median),
                f"{percent(own.median)} (median)",
                loud=after >= RECOVERED_AFTER and own.median > SAFE_RATE,
            )


def _in_separation(study: ClosedLoop) -> Iterator[Loss]:
    mine = next((one for one in study.separations if one.group == Group.LEARNT), None)
    for other in study.separations:
        if mine and other.group != Group.LEARNT and other.auroc > mine.auroc:
            theirs, own = (within(3, 3)(one.auroc, one.low, one.high) for one in (other, mine))
            apart = other.low > mine.high
            yield Loss("AUROC for the dead end", _told(other), theirs, own, apart)


def _in_calibration(study: ClosedLoop) -> Iterator[Loss]:
    for one in study.reliabilities:
        if one.brier >= one.base_brier:
            base, own = number(one.base_brier, 4), number(one.brier, 4)
            yield Loss(f"Brier score, {one.what}", "always the base rate", base, own)


def _in_cases(study: ClosedLoop) -> Iterator[Loss]:
    for case in study.cases:
        what = f"the paper's {case.name}"
        if case.collided:
            own = f"collides at {case.end:.1f} s"
            yield Loss(what, "no collision", "the run's end", own, loud=True)
        elif not case.unrevised_collided and case.changed > 0.0:
            own = (
                f"{percent(case.changed)} of decisions changed ({percent(case.changed_late)} late)"
            )
            yield Loss(what, "the driver alone, who does not collide", percent(0.0), own)
    for one in cases_over_seeds(study):
        if one.collided:
            own = f"{MACHINE} collides with {part(one.collided, one.seeds)} learning seeds"
            yield Loss(f"the paper's {one.name}", "no collision", "0", own, loud=True)


def _between_worlds(study: ClosedLoop) -> Iterator[Loss]:
    for one, other in pairwise(study.worlds):
        if one.collisions != other.collisions:
            own = ", ".join(f"{part(w.collisions, w.episodes)} in {w.world}" for w in (one, other))
            yield Loss("collisions in both worlds", "the same model", "equal", own)
