"""The study of detection as a chapter: who sees danger, how early, and where ours does not."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from functools import partial
from itertools import product
from typing import Any

import numpy as np

from evofsm.app import NONE, Table, interval, listed, number, percent, seeds_text
from evofsm.driving import Group
from evofsm.evidence.detection.measures import Ours
from evofsm.evidence.detection.rows import Row
from evofsm.evidence.detection.study import ASSUMED, IN_GRID, Detection
from evofsm.evidence.detection.watch import HORIZON, Target
from evofsm.evidence.report.asked import Asked, failures, tables_of_asked
from evofsm.evidence.report.chapter import Chapter
from evofsm.evidence.report.html import Setting
from evofsm.extras import needs

with needs("matplotlib", "plot", "drawing figures"):
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

    from evofsm.evidence.report.drawing import Sketch
    from evofsm.evidence.report.of_policies import draw_reliability
    from evofsm.plot import DEAD_END, FIRST, FOLLOWER, INK, LEADER, SOFT, WIDTH

_OURS: str = Ours.DEFAULT
_WHAT = {
    Target.DEAD_END: "dead end",
    Target.COLLISION: f"collision within {HORIZON:g} s",
}
# Measures that stand in the columns of tables over families.
_COLUMNS = (_OURS, Ours.STATES, Ours.PAPER, "rss-r157", "rss-tuned", "rss-matched", "ttc")
_LEADS = (_OURS, Ours.COUNTS, Ours.PAPER, "rss-r157", "rss-matched", "headway", "ttc")
_BRIERS = (_OURS, Ours.COUNTS, Ours.PAPER, "rss-r157", "rss-matched", "ttc")
# A measure by colour and by shape, so that neither is needed.
_LOOKS: dict[str, dict[str, Any]] = {
    _OURS: {"marker": "o", "color": FOLLOWER, "markersize": 8.0},
    Ours.STATES: {"marker": "o", "color": FOLLOWER, "markersize": 5.0, "fillstyle": "none"},
    Ours.PAPER: {"marker": "P", "color": FIRST, "markersize": 6.0},
    "rss-r157": {"marker": "s", "color": DEAD_END, "markersize": 4.5},
    "rss-matched": {"marker": "D", "color": LEADER, "markersize": 4.5},
    "headway": {"marker": "^", "color": SOFT, "markersize": 5.0},
    "ttc": {"marker": "x", "color": INK, "markersize": 5.0},
}
# AUROC is drawn as what it lacks to 1, and nothing below this is told apart.
_CLOSEST = 1e-4
_ASKED_LEAD, _ASKED_MARGIN = 5.0, 0.2


def tell(study: Detection) -> Chapter:
    """What the study found."""
    asked = list(claims(study))
    met = sum(claim.met for claim in asked)
    headline = f"{met} of the {len(asked)} targets that can be judged are met."
    if asked and met == len(asked):
        headline = f"All {len(asked)} targets that can be judged are met."
    return Chapter(
        id=study.plan.id,
        title=study.plan.question,
        about=_about(study),
        headline=headline,
        answer=tuple(_answer(study)),
        fails=failures(asked),
        losses=tuple(losses(study)),
        tables=tuple(_tables(study, asked)),
        sketches=tuple(_sketches(study)),
        plan=tuple(_plan(study)),
        packages=("scipy",),
    )


def _about(study: Detection) -> str:
    return (
        "Nobody acts here. Each decision of unrevised episodes is a case, and every measure scores "
        "it from what was seen until then. Two things may come: a dead end (by an oracle: if "
        "both cars braked as hard as they truly can from now on, they would collide), and a "
        f"collision within {HORIZON:g} s, going on as driven. Ours has watched {study.plan.train} "
        "other episodes without acting and was told nothing; on dead ends it is nearly perfect "
        "because the oracle is kinematics with the true brakes, and ours the same kinematics with "
        "brakes that it learnt: what is shown is that they can be learnt by watching. An alarm "
        "holds for 1 s after it was raised, and is false if the target does not hold within 5 s; "
        "thresholds are chosen on draws of their own."
    )


# -- What was asked for ---------------------------------------------------------------------------


def claims(study: Detection) -> Iterator[Asked]:
    """The targets that were set before, as far as their worlds were judged."""
    table = _by_key(study)

    def of(family: str, measure: str = _OURS, target: Target = Target.DEAD_END) -> Row | None:
        return table.get((family, measure, target))

    for family, least in (("emergency", 0.97), ("rare", 0.9)):
        if row := of(family):
            yield _at_least(f"AUROC on {family}", row.auroc, least)
    for family in ("weak_brakes", "shift"):
        row, other = of(family), of(family, "rss-r157")
        if row and other:
            yield _at_least(f"AUROC on {family}: at least rss-r157's", row.auroc, other.auroc)
    for target in Target:
        row, other = of("paper", _OURS, target), of("paper", "ttc", target)
        if row and other and row.lead_median_1 is not None and other.lead_median_1 is not None:
            longer = row.lead_median_1 - other.lead_median_1
            yield Asked(
                f"Lead time on paper beyond TTC's, {_WHAT[target]}",
                f"≥ {_ASKED_LEAD:g} s",
                f"{longer:.1f} s",
                longer >= _ASKED_LEAD,
            )
    paper = of("rare", Ours.PAPER)
    for measure in (Ours.DEFAULT, Ours.STATES):
        row = of("rare", measure)
        if row and paper:
            what = f"AUROC on rare, {measure}: {Ours.PAPER}'s + {_ASKED_MARGIN:g}"
            yield _at_least(what, row.auroc, paper.auroc + _ASKED_MARGIN)


def _at_least(what: str, measured: float, least: float) -> Asked:
    return Asked(what, f"≥ {number(least, 4)}", number(measured, 4), measured >= least)


def _by_key(study: Detection) -> dict[tuple[str, str, str], Row]:
    return {(row.family, row.measure, row.target): row for row in study.rows}


def _answer(study: Detection) -> Iterator[str]:
    for target in Target:
        best = [
            family for family in study.families if _best(study, family, target).measure == _OURS
        ]
        rows = [row for row in study.rows if row.measure == _OURS and row.target == target]
        areas = [row.auroc for row in rows if math.isfinite(row.auroc)]
        if areas:
            among = f"best in {len(best)} of {len(study.families)} worlds"
            yield (
                f"{_WHAT[target].capitalize()}: AUROC of ours from {min(areas):.3f} to "
                f"{max(areas):.3f}, {among}, those that are told the truth included."
            )
    row = _by_key(study).get(("paper", _OURS, Target.DEAD_END))
    ttc = _by_key(study).get(("paper", "ttc", Target.DEAD_END))
    if row and ttc and row.lead_median_1 is not None and ttc.lead_median_1 is not None:
        yield (
            "In the paper's cases, at one false alarm per hour, ours warns "
            f"{row.lead_median_1:.1f} s before the collision (median), time to collision "
            f"{ttc.lead_median_1:.1f} s."
        )


def _is_rival(measure: str) -> bool:
    """Whether it is no other reading of ours; the default itself is among those compared."""
    return measure == _OURS or measure not in list(Ours)


def _among(study: Detection, family: str, target: Target) -> list[Row]:
    """Ours and its rivals in one world."""
    return [
        row
        for row in study.rows
        if (row.family, row.target) == (family, target) and _is_rival(row.measure)
    ]


def _best(study: Detection, family: str, target: Target) -> Row:
    rows = _among(study, family, target)
    return max(rows, key=lambda row: (np.nan_to_num(row.auroc), row.measure == _OURS))


# -- Where it loses -------------------------------------------------------------------------------


def losses(study: Detection) -> Iterator[str]:
    """Where a rival does better than ours, the most important first."""
    for target in Target:
        yield from _beaten(study, target)
    yield from _later(study)
    yield from _called(study)
    yield from _in_grid(study)
    yield from _states_alone(study)


def _beaten(study: Detection, target: Target) -> Iterator[str]:
    """Families in which another measure is better beyond both intervals."""
    found = []
    for family in study.families:
        mine = _by_key(study).get((family, _OURS, target))
        best = _best(study, family, target)
        if mine and best.auroc_low > mine.auroc_high:
            found.append(f"{family} ({best.measure} {best.auroc:.4f}, ours {mine.auroc:.4f})")
    if found:
        yield f"AUROC, {_WHAT[target]}: another measure is clearly better on {listed(found)}."


def _later(study: Detection) -> Iterator[str]:
    """Families in which another one warns earlier, at no more false alarms that came."""
    for target in Target:
        found = []
        for family in study.families:
            rows = [r for r in _among(study, family, target) if r.lead_median_1 is not None]
            mine = next((r for r in rows if r.measure == _OURS), None)
            if mine is None or mine.lead_median_1 is None:
                continue
            first = max(rows, key=lambda r: r.lead_median_1 or 0.0)
            if (first.lead_median_1 or 0.0) > (mine.lead_median_1 or 0.0) + 0.25:
                found.append(
                    f"{family} ({first.measure} {number(first.lead_median_1 or 0.0, 1)} s, in "
                    f"alarm for {percent(first.false_time_1 or 0.0)} of the time without, ours "
                    f"{mine.lead_median_1:.1f} s, {percent(mine.false_time_1 or 0.0)})"
                )
        if found:
            yield (
                f"Lead time at one false alarm per hour, {_WHAT[target]}: another one warns "
                f"earlier on {listed(found)}."
            )


def _called(study: Detection) -> Iterator[str]:
    """What its own threshold costs where brakes are better than it dares to assume."""
    cells = [row for row in study.grid if row.measure == _OURS and row.called is not None]
    if cells:
        worst = max(cells, key=lambda row: row.called or 0.0)
        yield (
            f"Where its own brakes were never seen at work it stays cautious: with brakes of "
            f"{worst.decel:g} and leaders up to {worst.leader_decel:g} m/s² it calls for braking "
            f"in {percent(worst.called or 0.0)} of the decisions that are no dead end."
        )


def _in_grid(study: Detection) -> Iterator[str]:
    """The world of the grid in which ours tells worst, where another one tells better."""
    cells = [r for r in study.grid if math.isfinite(r.auroc) and _is_rival(r.measure)]
    mine = [row for row in cells if row.measure == _OURS]
    if not mine:
        return
    worst = min(mine, key=lambda row: row.auroc)
    limits = (worst.decel, worst.leader_decel)
    best = max(
        (row for row in cells if (row.decel, row.leader_decel) == limits),
        key=lambda row: row.auroc,
    )
    if best.auroc > worst.auroc:
        yield (
            f"In the grid, with own brakes of {worst.decel:g} and leaders up to "
            f"{worst.leader_decel:g} m/s², where {percent(worst.share)} of the decisions are dead "
            f"ends, its AUROC is {worst.auroc:.3f}, that of {best.measure} {best.auroc:.3f}."
        )


def _margin_by_seed(study: Detection) -> str:
    """The margin over the paper's preset is not the same with every learning seed."""
    table = _by_key(study)
    paper = table.get(("rare", Ours.PAPER, Target.DEAD_END))
    states = table.get(("rare", Ours.STATES, Target.DEAD_END))
    if not (paper and states and paper.auroc_seeds and states.auroc_seeds):
        return ""
    pairs = list(zip(states.auroc_seeds, paper.auroc_seeds, strict=True))
    clear = sum(mine >= other + _ASKED_MARGIN for mine, other in pairs)
    return (
        f" On rare {Ours.STATES} is better than {Ours.PAPER} by the margin of {_ASKED_MARGIN:g} "
        f"with {clear} of {len(pairs)} of them."
    )


