"""The chapter on real data: tables, figures, and where it loses."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evofsm.app import NONE, Table, count, interval, listed, number, percent
from evofsm.driving import name_states
from evofsm.evidence.real.cases import HORIZONS, INTERVAL
from evofsm.evidence.real.measures import LOWEST, MEASURES, Group, StateShare
from evofsm.evidence.real.moments import ALARM_SHARE, LONGEST_LEAD, Kind, Moment, Warned
from evofsm.evidence.real.study import (
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
from evofsm.evidence.real.targets import TARGETS, Target
from evofsm.evidence.report.html import Setting
from evofsm.extras import needs

with needs("matplotlib", "plot", "drawing figures"):
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

    from evofsm.evidence.report.asked import Asked, failures, tables_of_asked
    from evofsm.evidence.report.chapter import Chapter
    from evofsm.evidence.report.drawing import Sketch
    from evofsm.plot import DEAD_END, FIRST, FOLLOWER, INK, LEADER, LEADER_DASHES, SOFT, WIDTH

_OURS = tuple(measure.name for measure in MEASURES if measure.group is Group.OURS)
_LOOKS: dict[str, dict[str, Any]] = {
    Group.FIXED: {"color": DEAD_END, "marker": "s", "markersize": 3.5},
    Group.NOW: {"color": SOFT, "marker": "X", "markersize": 4.5},
    Group.LEARNT: {"color": FIRST, "marker": "D", "markersize": 3.5},
    Group.OURS: {"color": FOLLOWER, "marker": "o", "markersize": 4.5},
}
_TOO_FEW = "Too few: these rows order by chance, and no comparison among them holds."
# Where the axis of areas begins: below chance, which is 0.5.
_LEAST_AREA = 0.3
# A state is listed if so much time was spent in it [s].
_LEAST_SECONDS, _MOST_STATES = 5.0, 8
_GROUPS = {measure.name: measure.group for measure in MEASURES}
_TARGETS = {target.name: target for target in TARGETS}


def tell(study: RealStudy) -> Chapter:
    """What the study found."""
    sketches = [_sketch_areas(study)] if _comparable(study) else []
    if study.moments:
        sketches.append(_sketch_moments(study))
    return Chapter(
        id=study.plan.id,
        title=study.plan.question,
        about=_about(study),
        headline=_headline(study),
        answer=tuple(_answer(study)),
        losses=tuple(losses(study)),
        fails=failures(asked := list(_what_was_asked(study))),
        tables=(*_tables(study), *tables_of_asked(asked)),
        sketches=tuple(sketches),
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
    rows = _comparable(study)
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
    mine = [row for row in _comparable(study) if row.measure == SHOWN]
    if mine:
        clear = sum(row.over_ttc_low > 0.0 for row in mine)
        yield Asked(
            f"{SHOWN} ranks moments better than time to collision",
            "clearly (interval above 0) in every question",
            f"in {clear} of {len(mine)} questions",
            clear == len(mine),
        )


def _answer(study: RealStudy) -> Iterable[str]:
    for row in (row for row in _comparable(study) if row.measure == SHOWN):
        ttc = _row(study, row, REFERENCE)
        yield (
            f"{_target(row).title.capitalize()} within {row.horizon:g} s ({row.events} events in "
            f"{row.runs_with_events} runs): AUROC {number(row.auroc, 3)} against "
            f"{number(ttc.auroc, 3)} of time to collision (difference {_signed(row.over_ttc)}, "
            f"{_between(row.over_ttc_low, row.over_ttc_high)}), AUPRC {number(row.auprc, 3)} "
            f"against {number(ttc.auprc, 3)}, where chance gives {number(row.prevalence, 4)}."
        )
    if few := [target for target in TARGETS if not _enough(study, target)]:
        events = [f"{max(r.events for r in _of(study, t))} with {t.title}" for t in few]
        yield (
            f"Too few to compare anything (at least {FEWEST_EVENTS} events in {FEWEST_RUNS} runs "
            f"are asked for): {listed(events)}."
        )


def losses(study: RealStudy) -> list[str]:
    """Every comparison that goes against us, merged by who is better.

    Parameters
    ----------
    study : RealStudy
    """
    found = []
    rows = _comparable(study)
    for measure in (measure for measure in MEASURES if measure.group is not Group.OURS):
        for what in ("auroc", "auprc"):
            better = [
                (row, mine)
                for row in rows
                if row.measure == measure.name
                for mine in [_row(study, row, SHOWN)]
                if getattr(row, what) > getattr(mine, what)
            ]
            if better:
                cases = "; ".join(
                    f"{_question(row)} {number(getattr(row, what), 3)} against "
                    f"{number(getattr(mine, what), 3)}"
                    for row, mine in better
                )
                found.append(
                    (len(better), f"{measure.name} has the larger {what.upper()}: {cases}.")
                )
    sentences = [text for _, text in sorted(found, key=lambda one: -one[0])]
    for name in (name for name in _OURS if name != SHOWN):
        below = [row for row in rows if row.measure == name and row.over_ttc < 0.0]
        if below:
            clear = sum(row.over_ttc_high < 0.0 for row in below)
            worst = min(below, key=lambda row: row.over_ttc)
            sentences.append(
                f"{name} ranks worse than time to collision in {len(below)} of "
                f"{len(rows) // len(MEASURES)} questions ({clear} clearly), by up to "
                f"{number(-worst.over_ttc, 3)} ({_question(worst)}: {number(worst.auroc, 3)})."
            )
    sentences += _late(study)
    return sentences


def _late(study: RealStudy) -> Iterable[str]:
    """Who warns of more events than ours does."""
    for target in WARNED_OF:
        found = {one.measure: one for one in study.warned if one.target == target}
        mine = found[SHOWN]
        better = [one for one in found.values() if one.warned > mine.warned]
        if better and mine.events >= FEWEST_EVENTS:
            yield (
                f"Of {mine.events} events {target}, {SHOWN} warned of {mine.warned}, "
                + listed(f"{one.measure} of {one.warned}" for one in better)
                + f", each on alarm for {percent(ALARM_SHARE)} of quiet time."
            )


def _target(row: Row) -> Target:
    return _TARGETS[row.target]


def _question(row: Row) -> str:
    return f"{row.target} within {row.horizon:g} s"


def _signed(value: float) -> str:
    return f"{value:+.3f}".replace("-", "−") if math.isfinite(value) else NONE


def _between(low: float, high: float) -> str:
    if not (math.isfinite(low) and math.isfinite(high)):
        return NONE
    return f"{_signed(low)} to {_signed(high)}"


def _of(study: RealStudy, target: Target) -> list[Row]:
    return [row for row in study.rows if row.target == target.name]


def _enough(study: RealStudy, target: Target) -> bool:
    return any(row.enough for row in _of(study, target))


def _comparable(study: RealStudy) -> list[Row]:
    return [row for row in study.rows if row.enough]


def _row(study: RealStudy, like: Row, measure: str) -> Row:
    return next(r for r in study.of(like.target, like.horizon) if r.measure == measure)


# -- Tables ---------------------------------------------------------------------------------------


def _tables(study: RealStudy) -> Iterable[Table]:
    ours = tuple(place for place, measure in enumerate(MEASURES) if measure.name in _OURS)
    for target in TARGETS:
        if max((row.events for row in _of(study, target)), default=0) > 1:
            yield _table_areas(study, target, ours)
            yield _table_precision(study, target, ours)
    yield _table_warned(study, ours)
    yield Table(
        "What is compared",
        ("measure", "it is"),
        tuple((one.name, one.about) for one in MEASURES),
        "Only logistic and ours learn anything from the training runs.",
        ours,
    )
    named = [one for one in study.shares if one.seconds >= _LEAST_SECONDS][:_MOST_STATES]
    if named:
        first = "the runs outside the first fold"
        yield _table_states(named, "the other folder" if study.taught_by else first)


def _table_areas(study: RealStudy, target: Target, ours: tuple[int, ...]) -> Table:
    rows = _of(study, target)
    first = [row for row in rows if row.measure == REFERENCE]
    events = listed(f"{row.events} ({row.horizon:g} s)" for row in first)
    note = f"Events that could be foretold: {events}, in {first[-1].runs_with_events} runs."
    return Table(
        f"AUROC: {target.title}, within 1, 2 and 5 s",
        ("measure", *(f"{horizon:g} s" for horizon in HORIZONS)),
        tuple((one.name, *(_area(row) for row in _by(rows, one.name))) for one in MEASURES),
        note if _enough(study, target) else f"{note} {_TOO_FEW}",
        ours,
    )


def _table_precision(study: RealStudy, target: Target, ours: tuple[int, ...]) -> Table:
    rows = _of(study, target)
    note = "Chance is the share of decisions after which the event came."
    return Table(
        f"AUPRC: {target.title}, within 1, 2 and 5 s",
        ("measure", *(f"{horizon:g} s" for horizon in HORIZONS)),
        (
            *((one.name, *(_precision(row) for row in _by(rows, one.name))) for one in MEASURES),
            ("chance", *(number(row.prevalence, 4) for row in _by(rows, REFERENCE))),
        ),
        note if _enough(study, target) else f"{note} {_TOO_FEW}",
        ours,
    )


def _by(rows: Iterable[Row], measure: str) -> list[Row]:
    return [row for row in rows if row.measure == measure]


def _area(row: Row) -> str:
    return f"{number(row.auroc, 3)} ({interval(row.low, row.high, _two)})"


def _precision(row: Row) -> str:
    return f"{number(row.auprc, 3)} ({interval(row.auprc_low, row.auprc_high, _two)})"


def _two(value: float) -> str:
    return number(value, 2)


def _table_warned(study: RealStudy, ours: tuple[int, ...]) -> Table:
    by = {(one.target, one.measure): one for one in study.warned}

    def cells(one: Warned) -> tuple[str, str]:
        lead = f"{one.median:.1f} s" if math.isfinite(one.median) else NONE
        return f"{one.warned} of {one.events}", lead

    return Table(
        f"Warned before the event, each on alarm for {percent(ALARM_SHARE)} of quiet time",
        ("measure", *(text for target in WARNED_OF for text in (target, "lead"))),
        tuple(
            (m.name, *(text for target in WARNED_OF for text in cells(by[target, m.name])))
            for m in MEASURES
        ),
        f"An event counts as warned of if the alarm is on in the decision before it; the lead is "
        f"the median time for which it had been on, at most {LONGEST_LEAD:g} s. Scores are those "
        f"for {WARNED_HORIZON:g} s. The threshold is set on the judged runs themselves, for all "
        "measures alike.",
        ours,
    )


def _table_states(states: Sequence[StateShare], taught_by: str) -> Table:
    names = name_states([one.center for one in states])
    return Table(
        f"The states after which {_TARGETS[SHOWN_QUESTION.target].title} most often came within "
        f"{SHOWN_QUESTION.horizon:g} s",
        ("state", "seconds", "share"),
        tuple(
            (name, count(round(one.seconds)), percent(one.share))
            for name, one in zip(names, states, strict=True)
        ),
        f"Of evofsm-states, as {taught_by} taught it: states in which {_LEAST_SECONDS:g} s or "
        "more were spent.",
    )


def _plan(study: RealStudy) -> Iterable[Setting]:
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


# -- Figures --------------------------------------------------------------------------------------


def _sketch_areas(study: RealStudy) -> Sketch:
    return Sketch(
        "real-areas",
        "How well each measure ranks the moments before an event",
        "Area under the ROC curve with its 95 % interval (whole runs drawn), for every event that "
        "is frequent enough. Filled circles are ours. 0.5 is chance.",
        "A grid of panels, events by horizons, with a dot and an interval for each measure.",
        partial(draw_areas, study),
    )


def draw_areas(study: RealStudy) -> Figure:
    """AUROC of every measure, a panel for each question that can be answered."""
    targets = [target for target in TARGETS if _enough(study, target)]
    figure = Figure(figsize=(WIDTH, 0.75 + 2.55 * len(targets)))
    height = figure.get_figheight()
    grid = figure.subplots(
        len(targets),
        len(HORIZONS),
        sharex=True,
        sharey=True,
        squeeze=False,
        gridspec_kw={
            "left": 0.175,
            "right": 0.985,
            "top": 1.0 - 0.55 / height,
            "bottom": 0.45 / height,
            "wspace": 0.08,
            "hspace": 0.18,
        },
    )
    for line, target in zip(grid, targets, strict=True):
        for axes, horizon in zip(line, HORIZONS, strict=True):
            rows = study.of(target.name, horizon)
            _draw_areas_of(axes, rows)
            axes.set_title(
                f"{target.name} within {horizon:g} s ({rows[0].events} events)", fontsize=7.6
            )
    for axes in grid[-1]:
        axes.set_xlabel("AUROC")
    handles = [
        Line2D([], [], linestyle="none", label=str(group), **look) for group, look in _LOOKS.items()
    ]
    figure.legend(handles=handles, loc="upper center", ncols=4, handletextpad=0.3)
    return figure


def _draw_areas_of(axes: Axes, rows: Sequence[Row]) -> None:
    for place, row in enumerate(rows):
        look = _LOOKS[_GROUPS[row.measure]]
        axes.plot([row.low, row.high], [place, place], color=look["color"], linewidth=1.3)
        axes.plot([row.auroc], [place], linestyle="none", clip_on=False, zorder=4, **look)
    reference = next(row.auroc for row in rows if row.measure == REFERENCE)
    axes.axvline(reference, color=SOFT, linewidth=0.8, linestyle=(0, (1, 1.5)), zorder=1)
    axes.set_xlim(_LEAST_AREA, 1.0)
    axes.set_yticks(range(len(rows)), [row.measure for row in rows])
    axes.set_ylim(len(rows) - 0.5, -0.5)
    axes.grid(axis="y", visible=False)


def _sketch_moments(study: RealStudy) -> Sketch:
    event = _TARGETS[SHOWN_QUESTION.target].title
    return Sketch(
        "real-moments",
        "The five most telling moments",
        f"Chosen by a rule: of all events ({event}), those of which {SHOWN} warned earlier than "
        "time to collision by most, one of each run; the one of which it warned later by most, or "
        "that both missed; and its longest alarm after which nothing came. Risk is drawn from "
        f"each measure's own alarm threshold, that is on for {percent(ALARM_SHARE)} of quiet "
        "time: above 0 is alarm. At 0 s the event begins. Time to collision has no value while "
        "the gap does not close; it is drawn at the bottom there.",
        "Columns of three panels each: the gap, both speeds, and the risk of both measures over "
        "the 10 seconds before a moment.",
        partial(draw_moments, study.moments),
    )


def draw_moments(moments: Sequence[Moment]) -> Figure:
    """Gap, speeds and risk around each moment, a column for each."""
    figure = Figure(figsize=(WIDTH, 5.0))
    grid = figure.subplots(
        3,
        len(moments),
        sharex=True,
        squeeze=False,
        gridspec_kw={
            "left": 0.085,
            "right": 0.99,
            "top": 0.85,
            "bottom": 0.085,
            "wspace": 0.27,
            "hspace": 0.12,
        },
    )
    for column, (axes, moment) in enumerate(zip(grid.T, moments, strict=True)):
        _draw_moment(axes, moment)
        axes[0].set_title(_title(moment), fontsize=6.8)
        axes[2].set_xlabel("time [s]")
        if column == 0:
            for one, label in zip(axes, ("gap [m]", "speed [m/s]", "risk"), strict=True):
                one.set_ylabel(label)
        else:
            axes[2].tick_params(labelleft=False)
    figure.legend(
        handles=[
            Line2D([], [], color=INK, label="gap"),
            Line2D([], [], color=FOLLOWER, label="follower"),
            Line2D([], [], color=LEADER, linestyle=LEADER_DASHES, label="leader"),
            Line2D([], [], color=FOLLOWER, linewidth=2.0, label=SHOWN),
            Line2D([], [], color=DEAD_END, linestyle=(0, (3, 1)), label="1 / time to collision"),
        ],
        loc="upper center",
        ncols=5,
        handletextpad=0.4,
        columnspacing=1.2,
    )
    return figure


def _draw_moment(axes: Sequence[Axes], moment: Moment) -> None:
    gap, follower, leader = moment.observations.T
    axes[0].plot(moment.times, gap, color=INK)
    axes[0].set_ylim(bottom=0.0)
    axes[1].plot(moment.times, follower, color=FOLLOWER)
    axes[1].plot(moment.times, leader, color=LEADER, linestyle=LEADER_DASHES)
    looks: tuple[tuple[NDArray[np.float64], dict[str, Any]], ...] = (
        (moment.ours, {"color": FOLLOWER, "linewidth": 2.0}),
        (moment.other, {"color": DEAD_END, "linestyle": (0, (3, 1))}),
    )
    for score, look in looks:
        axes[2].plot(moment.times, _scaled(score), **look)
    axes[2].axhline(0.0, color=SOFT, linewidth=0.8)
    axes[2].set_ylim(-1.1, 1.1)
    axes[2].set_yticks([-1.0, 0.0, 1.0], ["none", "alarm", "most"])
    for one in axes:
        one.axvline(0.0, color=SOFT, linewidth=0.8, linestyle=(0, (1, 1.5)))


def _scaled(score: NDArray[np.float64]) -> NDArray[np.float64]:
    """From −1 to 1, the threshold at 0: risks of two units in one panel."""
    below, above = max(-float(score.min()), 1e-12), max(float(score.max()), 1e-12)
    return np.asarray(np.where(score < 0.0, score / below, score / above))


def _title(moment: Moment) -> str:
    run = moment.run.replace("_", " ")
    what = {
        Kind.EARLIER: f"earlier: {moment.lead:.1f} s",
        Kind.LATER: f"later: {moment.lead:.1f} s",
        Kind.FALSE_ALARM: "false alarm",
    }[moment.kind]
    against = "" if math.isnan(moment.other_lead) else f", TTC {moment.other_lead:.1f} s"
    return f"{what}{against}\n{_short(run)}\n{moment.pair}"


def _short(text: str, most: int = 22) -> str:
    """The end of it, which tells runs of one source apart."""
    return text if len(text) <= most else f"…{text[1 - most :]}"
