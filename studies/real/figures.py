"""The figures of the study of real data."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from studies.old import plot
from studies.old.drawing import Sketch
from studies.old.shim import percent
from studies.real.cases import HORIZONS
from studies.real.measures import MEASURES, Group
from studies.real.moments import ALARM_SHARE, Kind, Moment
from studies.real.study import REFERENCE, SHOWN, SHOWN_QUESTION, RealStudy
from studies.real.targets import TARGETS, TITLES

if TYPE_CHECKING:
    from matplotlib.figure import Figure


_LOOKS: dict[str, plot.Look] = {
    Group.FIXED: {**plot.FIXED, "markersize": 3.5},
    Group.NOW: plot.PLAIN,
    Group.LEARNT: {**plot.OTHER, "marker": "D", "markersize": 3.5},
    Group.OURS: plot.OURS,
}
_LINES: dict[str, plot.Look] = {
    "gap": {"color": plot.INK},
    "follower": {"color": plot.FOLLOWER},
    "leader": {"color": plot.LEADER, "linestyle": plot.LEADER_DASHES},
    SHOWN: {"color": plot.FOLLOWER, "linewidth": 2.0},
    "1 / time to collision": {"color": plot.DEAD_END, "linestyle": (0, (3, 1))},
}
# Where the axis of areas begins: below chance, which is 0.5.
_LEAST_AREA = 0.3
_GROUPS = {measure.name: measure.group for measure in MEASURES}
_KINDS = {
    Kind.EARLIER: "earlier: {:.1f} s",
    Kind.LATER: "later: {:.1f} s",
    Kind.FALSE_ALARM: "false alarm",
}


def sketches(study: RealStudy) -> Iterator[Sketch]:
    """The figures that apply."""
    if study.comparable:
        yield Sketch(
            "real-areas",
            "How well each measure ranks the moments before an event",
            "Area under the ROC curve with its 95 % interval (whole runs drawn), for every event "
            "that is frequent enough. Filled circles are ours. 0.5 is chance.",
            "A grid of panels, events by horizons, with a dot and an interval for each measure.",
            partial(draw_areas, study),
        )
    if study.moments:
        yield Sketch(
            "real-moments",
            "The five most telling moments",
            f"Chosen by a rule: of all events ({TITLES[SHOWN_QUESTION.target]}), those of which "
            f"{SHOWN} warned earlier than time to collision by most, one of each run; the one of "
            "which it warned later by most, or that both missed; and its longest alarm after which "
            "nothing came. Risk is drawn from each measure's own alarm threshold, that is on for "
            f"{percent(ALARM_SHARE)} of quiet time: above 0 is alarm. At 0 s the event begins. "
            "Time to collision has no value while the gap does not close; it is drawn at the "
            "bottom there.",
            "Columns of three panels each: the gap, both speeds, and the risk of both measures "
            "over the 10 seconds before a moment.",
            partial(draw_moments, study.moments),
        )


def draw_areas(study: RealStudy) -> Figure:
    """AUROC of every measure, a panel for each question that can be answered."""
    targets = [target for target in TARGETS if study.is_enough(target)]
    height = 0.75 + 2.55 * len(targets)
    figure, grid = plot.panels(len(targets), len(HORIZONS), height, sharex=True, sharey=True)
    for line, target in zip(grid, targets, strict=True):
        for axes, horizon in zip(line, HORIZONS, strict=True):
            rows = study.of(target.name, horizon)
            for place, row in enumerate(rows):
                plot.dots(axes, _LOOKS[_GROUPS[row.measure]], place, row.auroc, row.low, row.high)
            reference = study.row(target.name, horizon, REFERENCE).auroc
            plot.level(axes, reference, across=False, linestyle=(0, (1, 1.5)))
            plot.name_lines(axes, [row.measure for row in rows])
            title = f"{target.name} within {horizon:g} s ({rows[0].events} events)"
            axes.set_title(title, fontsize=7.6)
    grid[0, 0].set_xlim(_LEAST_AREA, 1.0)
    for axes in grid[-1]:
        axes.set_xlabel("AUROC")
    plot.legend(figure, _LOOKS)
    return figure


def draw_moments(moments: Sequence[Moment]) -> Figure:
    """Gap, speeds and risk around each moment, a column for each."""
    figure, grid = plot.panels(3, len(moments), 5.0, sharex=True)
    gap, follower, leader, ours, other = _LINES.values()
    for column, (axes, moment) in enumerate(zip(grid.T, moments, strict=True)):
        above, middle, below = axes
        observed = moment.observations.T
        plot.curves(above, gap, moment.times, observed[0])
        plot.curves(middle, follower, moment.times, observed[1])
        plot.curves(middle, leader, moment.times, observed[2])
        plot.curves(below, ours, moment.times, _scaled(moment.ours))
        plot.curves(below, other, moment.times, _scaled(moment.other))
        plot.level(below, 0.0, linestyle="-")
        above.set_ylim(bottom=0.0)
        below.set_ylim(-1.1, 1.1)
        below.set_yticks([-1.0, 0.0, 1.0], [] if column else ["none", "alarm", "most"])
        for one in axes:
            plot.level(one, 0.0, across=False, linestyle=(0, (1, 1.5)))
        above.set_title(_title(moment), fontsize=6.8)
        below.set_xlabel("time [s]")
    for one, label in zip(grid[:, 0], ("gap [m]", "speed [m/s]", "risk"), strict=True):
        one.set_ylabel(label)
    plot.legend(figure, {name: {"linestyle": "-", **look} for name, look in _LINES.items()})
    return figure


def _scaled(score: NDArray[np.float64]) -> NDArray[np.float64]:
    """From −1 to 1, the threshold at 0: risks of two units in one panel."""
    below, above = max(-float(score.min()), 1e-12), max(float(score.max()), 1e-12)
    return np.asarray(np.where(score < 0.0, score / below, score / above))


def _title(moment: Moment) -> str:
    """Why it is shown, how early the other measure warned, and the end of the run's name."""
    what = _KINDS[moment.kind].format(moment.lead)
    against = "" if math.isnan(moment.other_lead) else f", TTC {moment.other_lead:.1f} s"
    run = moment.run.replace("_", " ")
    return f"{what}{against}\n{run if len(run) <= 22 else '…' + run[-21:]}\n{moment.pair}"
