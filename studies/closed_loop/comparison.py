"""Ours among the others: the lines of the table, and who is better on which axis."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

import numpy as np

from evofsm.driving import Row
from studies.closed_loop.machine import MACHINE
from studies.closed_loop.over_seeds import OURS, gathered, learning_curve
from studies.closed_loop.study import ClosedLoop, TradeOff, told
from studies.policies import Group

UNREVISED = "unrevised"
#: Numbers that are equal but for rounding.
ROUNDING = 1e-9
# Baselines; the rows that bound the field are none.
_RIVALS = (Group.FIXED, Group.TUNED, Group.MATCHED)
#: Our own reviser, told what ours has to learn: it shows the price of learning, and is no rival.
OURS_TOLD = ("oracle", "evofsm-told")


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
    rear_ends: float
    until_safe: float  #: infinite where never reached, NaN for what does not learn
    train_collisions: float  #: NaN for what does not learn
    told: str  #: what it was told

    @property
    def is_ours(self) -> bool:
        """Whether it learnt online."""
        return self.group == Group.LEARNT


_MEASURED = (
    *("collisions", "collision_rate", "collision_low", "collision_high"),
    *("mobility", "mobility_low", "mobility_high"),
    *("intervention_rate", "mean_change", "jerk", "rear_ends"),
)


def table_groups(study: ClosedLoop) -> list[tuple[str, list[Line]]]:
    """The table's lines in their groups: bounds first, ours last."""
    every = [*_baselines(study), *our_lines(study, MACHINE), *our_lines(study)]
    lines = gathered(every, lambda line: line.group)
    return [(str(group), lines[group]) for group in Group if group in lines]


def our_lines(study: ClosedLoop, policy: str = OURS) -> list[Line]:
    """Median and worst of the learning seeds, for each number of training episodes."""
    learnt = (row for row in study.rows if row.policy == policy)
    lines = []
    for _, rows in sorted(gathered(learnt, lambda row: row.train_episodes).items()):
        worst = max(rows, key=safest_first)
        lines += [_line(rows, "median", len(rows)), _line([worst], "worst seed", len(rows))]
    return lines


def ours(study: ClosedLoop, which: str = "median", policy: str = OURS) -> Line | None:
    """Ours after all training, unless another policy is named; None where nothing was learnt."""
    lines = [line for line in our_lines(study, policy) if line.which == which]
    return lines[-1] if lines else None


def _baselines(study: ClosedLoop) -> list[Line]:
    return [_line([row]) for row in study.rows if row.group != Group.LEARNT]


def _line(rows: Sequence[Row], which: str = "", seeds: int = 0) -> Line:
    """Each column's median by itself; of one row, the row."""
    first = rows[0]
    values = {name: [getattr(row, name) for row in rows] for name in _MEASURED}
    values["until_safe"] = values["train_collisions"] = [math.nan]
    if first.group == Group.LEARNT:
        safe = [row.episodes_until_safe for row in rows]
        values["until_safe"] = [math.inf if k is None else k for k in safe]
        values["train_collisions"] = [row.train_collisions for row in rows]
    return Line(
        first.policy,
        first.group,
        which,
        seeds,
        first.train_episodes,
        first.episodes,
        told=told(first.policy, first.group),
        **{name: float(np.median(found)) for name, found in values.items()},
    )


def unrevised(study: ClosedLoop) -> Row | None:
    """The row of the controller left alone."""
    return next((row for row in study.rows if row.policy == UNREVISED), None)


def never_safe(study: ClosedLoop, mine: Line) -> int:
    """How many learning seeds of all training were never as safe as is asked."""
    return sum(
        row.policy == mine.policy
        and row.train_episodes == mine.train_episodes
        and row.episodes_until_safe is None
        for row in study.rows
    )


def has_third_car(study: ClosedLoop) -> bool:
    """Whether a car drives behind, which our braking may surprise."""
    return study.family.draw(study.plan.seed, 0).scenario.behind is not None


