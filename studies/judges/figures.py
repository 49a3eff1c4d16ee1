"""The figures of the study of judges."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from studies.judges.study import Judges
from studies.judges.summary import Summary, summary
from studies.old import plot
from studies.old.drawing import Sketch
from studies.old.trials import scale_failed, scale_kept

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_COLUMNS = 5
#: Lines above those of the parts: who decides.
_WHOLE = "learnt, whole"
_JUDGES = {"controller alone": "unrevised", "kinematic": "kinematic", _WHOLE: "learnt"}
_LOOKS: dict[str, plot.Look] = {
    "controller alone": plot.PLAIN,
    "kinematic": plot.TOLD,
    _WHOLE: plot.OURS,
    "without one part": {**plot.OTHER, "color": plot.INK},
}


def sketches(found: Judges) -> Iterator[Sketch]:
    """The figures that apply."""
    yield Sketch(
        "judges-failed",
        "How often systems fail, and what each part is worth",
        "Held-out episodes that failed, of all controllers and learning seeds; linear up to 1 %, "
        "logarithmic beyond. Bars: 95 %, as if all episodes were independent; seeds share their "
        "draws. The broken line is the whole judge.",
        "Dots with intervals, a panel for each system: from above the controller alone, the whole "
        "judge, and the judge without each of its parts.",
        partial(draw, found, _failed, "failed [%]"),
    )
    yield Sketch(
        "judges-kept",
        "How many proposals are executed exactly",
        "Held-out decisions; a dot is the median over controllers and learning seeds, the bar "
        "reaches from the lowest to the highest of them.",
        "Dots with ranges by system: shares of proposals that are executed unchanged.",
        partial(draw, found, _kept, "kept [%]"),
    )


_Place = tuple[float, float, float]


def draw(found: Judges, place: Callable[[Judges, Summary], _Place], label: str) -> Figure:
    """A panel for each system, with a line for each judge and each part."""
    names = [*_JUDGES, *(f"without {part}" for part in found.parts)]
    if not found.of(judge="kinematic"):
        names.remove("kinematic")
    systems = found.systems
    rows = math.ceil(len(systems) / _COLUMNS)
    columns = min(len(systems), _COLUMNS)
    height = 0.6 + rows * (0.75 + 0.17 * len(names))
    figure, grid = plot.panels(rows, columns, height, sharex=True, sharey=True)
    for axes in grid.flat[len(systems) :]:
        axes.set_visible(False)
    for axes, system in zip(grid.flat, systems, strict=False):
        axes.set_title(system)
        plot.name_lines(axes, names, striped=True, bold=(_WHOLE,))
        for line, name in enumerate(names):
            part = name.removeprefix("without ") if name not in _JUDGES else ""
            if of_line := found.of(system, judge=_JUDGES.get(name, "learnt"), without=part):
                value, low, high = place(found, summary(of_line))
                look = _LOOKS.get(name, _LOOKS["without one part"])
                plot.dots(axes, look, [line], [value], [low], [high])
                if name == _WHOLE:
                    plot.level(axes, value, across=False)
        axes.tick_params(axis="x", labelsize=6.5)
    if place is _failed:
        scale_failed(grid[0, 0])
    else:
        scale_kept(grid[0, 0])
    for axes in grid.flat:
        axes.minorticks_off()
    figure.supxlabel(label, fontsize=8.0)
    plot.legend(figure, {name: look for name, look in _LOOKS.items() if _is_shown(name, names)})
    return figure


def _is_shown(name: str, names: list[str]) -> bool:
    return name in names or (name not in _JUDGES and any(one not in _JUDGES for one in names))


def _failed(found: Judges, one: Summary) -> _Place:
    share = one.failed
    return 100.0 * share.value, 100.0 * share.low, 100.0 * share.high


def _kept(found: Judges, one: Summary) -> _Place:
    every = [row.kept for row in found.of(one.system, None, one.judge, one.without)]
    return 100.0 * float(np.median(every)), 100.0 * min(every), 100.0 * max(every)
