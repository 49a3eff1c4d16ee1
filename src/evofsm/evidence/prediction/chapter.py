"""The prediction study as a chapter: skill over horizon, the table, and what makes the skill."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import Any

import numpy as np

from evofsm.app import NONE, Table, interval, listed, number
from evofsm.evidence.prediction.forecasters import Method, Variant
from evofsm.evidence.prediction.scoring import Row
from evofsm.evidence.prediction.sources import Pace
from evofsm.evidence.prediction.study import Prediction
from evofsm.evidence.report.asked import Asked, failures, tables_of_asked
from evofsm.evidence.report.chapter import Chapter
from evofsm.evidence.report.html import Setting
from evofsm.extras import needs

with needs("matplotlib", "plot", "drawing figures"):
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from evofsm.evidence.report.drawing import Sketch
    from evofsm.plot import DEAD_END, FIRST, FOLLOWER, INK, LEADER, WIDTH

#: The horizons that the study is about [s]; shorter ones show where the paper's test is made.
_ASKED = 0.5
_TABLED = (Method.EVOFSM, Method.BLEND, Method.BATCH, Method.PAPER)
_LOOKS: dict[str, dict[str, Any]] = {
    Method.EVOFSM: {"color": FOLLOWER, "marker": "o", "linewidth": 1.6, "zorder": 5},
    Method.BATCH: {"color": DEAD_END, "marker": "s", "linestyle": (0, (4, 1.6))},
    Method.BLEND: {"color": LEADER, "marker": "^", "linestyle": (0, (1, 1.2))},
    Method.PAPER: {"color": FIRST, "marker": "D", "linestyle": (0, (5, 1.2, 1, 1.2))},
}
# Skills lower than this are drawn at the panel's edge.
_LOWEST = -1.05
_DECIMALS = 2
# Skills of this and less are all alike: nothing is foreseen.
_FAR_BELOW = -99.0


def tell(study: Prediction) -> Chapter:
    """What the study found."""
    return Chapter(
        id=study.plan.id,
        title=study.plan.question,
        about=_about(study),
        headline=_headline(study),
        answer=tuple(_answer(study)),
        losses=tuple(_losses(study)),
        fails=failures(asked := list(_what_was_asked(study))),
        tables=(
            _table_of_skills(study),
            _table_of_scores(study),
            *_tables_of_ablation(study),
            *tables_of_asked(asked),
        ),
        sketches=(_sketch_skills(study),),
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
    ours = [row for row in study.rows if row.method == Method.EVOFSM]
    by_key = {(row.source, row.horizon, row.method): row for row in study.rows}
    for row in ours:
        if row.low <= 0.0 and row.horizon >= _ASKED:
            yield _against(row, "persistence in divergence", row.skill_persistence, row.low)
        if row.log_low <= 0.0 and row.horizon >= _ASKED:
            yield _against(row, "persistence in log score", row.log_skill_persistence, row.log_low)
    for rival, reference in ((Method.BATCH, "deeptime's batch"), (Method.BLEND, "the blend")):
        for row in ours:
            other = by_key[row.source, row.horizon, rival]
            if other.jsd < row.jsd and row.horizon >= _ASKED:
                yield (
                    f"{_where(row)}: {reference} has the smaller divergence, {other.jsd:.3f} "
                    f"against {row.jsd:.3f} bit."
                )
            if other.log_score < row.log_score and row.horizon >= _ASKED:
                yield (
                    f"{_where(row)}: {reference} has the better log score, {other.log_score:.2f} "
                    f"against {row.log_score:.2f} bit."
                )
    short = [row for row in ours if row.horizon < _ASKED and row.skill_persistence < 0.0]
    if short:
        named = [f"{_where(row)} {_skill(row.skill_persistence)}" for row in short]
        yield f"Below 0.5 s persistence is hard to beat; skill is negative in {listed(named)}."
    unsteady = [row for row in ours if row.horizon >= _ASKED and row.worst <= 0.0 < row.low]
    if unsteady:
        named = [f"{_where(row)} {_skill(row.worst)}" for row in unsteady]
        yield f"Negative for the worst learning seed or part of the runs: {listed(named)}."


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


def _table_of_skills(study: Prediction) -> Table:
    """Skill of every method at every horizon."""
    rows = []
    for source in study.sources:
        for row in _by_horizon(study, source):
            by_method = {
                one.method: one
                for one in study.rows
                if (one.source, one.horizon) == (source, row.horizon)
            }
            rows.append(
                (
                    f"{source} {row.horizon:g} s",
                    _skill(row.skill_persistence),
                    interval(row.low, row.high, _plain),
                    *(_skill(by_method[other].skill_persistence) for other in _TABLED[1:]),
                    _skill(row.log_skill_persistence),
                    _skill(by_method[Method.BLEND].log_skill_persistence),
                )
            )
    return Table(
        "Skill against persistence",
        ("source, horizon", "evofsm", "95 %", "blend", "batch", "paper", "log", "blend"),
        tuple(rows),
        note=(
            "By divergence, and in the last two columns by log score: ours and the blend's. The "
            "paper's machine against persistence in its own states. 95 % by bootstrap over test "
            "episodes."
        ),
    )


def _by_horizon(study: Prediction, source: str) -> list[Row]:
    """Our rows, the shortest horizon first."""
    return sorted(study.of(source, Method.EVOFSM), key=lambda row: row.horizon)


def _plain(value: float) -> str:
    return number(value, _DECIMALS) if value > -10.0 else f"{max(value, _FAR_BELOW):.0f}"


def _table_of_scores(study: Prediction) -> Table:
    """The scores themselves, ours beside the references."""
    rows = []
    for source in study.sources:
        for row in _by_horizon(study, source):
            still, batch = (
                next(one for one in study.of(source, other) if one.horizon == row.horizon)
                for other in (Method.PERSISTENCE, Method.BATCH)
            )
            rows.append(
                (
                    f"{source} {row.horizon:g} s",
                    number(row.jsd, 4),
                    number(still.jsd, 4),
                    number(batch.jsd, 4),
                    number(row.log_score, 2),
                    number(still.log_score, 2),
                    number(batch.log_score, 2),
                    _skill(row.worst),
                )
            )
    return Table(
        "Scores [bit]",
        (
            *("source, horizon", "evofsm", "persist.", "batch"),
            *("log", "persist.", "batch", "worst"),
        ),
        tuple(rows),
        note=(
            "Mean divergence, then mean log score, of ours, persistence and batch; the lowest "
            "skill in divergence of a learning seed, or of a part of the runs."
        ),
    )


def _tables_of_ablation(study: Prediction) -> Iterator[Table]:
    """What each thing brings, a table for each source."""
    for source in dict.fromkeys(row.source for row in study.ablation):
        rows = [row for row in study.ablation if row.source == source]
        horizons = sorted({row.horizon for row in rows if row.horizon >= _ASKED})
        logs = horizons[1:2]
        skills = {(row.method, row.horizon): row for row in rows}
        yield Table(
            f"What makes the skill: {source.replace('_', ' ')}",
            ("variant", *(f"{h:g} s" for h in horizons), *(f"log {h:g} s" for h in logs)),
            tuple(
                (
                    str(variant),
                    *(_skill(skills[variant, h].skill_persistence) for h in horizons),
                    *(_skill(skills[variant, h].log_skill_persistence) for h in logs),
                )
                for variant in Variant
            ),
            note=(
                "Skill against persistence in the same states, by divergence and by log score; one "
                f"learning seed, or one part of {study.plan.ablation_runs} runs at most. evofsm "
                "has evidence 0.3 and moved 0.003."
            ),
            ours=(list(Variant).index(Variant.ACTIONS),),
        )


# -- Figure ---------------------------------------------------------------------------------------


def _sketch_skills(study: Prediction) -> Sketch:
    return Sketch(
        name="skill-over-horizon",
        title="Skill over horizon",
        caption=(
            "Skill in divergence against persistence; bars are 95 % over test episodes. Marks "
            "at the lower edge lie below it. Lines are broken where another machine begins."
        ),
        alt=_headline(study),
        figure=partial(draw_skills, study),
    )


def draw_skills(study: Prediction) -> Figure:
    """Skill over horizon, a panel for each source."""
    columns = 3 if len(study.sources) > 4 else 2
    lines = -(-len(study.sources) // columns)
    figure = Figure(figsize=(WIDTH, 0.75 + 1.85 * lines), layout="constrained")
    grid: Any = figure.subplots(lines, columns, sharex=True, sharey=True, squeeze=False)
    for axes, source in zip(grid.flat, study.sources, strict=False):
        _draw_panel(axes, study, source)
    for axes in grid.flat[len(study.sources) :]:
        axes.set_visible(False)
    for axes in grid[:, 0]:
        axes.set_ylabel("skill")
    for k, axes in enumerate(grid.flat[: len(study.sources)]):
        if k + columns >= len(study.sources):
            axes.set_xlabel("horizon [s]")
            axes.tick_params(labelbottom=True)
    handles, labels = grid.flat[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=len(labels))
    return figure


def _draw_panel(axes: Axes, study: Prediction, source: str) -> None:
    axes.set_title(source.replace("_", " "))
    axes.axhline(0.0, color=INK, linewidth=0.8, label="persistence")
    for method in _TABLED:
        label: str | None = str(method)
        for rows in _by_machine(study, source, method):
            horizons = [row.horizon for row in rows]
            skills, low, high = (
                np.maximum([getattr(row, name) for row in rows], _LOWEST)
                for name in ("skill_persistence", "low", "high")
            )
            look = _LOOKS[method]
            axes.plot(horizons, skills, markersize=4.0, label=label, clip_on=False, **look)
            axes.vlines(horizons, low, high, color=look["color"], linewidth=1.0)
            label = None
    axes.set_xscale("log")
    axes.set_xticks([0.01, 0.1, 0.5, 1.0, 2.0, 5.0], ["0.01", "0.1", "0.5", "1", "2", "5"])
    axes.minorticks_off()
    axes.set_ylim(_LOWEST, 1.0)


def _by_machine(study: Prediction, source: str, method: Method) -> Iterator[list[Row]]:
    """Rows by horizon; apart where a machine that observes every 0.01 s made the short ones."""
    rows = sorted(study.of(source, method), key=lambda row: row.horizon)
    two_paces = rows[0].horizon < min(Pace.LOGS.horizons)
    short = [row for row in rows if two_paces and row.horizon < _ASKED]
    yield from (part for part in (short, rows[len(short) :]) if part)