def _spread(row: Row) -> str:
    return interval(min(row.auroc_seeds), max(row.auroc_seeds), lambda x: number(x, 3))


def _states_alone(study: Detection) -> Iterator[str]:
    """The state machine itself, against a fixed formula."""
    table, found = _by_key(study), []
    for family in study.families:
        states = table.get((family, Ours.STATES, Target.DEAD_END))
        other = table.get((family, "rss-r157", Target.DEAD_END))
        if states and other and other.auroc_low > states.auroc_high:
            found.append(f"{family} ({states.auroc:.3f} against {other.auroc:.3f})")
    if found:
        yield (
            "Read through its states alone, ours tells dead ends less well than RSS with R157's "
            f"constants on {listed(found)}: states are coarse."
        )


# -- Tables ---------------------------------------------------------------------------------------


def _tables(study: Detection, asked: Sequence[Asked]) -> Iterator[Table]:
    yield from tables_of_asked(asked)
    for target in Target:
        yield _areas_by_family(study, target)
    yield from _seeds_table(study)
    for target in Target:
        yield from _leads_by_family(study, target)
    for family, target in product(("paper", "emergency"), Target):
        yield from _family_table(study, family, target)
    yield from _briers(study)
    yield from _grid_table(study)


def _areas_by_family(study: Detection, target: Target) -> Table:
    table = _by_key(study)
    rows = []
    for family in study.families:
        cells = [table.get((family, measure, target)) for measure in _COLUMNS]
        rows.append((family, *(number(row.auroc, 3) if row else NONE for row in cells)))
    return Table(
        f"AUROC, {_WHAT[target]}",
        ("world", *map(_short_name, _COLUMNS)),
        tuple(rows),
        "Half is chance; below, danger is where the measure says safety. states, paper: ours read "
        "through the states of the default and of the paper's rule. tuned, matched: RSS, told the "
        "truth in training, and told the true limits. Intervals, and all other measures, are in "
        "detection.json.",
    )


