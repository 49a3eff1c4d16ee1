"""The table of the closed-loop study: its lines, and what they say in sentences."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby

import numpy as np

from evofsm.report.words import count, listed, number, percent
from evofsm.studies.closed_loop import ClosedLoop, Group, Row
from evofsm.studies.closed_loop.study import SAFE_RATE

UNREVISED = "unrevised"
#: Numbers that are equal but for rounding.
ROUNDING = 1e-9
# Baselines; the rows that bound the field are none.
_RIVALS = (Group.FIXED, Group.TUNED, Group.MATCHED)


# -- Lines ----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Line:
    """A line of the table: a baseline, or ours over its learning seeds."""

    policy: str
    group: str
    which: str  #: "median", "worst seed", or nothing for baselines
    seeds: int  #: learning seeds
    train_episodes: int
    episodes: int  #: held out
    collisions: float
    collision_rate: float
    collision_low: float
    collision_high: float
    mobility: float
    mobility_low: float
    mobility_high: float
    intervention_rate: float
    mean_change: float
    jerk: float
    until_safe: float  #: infinite where never reached, NaN for what does not learn
    train_collisions: float  #: NaN for what does not learn
    rear_ends: float

    @property
    def is_ours(self) -> bool:
        """Whether it learnt online."""
        return self.group == Group.LEARNT

    @property
    def name(self) -> str:
        """As people read it."""
        if not self.is_ours:
            return self.policy
        return f"{self.policy}, {self.train_episodes} episodes, {self.which}"

    @property
    def until_safe_text(self) -> str:
        """Episodes until safe."""
        if math.isinf(self.until_safe):
            return f"not in {self.train_episodes}"
        return count(self.until_safe)


_COUNTED = ("collisions", "train_collisions", "rear_ends")
_MEASURED = (
    *("collision_rate", "collision_low", "collision_high"),
    *("mobility", "mobility_low", "mobility_high"),
    *("intervention_rate", "mean_change", "jerk"),
)


def table_groups(study: ClosedLoop) -> list[tuple[str, list[Line]]]:
    """The table's lines in their groups: bounds first, ours last."""
    lines = [_baseline(row) for row in study.rows if row.group != Group.LEARNT]
    lines += our_lines(study)
    groups = [(str(group), [line for line in lines if line.group == group]) for group in Group]
    order = (Group.BOUND, Group.FIXED, Group.TUNED, Group.MATCHED, Group.LEARNT)
    return [
        (name, found)
        for name, found in sorted(groups, key=lambda g: order.index(Group(g[0])))
        if found
    ]


def our_lines(study: ClosedLoop) -> list[Line]:
    """Median and worst of the learning seeds, for each number of training episodes."""
    learnt = sorted(
        (row for row in study.rows if row.group == Group.LEARNT), key=lambda r: r.train_episodes
    )
    lines = []
    for _, rows in groupby(learnt, key=lambda row: row.train_episodes):
        seeds = list(rows)
        lines.append(_overseeds_text(seeds, "median"))
        worst = max(seeds, key=lambda row: (row.collision_rate, -row.mobility))
        lines.append(_overseeds_text([worst], "worst seed", len(seeds)))
    return lines


def ours(study: ClosedLoop, which: str = "median") -> Line | None:
    """Ours after all training; None where nothing was learnt."""
    lines = [line for line in our_lines(study) if line.which == which]
    return lines[-1] if lines else None


def rivals(study: ClosedLoop) -> list[Line]:
    """The baselines, without the rows that bound the field."""
    return [_baseline(row) for row in study.rows if row.group in _RIVALS]


def has_third_car(study: ClosedLoop) -> bool:
    """Whether a car drives behind, which our braking may surprise."""
    return study.family.draw(study.plan.seed, 0).scenario.behind is not None


def unrevised(study: ClosedLoop) -> Row | None:
    """The row of the controller left alone."""
    return next((row for row in study.rows if row.policy == UNREVISED), None)


def _baseline(row: Row) -> Line:
    values = {name: float(getattr(row, name)) for name in (*_COUNTED, *_MEASURED)}
    values["train_collisions"] = math.nan
    return Line(
        **values,
        policy=row.policy,
        group=row.group,
        which="",
        seeds=0,
        train_episodes=row.train_episodes,
        episodes=row.episodes,
        until_safe=math.nan,
    )


