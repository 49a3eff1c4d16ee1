"""The study as a chapter: how likely failures are, which were found, and where it loses."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

from evofsm.cli import NONE, Column, Table, bare_percent, count, listed, number
from evofsm.fsm.proportions import outward, two_digits
from studies.breaks.amounts import NOBODY, TOY
from studies.breaks.cases import FoundCase, odds
from studies.breaks.figures import sketches
from studies.breaks.study import SEEN, Breaks, Row
from studies.breaks.targets import claims
from studies.old.asked import failures, tables_of_asked
from studies.old.chapter import Chapter, Section, Source
from studies.old.html import Setting


def tell(found: Breaks) -> Chapter:
    """How likely failures are, which were found, and where it loses."""
    asked = list(claims(found))
    return Chapter(
        id=found.plan.id,
        title=found.plan.question,
        about=_ABOUT,
        headline=_headline(found),
        answer=tuple(map(_sentence, found.rows)),
        losses=tuple(_losses(found)),
        fails=failures(asked),
        tables=(*tables_of_asked(asked), _table(found)),
        sketches=tuple(sketches(found)),
        plan=tuple(_plan(found)),
        packages=("scipy",),
        sections=tuple(_sections(found)),
        sources=_SOURCES,
    )


_ABOUT = (
    "A family draws its scenarios by chance. Adaptive multilevel splitting keeps many of them side "
    "by side, gives up those that came least close to a collision for moved copies of the others, "
    "and multiplies the shares that it kept: the probability of a collision. Its interval is that "
    "of the mean over independent runs (Student's t, 95 %). Plain samples are ordinary draws of "
    "the same family, with an exact interval (Clopper and Pearson). How close: by the braking that "
    "was needed at the worst moment. Guards are frozen; all is driven in closed form. Sensor noise "
    "is drawn anew as a whole and cannot be searched bit by bit. What is found is written as "
    "found-FAMILY-JUDGE.py, a family that evofsm drive and campaign take."
)
_SOURCES = (
    Source(
        "Cérou and Guyader 2007, Adaptive multilevel splitting for rare event analysis",
        "doi:10.1080/07362990601139628",
        "https://doi.org/10.1080/07362990601139628",
    ),
    Source(
        "Au and Beck 2001, Estimation of small failure probabilities by subset simulation",
        "doi:10.1016/S0266-8920(01)00019-4",
        "https://doi.org/10.1016/S0266-8920(01)00019-4",
    ),
)


# -- Words ----------------------------------------------------------------------------------------


def small(value: float, rounded: Callable[[float], int] = round) -> str:
    """A probability, which may be small; a bound is rounded outward."""
    if not math.isfinite(value):
        return NONE
    if 0.0 < value < 0.01:
        return f"{two_digits(value, rounded):.2g}"
    return number(outward(rounded, value, 4), 4 if value else 0)


def _between(low: float, high: float) -> str:
    return f"{small(low, math.floor)}–{small(high, math.ceil)}"


def _headline(found: Breaks) -> str:
    cars = [row for row in found.rows if row.family != TOY]
    broken = [f"{row.name} ({small(row.probability)})" for row in cars if row.found]
    whole = [row.name for row in cars if not row.found and not row.plain_failed]
    told = []
    if broken:
        told.append(f"Failures were found, with their probability: {'; '.join(broken)}.")
    if whole:
        told.append(f"None was found: {'; '.join(whole)}.")
    return " ".join(told) or "; ".join(map(_sentence, found.rows))


def _sentence(row: Row) -> str:
    """What came of a row, and what that does not say."""
    if row.probability > 0.0:
        text = (
            f"{row.name}: {small(row.probability)} ({_between(row.low, row.high)}) from "
            f"{count(row.tried)} cases."
        )
        zeros = sum(value == 0.0 for value in row.runs)
        if zeros:
            text += f" {zeros} of {len(row.runs)} runs found no failure and count as 0."
        return text
    text = (
        f"{row.name}: no failure in {count(row.tried)} cases of splitting, which went down to a "
        f"probability of {small(row.reached)}"
    )
    if row.judge != NOBODY or row.family != TOY:
        text += f"; at worst {number(row.worst, 2)} m/s² of braking were needed"
    seen = (
        f"{count(row.plain_failed)} of {count(row.plain)} plain samples failed" if row.plain else ""
    )
    bound = f" (at most {small(row.plain_high, math.ceil)}, 95 %)" if row.plain else ""
    return (
        f"{text}. {seen}{bound}{'. ' if seen else ''}This is no proof: failures to which no "
        "close case leads would be missed."
    )


def _losses(found: Breaks) -> Iterator[str]:
    """What goes against the guard, and against the search."""
    for row in found.rows:
        if row.judge != NOBODY and row.found:
            yield (
                f"{row.name}: the guard fails, {count(row.found)} different cases were found "
                f"(probability {small(row.probability)})."
            )
    for row in found.rows:
        if row.judge != NOBODY and row.plain_failed and not row.found:
            yield (
                f"{row.name}: {count(row.plain_failed)} of {count(row.plain)} plain samples "
                "failed, and splitting found none."
            )
        if row.agrees is False:
            yield (
                f"{row.name}: splitting says {small(row.probability)}, plain sampling "
                f"{small(row.plain_probability)}: they differ by more than chance."
            )
        zeros = sum(value == 0.0 for value in row.runs)
        if 0 < zeros < len(row.runs):
            yield f"{row.name}: {zeros} of {len(row.runs)} runs found nothing where others did."
        if row.probability and row.high > 3.0 * row.probability:
            yield f"{row.name}: the interval is wide; more runs or cases would narrow it."


# -- Tables ---------------------------------------------------------------------------------------


def _agreement(row: Row) -> str:
    if row.agrees is not None:
        return "yes" if row.agrees else "no"
    if not row.plain:
        return NONE
    return "both saw none" if not row.probability and not row.plain_failed else "too few seen"


_COLUMNS: tuple[Column[Row], ...] = (
    Column("family, judge", "name"),
    Column("splitting", "probability", small),
    Column("95 %", "low high", _between),
    Column("cases", "tried", count),
    Column("moves kept [%]", "accepted", bare_percent),
    Column("worst", "worst", lambda value: number(value, 2)),
    Column("down to", "reached", small),
    Column("found", "found", count),
    Column("plain", lambda row: f"{count(row.plain_failed)} of {count(row.plain)}"),
    Column("plain 95 %", "plain_low plain_high", _between),
    Column("known", "known", small),
    Column("agree", _agreement),
)


def _table(found: Breaks) -> Table:
    return Table.of(
        "How likely a failure is",
        _COLUMNS,
        found.rows,
        "Cases: played by all runs of splitting. Worst: how close came what did not fail, in m/s² "
        "of braking needed (of the toy: in standard deviations). Down to: probability of the last "
        "level. Found: different cases that failed. Plain: failures of plain samples. Agree: "
        f"whether both differ by no more than chance (99 %), where plain sampling saw {SEEN} "
        "failures or more.",
        ours=lambda row: row.judge != NOBODY,
        failing=lambda row: row.agrees is False or row.hits is False,
    )


def _sections(found: Breaks) -> Iterator[Section]:
    """A table for each row in which something failed."""
    columns: tuple[Column[FoundCase], ...] = (
        Column("numbers", lambda one: "; ".join(number.text for number in one.numbers)),
        Column("as far from ordinary", lambda one: f"{odds(one.as_far)} draws"),
    )
    tables = [
        Table.of(row.name, columns, cases, in_words=True)
        for row, cases in zip(found.rows, found.cases, strict=True)
        if cases and row.family != TOY
    ]
    if tables:
        yield Section(
            "found",
            "Cases that were found",
            "Of each row the most likely ones first. A number stands where the family's file has "
            "it; the last column says how many ordinary draws lie as far from the middle of all.",
            tuple(tables),
        )


def _plan(found: Breaks) -> Iterator[Setting]:
    plan = found.plan
    yield Setting("seed", str(plan.seed))
    yield Setting("families", listed(plan.families))
    yield Setting("judges", listed(plan.judges))
    if plan.switches:
        yield Setting("switches", listed(plan.switches))
    learnt = plan.learnt or f"{plan.train} episodes of the family, then frozen"
    yield Setting("guards learnt from", learnt)
    yield Setting("splitting", f"{plan.runs} runs of {plan.cases} cases, {plan.moves} moves each")
    yield Setting("given up below", small(plan.least))
    yield Setting("plain samples", f"{count(plan.plain)}; under a guard {count(plan.guarded)}")
