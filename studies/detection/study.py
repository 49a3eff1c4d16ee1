"""Detection: who sees danger, how early, and at how many false alarms.

Every decision of unrevised held-out episodes is a case. Ours has watched other episodes without
acting; thresholds are chosen, and probabilities calibrated, on yet others. Work is split by world
and learning seed over the cores, and put together in the order of the tasks.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import islice, product
from typing import Any, NamedTuple

from evofsm.driving import measures
from studies.detection.amounts import Amounts
from studies.detection.measures import (
    Detector,
    Ours,
    Watcher,
    behind_filter,
    classic,
    fixed,
    own,
    tuned,
)
from studies.detection.rows import Judged, Reliable, Row, Scored, judge
from studies.detection.watch import (
    Exposure,
    Target,
    calibration_draws,
    expose,
    held_out_draws,
    watch,
)
from studies.detection.worlds import World, grid_world, world
from studies.old.frame import Frame, Progress, silent
from studies.old.scores import auroc
from studies.old.shim import in_order
from studies.policies import Group

#: Limits that are told to the safe distance of the grid that is wrong almost everywhere [m/s²].
ASSUMED = (4.0, 6.0)
#: Measures of the grid.
IN_GRID = (Ours.DEFAULT, Ours.PAPER, "rss-r157", "rss-assumed", "rss-matched")


@dataclass(frozen=True)
class Detection:
    """All that the study measured."""

    plan: Amounts
    families: tuple[str, ...]
    rows: list[Row]
    grid: list[Row] = field(default_factory=list)
    reliable: list[Reliable] = field(default_factory=list)

    @property
    def frame(self) -> Frame:
        """Every row, those of the grid last."""
        return Frame([*self.rows, *self.grid])

    def row(self, family: str, measure: str, target: Target) -> Row | None:
        """The row of one measure, if there is one."""
        wanted = family, measure, target
        return next((r for r in self.rows if (r.family, r.measure, r.target) == wanted), None)


def run_detection(
    plan: Amounts, progress: Progress = silent, workers: int | None = None
) -> Detection:
    """Judge every measure in every world; see `Study.run`.

    Raises
    ------
    ValueError
        If a name is none.
    """
    families = plan.families
    own(plan.measure)  # so that a wrong name shows at once
    for name in families:
        world(name, plan)
    longest = sorted(families, key=lambda name: -plan.hours_of(name))
    tasks: list[partial[Any]] = [partial(_judge_world, name, plan) for name in longest]
    tasks += [
        partial(_other_seed, name, plan, seed)
        for name, seed in product(families, range(1, plan.seeds))
    ]
    if plan.with_grid:
        tasks += [
            partial(_judge_cell, decel, leader_decel, plan)
            for decel, leader_decel in product(plan.grid, plan.grid_leader)
        ]
    found = in_order(tasks, workers, progress)
    by_name = dict(zip(longest, found, strict=False))
    judged = [one for name in families for one in by_name[name]]
    areas = [area for result in found if isinstance(result, _Areas) for area in result.areas]
    return Detection(
        plan,
        families,
        [_with_seeds(one.row, areas) for one in judged],
        [row for result in found if isinstance(result, _Cell) for row in result.rows],
        [fit for one in judged for fit in one.reliable],
    )


class _Area(NamedTuple):
    """Area under the ROC curve of another learning seed."""

    family: str
    measure: str
    target: Target
    auroc: float


class _Areas(NamedTuple):
    areas: list[_Area]


class _Cell(NamedTuple):
    rows: list[Row]


def _judge_world(name: str, plan: Amounts) -> list[Judged]:
    here = world(name, plan)
    hours = plan.hours_of(name)
    watcher = Watcher(here.watched).watch(here.training(plan, 0))
    held_out = expose(here.family, held_out_draws(here.family, plan.seed), hours)
    calibration = expose(here.settled, calibration_draws(here.settled, plan.seed), hours)
    training = _first_watched(here, plan)
    detectors = [*watcher.detectors(), *fixed(here.family), *own(plan.measure)]
    if any(watcher.risk.perception.noise):
        detectors += behind_filter(here.family, watcher.risk)

    def scored(detector: Detector) -> tuple[Detector, Scored, Scored]:
        now, before = (Scored(one, detector.score(one)) for one in (held_out, calibration))
        return detector, now, before

    known = [scored(detector) for detector in detectors]
    return [
        judge(name, detector, target, on_held_out, on_calibration, plan.rounds)
        for target in Target
        for detector, on_held_out, on_calibration in [*known, scored(tuned(training, target))]
    ]


def _first_watched(here: World, plan: Amounts) -> Exposure:
    """What baselines are tuned on: the world that is watched first, before any shift."""
    draws = islice(here.training(plan, 0), plan.train)
    return Exposure(here.watched, tuple(watch(family, draw) for family, draw in draws))


def _other_seed(name: str, plan: Amounts, seed: int) -> _Areas:
    """How far what is learnt depends on what happened to be watched."""
    here = world(name, plan)
    watcher = Watcher(here.watched).watch(here.training(plan, seed))
    held_out = expose(here.family, held_out_draws(here.family, plan.seed), plan.seed_hours)
    areas = []
    for detector in watcher.detectors():
        scores = detector.score(held_out)
        for target in Target:
            cases = held_out.cases(target)
            area = auroc(scores[cases.rows], cases.truth)
            areas.append(_Area(name, detector.name, target, area))
    return _Areas(areas)


def _with_seeds(row: Row, areas: Sequence[_Area]) -> Row:
    """With those of the other learning seeds, where there are some."""
    mine = (row.family, row.measure, row.target)
    return replace(row, auroc_seeds=tuple(one.auroc for one in areas if one[:3] == mine))


def _judge_cell(decel: float, leader_decel: float, plan: Amounts) -> _Cell:
    """One world of the grid, by dead ends alone."""
    here = grid_world(decel, leader_decel, plan)
    watcher = Watcher(here.watched).watch(here.training(plan, 0))
    held_out = expose(here.family, held_out_draws(here.family, plan.seed), plan.grid_hours)
    assumed = measures.ResponsibilitySensitiveSafety.matched(*ASSUMED)
    known: list[Detector] = [
        *watcher.detectors(),
        *fixed(here.family),
        classic("rss-assumed", Group.FIXED, assumed),
    ]
    return _Cell(
        [
            judge(
                here.name,
                one,
                Target.DEAD_END,
                Scored(held_out, one.score(held_out)),
                None,
                plan.rounds,
            ).row
            for one in known
            if one.name in IN_GRID
        ]
    )
