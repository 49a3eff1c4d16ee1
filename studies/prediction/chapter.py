"""The prediction study as a chapter: skill over horizon, the table, and what makes the skill."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from studies.old import plot
from studies.old.against import ahead
from studies.old.asked import Asked, failures, tables_of_asked
from studies.old.chapter import Chapter
from studies.old.drawing import Sketch
from studies.old.html import Setting
from studies.old.shim import NONE, Column, Table, decimals, interval, listed, number
from studies.prediction.forecasters import Method, Variant
from studies.prediction.scoring import Row
from studies.prediction.sources import Pace
from studies.prediction.study import Prediction

if TYPE_CHECKING:
    from matplotlib.figure import Figure


#: The horizons that the study is about [s]; shorter ones show where the paper's test is made.
_ASKED = 0.5
_TABLED = (Method.EVOFSM, Method.BLEND, Method.BATCH, Method.PAPER)
_LOOKS: dict[str, plot.Look] = {
    Method.EVOFSM: {**plot.OURS, "linewidth": 1.6, "zorder": 5},
    Method.BLEND: {**plot.TOLD, "marker": "^", "linestyle": (0, (1, 1.2))},
    Method.BATCH: {**plot.FIXED, "linestyle": (0, (4, 1.6))},
    Method.PAPER: {**plot.OTHER, "marker": "D", "linestyle": (0, (5, 1.2, 1, 1.2))},
}
# Skills lower than this are drawn at the panel's edge.
_LOWEST = -1.05
_DECIMALS = 2
# Lower is better; how they are called, and with how many decimals.
_SCORES = (("jsd", "smaller divergence", 3), ("log_score", "better log score", 2))
# Skills of this and less are all alike: nothing is foreseen.
_FAR_BELOW = -99.0


def tell(study: Prediction) -> Chapter:
    """Skill over horizon, and what makes it."""
    asked = list(_what_was_asked(study))
    return Chapter(
        id=study.plan.id,
        title=study.plan.question,
        about=_about(study),
        headline=_headline(study),
        answer=tuple(_answer(study)),
        losses=tuple(_losses(study)),
        fails=failures(asked),
        tables=(*_tables(study), *tables_of_asked(asked)),
        sketches=(
            Sketch(
                "skill-over-horizon",
                "Skill over horizon",
                "Skill in divergence against persistence; bands are 95 % over test episodes. Marks "
                "at the lower edge lie below it. Lines are broken where another machine begins.",
                _headline(study),
                partial(draw_skills, study),
            ),
        ),
        plan=tuple(_plan(study)),
        packages=("scipy", "deeptime"),
    )


# -- Words ----------------------------------------------------------------------------------------


def _about(study: Prediction) -> str:
    real = "; logs are split by run, and every run is held out once" if study.logs else ""
    return (
        "Forecasts of the distribution over states, on episodes that nothing was learnt from"
        f"{real}. Machines learn every training row once and are frozen then; all methods forecast "
        "the same rows. A skill is 1 for a perfect forecast and 0 for one as good as persistence, "
        "the belief that stays as it is. Divergence is Jensen and Shannon's; the log score is that "
        "of the belief that came, and its skill counts what is above the entropy of that belief, "
        "which nobody gets below. evofsm-paper is the paper's machine, whose states are few and "
        "wide: its divergences are small, and so are persistence's in these states, which it is "
        "compared with. `batch` is deeptime's count of transitions between the most probable "
        "states at the lag of the horizon, over all training rows at once; `blend` is persistence "
        "with the best share of the mean belief. Horizons of 0.01 and 0.1 s in simulation are of "
        "machines that observe every 0.01 s, longer ones every 0.25 s. What is forecast are "
        "beliefs in our own states, not accelerations or gaps: how useful a forecast is depends on "
        "how fine the states are, and finer ones are harder to foresee."
    )


def _asked(study: Prediction, method: Method) -> list[Row]:
    """Rows of the horizons that were asked about."""
    return [row for row in study.rows if row.method == method and row.horizon >= _ASKED]


def _headline(study: Prediction) -> str:
    rows = _asked(study, Method.EVOFSM)
    won = [row for row in rows if row.low > 0.0]
    log_won = [row for row in rows if row.log_low > 0.0]
    return (
        f"From 0.5 to 5 s ahead, better than persistence in {len(won)} of {len(rows)} cases by "
        f"divergence and in {len(log_won)} by log score, whole intervals above 0 "
        f"(lowest skill {_skill(min(row.skill_persistence for row in rows))} and "
        f"{_skill(min(row.log_skill_persistence for row in rows))})."
    )


def _what_was_asked(study: Prediction) -> Iterator[Asked]:
    rows = _asked(study, Method.EVOFSM)
    for what, name in (("divergence", "low"), ("log score", "log_low")):
        clear = sum(getattr(row, name) > 0.0 for row in rows)
        yield Asked(
            f"Better than persistence from 0.5 to 5 s ahead, by {what}",
            "whole interval above 0 in every case",
            f"in {clear} of {len(rows)} cases",
            clear == len(rows),
        )


def _answer(study: Prediction) -> Iterator[str]:
    for source in study.sources:
        rows = [row for row in study.of(source, Method.EVOFSM) if row.horizon >= _ASKED]
        skills = [f"{_skill(row.skill_persistence)} at {row.horizon:g} s" for row in rows]
        yield f"Skill in {source.replace('_', ' ')}: {listed(skills)}."
    paper = _asked(study, Method.PAPER)
    lost = [row for row in paper if row.skill_persistence < 0.0]
    yield (
        f"The paper's machine, its matrices raised to a power, does worse than persistence in "
        f"{len(lost)} of {len(paper)} of these cases."
    )


def _losses(study: Prediction) -> Iterator[str]:
    """Where a reference does better, or as well, the most important first."""
    for row in _asked(study, Method.EVOFSM):
        if row.low <= 0.0:
            yield _against(row, "persistence in divergence", row.skill_persistence, row.low)
        if row.log_low <= 0.0:
            yield _against(row, "persistence in log score", row.log_skill_persistence, row.log_low)
    for rival, reference in ((Method.BATCH, "deeptime's batch"), (Method.BLEND, "the blend")):
        rows = [row for method in (Method.EVOFSM, rival) for row in _asked(study, method)]
        for what, text, n in _SCORES:
            for other, mine in ahead(
                rows,
                lambda row: row.method == Method.EVOFSM,
                lambda row: (row.source, row.horizon),
                partial(_smaller, what),
            ):
                theirs, own = (number(getattr(row, what), n) for row in (other, mine))
                yield f"{_where(mine)}: {reference} has the {text}, {theirs} against {own} bit."
    ours = [row for row in study.rows if row.method == Method.EVOFSM]
    short = [row for row in ours if row.horizon < _ASKED and row.skill_persistence < 0.0]
    if short:
        named = [f"{_where(row)} {_skill(row.skill_persistence)}" for row in short]
        yield f"Below 0.5 s persistence is hard to beat; skill is negative in {listed(named)}."
    unsteady = [row for row in ours if row.horizon >= _ASKED and row.worst <= 0.0 < row.low]
    if unsteady:
        named = [f"{_where(row)} {_skill(row.worst)}" for row in unsteady]
        yield f"Negative for the worst learning seed or part of the runs: {listed(named)}."


def _smaller(what: str, one: Row, mine: Row) -> bool:
    return bool(getattr(one, what) < getattr(mine, what))


def _where(row: Row) -> str:
    return f"{row.source.replace('_', ' ')}, {row.horizon:g} s"


def _against(row: Row, rival: str, skill: float, low: float) -> str:
    gain, least = _skill(skill), _skill(low)
    return f"{_where(row)}: no safe gain over {rival}, skill {gain}, 95 % from {least}."


def _skill(value: float) -> str:
    """A skill, with its sign; very low ones without decimals."""
    if not np.isfinite(value):
        return NONE
    if value <= _FAR_BELOW:
        return f"< {_FAR_BELOW:g}"
    return f"{value:+.0f}" if value <= -10.0 else f"{value:+.{_DECIMALS}f}"


def _plan(study: Prediction) -> Iterator[Setting]:
    plan = study.plan
    yield Setting("seed", str(plan.seed))
    yield Setting("learning seeds", f"{plan.seeds}; {plan.fine_seeds} where every 0.01 s is seen")
    yield Setting(
        "episodes of a learning seed",
        f"{plan.train} to learn from, {plan.test} held out; "
        f"{plan.fine_train} and {plan.fine_test} where every 0.01 s is seen",
    )
    for logs in study.logs:
        parts = min(plan.parts, len(logs.files))
        yield Setting(f"runs of {logs.name}", f"{len(logs.files)}, in {parts} parts")
    yield Setting("bootstrap", f"{plan.rounds} rounds over test episodes")


# -- Tables ---------------------------------------------------------------------------------------


def _tables(study: Prediction) -> Iterator[Table]:
    """Skills and scores of every source at every horizon, and what makes the skill."""
    by_key = {(row.source, row.horizon, row.method): row for row in study.rows}
    rows = [row for source in study.sources for row in _by_horizon(study, source, Method.EVOFSM)]
    place = Column[Row]("source, horizon", lambda row: f"{row.source} {row.horizon:g} s")

    def of(
        header: str, method: Method, what: str, show: Callable[..., str] | None = None
    ) -> Column[Row]:
        def value(row: Row) -> float:
            return float(getattr(by_key[row.source, row.horizon, method], what))

        return Column(header, value, show or _skill)

    yield Table.of(
        "Skill against persistence",
        (
            place,
            Column("evofsm", "skill_persistence", _skill),
            Column("95 %", "low high", lambda low, high: interval(low, high, _plain)),
            *(
                of(name, method, "skill_persistence")
                for name, method in zip(("blend", "batch", "paper"), _TABLED[1:], strict=True)
            ),
            Column("log", "log_skill_persistence", _skill),
            of("blend", Method.BLEND, "log_skill_persistence"),
        ),
        rows,
        "By divergence, and in the last two columns by log score: ours and the blend's. The "
        "paper's machine against persistence in its own states. 95 % by bootstrap over test "
        "episodes.",
    )
    compared = ((Method.PERSISTENCE, "persist."), (Method.BATCH, "batch"))
    yield Table.of(
        "Scores [bit]",
        (
            place,
            Column("evofsm", "jsd", decimals(4)),
            *(of(name, method, "jsd", decimals(4)) for method, name in compared),
            Column("log", "log_score", decimals(2)),
            *(of(name, method, "log_score", decimals(2)) for method, name in compared),
            Column("worst", "worst", _skill),
        ),
        rows,
        "Mean divergence, then mean log score, of ours, persistence and batch; the lowest "
        "skill in divergence of a learning seed, or of a part of the runs.",
    )
    for source in dict.fromkeys(row.source for row in study.ablation):
        yield _ablation(study, source)


def _by_horizon(study: Prediction, source: str, method: Method) -> list[Row]:
    """Rows of a method, the shortest horizon first."""
    return sorted(study.of(source, method), key=lambda row: row.horizon)


def _plain(value: float) -> str:
    return number(value, _DECIMALS) if value > -10.0 else f"{max(value, _FAR_BELOW):.0f}"


def _ablation(study: Prediction, source: str) -> Table:
    """What each thing brings."""
    rows = {(row.method, row.horizon): row for row in study.ablation if row.source == source}
    horizons = sorted({horizon for _, horizon in rows if horizon >= _ASKED})

    def of(name: str, horizon: float, what: str) -> Column[Variant]:
        return Column(name, lambda variant: getattr(rows[variant, horizon], what), _skill)

    return Table.of(
        f"What makes the skill: {source.replace('_', ' ')}",
        (
            Column("variant", str),
            *(of(f"{h:g} s", h, "skill_persistence") for h in horizons),
            *(of(f"log {h:g} s", h, "log_skill_persistence") for h in horizons[1:2]),
        ),
        list(Variant),
        "Skill against persistence in the same states, by divergence and by log score; one "
        f"learning seed, or one part of {study.plan.ablation_runs} runs at most. evofsm "
        "has evidence 0.3 and moved 0.003.",
        ours=lambda variant: variant is Variant.ACTIONS,
    )


# -- Figure ---------------------------------------------------------------------------------------


def draw_skills(study: Prediction) -> Figure:
    """Skill over horizon, a panel for each source."""
    columns = 3 if len(study.sources) > 4 else 2
    lines = -(-len(study.sources) // columns)
    figure, grid = plot.panels(lines, columns, 0.75 + 1.85 * lines, sharex=True, sharey=True)
    for place, axes in enumerate(grid.flat):
        axes.set_visible(place < len(study.sources))
        if place + columns >= len(study.sources):
            axes.set_xlabel("horizon [s]")
            axes.tick_params(labelbottom=True)
    for axes, source in zip(grid.flat, study.sources, strict=False):
        axes.set_title(source.replace("_", " "))
        plot.level(axes, 0.0, color=plot.INK, linestyle="-")
        for method in _TABLED:
            for rows in _by_machine(_by_horizon(study, source, method)):
                values = np.array([(r.skill_persistence, r.low, r.high) for r in rows])
                drawn = np.maximum(values, _LOWEST)
                plot.curves(axes, _LOOKS[method], [row.horizon for row in rows], *drawn.T)
    for axes in grid[:, 0]:
        axes.set_ylabel("skill")
    ticks = [0.01, 0.1, 0.5, 1.0, 2.0, 5.0]
    grid[0, 0].set(xscale="log", ylim=(_LOWEST, 1.0))
    grid[0, 0].set_xticks(ticks, [f"{tick:g}" for tick in ticks])
    for axes in grid.flat:
        axes.minorticks_off()
    zero: plot.Look = {"color": plot.INK, "linestyle": "-", "linewidth": 0.8}
    looks = {str(method): {"linestyle": "-", **_LOOKS[method]} for method in _TABLED}
    plot.legend(figure, {"persistence": zero, **looks})
    return figure


def _by_machine(rows: list[Row]) -> Iterator[list[Row]]:
    """Rows apart where a machine that observes every 0.01 s made the short ones."""
    two_paces = rows[0].horizon < min(Pace.LOGS.horizons)
    short = [row for row in rows if two_paces and row.horizon < _ASKED]
    yield from (part for part in (short, rows[len(short) :]) if part)
