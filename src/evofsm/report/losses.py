"""Where ours loses in the closed-loop study: found in its numbers, whatever they are."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import numpy as np

from evofsm.report.beside import checks_by_time, median_point, points_beside_rules, when
from evofsm.report.comparison import (
    ROUNDING,
    UNREVISED,
    Line,
    better_on_both,
    has_third_car,
    ours,
    rivals,
    seeds_text,
    table_groups,
)
from evofsm.report.words import count, interval, number, percent
from evofsm.studies.closed_loop import ClosedLoop, Group
from evofsm.studies.closed_loop.separation import Separation
from evofsm.studies.closed_loop.study import SAFE_RATE


class Loss(NamedTuple):
    """Something in which another does better than ours, or ours worse than it should."""

    what: str
    who: str
    theirs: str
    ours: str
    apart: bool | None  #: whether 95 % intervals do not meet; None where there are none
    loud: bool = False  #: a baseline that is better on both axes, or a failure


def losses(study: ClosedLoop) -> list[Loss]:
    """Every row and measure in which ours loses; empty where it is nowhere."""
    return [
        *_losses_in_the_table(study),
        *_losses_of_learning(study),
        *_losses_after_a_shift(study),
        *_losses_in_separation(study),
        *_losses_in_calibration(study),
        *_losses_to_state_rules(study),
        *_losses_in_cases(study),
        *_losses_between_worlds(study),
    ]


def _safer_apart(line: Line, mine: Line) -> bool:
    return line.collision_high < mine.collision_low


def _on_axes(line: Line) -> str:
    return f"{percent(line.collision_rate)} at mobility {number(line.mobility, 3)}"


def _losses_in_the_table(study: ClosedLoop) -> Iterator[Loss]:
    mine, worst = ours(study), ours(study, "worst seed")
    if mine is None or worst is None:
        return
    others = rivals(study)
    bounds = [
        line
        for name, lines in table_groups(study)
        if name == Group.BOUND
        for line in lines
        if line.policy != UNREVISED
    ]
    for line in [*others, *bounds]:
        if better_on_both(line, mine):
            apart = line.mobility_low > mine.mobility_high or _safer_apart(line, mine)
            yield Loss(
                "collisions and mobility, both",
                _who(line),
                _on_axes(line),
                _on_axes(mine),
                apart,
                loud=line.group != Group.BOUND,
            )
    for line in others:
        if better_on_both(line, mine):
            continue
        if line.collision_rate < mine.collision_rate - ROUNDING:
            apart = _safer_apart(line, mine)
            what = "collisions, at less mobility"
            yield Loss(what, _who(line), _on_axes(line), _on_axes(mine), apart)
        elif line.collision_rate < worst.collision_rate - ROUNDING:
            apart = _safer_apart(line, worst)
            what = "collisions of our worst seed"
            yield Loss(what, _who(line), _on_axes(line), _on_axes(worst), apart)
    yield from _losses_in_prices(mine, others)
    if has_third_car(study):
        yield from _losses_behind(study, mine)


def _losses_in_prices(mine: Line, others: Sequence[Line]) -> Iterator[Loss]:
    """Of those that collide no more often, who pays less."""
    as_safe = [line for line in others if line.collision_rate <= mine.collision_rate + ROUNDING]
    prices: dict[str, tuple[str, Callable[[float], str]]] = {
        "intervention_rate": ("interventions", percent),
        "mean_change": ("mean change", lambda x: f"{number(x, 2)} m/s²"),
        "jerk": ("RMS jerk", lambda x: f"{number(x, 2)} m/s³"),
    }
    for name, (what, show) in prices.items():
        for line in as_safe:
            theirs, own = getattr(line, name), getattr(mine, name)
            if theirs < own - ROUNDING:
                yield Loss(
                    f"{what}, at no more collisions", _who(line), show(theirs), show(own), None
                )


def _losses_behind(study: ClosedLoop, mine: Line) -> Iterator[Loss]:
    for _, lines in table_groups(study):
        for line in lines:
            if not line.is_ours and line.rear_ends < mine.rear_ends:
                yield Loss(
                    "rear-end collisions by the car behind",
                    _who(line),
                    _of(line.rear_ends, line.episodes),
                    _of(mine.rear_ends, mine.episodes),
                    None,
                )


def _losses_of_learning(study: ClosedLoop) -> Iterator[Loss]:
    mine, worst = ours(study), ours(study, "worst seed")
    if mine is None or worst is None:
        return
    if mine.train_collisions > 0.0:
        yield Loss(
            "collisions while learning",
            "whatever does not learn",
            "0",
            f"{_of(mine.train_collisions, mine.train_episodes)} episodes (median)",
            None,
        )
    last = [r for r in study.rows if r.group == Group.LEARNT]
    last = [row for row in last if row.train_episodes == mine.train_episodes]
    never = sum(row.episodes_until_safe is None for row in last)
    if never:
        yield Loss(
            "becoming safe",
            f"the mark of {SAFE_RATE:.0%}",
            "reached by every seed",
            f"not reached by {never} of {seeds_text(len(last))} in "
            f"{mine.train_episodes:,} episodes",
            None,
            loud=True,
        )


def _losses_after_a_shift(study: ClosedLoop) -> Iterator[Loss]:
    for after, own, theirs in checks_by_time(study):
        if not own or not theirs:
            continue
        mine, other = float(np.median(own)), float(np.median(theirs))
        if mine > other + ROUNDING:
            yield Loss(
                f"collisions {when(after)}",
                "rss-unchanged",
                percent(other),
                f"{percent(mine)} (median)",
                None,
                loud=after == max(check.episodes_after for check in study.checks),
            )


def _losses_in_separation(study: ClosedLoop) -> Iterator[Loss]:
    mine = _own_separation(study)
    if mine is None:
        return
    for other in study.separations:
        if other.group != Group.LEARNT and other.auroc > mine.auroc:
            yield Loss(
                "AUROC for the dead end",
                f"{other.measure} ({other.group})",
                _area(other),
                _area(mine),
                other.low > mine.high,
            )


def _own_separation(study: ClosedLoop) -> Separation | None:
    return next((one for one in study.separations if one.group == Group.LEARNT), None)


def _area(one: Separation) -> str:
    ends = interval(one.low, one.high, lambda x: number(x, 3))
    return f"{number(one.auroc, 3)} ({ends})"


def _losses_in_calibration(study: ClosedLoop) -> Iterator[Loss]:
    for one in study.reliabilities:
        if one.brier >= one.base_brier:
            yield Loss(
                f"Brier score, {one.what}",
                "always the base rate",
                number(one.base_brier, 4),
                number(one.brier, 4),
                None,
            )


def _losses_to_state_rules(study: ClosedLoop) -> Iterator[Loss]:
    points = points_beside_rules(study)
    if not points:
        return
    rate, mobility = median_point(points)
    for row in study.by_rule:
        fewer, further = rate - row.collision_rate, row.mobility - mobility
        if min(fewer, further) >= -ROUNDING and max(fewer, further) > ROUNDING:
            yield Loss(
                "risk read through states: collisions and mobility, both",
                f"{row.policy}, seed {row.learning_seed}",
                f"{percent(row.collision_rate)} at {number(row.mobility, 3)}",
                f"{percent(rate)} at {number(mobility, 3)} (judged where they are)",
                None,
            )


def _losses_in_cases(study: ClosedLoop) -> Iterator[Loss]:
    for case in study.cases:
        if case.collided:
            yield Loss(
                f"the paper's {case.name}",
                "no collision",
                "the run's end",
                f"collides at {case.end:.1f} s",
                None,
                loud=True,
            )
        elif not case.unrevised_collided and case.changed > 0.0:
            yield Loss(
                f"the paper's {case.name}",
                "the driver alone, who does not collide",
                percent(0.0),
                f"{percent(case.changed)} of decisions changed ({percent(case.changed_late)} late)",
                None,
            )


def _losses_between_worlds(study: ClosedLoop) -> Iterator[Loss]:
    if len({world.collisions for world in study.worlds}) > 1:
        found = ", ".join(f"{_of(w.collisions, w.episodes)} in {w.world}" for w in study.worlds)
        yield Loss("collisions in both worlds", "the same model", "equal", found, None)


def _who(line: Line) -> str:
    return f"{line.policy} ({line.group})"


def _of(part: float, whole: int) -> str:
    return f"{count(part)} of {whole:,}"
