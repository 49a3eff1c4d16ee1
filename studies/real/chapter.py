"""The chapter on real data: what was found, its tables, and where it loses."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from typing import Any

from studies.old.against import ahead
from studies.old.asked import Asked, failures, tables_of_asked
from studies.old.chapter import Chapter
from studies.old.html import Setting
from studies.old.shim import NONE, Column, Table, count, listed, number, percent, within
from studies.real.cases import HORIZONS, INTERVAL
from studies.real.figures import sketches
from studies.real.measures import LOWEST, MEASURES, OURS, StateShare
from studies.real.moments import ALARM_SHARE, LONGEST_LEAD
from studies.real.study import (
    FEWEST_EVENTS,
    FEWEST_RUNS,
    REFERENCE,
    SHOWN,
    SHOWN_QUESTION,
    WARNED_HORIZON,
    WARNED_OF,
    RealStudy,
    Row,
)
from studies.real.targets import TARGETS, TITLES, Target

_TOO_FEW = "Too few: these rows order by chance, and no comparison among them holds."
_CHANCE = "chance"
# A state is listed if so much time was spent in it [s].
_LEAST_SECONDS, _MOST_STATES = 5.0, 8


def tell(study: RealStudy) -> Chapter:
    """What was found, its tables and figures, and where it loses."""
    asked = list(_what_was_asked(study))
    return Chapter(
        id=study.plan.id,
        title=study.plan.question,
        about=_about(study),
        headline=_headline(study),
        answer=tuple(_answer(study)),
        losses=tuple(losses(study)),
        fails=failures(asked),
        tables=(*_tables(study), *tables_of_asked(asked)),
        sketches=tuple(sketches(study)),
        plan=tuple(_plan(study)),
        packages=("scipy",),
    )


# -- Words ----------------------------------------------------------------------------------------


def _about(study: RealStudy) -> str:
    return (
        f"{len(study.runs)} runs of real car-following, {study.hours:.1f} h, "
        f"{study.episodes} episodes of leader and follower, a decision every {INTERVAL:g} s. "
        f"{_taught(study)}; what came within "
        f"{listed(f'{horizon:g}' for horizon in HORIZONS)} s is the truth. Decisions at 5 m/s or "
        "slower, decisions at which the event is under way already, and those whose outcome the "
        "end of an episode hides are left out. Runs of one day may share cars and drivers, and "
        "pairs of one run do: intervals (95 %) draw whole runs, and are still too narrow for "
        "that. Nobody commanded anything that could be seen, so only watching is possible: full "
        f"braking is never observed, and {-LOWEST:g} m/s² is assumed to be commandable."
    )


def _taught(study: RealStudy) -> str:
    if (by := study.taught_by) is not None:
        return f"All are judged by what {by.runs} runs of another folder ({by.hours:.1f} h) taught"
    return (
        "Each run is judged once, by what was learnt on the runs of the other "
        f"{study.plan.folds - 1} of {study.plan.folds} folds"
    )


def _headline(study: RealStudy) -> str:
    rows = study.comparable
    if not rows:
        return "Too few events in these runs to compare anything."
    mine = [row for row in rows if row.measure == SHOWN]
    clear = [row for row in mine if row.over_ttc_low > 0.0]
    worse = [row for row in mine if row.over_ttc_high < 0.0]
    return (
        f"{SHOWN} ranks moments better than time to collision in {len(clear)} of {len(mine)} "
        f"questions, worse in {len(worse)}; in the others intervals of the difference hold 0."
    )


def _what_was_asked(study: RealStudy) -> Iterable[Asked]:
    mine = [row for row in study.comparable if row.measure == SHOWN]
    if mine:
        clear = sum(row.over_ttc_low > 0.0 for row in mine)
        yield Asked(
            f"{SHOWN} ranks moments better than time to collision",
            "clearly (interval above 0) in every question",
            f"in {clear} of {len(mine)} questions",
            clear == len(mine),
        )


def _answer(study: RealStudy) -> Iterable[str]:
    for row in (row for row in study.comparable if row.measure == SHOWN):
        ttc = study.row(row.target, row.horizon, REFERENCE)
        yield (
            f"{TITLES[row.target].capitalize()} within {row.horizon:g} s ({row.events} events in "
            f"{row.runs_with_events} runs): AUROC {number(row.auroc, 3)} against "
            f"{number(ttc.auroc, 3)} of time to collision (difference {_signed(row.over_ttc)}, "
            f"{_between(row.over_ttc_low, row.over_ttc_high)}), AUPRC {number(row.auprc, 3)} "
            f"against {number(ttc.auprc, 3)}, where chance gives {number(row.prevalence, 4)}."
        )
    if few := [target for target in TARGETS if not study.is_enough(target)]:
        events = [
            f"{max(r.events for r in study.rows if r.target == t.name)} with {t.title}" for t in few
        ]
        yield (
            f"Too few to compare anything (at least {FEWEST_EVENTS} events in {FEWEST_RUNS} runs "
            f"are asked for): {listed(events)}."
        )


def losses(study: RealStudy) -> list[str]:
    """Every comparison that goes against us, merged by who is better."""
    rows = [row for row in study.comparable if row.measure == SHOWN or row.measure not in OURS]
    found: dict[tuple[str, str], list[str]] = {}
    for what in ("auroc", "auprc"):
        for row, mine in ahead(rows, _is_shown, _key, partial(_larger, what)):
            theirs, own = (number(getattr(one, what), 3) for one in (row, mine))
            cases = found.setdefault((row.measure, what), [])
            cases.append(f"{_question(row)} {theirs} against {own}")
    return [
        *(
            f"{measure} has the larger {what.upper()}: {'; '.join(cases)}."
            for (measure, what), cases in sorted(found.items(), key=lambda one: -len(one[1]))
        ),
        *_below_ttc(study),
        *_late(study),
    ]


def _is_shown(row: Row) -> bool:
    return row.measure == SHOWN


def _key(row: Row) -> tuple[str, float]:
    return row.target, row.horizon


def _larger(what: str, one: Row, mine: Row) -> bool:
    return bool(getattr(one, what) > getattr(mine, what))


def _below_ttc(study: RealStudy) -> Iterator[str]:
    """Other readings of ours that rank worse than the reference."""
    for measure in (name for name in OURS if name != SHOWN):
        mine = [row for row in study.comparable if row.measure == measure]
        if below := [row for row in mine if row.over_ttc < 0.0]:
            clear = sum(row.over_ttc_high < 0.0 for row in below)
            worst = min(below, key=lambda row: row.over_ttc)
            yield (
                f"{measure} ranks worse than time to collision in {len(below)} of "
                f"{len(mine)} questions ({clear} clearly), by up to "
                f"{number(-worst.over_ttc, 3)} ({_question(worst)}: {number(worst.auroc, 3)})."
            )


def _late(study: RealStudy) -> Iterator[str]:
    """Who warns of more events than ours does."""
    for target in WARNED_OF:
        better = ahead(
            [one for one in study.warned if one.target == target],
            lambda one: one.measure == SHOWN,
            lambda one: one.target,
            lambda one, mine: one.warned > mine.warned and mine.events >= FEWEST_EVENTS,
        )
        for _, mine in better[:1]:
            yield (
                f"Of {mine.events} events {target}, {SHOWN} warned of {mine.warned}, "
                + listed(f"{one.measure} of {one.warned}" for one, _ in better)
                + f", each on alarm for {percent(ALARM_SHARE)} of quiet time."
            )


def _question(row: Row) -> str:
    return f"{row.target} within {row.horizon:g} s"


def _signed(value: float) -> str:
    return f"{value:+.3f}".replace("-", "−") if math.isfinite(value) else NONE


def _between(low: float, high: float) -> str:
    if not (math.isfinite(low) and math.isfinite(high)):
        return NONE
    return f"{_signed(low)} to {_signed(high)}"


# -- Tables ---------------------------------------------------------------------------------------


def _tables(study: RealStudy) -> Iterator[Table]:
    for target in TARGETS:
        events = {row.horizon: row for row in study.rows if row.target == target.name}
        if max((row.events for row in events.values()), default=0) > 1:
            yield from _areas(study, target)
    warned = {(one.target, one.measure): one for one in study.warned}

    def of(target: str, what: str) -> Callable[[str], Any]:
        return lambda measure: getattr(warned[target, measure], what)

    yield _by_measure(
        f"Warned before the event, each on alarm for {percent(ALARM_SHARE)} of quiet time",
        [
            column
            for target in WARNED_OF
            for column in (
                Column(target, of(target, "share"), "{} of {}".format),
                Column("lead", of(target, "median"), _seconds),
            )
        ],
        f"An event counts as warned of if the alarm is on in the decision before it; the lead is "
        f"the median time for which it had been on, at most {LONGEST_LEAD:g} s. Scores are those "
        f"for {WARNED_HORIZON:g} s. The threshold is set on the judged runs themselves, for all "
        "measures alike.",
    )
    about = {measure.name: measure.about for measure in MEASURES}
    yield _by_measure(
        "What is compared",
        [Column("it is", about.__getitem__)],
        "Only logistic and ours learn anything from the training runs.",
    )
    yield from _states(study)


def _by_measure(
    title: str, columns: Sequence[Column[str]], note: str, more: Sequence[str] = ()
) -> Table:
    """A line for each measure, and ``more``."""
    names = [*(measure.name for measure in MEASURES), *more]
    every = [Column[str]("measure", str), *columns]
    return Table.of(title, every, names, note, ours=lambda name: name in OURS)


def _areas(study: RealStudy, target: Target) -> Iterator[Table]:
    """Both areas of every measure, by horizon."""
    few = "" if study.is_enough(target) else f" {_TOO_FEW}"
    first = [study.row(target.name, horizon, REFERENCE) for horizon in HORIZONS]
    events = listed(f"{row.events} ({row.horizon:g} s)" for row in first)

    def auroc(row: Row) -> str:
        return within(3, 2)(row.auroc, row.low, row.high)

    def auprc(row: Row) -> str:
        return within(3, 2)(row.auprc, row.auprc_low, row.auprc_high)

    def columns(show: Callable[[Row], str]) -> list[Column[str]]:
        def of(horizon: float, measure: str) -> str:
            if measure == _CHANCE:
                return number(study.row(target.name, horizon, REFERENCE).prevalence, 4)
            return show(study.row(target.name, horizon, measure))

        return [Column(f"{horizon:g} s", partial(of, horizon)) for horizon in HORIZONS]

    yield _by_measure(
        f"AUROC: {target.title}, within 1, 2 and 5 s",
        columns(auroc),
        f"Events that could be foretold: {events}, in {first[-1].runs_with_events} runs.{few}",
    )
    yield _by_measure(
        f"AUPRC: {target.title}, within 1, 2 and 5 s",
        columns(auprc),
        f"Chance is the share of decisions after which the event came.{few}",
        [_CHANCE],
    )


def _seconds(value: float) -> str:
    return f"{value:.1f} s" if math.isfinite(value) else NONE


def _states(study: RealStudy) -> Iterator[Table]:
    """The most dangerous states, by names that tell them apart."""
    found = [one for one in study.shares if one.seconds >= _LEAST_SECONDS][:_MOST_STATES]
    taught_by = "the other folder" if study.taught_by else "the runs outside the first fold"
    columns: tuple[Column[tuple[str, StateShare]], ...] = (
        Column("state", lambda one: one[0]),
        Column("seconds", lambda one: round(one[1].seconds), count),
        Column("share", lambda one: one[1].share, percent),
    )
    if found:
        yield Table.of(
            f"The states after which {TITLES[SHOWN_QUESTION.target]} most often came within "
            f"{SHOWN_QUESTION.horizon:g} s",
            columns,
            ((_place(one.center), one) for one in found),
            f"Of evofsm-states, as {taught_by} taught it: states in which {_LEAST_SECONDS:g} s or "
            "more were spent.",
        )


def _place(center: tuple[float, ...]) -> str:
    gap, speed, ahead = center
    return f"{gap:.1f} m, {speed:.1f} m/s behind {ahead:.1f} m/s"


def _plan(study: RealStudy) -> Iterator[Setting]:
    yield Setting("runs", f"{len(study.runs)}, {study.hours:.1f} h")
    yield Setting("checksums held against a list", f"{study.verified} files")
    if (by := study.taught_by) is not None:
        yield Setting("learnt on", f"{by.runs} runs of another folder, {by.hours:.1f} h")
        yield Setting("seed", f"{study.plan.seed}")
    else:
        yield Setting("folds", f"{study.plan.folds}, by run, seed {study.plan.seed}")
    yield Setting("bootstrap", f"{study.plan.rounds} draws of whole runs")
    yield Setting("decisions", f"every {INTERVAL:g} s")
    for name, (fewest, most) in study.states.items():
        counts = f"{fewest} to {most} by fold" if study.taught_by is None else f"{fewest}"
        yield Setting(f"states of {name}", counts)