def _seeds_table(study: Detection) -> Iterator[Table]:
    table, rows = _by_key(study), []
    columns = (_OURS, Ours.STATES, Ours.COUNTS, Ours.PAPER)
    for family in study.families:
        cells = [table.get((family, measure, Target.DEAD_END)) for measure in columns]
        if all(row is not None and row.auroc_seeds for row in cells):
            rows.append((family, *(_spread(row) for row in cells if row)))
    if rows:
        yield Table(
            f"AUROC over {study.plan.seeds - 1} other learning seeds, dead end",
            ("world", *map(_short_name, columns)),
            tuple(rows),
            "From the lowest to the highest; on fewer held-out episodes than above."
            f"{_margin_by_seed(study)}",
        )


def _short_name(measure: str) -> str:
    """As it fits above a narrow column; the note says what it is."""
    for whole in ("rss-r157", "evofsm"):
        if measure == whole:
            return measure
    return measure.removeprefix("evofsm-").removeprefix("rss-")


def _leads_by_family(study: Detection, target: Target) -> Iterator[Table]:
    table, rows = _by_key(study), []
    for family in study.families:
        cells = [table.get((family, measure, target)) for measure in _LEADS]
        if any(row is not None and row.lead_median_1 is not None for row in cells):
            rows.append((family, *(_seconds(row.lead_median_1 if row else None) for row in cells)))
    if rows:
        yield Table(
            f"Median lead time at one false alarm per hour, in seconds: {_WHAT[target]}",
            ("world", *map(_short_name, _LEADS)),
            tuple(rows),
            "From the first alarm that stays on to the collision; 0 where there was none. counts, "
            "paper: failures counted in the states of the default and of the paper's rule. Worlds "
            "without enough hours for this rate are left out.",
        )


