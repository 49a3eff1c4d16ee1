"""The tables that stand beside that of the closed-loop study."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from itertools import groupby

import numpy as np

from evofsm.report.comparison import ROUNDING, checked_on, seeds_text
from evofsm.report.words import NONE, count, interval, number, percent, percents
from evofsm.studies.closed_loop import ClosedLoop, Group
from evofsm.studies.closed_loop.study import Point
from evofsm.studies.paper import Table

OURS = "evofsm"


def side_tables(study: ClosedLoop) -> dict[str, Table]:
    """All other tables that apply, by the section in which they stand."""
    tables = {
        "learning": (study.curve, _table_of_learning),
        "shift": (study.checks, _table_of_checks),
        "calibration": (study.reliabilities, _table_of_calibration),
        "separation": (study.separations, _table_of_separation),
        "states": (study.by_rule, _table_of_rules),
        "cases": (study.cases, _table_of_cases),
        "worlds": (study.worlds, _table_of_worlds),
    }
    return {name: make(study) for name, (found, make) in tables.items() if found}


def _spread(values: Sequence[float], show: Callable[[float], str]) -> str:
    """Median and range."""
    low, high = show(min(values)), show(max(values))
    middle = show(float(np.median(values)))
    return middle if low == high else f"{middle} ({low}–{high})"


def _bare_percent(share: float) -> str:
    return percent(share, "")


def _table_of_learning(study: ClosedLoop) -> Table:
    rows = []
    ordered = sorted(study.curve, key=lambda point: point.episodes)
    for episodes, found in groupby(ordered, key=lambda point: point.episodes):
        points = list(found)
        rows.append(
            (
                f"{episodes:,}",
                _spread([p.collisions / p.held_out for p in points], _bare_percent),
                _spread([p.mobility for p in points], lambda x: number(x, 3)),
                _spread([float(p.states) for p in points], count),
                _spread([float(p.train_collisions) for p in points], count),
            )
        )
    seeds = len({point.learning_seed for point in study.curve})
    return Table(
        "Learning: held-out tests on the way",
        ("episodes", "collisions [%]", "mobility", "states", "collided while learning"),
        tuple(rows),
        f"Median and range over {seeds_text(seeds)}; {checked_on(study):,} held-out episodes each, "
        "learning frozen.",
    )


def checks_by_time(study: ClosedLoop) -> list[tuple[int, list[float], list[float]]]:
    """Collision rates by episodes after the shift: ours, and of the one that is not told.

    The latter learns nothing: what it does at once after the shift, it does for ever.
    """
    rates: dict[tuple[str, int], list[float]] = {}
    for check in study.checks:
        key = ("" if check.policy == OURS else "other", check.episodes_after)
        rates.setdefault(key, []).append(check.collisions / check.held_out)
    later = [v for (who, k), values in rates.items() if who and k >= 0 for v in values]
    return [
        (k, own, rates.get(("other", k), []) if k < 0 else later)
        for (who, k), own in sorted(rates.items(), key=lambda entry: entry[0][1])
        if not who
    ]


def when(after: int) -> str:
    """A test's place in the stream."""
    if after < 0:
        return "before the shift"
    if after == 0:
        return "right after the shift"
    return f"{after} episode{'' if after == 1 else 's'} after the shift"


def _table_of_checks(study: ClosedLoop) -> Table:
    held_out = study.checks[0].held_out
    seeds = len({check.learning_seed for check in study.checks})
    rows = tuple(
        (
            when(after),
            percent(float(np.median(own)), ""),
            percent(max(own), ""),
            percent(float(np.median(theirs)), "") if theirs else NONE,
        )
        for after, own, theirs in checks_by_time(study)
    )
    return Table(
        "Held-out tests around the shift: collisions [%]",
        ("tested", "evofsm, median", "evofsm, worst seed", "rss-unchanged"),
        rows,
        f"{held_out:,} held-out episodes each, learning frozen, {seeds_text(seeds)}. rss-unchanged "
        "keeps the constants that were right before; it learns nothing, so one test after the "
        "shift stands for all.",
    )


def _table_of_calibration(study: ClosedLoop) -> Table:
    return Table(
        "Calibration",
        ("probability", "cases", "failures", "base rate [%]", "Brier", "Brier of base rate"),
        tuple(
            (
                one.what,
                f"{one.cases:,}",
                f"{one.failures:,}",
                percent(one.failures / one.cases if one.cases else math.nan, ""),
                number(one.brier, 4),
                number(one.base_brier, 4),
            )
            for one in study.reliabilities
        ),
        "Brier: mean squared error of the probability, 0 is perfect. Of the base rate: of one who "
        "always says the share of failures that these cases turned out to have.",
    )


