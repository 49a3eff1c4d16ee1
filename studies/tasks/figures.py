"""The figure of the study of tasks."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from studies.old import plot
from studies.old.drawing import Sketch
from studies.old.trials import scale_failed, scale_kept
from studies.tasks.study import Tasks
from studies.tasks.summary import Summary, summaries

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_LOOKS: dict[str, plot.Look] = {
    "controller alone": plot.PLAIN,
    "told more": plot.TOLD,
    "counted matrices": plot.OTHER,
    "your own": plot.FIXED,
    "ours": plot.OURS,
}
_NAMED = {
    "unrevised": "controller alone",
    "counted": "counted matrices",
    "learnt": "ours",
    "scene": "ours",
}
# Height of a line, and of what stands around them [inch].
_LINE, _AROUND = 0.34, 1.0


def sketches(found: Tasks) -> Iterator[Sketch]:
    """The figures that apply."""
    yield Sketch(
        "tasks-failed",
        "How often tasks of others fail, and how much is left to the controller",
        "Left: held-out episodes that failed, of all learning seeds; linear up to 1 %, logarithmic "
        "beyond; bars: 95 %, as if all episodes were independent. Right: proposals that are "
        "executed exactly, the median over seeds. Judges that are told more than failures share a "
        "look.",
        "Dots by task and controller: on the left shares of episodes that failed, on the right "
        "shares of proposals that were kept, for the controller alone and each judge.",
        partial(draw, found),
    )


def draw(found: Tasks) -> Figure:
    """A line for each task with each controller, a dot for each judge."""
    groups, every = found.groups, list(summaries(found))
    figure, grid = plot.panels(1, 2, _AROUND + _LINE * len(groups), sharey=True)
    failed, kept = grid[0]
    plot.name_lines(failed, [f"{task}, {who}" for task, who in groups], striped=True)
    for line in range(0, len(groups), 2):
        kept.axhspan(line - 0.5, line + 0.5, color="#F4F4F4", zorder=0.0)
    for line, group in enumerate(groups):
        mine = [one for one in every if one[:2] == group]
        places = line + np.linspace(-0.32, 0.32, len(mine))
        for place, one in zip(places, mine, strict=True):
            look = {**_LOOKS[_kind(one)], "markersize": 3.5}
            share = one.failed
            shown = [100.0 * value for value in (share.value, share.low, share.high)]
            plot.dots(failed, look, [place], *([value] for value in shown))
            plot.dots(kept, look, [place], *([100.0 * one.kept] for _ in range(3)))
    scale_failed(failed)
    scale_kept(kept)
    failed.set_xlabel("failed [%]")
    kept.set_xlabel("kept [%]")
    kinds = {_kind(one) for one in every}
    plot.legend(figure, {name: look for name, look in _LOOKS.items() if name in kinds})
    return figure


def _kind(one: Summary) -> str:
    if one.judge in _NAMED:
        return _NAMED[one.judge]
    return "your own" if ":" in one.judge else "told more"