def _family_table(study: Detection, family: str, target: Target) -> Iterator[Table]:
    rows = [row for row in study.rows if (row.family, row.target) == (family, target)]
    rows = [row for row in rows if row.lead_median_1 is not None]
    if not rows:
        return
    yield Table(
        f"{family}, {_WHAT[target]}: lead times, and what came of the alarms",
        (
            "measure",
            "median",
            "95 %",
            "10 %",
            "0.1/h",
            "false/h",
            "alarm %",
            "warn %",
        ),
        tuple(
            (
                row.measure,
                _seconds(row.lead_median_1),
                interval(
                    _or_nan(row.lead_median_1_low),
                    _or_nan(row.lead_median_1_high),
                    lambda x: number(x, 1),
                ),
                _seconds(row.lead_p10_1),
                _seconds(row.lead_median_01),
                number(_or_nan(row.false_alarms_1), 2),
                percent(_or_nan(row.false_time_1), ""),
                percent(_or_nan(row.warned_1), ""),
            )
            for row in rows
        ),
        f"Before {rows[0].collisions} collisions in {rows[0].hours:.1f} h, in seconds: median, and "
        "what is exceeded in 90 %, at one false alarm per hour; and the median at one in ten "
        "hours. false/h: those that came on held-out draws at the threshold that was chosen "
        "elsewhere; alarm: share of the decisions without the target that are in alarm; warn: of "
        "collisions before which an alarm stayed on.",
        tuple(place for place, row in enumerate(rows) if row.group == Group.LEARNT),
    )


