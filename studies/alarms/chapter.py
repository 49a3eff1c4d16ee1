"""The study of alarms as a chapter: which rates are kept, at what price, and which are not."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import TYPE_CHECKING, Any

from studies.alarms.amounts import Amounts, Errors
from studies.alarms.study import ADAPTIVE, DELAY, FIXED, Found, Row
from studies.alarms.windows import LENGTH
from studies.old import plot
from studies.old.asked import Asked, failures, tables_of_asked
from studies.old.chapter import Chapter, Source
from studies.old.drawing import Sketch
from studies.old.html import Setting
from studies.old.shim import Column, Table, count, listed, percent, percents, seeds_text

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_LOOKS: dict[str, plot.Look] = {ADAPTIVE: plot.OURS, FIXED: plot.FIXED}
# Of the other kind of errors, an alarm that makes as many is told among the losses.
_DEAR = 0.5


def tell(found: Found) -> Chapter:
    """Which rates are kept, at what price, and which are not."""
    asked = list(claims(found))
    return Chapter(
        id=found.plan.id,
        title=found.plan.question,
        about=_about(found.plan),
        headline=_headline(found),
        answer=tuple(_answer(found)),
        losses=tuple(_losses(found)),
        fails=failures(asked),
        tables=(*tables_of_asked(asked), *(_table(found, of) for of in found.plan.stated)),
        sketches=(
            Sketch(
                "alarms-held",
                "Stated and realised rates",
                "Dots: realised on held-out episodes; bars: 95 % over episodes; broken lines: the "
                "rate that was stated.",
                _headline(found),
                partial(draw, found),
            ),
        ),
        plan=tuple(_plan(found.plan)),
        packages=("scipy",),
        sources=(
            Source(
                "I. Gibbs, E. Candès, Adaptive conformal inference under distribution shift, 2021",
                "arXiv:2106.00170",
                "https://arxiv.org/abs/2106.00170",
            ),
        ),
    )


def _about(plan: Amounts) -> str:
    return (
        f"Nobody acts. Unrevised episodes are cut into windows of {LENGTH:g} s; the score of a "
        "window is its highest, and it is dangerous if a collision comes in it or within "
        f"{LENGTH:g} s of it. An alarm states either which share of the safe windows it disturbs, "
        "or which share of the dangerous ones it misses. Fixed: a threshold that is chosen once on "
        "calibration draws, by split conformal prediction, which holds as long as nothing changes. "
        "Adaptive: ConformalAlarm, which goes on learning from what came of each window, one "
        "window later. Scores: the latent risk of the situation and failures counted in the "
        "machine's states, both learnt by watching and then frozen, and time to collision. On "
        "shift the brakes weaken. The guarantee speaks of one kind of errors; the other kind is "
        "its price."
    )


# -- Words ----------------------------------------------------------------------------------------


def claims(found: Found) -> Iterator[Asked]:
    """What was asked for, as far as it was driven."""
    for of in found.plan.stated:
        for changed, where in ((False, "as calibrated"), (True, "after the change")):
            rows = found.of(ADAPTIVE, of, changed)
            if rows:
                holds = sum(row.holds for row in rows)
                yield Asked(
                    f"Adaptive, {of}, {where}: the stated rate is in the interval",
                    "in every case",
                    f"in {holds} of {len(rows)}",
                    holds == len(rows),
                )


def _headline(found: Found) -> str:
    held = {}
    for alarm in (ADAPTIVE, FIXED):
        rows = found.of(alarm, changed=True) or found.of(alarm)
        held[alarm] = f"{sum(row.holds for row in rows)} of {len(rows)}"
    where = "After the change the" if found.of(ADAPTIVE, changed=True) else "The"
    return (
        f"{where} stated rate is kept in {held[ADAPTIVE]} cases by the alarm that adapts, and in "
        f"{held[FIXED]} by the one whose threshold is fixed."
    )


def _answer(found: Found) -> Iterator[str]:
    for of, stated in found.plan.stated.items():
        if rows := found.of(ADAPTIVE, of):
            rates = [row.realised for row in rows]
            fixed = [row.realised for row in found.of(FIXED, of)]
            yield (
                f"Of {of} {percent(stated)} were stated; realised are {percent(min(rates))} to "
                f"{percent(max(rates))} adaptive, {percent(min(fixed))} to {percent(max(fixed))} "
                "fixed."
            )


def _losses(found: Found) -> Iterator[str]:
    """What goes against the alarm that adapts, the most important first."""
    fixed = {(row.world, row.score, row.of): row for row in found.of(FIXED)}
    for row in found.of(ADAPTIVE):
        if not row.holds:
            yield (
                f"{_where(row)}: {percent(row.realised)} realised "
                f"({percents(row.low, row.high)}), {percent(row.stated)} stated."
            )
    dear = [
        f"{_where(row)} ({percent(row.other)})"
        for row in found.of(ADAPTIVE)
        if row.other is not None and row.other >= _DEAR
    ]
    if dear:
        yield (
            "A rate that is held says nothing of the other kind of errors. At least half of all "
            f"dangerous windows missed, or of all safe ones disturbed: {listed(dear)}."
        )
    better = [
        f"{_where(row)} ({percent(other.other)}, adaptive {percent(row.other)})"
        for row in found.of(ADAPTIVE)
        if (other := fixed[row.world, row.score, row.of]).holds
        and None not in (row.other, other.other)
        and (other.other or 0.0) < (row.other or 0.0)
    ]
    if better:
        yield f"The fixed threshold keeps its rate at fewer other errors: {listed(better)}."
    loose = [row for row in found.of(ADAPTIVE) if (row.most or 0.0) > 2.0 * row.stated]
    if loose:
        where = listed(f"{_where(row)} ({count(row.windows)} windows)" for row in loose)
        yield f"With few windows the guarantee is worth little, more than twice the rate: {where}."


def _where(row: Row) -> str:
    return f"{row.world}, {row.score}, {row.of}"


def _plan(plan: Amounts) -> Iterator[Setting]:
    yield Setting("families", ", ".join(plan.families))
    yield Setting("seed", f"{plan.seed}; {seeds_text(plan.seeds)}, each with draws of its own")
    yield Setting(
        "episodes",
        f"{plan.train} watched, {plan.calibration} for thresholds, {plan.episodes} held out, after "
        "the change as many again",
    )
    yield Setting(
        "adaptive", f"step {plan.step:g}, {plan.memory} scores, told {DELAY} window later"
    )
    yield Setting("bootstrap", f"{plan.rounds} rounds over episodes")


# -- Tables and figure ----------------------------------------------------------------------------


def _table(found: Found, of: Errors) -> Table:
    fixed = {(row.world, row.score): row for row in found.of(FIXED, of)}

    def beside(what: str) -> Any:
        return lambda row: getattr(fixed[row.world, row.score], what)

    other = "missed" if of == "false alarms" else "false"
    return Table.of(
        f"{of.capitalize()}, {percent(found.plan.stated[of])} stated",
        (
            Column[Row]("world", "world"),
            Column("score", "score"),
            Column("adaptive", "realised", percent),
            Column("95 %", "low high", percents),
            Column("at most", "most", percent),
            Column(other, "other", percent),
            Column("fixed", beside("realised"), percent),
            Column("95 % ", lambda row: percents(*_ends(fixed[row.world, row.score]))),
            Column(f"{other} ", beside("other"), percent),
            Column("windows", "windows", count),
        ),
        found.of(ADAPTIVE, of),
        f"at most: what is guaranteed of the adaptive one, whatever comes. {other}: share of "
        "errors of the other kind, the price. windows: those that the rate is of.",
        failing=lambda row: not row.holds,
    )


def _ends(row: Row) -> tuple[float, float]:
    return row.low, row.high


def draw(found: Found) -> Figure:
    """A panel for each kind of errors, with a line for each world and score."""
    kinds = [of for of in found.plan.stated if found.of(ADAPTIVE, of)]
    lines = [f"{row.world}, {row.score}" for row in found.of(ADAPTIVE, kinds[0])]
    figure, grid = plot.panels(1, len(kinds), 0.9 + 0.26 * len(lines), sharey=True)
    for axes, of in zip(grid[0], kinds, strict=True):
        axes.set_title(of)
        plot.name_lines(axes, lines, striped=True)
        plot.level(axes, 100.0 * found.plan.stated[of], across=False)
        for alarm, off in ((ADAPTIVE, -0.17), (FIXED, 0.17)):
            rows = {f"{row.world}, {row.score}": row for row in found.of(alarm, of)}
            places = [line + off for line, name in enumerate(lines) if name in rows]
            every = [rows[name] for name in lines if name in rows]
            values = [[100.0 * number for number in (r.realised, r.low, r.high)] for r in every]
            plot.dots(axes, _LOOKS[alarm], places, *zip(*values, strict=True))
        axes.set_xlabel("realised [%]")
        axes.set_xlim(left=-0.3)
    plot.legend(figure, _LOOKS)
    return figure
