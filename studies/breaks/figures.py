"""The figures of the study that breaks guards on purpose."""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import partial
from typing import TYPE_CHECKING

from studies.breaks.amounts import TOY
from studies.breaks.study import Breaks
from studies.old import plot
from studies.old.drawing import Sketch

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_LOOKS: dict[str, plot.Look] = {
    "splitting": plot.OURS,
    "plain sampling": plot.OTHER,
    "known": plot.TOLD,
}
_COLUMNS = 3


def sketches(found: Breaks) -> Iterator[Sketch]:
    """The figures that apply."""
    yield Sketch(
        "break-probability",
        "How likely a failure is, by both ways",
        "Dots with 95 % intervals. Where no failure was seen there is no dot: plain sampling shows "
        "the upper end of its interval as a line from the left, splitting nothing, as it bounds "
        "nothing then.",
        "Dots with intervals on a logarithmic scale, a line for each family and judge.",
        partial(draw_probabilities, found),
    )
    if any(split.levels for splits in found.splits for split in splits):
        yield Sketch(
            "break-levels",
            "How near to a failure splitting came, at which probability",
            "A line for each run, from ordinary cases on the left to a failure or to where it was "
            "given up. A line that rises steeply at its end comes to a failure; one that runs flat "
            "comes no closer however rare its cases are.",
            "Curves, a panel for each family and judge: probability on a logarithmic scale below, "
            "the braking that was needed on the left.",
            partial(draw_levels, found),
        )


def draw_probabilities(found: Breaks) -> Figure:
    """A line for each row."""
    names = [row.name for row in found.rows]
    figure, grid = plot.panels(1, 1, 1.1 + 0.34 * len(names))
    axes = grid[0, 0]
    plot.name_lines(axes, names, striped=True)
    axes.set_xscale("log")
    ends = [found.plan.least]
    for row in found.rows:
        ends += [x for x in (row.low, row.probability, row.plain_low, row.known) if x]
    lowest = min(ends) / 3.0
    axes.set_xlim(lowest, 1.5)
    for line, row in enumerate(found.rows):
        places = [
            (
                "splitting",
                -0.2,
                row.probability,
                row.low,
                row.high if row.probability else math.nan,
            ),
            ("plain sampling", 0.0, row.plain_probability, row.plain_low, row.plain_high),
            ("known", 0.2, row.known or math.nan, math.nan, math.nan),
        ]
        for name, shift, value, low, high in places:
            if name == "plain sampling" and not row.plain:
                continue
            shown = value if value > 0.0 else math.nan
            plot.dots(axes, _LOOKS[name], [line + shift], [shown], [max(low, lowest)], [high])
    axes.set_xlabel("probability of a failure")
    named = {
        n: look for n, look in _LOOKS.items() if n != "known" or any(r.known for r in found.rows)
    }
    plot.legend(figure, named)
    return figure


def draw_levels(found: Breaks) -> Figure:
    """A panel for each row that had levels."""
    every = [
        (row, splits)
        for row, splits in zip(found.rows, found.splits, strict=True)
        if any(split.levels for split in splits)
    ]
    columns = min(_COLUMNS, len(every))
    rows = math.ceil(len(every) / columns)
    figure, grid = plot.panels(rows, columns, 0.5 + 1.9 * rows)
    for axes in grid.flat[len(every) :]:
        axes.set_visible(False)
    for axes, (row, splits) in zip(grid.flat, every, strict=False):
        axes.set_title(row.name)
        axes.set_xscale("log")
        for split in splits:
            x = [1.0, *(level.probability for level in split.levels)]
            y = (
                [split.levels[0].score, *(level.score for level in split.levels)]
                if split.levels
                else []
            )
            if y:
                look = {"color": plot.OURS["color"], "linewidth": 0.8, "alpha": 0.6}
                plot.curves(axes, look, x, y)
        axes.invert_xaxis()
        axes.set_ylabel("normal sum [sd]" if row.family == TOY else "braking needed [m/s²]")
    figure.supxlabel("probability of coming so close", fontsize=8.0)
    return figure