def _briers(study: Detection) -> Iterator[Table]:
    table, rows = _by_key(study), []
    for family in study.families:
        cells = [table.get((family, measure, Target.COLLISION)) for measure in _BRIERS]
        base = next((row.share * (1.0 - row.share) for row in cells if row), math.nan)
        calibrated = [_or_nan(row.brier) if row else math.nan for row in cells]
        counted = table.get((family, Ours.COUNTS, Target.COLLISION))
        own = _or_nan(counted.brier_own) if counted else math.nan
        rows.append((family, *(number(value, 3) for value in (base, *calibrated, own))))
    yield Table(
        f"Brier score, {_WHAT[Target.COLLISION]}",
        ("world", "base", *map(_short_name, _BRIERS), "own"),
        tuple(rows),
        "Lower is better; base: always saying the share of cases. Scores became probabilities by "
        "isotonic regression on other draws; own: the probability of counts, as it was counted.",
    )


def _grid_table(study: Detection) -> Iterator[Table]:
    rows = []
    for measure in IN_GRID:
        cells = [row for row in study.grid if row.measure == measure]
        areas = [row.auroc for row in cells if math.isfinite(row.auroc)]
        if not areas:
            continue
        missed = [row.missed for row in cells if row.missed is not None]
        called = [row.called for row in cells if row.called is not None]
        rows.append(
            (
                str(measure),
                number(min(areas), 4),
                number(float(np.median(areas)), 4),
                percent(max(missed, default=math.nan)),
                percent(float(np.mean(missed)) if missed else math.nan),
                percent(float(np.mean(called)) if called else math.nan),
            )
        )
    if rows:
        yield Table(
            "Brakes that nobody was told of: own × leader's",
            ("measure", "lowest AUROC", "median", "most missed", "missed", "called"),
            tuple(rows),
            f"Over {len({(r.decel, r.leader_decel) for r in study.grid})} worlds; ours has watched "
            f"{study.plan.grid_train} episodes of each. missed, called: at the measure's own "
            "threshold, mean share of dead ends missed and of other decisions called dead ends. "
            f"rss-assumed counts on {ASSUMED[0]:g} and {ASSUMED[1]:g} m/s².",
            tuple(k for k, row in enumerate(rows) if row[0] == _OURS),
        )


def _or_nan(value: float | None) -> float:
    return math.nan if value is None else value


def _seconds(value: float | None) -> str:
    return number(_or_nan(value), 1)