def _table_of_separation(study: ClosedLoop) -> Table:
    ordered = sorted(
        study.separations, key=lambda one: -one.auroc if math.isfinite(one.auroc) else math.inf
    )
    rows = tuple(
        (
            f"▸ {one.measure}" if one.group == Group.LEARNT else one.measure,
            one.group,
            number(one.auroc, 3),
            interval(one.low, one.high, lambda x: number(x, 3)),
        )
        for one in ordered
    )
    first = study.separations[0]
    return Table(
        "Telling dead ends from the rest: AUROC",
        ("measure", "told", "AUROC", "95 %"),
        rows,
        f"Truth: the oracle's dead end ({percent(first.dead_end_share)} of decisions in "
        f"{first.episodes:,} unrevised held-out episodes). 0.5 is chance, 1 perfect. Intervals by "
        "bootstrap over episodes.",
    )


def _table_of_rules(study: ClosedLoop) -> Table:
    rows = tuple(
        (
            row.policy.removeprefix("states: "),
            str(row.learning_seed),
            f"{percent(row.collision_rate, '')} "
            f"({percents(row.collision_low, row.collision_high)})",
            number(row.mobility, 3),
            percent(row.intervention_rate, ""),
            count(row.train_collisions),
        )
        for row in study.by_rule
    )
    first = study.by_rule[0]
    return Table(
        "Risk read through the states alone",
        (
            "rule (states)",
            "seed",
            "collisions [%] (95 %)",
            "mobility",
            "interventions [%]",
            "collided while learning",
        ),
        rows,
        f"{first.train_episodes:,} training and {first.episodes:,} held-out episodes each.",
    )


def points_beside_rules(study: ClosedLoop) -> list[Point]:
    """Of our curve, the last test that had learnt from no more than the rules had."""
    if not study.by_rule:
        return []
    most = max(row.train_episodes for row in study.by_rule)
    points = [point for point in study.curve if point.episodes <= most]
    last = max((point.episodes for point in points), default=0)
    return [point for point in points if point.episodes == last]


def median_point(points: Sequence[Point]) -> tuple[float, float]:
    """Collision rate and mobility, each by itself."""
    return (
        float(np.median([point.collisions / point.held_out for point in points])),
        float(np.median([point.mobility for point in points])),
    )


def why_not_by_state(study: ClosedLoop) -> str:
    """Why the default judges situations where they are, or that these rows do not say so."""
    points = points_beside_rules(study)
    if not points:
        return ""
    rate, mobility = median_point(points)
    rows = study.by_rule
    worse = [
        row
        for row in rows
        if row.collision_rate >= rate - ROUNDING and row.mobility <= mobility + ROUNDING
    ]
    best = min(rows, key=lambda row: (row.collision_rate, -row.mobility))
    judged = (
        f"Judged where they are, situations lead to {percent(rate)} of collisions at mobility "
        f"{number(mobility, 3)} after {points[0].episodes:,} episodes; read through states alone, "
        f"the best rule, {best.policy.removeprefix('states: ')}, reaches "
        f"{percent(best.collision_rate)} at {number(best.mobility, 3)} after "
        f"{best.train_episodes:,}."
    )
    if len(worse) == len(rows):
        return (
            f"{judged} All {len(rows)} rows are no better on either axis: this is why the default "
            "judges situations where they are, and leaves the states to recognition and forecast."
        )
    gain = len(worse)
    return (
        f"{judged} {gain} of {len(rows)} rows are no better on either axis, the others trade one "
        "for the other or win: see where it loses."
    )


def _table_of_cases(study: ClosedLoop) -> Table:
    return Table(
        "The paper's cases, revised",
        ("run", "alone", "revised", "changed [%]", "from 16.5 s on [%]"),
        tuple(
            (
                case.name,
                "collides" if case.unrevised_collided else "safe",
                f"collides, {case.end:.1f} s" if case.collided else f"safe to {case.end:.1f} s",
                percent(case.changed, ""),
                percent(case.changed_late, ""),
            )
            for case in study.cases
        ),
        "Each case was learnt from once, the two later brakes never. Changed: share of decisions "
        "in which the proposal was not executed; in case 3 the driver has turned normal by 16.5 s.",
    )


def _table_of_worlds(study: ClosedLoop) -> Table:
    return Table(
        "The same model in both worlds",
        ("world", "episodes", "collisions", "mean speed [m/s]", "interventions [%]"),
        tuple(
            (
                world.world,
                f"{world.episodes:,}",
                f"{world.collisions:,}",
                number(world.mean_speed, 3),
                percent(world.intervention_rate, ""),
            )
            for world in study.worlds
        ),
        "Learnt in closed form, then frozen; the same held-out draws in each world.",
    )
