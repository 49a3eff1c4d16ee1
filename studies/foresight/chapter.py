"""The study of foresight as a chapter: who foresees what, and where ours does not."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from functools import partial
from typing import TYPE_CHECKING, NamedTuple

from studies.foresight.amounts import HORIZONS, Amounts
from studies.foresight.measures import FALSE, RECALL
from studies.foresight.rivals import NEIGHBOURS
from studies.foresight.study import OURS, RIVALS, Foresight, Row
from studies.old import plot
from studies.old.against import ahead
from studies.old.chapter import Chapter, Source
from studies.old.drawing import Sketch
from studies.old.html import Setting
from studies.old.shim import Column, Table, count, decimals, listed, number, percent, seeds_text

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: The one of ours that the others are held against, chosen before anything was run.
MAIN = OURS[0]
_LOOKS: dict[str, plot.Look] = {
    "evofsm-replay": plot.OURS,
    "evofsm-counts": {**plot.OURS, "marker": "v"},
    "evofsm-chain": {**plot.OURS, "marker": "P"},
    "logistic": plot.TOLD,
    "neighbours": plot.OTHER,
    "taylor": plot.FIXED,
}


class _Measure(NamedTuple):
    """A column of the comparison: its name, whether less is better, and how it is written."""

    name: str
    text: str
    less: bool
    show: Callable[[float | None], str]

    def of(self, row: Row) -> float:
        """Of a row; NaN counts as the worst there is."""
        value = float(getattr(row, self.name))
        worst = math.inf if self.less else -math.inf
        return worst if math.isnan(value) else value

    def rank(self, row: Row) -> float:
        """The larger the better."""
        return -self.of(row) if self.less else self.of(row)

    def is_better(self, one: Row, mine: Row) -> bool:
        """Whether one is better at all."""
        return self.rank(one) > self.rank(mine)

    def is_clearly_better(self, one: Row, mine: Row) -> bool:
        """Whether the intervals lie apart as well."""
        ends = ("_high", "_low") if self.less else ("_low", "_high")
        other, own = getattr(one, self.name + ends[0]), getattr(mine, self.name + ends[1])
        return self.is_better(one, mine) and bool(other < own if self.less else other > own)


_MEASURES = (
    _Measure("brier", "Brier score", True, decimals(3)),
    _Measure("ece", "ECE", True, decimals(3)),
    _Measure("f1", "F1", False, decimals(2)),
    _Measure("false_95", f"false alarms at a recall of {percent(RECALL)}", True, percent),
    _Measure("lead", "lead time", False, lambda value: f"{number(value, 2)} s"),
)


def tell(found: Foresight) -> Chapter:
    """Who foresees what, and where ours does not."""
    return Chapter(
        id=found.plan.id,
        title=found.plan.question,
        about=_ABOUT,
        headline=_headline(found),
        answer=tuple(_answer(found)),
        losses=tuple(_losses(found)),
        tables=tuple(_table(found, task) for task in found.tasks),
        sketches=(
            Sketch(
                "foresight-brier",
                "Brier score by horizon",
                "Calibrated probabilities on held-out episodes, as a share of the Brier score of "
                "always saying the share of failures; bars: 95 % over episodes. Lower is better.",
                _headline(found),
                partial(draw, found),
            ),
        ),
        plan=tuple(_plan(found.plan)),
        packages=("scipy", "gymnasium"),
        sources=(
            Source(
                "T. Henzinger et al., Predictive monitoring of black-box dynamical systems, 2024",
                "arXiv:2412.16564",
                "https://arxiv.org/abs/2412.16564",
            ),
        ),
    )


_ABOUT = (
    "Each task is run by a mixture of its controllers, of random actions, of random ones that are "
    "held for a while, and on cartpole and pendulum of feedback that would hold them; a tenth of "
    "all actions is drawn at random, of the last three tenths. All learn the same episodes, with "
    "the actions that were executed, and say how likely it is to fail within 10, 25 and 50 steps "
    "if an action is taken now, whatever is done after it. evofsm-replay replays it, and then "
    "what was done after the likest recorded steps, under the learnt dynamics, with and without "
    "the disturbances that are remembered. evofsm-counts counts failures by state and action; "
    "evofsm-chain raises the machine's matrices to a power. logistic has all products of "
    f"observation, change and action; neighbours is the share of the {NEIGHBOURS} nearest steps "
    "that failed, calibrated by Venn and Abers; taylor extrapolates by backward differences to the "
    "boundaries that ours found in the failures, by first or second order, whichever ranks better "
    "on calibration episodes. All probabilities are calibrated by isotonic regression on episodes "
    "of their own; own: ECE without that. Of ours evofsm-replay was chosen beforehand; where a "
    "rival does better than it, that is printed."
)


# -- Words ----------------------------------------------------------------------------------------


def _question(row: Row) -> tuple[str, int]:
    return row.task, row.steps


def _is_main(row: Row) -> bool:
    return row.method == MAIN


def _rivals(found: Foresight) -> list[Row]:
    """Ours and its rivals, where both failures and others were to be foreseen."""
    return [row for row in found.rows if row.base > 0.0 and (_is_main(row) or row.method in RIVALS)]


def _headline(found: Foresight) -> str:
    brier = _MEASURES[0]
    rows = _rivals(found)
    questions = dict.fromkeys(_question(row) for row in rows)
    lost = ahead(rows, _is_main, _question, brier.is_better, brier.rank)
    clear = ahead(rows, _is_main, _question, brier.is_clearly_better, brier.rank)
    return (
        f"By Brier score {MAIN} is the best in {len(questions) - len(lost)} of {len(questions)} "
        f"cases, a rival in {len(lost)}, clearly so in {len(clear)}."
    )


def _answer(found: Foresight) -> Iterator[str]:
    for measure in _MEASURES:
        rows = _rivals(found)
        best: dict[tuple[str, int], Row] = {}
        for row in rows:
            key = _question(row)
            if key not in best or measure.is_better(row, best[key]):
                best[key] = row  # of equals the first, which is ours
        won = {name: sum(row.method == name for row in best.values()) for name in (MAIN, *RIVALS)}
        text = ", ".join(f"{name} {held}" for name, held in won.items() if held)
        yield f"Best by {measure.text}, of equals ours, in {len(best)} cases: {text}."


def _losses(found: Foresight) -> Iterator[str]:
    """Where a rival does better: what is clear first, then what may be chance."""
    pairs = {
        measure.text: (
            measure,
            ahead(_rivals(found), _is_main, _question, measure.is_better, measure.rank),
        )
        for measure in _MEASURES
    }
    for clear in (True, False):
        for text, (measure, every) in pairs.items():
            some = [pair for pair in every if measure.is_clearly_better(*pair) == clear]
            if some:
                where = listed(
                    f"{one.task} in {one.steps} ({one.method} {_shown(measure, one)}, "
                    f"{MAIN} {_shown(measure, mine)})"
                    for one, mine in some
                )
                how = "clearly better" if clear else "better, intervals overlap"
                yield f"{text[:1].upper()}{text[1:]}: a rival is {how}, on {where}."
    weak = [
        f"{row.task} in {row.steps} ({number(row.brier, 3)}, {number(row.base, 3)})"
        for row in found.rows
        if row.method == "evofsm-chain" and row.brier >= row.base > 0.0
    ]
    if weak:
        yield (
            "The machine's matrices to a power foresee no more than who always says the share of "
            f"failures, by Brier score: {listed(weak)}."
        )


def _shown(measure: _Measure, row: Row) -> str:
    return measure.show(getattr(row, measure.name))


def _plan(plan: Amounts) -> Iterator[Setting]:
    yield Setting("tasks", plan.tasks)
    yield Setting("seed", f"{plan.seed}; {seeds_text(plan.seeds)}, means over them")
    yield Setting(
        "episodes",
        f"{plan.train} to learn from, {plan.calibration} to calibrate on, {plan.test} held out, "
        "the same for every seed",
    )
    yield Setting("judged", f"every {plan.every} steps, back from the end")
    yield Setting("lead time", f"at {percent(FALSE)} false alarms on calibration episodes")
    yield Setting("bootstrap", f"{plan.rounds} rounds over held-out episodes")


# -- Table and figure -----------------------------------------------------------------------------


def _table(found: Foresight, task: str) -> Table:
    rows = [row for row in found.rows if row.task == task]
    one = rows[0]
    shares = ", ".join(
        f"{percent(row.share)} within {row.steps}" for row in rows if row.method == MAIN
    )

    def span(name: str) -> str:
        return f"{name}_low {name}_high"

    def thirds(low: float, high: float) -> str:
        return f"{number(low, 3)}–{number(high, 3)}"

    return Table.of(
        f"{task}: failure within so many steps",
        (
            Column[Row]("method", lambda row: f"{row.steps}, {row.method}"),
            Column("Brier", "brier", decimals(3)),
            Column("95 %", span("brier"), thirds),
            Column("ECE", "ece", decimals(3)),
            Column("own", "ece_own", decimals(3)),
            Column("F1", "f1", decimals(2)),
            Column("false", "false_95", percent),
            Column("lead", "lead", decimals(2)),
        ),
        rows,
        f"{count(one.failed)} of {count(one.episodes)} held-out episodes failed; {shares} of the "
        f"steps. false: false-alarm rate at a recall of {percent(RECALL)}. lead: median, from the "
        "first alarm that stays on to the failure [s].",
        ours=lambda row: row.method in OURS,
    )


def draw(found: Foresight) -> Figure:
    """A panel for each task, with a line for each method and horizon."""
    methods = (*OURS, *RIVALS)
    lines = [f"{steps} steps" for steps in HORIZONS]
    figure, grid = plot.panels(1, len(found.tasks), 3.6, sharey=True)
    for axes, task in zip(grid[0], found.tasks, strict=True):
        axes.set_title(task)
        plot.name_lines(axes, lines, striped=True)
        plot.level(axes, 1.0, across=False)
        for k, method in enumerate(methods):
            rows = [row for row in found.rows if (row.task, row.method) == (task, method)]
            values = [
                [part / row.base for part in (row.brier, row.brier_low, row.brier_high)]
                for row in rows
                if row.base > 0.0
            ]
            places = [
                HORIZONS.index(row.steps) + 0.13 * (k - 0.5 * (len(methods) - 1))
                for row in rows
                if row.base > 0.0
            ]
            if values:
                plot.dots(axes, _LOOKS[method], places, *zip(*values, strict=True))
        axes.set_xlabel("Brier score / base")
        axes.set_xlim(left=0.0)
    plot.legend(figure, _LOOKS, columns=3)
    return figure
