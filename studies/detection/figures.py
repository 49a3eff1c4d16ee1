"""The figures of the study of detection."""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import partial
from itertools import product
from typing import TYPE_CHECKING

import numpy as np

from studies.detection.calibration import Reliability
from studies.detection.measures import Ours
from studies.detection.rows import Row
from studies.detection.study import ASSUMED, IN_GRID, Detection
from studies.detection.watch import WHAT, Target
from studies.old import plot
from studies.old.drawing import Sketch
from studies.policies import Group

if TYPE_CHECKING:
    from matplotlib.figure import Figure


_LOOKS: dict[str, plot.Look] = {
    Ours.DEFAULT: {**plot.OURS, "markersize": 7.5},
    Ours.STATES: {**plot.OURS, "markersize": 5.0, "fillstyle": "none"},
    Ours.PAPER: {**plot.OTHER, "marker": "P", "markersize": 6.0},
    "rss-r157": plot.FIXED,
    "rss-matched": plot.TOLD,
    "headway": {**plot.PLAIN, "marker": "^"},
    "ttc": {**plot.PLAIN, "marker": "x", "color": plot.INK},
}
# AUROC is drawn as what it lacks to 1, and nothing below this is told apart.
_CLOSEST = 1e-4


def sketches(study: Detection) -> Iterator[Sketch]:
    """The figures that apply."""
    yield Sketch(
        "detection-auroc",
        "How well the dangerous is told from the rest",
        "What AUROC lacks to 1, on a logarithmic scale: left is better. Shaded: worlds by turns. "
        "Bars: 95 %, over episodes. Half, the dashed line, is chance.",
        "Dots by world and measure; ours is furthest left on dead ends, and mixed on collisions.",
        partial(draw_areas, study),
    )
    if any(row.lead_median_1 is not None for row in study.rows):
        yield Sketch(
            "detection-lead",
            "How early, at one false alarm per hour and at one in ten",
            "Median time from the first alarm that stays on to the collision. Filled: at one false "
            "alarm per hour, with its 95 % interval; the thin line goes down to what is exceeded "
            "in 90 % of collisions. Open: at one in ten hours, where there were hours enough.",
            "Lead times by measure; ours and the safe distances are longest on dead ends.",
            partial(draw_leads, study),
        )
    if fits := list(_fits(study)):
        yield Sketch(
            "detection-reliability",
            f"Does what is called 30 % come in 30 of 100? ({_shown_family(study)})",
            f"Probability of a {WHAT[Target.COLLISION]}, going on as driven, against how often it "
            "came on held-out draws. On the dashed line both agree.",
            "Two reliability diagrams with the number of cases below each.",
            partial(plot.reliability, {one.title: one.bins for one in fits}),
        )
    if study.grid:
        yield Sketch(
            "detection-grid",
            "Brakes that nobody was told of",
            "Above: 1 − AUROC for dead ends. Below: share of decisions misjudged at the measure's "
            "own threshold, the mean of dead ends missed and of others called one; "
            f"{Ours.PAPER} has no such threshold. rss-assumed counts on own brakes of "
            f"{ASSUMED[0]:g} and leaders up to {ASSUMED[1]:g} m/s², rss-matched on the truth. "
            "Crossed out: no dead ends at all, so that only false calls count below.",
            "Heat maps over own and leader's brakes; ours is the lightest but for worlds without "
            "any dead end.",
            partial(draw_grid, study),
        )


def draw_areas(study: Detection) -> Figure:
    """AUROC by world and measure, for both targets."""
    worlds = study.families
    figure, grid = plot.panels(1, 2, 1.1 + 0.36 * len(worlds), sharex=True, sharey=True)
    shifts = np.linspace(-0.36, 0.36, len(_LOOKS))
    for axes, target in zip(grid.flat, Target, strict=True):
        plot.level(axes, 0.5, across=False)
        for shift, (measure, look) in zip(shifts, _LOOKS.items(), strict=True):
            rows = [study.row(world, measure, target) for world in worlds]
            areas = np.array(
                [(r.auroc, r.auroc_low, r.auroc_high) if r else (math.nan,) * 3 for r in rows]
            )
            lacking = np.maximum(1.0 - areas, _CLOSEST)
            plot.dots(axes, look, np.arange(len(worlds)) + shift, *lacking.T)
        axes.set_title(WHAT[target].capitalize())
        axes.set_xlabel("1 − AUROC")
        plot.name_lines(axes, worlds, striped=True)
    ticks = {_CLOSEST: "≤ 0.0001", 1e-3: "0.001", 1e-2: "0.01", 0.1: "0.1", 0.5: "0.5"}
    grid[0, 0].set(xscale="log", xlim=(0.7 * _CLOSEST, 1.15))
    grid[0, 0].set_xticks(list(ticks), list(ticks.values()))
    for axes in grid.flat:
        axes.minorticks_off()
        axes.tick_params(axis="x", labelsize=6.5)
    plot.legend(figure, _LOOKS)
    return figure