def _plan(study: Detection) -> Iterator[Setting]:
    plan = study.plan
    yield Setting("worlds", ", ".join(study.families))
    yield Setting("seed", f"{plan.seed}; {seeds_text(plan.seeds)}")
    yield Setting("watched", f"{plan.train} episodes, after a shift {plan.since} more")
    yield Setting(
        "held out",
        f"{plan.hours:g} h of each world, {plan.long_hours:g} h of {listed(plan.long)}; as much "
        "again for thresholds and calibration",
    )
    yield Setting("bootstrap", f"{plan.rounds} rounds over episodes")
    yield Setting("grid", f"{plan.grid_train} episodes watched, {plan.grid_hours:g} h held out")
    yield Setting("paper", "the four cases, with gap, top speed and the driver's change drawn")
    yield Setting("r157", "seven fixed runs: training and test are the same")
    yield Setting("shift", "judged after the shift; shift-at-once: before anything was seen of it")


# -- Figures --------------------------------------------------------------------------------------


def _sketches(study: Detection) -> list[Sketch]:
    sketches: list[Sketch] = [_sketch_areas(study)]
    if any(row.lead_median_1 is not None for row in study.rows):
        sketches.append(_sketch_leads(study))
    if any(True for _ in _fits(study)):
        sketches.append(_sketch_reliability(study))
    if study.grid:
        sketches.append(_sketch_grid(study))
    return sketches


def _sketch_areas(study: Detection) -> Sketch:
    return Sketch(
        "detection-auroc",
        "How well the dangerous is told from the rest",
        "What AUROC lacks to 1, on a logarithmic scale: left is better. Shaded: worlds by turns. "
        "Bars: 95 %, over episodes. Half, the dashed line, is chance.",
        "Dots by world and measure; ours is furthest left on dead ends, and mixed on collisions.",
        partial(draw_areas, study),
    )


def draw_areas(study: Detection) -> Figure:
    """AUROC by world and measure, for both targets."""
    figure = Figure(figsize=(WIDTH, 1.1 + 0.36 * len(study.families)))
    left, right = figure.subplots(1, 2, sharey=True, sharex=True)
    top = 1.0 - 0.55 / figure.get_figheight()
    bottom = 0.42 / figure.get_figheight()
    figure.subplots_adjust(left=0.155, right=0.985, top=top, bottom=bottom, wspace=0.05)
    table = _by_key(study)
    for axes, target in ((left, Target.DEAD_END), (right, Target.COLLISION)):
        axes.set_xscale("log")
        axes.set_xlim(1.15, 0.7 * _CLOSEST)
        axes.invert_xaxis()
        axes.axvline(0.5, color=SOFT, linewidth=0.8, linestyle=(0, (4, 2)))
        for place in range(0, len(study.families), 2):
            axes.axhspan(place - 0.5, place + 0.5, color="#F4F4F4", zorder=0.0)
        for k, (measure, look) in enumerate(_LOOKS.items()):
            for place, family in enumerate(study.families):
                row = table.get((family, measure, target))
                if row is not None and math.isfinite(row.auroc):
                    y = place + 0.36 * (2.0 * k / (len(_LOOKS) - 1) - 1.0)
                    _draw_area(axes, row, y, look)
        axes.set_title(_WHAT[target].capitalize())
        axes.set_xlabel("1 − AUROC")
        axes.grid(visible=False, axis="y")
        axes.minorticks_off()
    left.set_xticks(
        [1e-4, 1e-3, 1e-2, 1e-1, 0.5, 1.0], ["≤ 0.0001", "0.001", "0.01", "0.1", "0.5", "1"]
    )
    for axes in (left, right):
        axes.tick_params(axis="x", labelsize=6.5)
    left.set_ylim(len(study.families) - 0.5, -0.5)
    left.set_yticks(range(len(study.families)), study.families)
    _legend(figure, _LOOKS)
    return figure


def _draw_area(axes: Axes, row: Row, y: float, look: dict[str, Any]) -> None:
    def place(area: float) -> float:
        return max(1.0 - area, _CLOSEST)

    axes.plot(
        [place(row.auroc_low), place(row.auroc_high)], [y, y], color=look["color"], linewidth=0.8
    )
    axes.plot([place(row.auroc)], [y], linestyle="none", clip_on=False, zorder=4.0, **look)