# -- Two axes -------------------------------------------------------------------------------------


#: Whatever has a place in collisions and mobility.
OnAxes: TypeAlias = Line | Row | TradeOff


def safest_first(one: OnAxes) -> tuple[float, float]:
    """Key to sort by: fewer collisions, then more mobility."""
    return one.collision_rate, -one.mobility


def as_safe(one: OnAxes, mine: OnAxes) -> bool:
    """Whether it collides no more often."""
    return one.collision_rate <= mine.collision_rate + ROUNDING


def better_on_both(one: OnAxes, mine: OnAxes) -> bool:
    """No worse on either axis, and better on one."""
    fewer = mine.collision_rate - one.collision_rate
    further = one.mobility - mine.mobility
    return min(fewer, further) >= -ROUNDING and max(fewer, further) > ROUNDING


def better_on_none(one: OnAxes, mine: OnAxes) -> bool:
    """No better on either axis."""
    return as_safe(mine, one) and one.mobility <= mine.mobility + ROUNDING


# -- Ours among them ------------------------------------------------------------------------------


class Standing(NamedTuple):
    """Ours after all training among the others."""

    told: list[Line]  #: our own reviser that did not have to learn, which is no baseline
    rivals: list[Line]  #: the baselines
    better: list[Line]  #: baselines that are better on both axes
    as_safe: list[Line]  #: baselines that collide no more often

    @property
    def most_mobile(self) -> Line:
        """Of those that collide no more often."""
        return max(self.as_safe, key=lambda line: line.mobility)


def standing(study: ClosedLoop, mine: Line) -> Standing:
    """Where ours stands."""
    lines = _baselines(study)
    rivals = [line for line in lines if line.group in _RIVALS and line.policy not in OURS_TOLD]
    return Standing(
        [line for line in lines if line.policy in OURS_TOLD],
        rivals,
        [line for line in rivals if better_on_both(line, mine)],
        [line for line in rivals if as_safe(line, mine)],
    )


class StatesAlone(NamedTuple):
    """Ours, judging situations where they are, to hold risk read through states alone against."""

    episodes: int  #: learnt from, no more than the rules had
    collision_rate: float  #: median over seeds
    mobility: float  #: median over seeds
    best: Row  #: of the rules
    better: list[Row]  #: rules that are better on both axes
    no_better: int  #: rules that are better on none


def states_alone(study: ClosedLoop) -> StatesAlone | None:
    """What states alone are worth; None where that was not tried."""
    rows = study.by_rule
    most = max((row.train_episodes for row in rows), default=-1)
    stages = [stage for stage in learning_curve(study) if stage.episodes <= most]
    if not stages:
        return None
    rate, mobility = stages[-1].collision_rate.median, stages[-1].mobility.median
    mine = TradeOff("", "", rate, mobility)
    return StatesAlone(
        stages[-1].episodes,
        rate,
        mobility,
        min(rows, key=safest_first),
        [row for row in rows if better_on_both(row, mine)],
        sum(better_on_none(row, mine) for row in rows),
    )


# -- Settings -------------------------------------------------------------------------------------


def settings(study: ClosedLoop) -> dict[str, list[TradeOff]]:
    """What each policy reaches, by its name."""
    return gathered(study.trade_offs, lambda point: point.policy)


def chosen(points: Sequence[TradeOff]) -> TradeOff:
    """The setting that tuning chose: of the safest the most mobile."""
    return min(points, key=safest_first)


def front(points: Sequence[TradeOff]) -> list[TradeOff]:
    """The settings that no other one beats on both axes, from most mobile to safest."""
    found: list[TradeOff] = []
    for point in sorted(points, key=lambda p: (-p.mobility, p.collision_rate)):
        if not found or point.collision_rate < found[-1].collision_rate:
            found.append(point)
    return found
