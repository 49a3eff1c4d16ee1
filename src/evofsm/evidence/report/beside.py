"""The tables that stand beside that of the closed-loop study."""

from __future__ import annotations

import math
from collections.abc import Callable

from evofsm.app import NONE, Table, count, interval, number, percent, percents, seeds_text
from evofsm.driving import Group
from evofsm.evidence.closed_loop.comparison import states_alone
from evofsm.evidence.closed_loop.over_seeds import Spread, around_shift, learning_curve
from evofsm.evidence.closed_loop.study import ClosedLoop
from evofsm.evidence.report.comparison import checked_on


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


def _spread(values: Spread, show: Callable[[float], str]) -> str:
    """Median and range."""
    low, middle, high = map(show, values)
    return middle if low == high else f"{middle} ({low}–{high})"


def _bare_percent(share: float) -> str:
    return percent(share, "")


def _table_of_learning(study: ClosedLoop) -> Table:
    rows = tuple(
        (
            f"{stage.episodes:,}",
            _spread(stage.collision_rate, _bare_percent),
            _spread(stage.mobility, lambda x: number(x, 3)),
            _spread(stage.states, count),
            _spread(stage.train_collisions, count),
        )
        for stage in learning_curve(study)
    )
    seeds = len({point.learning_seed for point in study.curve})
    return Table(
        "Learning: held-out tests on the way",
        ("episodes", "collisions [%]", "mobility", "states", "collided while learning"),
        rows,
        f"Median and range over {seeds_text(seeds)}; {checked_on(study):,} held-out episodes each, "
        "learning frozen.",
    )


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
            percent(own.median, ""),
            percent(own.high, ""),
            percent(theirs.median, "") if theirs else NONE,
        )
        for after, own, theirs in around_shift(study)
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
            one.measure,
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
        ours=tuple(place for place, one in enumerate(ordered) if one.group == Group.LEARNT),
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


def why_not_by_state(study: ClosedLoop) -> str:
    """Why the default judges situations where they are, or that these rows do not say so."""
    found = states_alone(study)
    if found is None:
        return ""
    best, n = found.best, len(study.by_rule)
    judged = (
        f"Judged where they are, situations lead to {percent(found.collision_rate)} of collisions "
        f"at mobility {number(found.mobility, 3)} after {found.episodes:,} episodes; read through "
        f"states alone, the best rule, {best.policy.removeprefix('states: ')}, reaches "
        f"{percent(best.collision_rate)} at {number(best.mobility, 3)} after "
        f"{best.train_episodes:,}."
    )
    if found.no_better == n:
        return (
            f"{judged} All {n} rows are no better on either axis: this is why the default "
            "judges situations where they are, and leaves the states to recognition and forecast."
        )
    return (
        f"{judged} {found.no_better} of {n} rows are no better on either axis, the others trade "
        "one for the other or win: see the table."
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