def draw_leads(study: Detection) -> Figure:
    """Lead times by measure, for the families that were driven longest."""
    known = {row.family for row in study.rows if row.lead_median_1 is not None}
    families = [one for one in ("paper", "emergency", "rare") if one in known]
    wanted = list(product(families or study.families[:1], Target))
    names = list(dict.fromkeys(row.measure for row in study.rows if "filtered" not in row.measure))
    height = len(wanted) // 2 * (0.5 + 0.15 * len(names)) + 0.6
    figure, grid = plot.panels(len(wanted) // 2, 2, height, sharey=True)
    ours, fixed, told = ("ours", "fixed constants", "tuned, or told the truth")
    kinds = {Group.LEARNT: ours, Group.FIXED: fixed}
    looks = {ours: plot.OURS, fixed: {**plot.FIXED, "color": plot.INK}, told: plot.TOLD}
    for axes, (family, target) in zip(grid.flat, wanted, strict=True):
        axes.set_title(f"{family}: {WHAT[target]}")
        plot.name_lines(axes, names, bold=(Ours.DEFAULT,))
        for row in study.rows:
            if (row.family, row.target) != (family, target) or row.measure not in names:
                continue
            look, line = looks[kinds.get(Group(row.group), told)], names.index(row.measure)
            median, least, low, high, seldom = np.array(
                [
                    *(row.lead_median_1, row.lead_p10_1),
                    *(row.lead_median_1_low, row.lead_median_1_high, row.lead_median_01),
                ],
                dtype=np.float64,  # NaN for None
            )
            plot.dots(axes, look, line, median, least, median, width=0.7)
            plot.dots(axes, look, line, median, low, high, width=2.4)
            hollow = {**look, "fillstyle": "none", "markersize": 6.5}
            plot.dots(axes, hollow, line, seldom, seldom, seldom)
        axes.set_xlim(left=-0.4)
    for axes in grid[-1]:
        axes.set_xlabel("lead time [s]")
    plot.legend(figure, looks)
    return figure


def _fits(study: Detection) -> Iterator[Reliability]:
    """Of one family: ours after calibration, and what was counted as it is."""
    for name, calibrated in ((Ours.DEFAULT, True), (Ours.COUNTS, False)):
        wanted = _shown_family(study), name, Target.COLLISION, calibrated
        for one in study.reliable:
            if one[:4] == wanted:
                how = "after calibration" if calibrated else "as it was counted in states"
                yield one.fit._replace(what=f"{how} ({name})")


def _shown_family(study: Detection) -> str:
    return "emergency" if "emergency" in study.families else study.families[0]


def draw_grid(study: Detection) -> Figure:
    """AUROC, and decisions misjudged, over true own brakes and true leader's brakes."""
    names = [name for name in IN_GRID if any(row.measure == name for row in study.grid)]
    own = sorted({row.decel for row in study.grid})
    leader = sorted({row.leader_decel for row in study.grid})
    figure, grid = plot.panels(2, len(names), 3.9, sharex=True, sharey=True)
    for column, name in enumerate(names):
        cells = {(r.decel, r.leader_decel): r for r in study.grid if r.measure == name}
        lacking = [[1.0 - cells[b, a].auroc for b in own] for a in leader]
        wrong = [[_misjudged(cells[b, a]) for b in own] for a in leader]
        for axes, values, most in zip(grid[:, column], (lacking, wrong), (0.05, 0.5), strict=True):
            drawn = plot.heat(axes, values, (0.0, most), text=_short, size=5.5)
            if name == names[-1]:
                text = "misjudged" if most == 0.5 else "1 − AUROC"
                figure.colorbar(drawn, ax=axes, extend="max", label=text)
        grid[0, column].set_title(name, fontsize=8.0)
    grid[0, 0].set_xticks(range(len(own)), [f"{b:g}" for b in own])
    grid[0, 0].set_yticks(range(len(leader)), [f"{a:g}" for a in leader])
    figure.supxlabel("true own brakes [m/s²]", fontsize=8.0)
    figure.supylabel("leader's brakes [m/s²]", fontsize=8.0)
    return figure


def _misjudged(row: Row) -> float:
    known = [value for value in (row.missed, row.called) if value is not None]
    return float(np.mean(known)) if known else math.nan


def _short(value: float) -> str:
    """Without the leading 0, to fit."""
    if math.isnan(value):
        return "×"
    return "0" if value < 0.0005 else f"{value:.3f}".removeprefix("0")