def _legend(figure: Figure, looks: dict[str, dict[str, Any]]) -> None:
    handles = [Line2D([], [], linestyle="none", label=name, **look) for name, look in looks.items()]
    figure.legend(
        handles=handles,
        loc="upper center",
        ncols=len(handles),
        columnspacing=0.9,
        handletextpad=0.1,
        bbox_to_anchor=(0.5, 1.0),
    )


def _sketch_leads(study: Detection) -> Sketch:
    return Sketch(
        "detection-lead",
        "How early, at one false alarm per hour and at one in ten",
        "Median time from the first alarm that stays on to the collision. Filled: at one false "
        "alarm per hour, with its 95 % interval; the thin line goes down to what is exceeded in "
        "90 % of collisions. Open: at one in ten hours, where there were hours enough. Blue: ours; "
        "black: fixed constants; green: tuned, or told the truth.",
        "Lead times by measure; ours and the safe distances are longest on dead ends.",
        partial(draw_leads, study),
    )


def draw_leads(study: Detection) -> Figure:
    """Lead times by measure, for the families that were driven longest."""
    wanted = [
        (family, target)
        for family, target in product(("paper", "emergency", "rare"), Target)
        if any(r.family == family and r.lead_median_1 is not None for r in study.rows)
    ]
    wanted = wanted or [(family, target) for family, target in product(study.families[:1], Target)]
    rows = -(-len(wanted) // 2)
    names = list(dict.fromkeys(row.measure for row in study.rows if "filtered" not in row.measure))
    figure = Figure(figsize=(WIDTH, rows * (0.5 + 0.15 * len(names)) + 0.4))
    grid = figure.subplots(rows, 2, sharey=True, squeeze=False)
    figure.subplots_adjust(
        left=0.19,
        right=0.985,
        top=1.0 - 0.26 / figure.get_figheight(),
        bottom=0.42 / figure.get_figheight(),
        wspace=0.06,
        hspace=0.22,
    )
    for axes, (family, target) in zip(grid.flat, wanted, strict=False):
        axes.set_title(f"{family}: {_WHAT[target]}")
        for row in study.rows:
            if (row.family, row.target) == (family, target) and row.measure in names:
                _draw_lead(axes, row, names.index(row.measure))
        axes.set_ylim(len(names) - 0.4, -0.6)
        axes.set_xlim(left=-0.4)
        axes.set_yticks(range(len(names)), names)
        for label in axes.get_yticklabels():
            if label.get_text() == _OURS:
                label.set_fontweight("bold")
    for axes in grid[-1]:
        axes.set_xlabel("lead time [s]")
    return figure


def _draw_lead(axes: Axes, row: Row, y: float) -> None:
    if row.lead_median_1 is None:
        return
    ours = row.group == Group.LEARNT
    color = FOLLOWER if ours else (LEADER if row.group != Group.FIXED else INK)
    median, least = row.lead_median_1, _or_nan(row.lead_p10_1)
    spread = [_or_nan(row.lead_median_1_low), _or_nan(row.lead_median_1_high)]
    axes.plot([least, median], [y, y], color=color, linewidth=0.7)
    axes.plot(
        spread,
        [y, y],
        color=color,
        linewidth=2.4,
        solid_capstyle="butt",
    )
    axes.plot([median], [y], marker="o" if ours else "s", markersize=4.5, color=color)
    if row.lead_median_01 is not None:
        axes.plot(
            [row.lead_median_01],
            [y],
            marker="o" if ours else "s",
            markersize=6.5,
            markerfacecolor="none",
            markeredgecolor=color,
            markeredgewidth=0.8,
        )


def _fits(study: Detection) -> Iterator[Any]:
    """Of the first family: ours after calibration, and what was counted as it is."""
    for name, calibrated in ((_OURS, True), (Ours.COUNTS, False)):
        for one in study.reliable:
            if (
                one.family == _shown_family(study)
                and (one.measure, one.calibrated) == (name, calibrated)
                and one.target == Target.COLLISION
            ):
                how = "after calibration" if calibrated else "as it was counted in states"
                yield one.fit._replace(what=f"{how} ({name})")


def _shown_family(study: Detection) -> str:
    return "emergency" if "emergency" in study.families else study.families[0]


def _sketch_reliability(study: Detection) -> Sketch:
    return Sketch(
        "detection-reliability",
        f"Does what is called 30 % come in 30 of 100? ({_shown_family(study)})",
        f"Probability of a {_WHAT[Target.COLLISION]}, going on as driven, against how often it "
        "came on held-out draws. On the dashed line both agree.",
        "Two reliability diagrams with the number of cases below each.",
        partial(draw_reliability, list(_fits(study))),
    )


def _sketch_grid(study: Detection) -> Sketch:
    return Sketch(
        "detection-grid",
        "Brakes that nobody was told of",
        "Above: 1 − AUROC for dead ends. Below: share of decisions misjudged at the measure's own "
        "threshold, the mean of dead ends missed and of others called one; "
        f"{Ours.PAPER} has no such threshold. rss-assumed counts on own brakes of {ASSUMED[0]:g} "
        f"and leaders up to {ASSUMED[1]:g} m/s², rss-matched on the truth. Crossed out: no dead "
        "ends at all, so that only false calls count below.",
        "Heat maps over own and leader's brakes; ours is the lightest but for worlds without any "
        "dead end.",
        partial(draw_grid, study),
    )


def draw_grid(study: Detection) -> Figure:
    """AUROC, and decisions misjudged, over true own brakes and true leader's brakes."""
    names = [name for name in IN_GRID if any(row.measure == name for row in study.grid)]
    own = sorted({row.decel for row in study.grid})
    leader = sorted({row.leader_decel for row in study.grid})
    figure = Figure(figsize=(WIDTH, 3.7))
    grid = figure.subplots(2, len(names), sharex=True, sharey=True, squeeze=False)
    figure.subplots_adjust(left=0.08, right=0.885, top=0.92, bottom=0.13, wspace=0.08, hspace=0.1)
    figure.text(0.48, 0.02, "true own brakes [m/s²]", ha="center")
    for column, name in enumerate(names):
        cells = {(r.decel, r.leader_decel): r for r in study.grid if r.measure == name}
        lacking = [[1.0 - cells[b, a].auroc for b in own] for a in leader]
        wrong = [[_misjudged(cells[b, a]) for b in own] for a in leader]
        for axes, values, most in (
            (grid[0, column], lacking, 0.05),
            (grid[1, column], wrong, 0.5),
        ):
            _draw_heat(axes, np.array(values), most)
        grid[0, column].set_title(name, fontsize=8.0)
        grid[1, column].set_xticks(range(len(own)), [f"{b:g}" for b in own])
    for axes, text in ((grid[0, 0], "1 − AUROC"), (grid[1, 0], "misjudged")):
        axes.set_yticks(range(len(leader)), [f"{a:g}" for a in leader])
        axes.set_ylabel("leader's brakes [m/s²]")
        row = 0 if axes is grid[0, 0] else 1
        place = grid[row, -1].get_position()
        bar = figure.add_axes((0.905, place.y0, 0.014, place.height))
        figure.colorbar(grid[row, -1].images[0], cax=bar, extend="max").set_label(text)
    return figure


def _misjudged(row: Row) -> float:
    known = [value for value in (row.missed, row.called) if value is not None]
    return float(np.mean(known)) if known else math.nan


def _draw_heat(axes: Axes, values: Any, most: float) -> None:
    axes.imshow(values, cmap="cividis_r", vmin=0.0, vmax=most, origin="lower", aspect="auto")
    axes.grid(visible=False)
    for (y, x), value in np.ndenumerate(values):
        text = "×" if math.isnan(value) else _short(value)
        dark = math.isfinite(value) and value > 0.55 * most
        axes.text(
            x, y, text, ha="center", va="center", fontsize=5.5, color="white" if dark else INK
        )


def _short(value: float) -> str:
    """Without the leading 0, to fit."""
    return "0" if value < 0.0005 else f"{value:.3f}".removeprefix("0")