def _overseeds_text(rows: Sequence[Row], which: str, seeds: int | None = None) -> Line:
    """Each column's median by itself; of one row, the row."""
    values = {
        name: float(np.median([getattr(row, name) for row in rows]))
        for name in (*_COUNTED, *_MEASURED)
    }
    safe = [math.inf if r.episodes_until_safe is None else r.episodes_until_safe for r in rows]
    return Line(
        **values,
        policy=rows[0].policy,
        group=rows[0].group,
        which=which,
        seeds=seeds or len(rows),
        train_episodes=rows[0].train_episodes,
        episodes=rows[0].episodes,
        until_safe=_median(safe),
    )


def _median(values: Sequence[float]) -> float:
    """The median, infinite ones among them."""
    ordered = sorted(values)
    middle = len(ordered) // 2
    if len(ordered) % 2:
        return float(ordered[middle])
    return (ordered[middle - 1] + ordered[middle]) / 2.0


def better_on_both(line: Line, mine: Line) -> bool:
    """No worse on either axis, and better on one."""
    fewer = mine.collision_rate - line.collision_rate
    further = line.mobility - mine.mobility
    return min(fewer, further) >= -ROUNDING and max(fewer, further) > ROUNDING


# -- Sentences -------------------------------------------------------------------------------------


def headline(study: ClosedLoop) -> str:
    """What changed, in a line."""
    mine, alone = ours(study), unrevised(study)
    if mine is None:
        return "Nothing was learnt in this study"
    before = f"{percent(alone.collision_rate)} → " if alone else ""
    return (
        f"Collisions {before}{percent(mine.collision_rate)}, at mobility {number(mine.mobility, 3)}"
    )


def answer(study: ClosedLoop) -> list[str]:
    """Three sentences: what it does, what that costs, and who does better."""
    mine, worst, alone = ours(study), ours(study, "worst seed"), unrevised(study)
    if mine is None or worst is None:
        return ["The study has no row of a policy that learnt online."]
    before = (
        f"Left alone, the driver collides in {percent(alone.collision_rate)} of "
        f"{alone.episodes:,} held-out episodes; revised"
        if alone
        else "Revised"
    )
    does = (
        f"{before} by {mine.policy}, after {mine.train_episodes:,} training episodes, in "
        f"{percent(mine.collision_rate)} (median of {seeds_text(mine.seeds)}; worst seed "
        f"{percent(worst.collision_rate)})."
    )
    costs = (
        f"It costs mobility, which is {number(mine.mobility, 3)} of the unrevised driver's, "
        f"{percent(mine.intervention_rate)} of the decisions, which are changed, and "
        f"{count(mine.train_collisions)} collisions while learning (medians)."
    )
    return [does, costs, _who_does_better(study, mine)]


def _who_does_better(study: ClosedLoop, mine: Line) -> str:
    others = rivals(study)
    if not others:
        return "No baseline was driven."
    better = [line for line in others if better_on_both(line, mine)]
    if better:
        names = listed(f"{line.policy} ({line.group})" for line in better)
        verb = "does" if len(better) == 1 else "do"
        return (
            f"Of {len(others)} baselines {len(better)} {verb} better, colliding no more often at "
            f"no less mobility: {names}."
        )
    as_safe = [line for line in others if line.collision_rate <= mine.collision_rate + ROUNDING]
    if not as_safe:
        return f"None of {len(others)} baselines collides as rarely."
    best = max(as_safe, key=lambda line: line.mobility)
    return (
        f"None of {len(others)} baselines is at once as safe and as mobile; of the "
        f"{len(as_safe)} that collide as rarely the most mobile is {best.policy} "
        f"({best.group}), with {number(best.mobility, 3)}."
    )


def seeds_text(n: int) -> str:
    """How many learning seeds."""
    return f"{n} learning seed{'' if n == 1 else 's'}"


def note_on_the_table(study: ClosedLoop) -> str:
    """How the table is to be read."""
    mine = ours(study)
    held_out = study.rows[0].episodes if study.rows else 0
    seeds = (
        f"Ours is given over {seeds_text(mine.seeds)}: each column's median by itself, and the "
        "seed with most collisions (of those, least mobility). "
        if mine
        else ""
    )
    return (
        f"All policies drive the same {held_out:,} held-out episodes. {seeds}"
        "In brackets 95 % intervals, by Clopper and Pearson for collisions, by bootstrap over "
        "episodes for mobility; over seeds, the medians of their ends. Mobility: distance until "
        "the leader's brake, in those of the unrevised driver. Interventions: share of decisions "
        "that were changed. Change: mean of |executed − proposed| over all decisions. Until safe: "
        f"training episodes after which, learning frozen, at most {percent(SAFE_RATE)} of "
        f"{checked_on(study):,} held-out episodes collide."
    )


def checked_on(study: ClosedLoop) -> int:
    """Held-out episodes of a test on the way."""
    return study.curve[0].held_out if study.curve else 0
