"""The tables of the closed-loop study: all policies, and those that stand beside them."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator
from typing import Any

from evofsm.cli import (
    NONE,
    Column,
    Table,
    bare_percent,
    count,
    decimals,
    number,
    part,
    percent,
    percents,
    seeds_text,
    span,
)
from evofsm.driving import measures
from studies.closed_loop.comparison import (
    Line,
    chosen,
    has_third_car,
    ours,
    settings,
    states_alone,
    table_groups,
)
from studies.closed_loop.machine import MACHINE, trained
from studies.closed_loop.over_seeds import (
    OURS,
    AroundShift,
    Spread,
    around_shift,
    cases_over_seeds,
    learning_curve,
    when,
)
from studies.closed_loop.stages import SAFE_RATE
from studies.closed_loop.study import ClosedLoop, told
from studies.policies import Group

# -- All policies ---------------------------------------------------------------------------------

_POLICIES: tuple[Column[Line], ...] = (
    Column("policy", lambda line: f"{line.policy}{_which(line)}"),
    Column(
        "collisions (95\N{NO-BREAK SPACE}%)",
        lambda line: (
            f"{percent(line.collision_rate)} ({percents(line.collision_low, line.collision_high)})"
            f"\n{part(line.collisions, line.episodes)}"
        ),
    ),
    Column(
        "mobility (95\N{NO-BREAK SPACE}%)",
        "mobility mobility_low mobility_high",
        lambda value, low, high: f"{number(value, 3)}\n{span(3)(low, high)}",
    ),
    Column("interventions", "intervention_rate", percent),
    Column("mean change", "mean_change", decimals(2), "m/s²"),
    Column("RMS jerk", "jerk", decimals(2), "m/s³"),
    Column(
        "episodes until safe",
        "until_safe train_episodes",
        lambda k, most: f"not in {most}" if math.isinf(k) else count(k),
    ),
    Column(
        "collisions while learning",
        "train_collisions train_episodes",
        lambda n, most: NONE if math.isnan(n) else f"{count(n)}\nof {most:,}",
    ),
)
_REAR_ENDS: Column[Line] = Column(
    "rear-end collisions",
    "rear_ends episodes",
    lambda n, episodes: f"{count(n)}\nof {episodes:,}",
)


def _which(line: Line) -> str:
    """What a policy was told; of ours, after how many episodes, and over which seeds."""
    if not line.is_ours:
        return f"\n{line.group}"
    of_seeds = "of" if line.which == "worst seed" else "over"
    learnt = f"{line.group}, {line.which} {of_seeds} {line.seeds}"
    return f", {line.train_episodes:,} episodes\n{learnt}\ntold: {line.told}"


def policy_table(study: ClosedLoop) -> Table:
    """All policies: the value, and below it what it was counted in or its interval."""
    lines = [line for _, found in table_groups(study) for line in found]
    columns = (*_POLICIES, _REAR_ENDS) if has_third_car(study) else _POLICIES
    note = _note_on_policies(study)
    return Table.of("All policies", columns, lines, note, ours=lambda line: line.is_ours)


def _note_on_policies(study: ClosedLoop) -> str:
    mine = ours(study)
    held_out = study.rows[0].episodes if study.rows else 0
    seeds = (
        f"Ours is given over {seeds_text(mine.seeds)}: each column's median by itself, and the "
        "seed with most collisions (of those, least mobility). "
        if mine
        else ""
    )
    machine = ours(study, policy=MACHINE)
    if machine:
        seeds += (
            f"{MACHINE} was told nothing but which episodes failed, and drives the first "
            f"{machine.episodes:,} of these episodes over {seeds_text(machine.seeds)}; its states "
            "decide nothing. "
        )
    return (
        f"All policies drive the same {held_out:,} held-out episodes. {seeds}"
        "In brackets 95 % intervals, by Clopper and Pearson for collisions, by bootstrap over "
        "episodes for mobility; over seeds, the medians of their ends. Mobility: distance until "
        "the leader's brake, in those of the unrevised driver. Interventions: share of decisions "
        "that were changed. Change: mean of |executed − proposed| over all decisions. Until safe: "
        f"training episodes after which, learning frozen, at most {percent(SAFE_RATE)} of "
        f"{_checked_on(study, OURS):,} held-out episodes collide"
        + (f" (of {_checked_on(study, MACHINE):,} for {MACHINE})." if machine else ".")
    )


def _checked_on(study: ClosedLoop, policy: str) -> int:
    """Held-out episodes of a test on the way."""
    return next((point.held_out for point in study.curve if point.policy == policy), 0)


def table_of_names(study: ClosedLoop) -> Table:
    """What each baseline is made of; of the tuned ones, what tuning chose."""
    rows = tuple(_made_of(study))
    return Table("What the names stand for", ("policy", "made of"), rows, in_words=True)


def _made_of(study: ClosedLoop) -> Iterator[tuple[str, str]]:
    driven = {row.policy for row in study.rows}
    yield ("unrevised", "the family's controller, left alone")
    yield ("always-brake", "hardest braking at every decision")
    yield ("oracle", "our reviser, told how hard this very leader brakes, and the brakes")
    for name, measure in measures.FIXED_MEASURES.items():
        if name in driven:
            yield (name, _short(repr(measure)))
    limits = f"own {study.family.decel:g}, leader's {study.family.leader_decel:g} m/s²"
    yield ("rss-matched", f"the safe distance, told the true limits: {limits}")
    for policy, points in settings(study).items():
        if policy in driven and policy.endswith("-tuned"):
            made = _short(chosen(points).setting)
            yield (policy, f"{made}, chosen from {len(points)} settings")


def _short(made: str) -> str:
    """How a measure was made, without the digits that floats bring along."""
    return re.sub(r"\d+\.\d+", lambda found: f"{float(found[0]):g}", made)


# -- Beside it ------------------------------------------------------------------------------------


def side_tables(study: ClosedLoop) -> dict[str, Table]:
    """All other tables that apply, by the section in which they stand."""
    tables: dict[str, tuple[Any, Callable[[ClosedLoop], Table | None]]] = {
        "learning": (study.curve, _table_of_learning),
        "machine": (study.curve, _table_of_the_machine),
        "shift": (study.checks, _table_of_checks),
        "calibration": (study.reliabilities, _table_of_calibration),
        "separation": (study.separations, _table_of_separation),
        "states": (study.by_rule, _table_of_rules),
        "cases": (study.cases, _table_of_cases),
        "machine_cases": (study.machine_cases, _table_of_the_machines_cases),
        "worlds": (study.worlds, _table_of_worlds),
    }
    made = {name: make(study) for name, (found, make) in tables.items() if found}
    return {name: table for name, table in made.items() if table is not None}


def _spread(values: Spread, show: Callable[[float], str]) -> str:
    """Median and range."""
    low, middle, high = map(show, values)
    return middle if low == high else f"{middle} ({low}–{high})"


def _table_of_learning(study: ClosedLoop) -> Table:
    return _learning_of(study, OURS, "Learning: held-out tests on the way")


def _table_of_the_machine(study: ClosedLoop) -> Table | None:
    if not learning_curve(study, MACHINE):
        return None
    return _learning_of(study, MACHINE, f"Learning: the same of {MACHINE}")


def _learning_of(study: ClosedLoop, policy: str, title: str) -> Table:
    seeds = len({point.learning_seed for point in study.curve if point.policy == policy})
    return Table.of(
        title,
        (
            Column("episodes", "episodes", count),
            Column("collisions", lambda one: _spread(one.collision_rate, bare_percent), unit="%"),
            Column("mobility", lambda one: _spread(one.mobility, decimals(3))),
            Column("states", lambda one: _spread(one.states, count)),
            Column("collided while learning", lambda one: _spread(one.train_collisions, count)),
        ),
        learning_curve(study, policy),
        f"Median and range over {seeds_text(seeds)}; {_checked_on(study, policy):,} held-out "
        f"episodes each, learning frozen. Told: {told(policy, Group.LEARNT)}.",
    )


_MACHINE_CHECKED: tuple[Column[AroundShift], ...] = (
    Column(f"{MACHINE}, median", lambda one: one.machine and one.machine.median, bare_percent),
    Column(f"{MACHINE}, worst seed", lambda one: one.machine and one.machine.high, bare_percent),
)


def _table_of_checks(study: ClosedLoop) -> Table:
    seeds = len({check.learning_seed for check in study.checks if check.policy == OURS})
    machine = [check for check in study.checks if check.policy == MACHINE]
    also = (
        f" {MACHINE}: {machine[0].held_out:,} held-out episodes each, "
        f"{seeds_text(len({check.learning_seed for check in machine}))}."
        if machine
        else ""
    )
    tried = next(check.held_out for check in study.checks if check.policy == OURS)
    return Table.of(
        "Held-out tests around the shift: collisions [%]",
        (
            Column("tested", "after", when),
            Column("evofsm, median", "ours.median", bare_percent),
            Column("evofsm, worst seed", "ours.high", bare_percent),
            *(_MACHINE_CHECKED if machine else ()),
            Column("rss-unchanged", lambda one: one.theirs and one.theirs.median, bare_percent),
        ),
        around_shift(study),
        f"{tried:,} held-out episodes each, learning frozen, {seeds_text(seeds)}.{also} "
        "rss-unchanged keeps the constants that were right before; it learns "
        "nothing, so one test after the shift stands for all.",
    )


def _table_of_calibration(study: ClosedLoop) -> Table:
    return Table.of(
        "Calibration",
        (
            Column("probability", "what"),
            Column("cases", "cases", count),
            Column("failures", "failures", count),
            Column(
                "base rate", lambda r: r.failures / r.cases if r.cases else None, bare_percent, "%"
            ),
            Column("Brier", "brier", decimals(4)),
            Column("Brier of base rate", "base_brier", decimals(4)),
        ),
        study.reliabilities,
        "Brier: mean squared error of the probability, 0 is perfect. Of the base rate: of one who "
        "always says the share of failures that these cases turned out to have.",
    )


def _table_of_separation(study: ClosedLoop) -> Table:
    first = study.separations[0]
    return Table.of(
        "Telling dead ends from the rest: AUROC",
        (
            Column("measure", "measure"),
            Column("told", "group"),
            Column("AUROC", "auroc", decimals(3)),
            Column("95 %", "low high", span(3)),
        ),
        sorted(study.separations, key=lambda one: -one.auroc if one.auroc >= 0.0 else math.inf),
        f"Truth: the oracle's dead end ({percent(first.dead_end_share)} of decisions in "
        f"{first.episodes:,} unrevised held-out episodes). 0.5 is chance, 1 perfect. Intervals by "
        "bootstrap over episodes.",
        ours=lambda one: one.group == Group.LEARNT,
    )


def _table_of_rules(study: ClosedLoop) -> Table:
    first = study.by_rule[0]
    return Table.of(
        "Risk read through the states alone",
        (
            Column("rule (states)", "policy", _rule),
            Column("seed", "learning_seed"),
            Column(
                "collisions [%] (95 %)",
                "collision_rate collision_low collision_high",
                lambda rate, low, high: f"{bare_percent(rate)} ({percents(low, high)})",
            ),
            Column("mobility", "mobility", decimals(3)),
            Column("interventions", "intervention_rate", bare_percent, "%"),
            Column("collided while learning", "train_collisions", count),
        ),
        study.by_rule,
        f"{first.train_episodes:,} training and {first.episodes:,} held-out episodes each.",
    )


def _rule(policy: str) -> str:
    return policy.removeprefix("states: ")


def why_not_by_state(study: ClosedLoop) -> str:
    """Why the default judges situations where they are, or that these rows do not say so."""
    found = states_alone(study)
    if found is None:
        return ""
    best, n = found.best, len(study.by_rule)
    judged = (
        f"Judged where they are, situations lead to {percent(found.collision_rate)} of collisions "
        f"at mobility {number(found.mobility, 3)} after {found.episodes:,} episodes; read through "
        f"states alone, the best rule, {_rule(best.policy)}, reaches "
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
    return Table.of(
        "The paper's cases, revised",
        (
            Column("run", "name"),
            Column("alone", lambda case: "collides" if case.unrevised_collided else "safe"),
            Column(
                "revised",
                "collided end",
                lambda hit, end: f"{'collides,' if hit else 'safe to'} {end:.1f} s",
            ),
            Column("changed", "changed", bare_percent, "%"),
            Column("from 16.5 s on", "changed_late", bare_percent, "%"),
        ),
        study.cases,
        "Each case was learnt from once, the two later brakes never. Changed: share of decisions "
        "in which the proposal was not executed; in case 3 the driver has turned normal by 16.5 s.",
    )


def _table_of_the_machines_cases(study: ClosedLoop) -> Table:
    return Table.of(
        f"The paper's cases: the same of {MACHINE}",
        (
            Column("run", "name"),
            Column("alone", lambda case: "collides" if case.unrevised_collided else "safe"),
            Column("collides, of seeds", "collided seeds", part),
            Column("changed", lambda case: _spread(case.changed, bare_percent), unit="%"),
            Column(
                "from 16.5 s on", lambda case: _spread(case.changed_late, bare_percent), unit="%"
            ),
        ),
        cases_over_seeds(study),
        f"Learnt from {trained(study.plan)} runs of the four cases in turn, told nothing but which "
        "collided; never from the two later brakes. Median and range over learning seeds.",
    )


def _table_of_worlds(study: ClosedLoop) -> Table:
    return Table.of(
        "The same model in both worlds",
        (
            Column("world", "world"),
            Column("episodes", "episodes", count),
            Column("collisions", "collisions", count),
            Column("mean speed", "mean_speed", decimals(3), "m/s"),
            Column("interventions", "intervention_rate", bare_percent, "%"),
        ),
        study.worlds,
        "Learnt in closed form, then frozen; the same held-out draws in each world.",
    )
