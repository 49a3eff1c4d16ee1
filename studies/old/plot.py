"""Five marks that the figures of the studies are made of.

Dots with intervals, heat, curves with a band, reliability, and strips, each on axes that are given;
`panels` makes the axes in constrained layout, so that no text meets another. A *look* is what
matplotlib is told of a line: its colour, and a marker or dashes, so that neither is needed to tell
lines apart.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from evofsm.extras import needs

with needs("matplotlib", "plot", "plotting"):
    from matplotlib import colormaps
    from matplotlib.axes import Axes
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import ListedColormap
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

Look = dict[str, Any]
WIDTH = 7.2
INK, SOFT, FOLLOWER, LEADER, DEAD_END, THIRD = (
    *("#222222", "#777777", "#0072B2"),
    *("#009E73", "#D55E00", "#CC79A7"),
)
LEADER_DASHES = (0, (4, 1.6))

#: Of who is ours, of fixed formulas, of what is tuned or told, of another learner, and of chance.
OURS: Look = {"color": FOLLOWER, "marker": "o"}
FIXED: Look = {"color": DEAD_END, "marker": "s"}
TOLD: Look = {"color": LEADER, "marker": "D"}
OTHER: Look = {"color": THIRD, "marker": "^"}
PLAIN: Look = {"color": SOFT, "marker": "X"}

_PALE = "#F4F4F4"
_DASHES = (0, (4, 2))


def panels(rows: int, columns: int, height: float, **shared: Any) -> tuple[Figure, Any]:
    """A figure of the width of a page and its axes, (rows, columns) of them, in constrained layout.

    Parameters
    ----------
    rows, columns : int
    height : float
        Of the figure [inch].
    **shared
        ``sharex``, ``sharey``, ``height_ratios``, as `Figure.subplots` takes them.
    """
    figure = Figure(figsize=(WIDTH, height), layout="constrained")
    return figure, figure.subplots(rows, columns, squeeze=False, **shared)


def legend(figure: Figure, looks: Mapping[str, Look], columns: int | None = None) -> None:
    """Explain looks above all panels."""
    usual: Look = {"linestyle": "none", "markersize": 4.5}
    figure.legend(
        handles=[Line2D([], [], label=name, **{**usual, **look}) for name, look in looks.items()],
        loc="outside upper center",
        ncols=columns or len(looks),
        columnspacing=1.1,
        handletextpad=0.4,
    )


def level(axes: Axes, value: float, *, across: bool = True, **look: Any) -> None:
    """A broken line at a height, or at a place on the lower axis, behind all else."""
    draw = axes.axhline if across else axes.axvline
    draw(value, **{"color": SOFT, "linewidth": 0.8, "linestyle": _DASHES, "zorder": 1.0, **look})


def name_lines(
    axes: Axes, names: Sequence[str], *, striped: bool = False, bold: Collection[str] = ()
) -> None:
    """Name the lines 0, 1, ... of the panel from above; they may be shaded by turns."""
    axes.set_ylim(len(names) - 0.5, -0.5)
    axes.set_yticks(range(len(names)), names)
    axes.tick_params(axis="y", length=0.0)
    axes.grid(visible=False, axis="y")
    for label in axes.get_yticklabels():
        label.set_fontweight("bold" if label.get_text() in bold else "normal")
    for place in range(0, len(names), 2) if striped else ():
        axes.axhspan(place - 0.5, place + 0.5, color=_PALE, zorder=0.0)


# -- Five marks -----------------------------------------------------------------------------------


def dots(
    axes: Axes,
    look: Look,
    lines: ArrayLike,
    values: ArrayLike,
    low: ArrayLike,
    high: ArrayLike,
    *,
    width: float = 1.1,
) -> None:
    """Dots with intervals, each on its line of the panel; NaN is left out.

    Parameters
    ----------
    axes : matplotlib.axes.Axes
    look : dict
    lines : (n,) array_like
        Heights, as `name_lines` names them.
    values, low, high : (n,) array_like
        Places of the dots, and from where to where the intervals reach.
    width : float
        Of the intervals [point].
    """
    axes.hlines(lines, low, high, color=look["color"], linewidth=width, zorder=3.0)
    axes.plot(
        values,
        lines,
        **{"linestyle": "none", "clip_on": False, "zorder": 4.0, "markersize": 4.5, **look},
    )


def heat(
    axes: Axes,
    values: ArrayLike,
    limits: tuple[float, float],
    *,
    steps: int | None = None,
    colors: str = "cividis_r",
    edges: tuple[ArrayLike, ArrayLike] | None = None,
    text: Callable[[float], str] | None = None,
    size: float = 6.0,
) -> ScalarMappable:
    """Cells that are darker or brighter by their value, which is written in them.

    Parameters
    ----------
    axes : matplotlib.axes.Axes
    values : (m, n) array_like
        The first row stands below.
    limits : (float, float)
        Values of the first and the last colour.
    steps : int, optional
        So many colours; as many as there are without.
    colors : str
        Name of a colour map.
    edges : ((n + 1,) array_like, (m + 1,) array_like), optional
        Between cells, to the right and upward; cells 0, 1, ... are of equal size without.
    text : callable, optional
        Writes a value; an empty text is not written. Without it none is.
    size : float
        Of the text [point].

    Returns
    -------
    matplotlib.cm.ScalarMappable
        For a colour bar.
    """
    cells = np.asarray(values, dtype=np.float64)
    x, y = edges or (np.arange(n + 1) - 0.5 for n in cells.shape[::-1])
    right, up = np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64)
    shades = colormaps[colors].resampled(steps or 256)
    seen = np.ma.masked_invalid(cells)
    mesh = axes.pcolormesh(right, up, seen, cmap=shades, vmin=limits[0], vmax=limits[1])
    axes.grid(visible=False)
    axes.tick_params(length=0.0)
    for j, i in np.ndindex(cells.shape):
        if text is None:
            break
        bright = math.isnan(cells[j, i]) or _is_bright(mesh.to_rgba(cells[j, i]))
        axes.text(
            0.5 * (right[i] + right[i + 1]),
            0.5 * (up[j] + up[j + 1]),
            text(float(cells[j, i])),
            ha="center",
            va="center",
            fontsize=size,
            color=INK if bright else "white",
        )
    return mesh


def _is_bright(color: Any) -> bool:
    """Whether dark type reads well on a colour: by its luminance (ITU-R BT.709)."""
    return bool(np.dot(color[:3], (0.2126, 0.7152, 0.0722)) > 0.45)


def curves(
    axes: Axes,
    look: Look,
    x: ArrayLike,
    y: ArrayLike,
    low: ArrayLike | None = None,
    high: ArrayLike | None = None,
    *,
    label: str | None = None,
) -> None:
    """A curve, with a band where it is told from where to where.

    Parameters
    ----------
    axes : matplotlib.axes.Axes
    look : dict
    x, y : (n,) array_like
    low, high : (n,) array_like, optional
    label : str, optional
        For a legend.
    """
    if low is not None and high is not None:
        axes.fill_between(x, low, high, color=look["color"], alpha=0.18, linewidth=0.0)
    axes.plot(x, y, label=label, **{"markersize": 3.5, "clip_on": False, "zorder": 4.0, **look})


def strips(
    axes: Axes, edges: ArrayLike, holds: ArrayLike, names: Sequence[str], *, size: float = 6.8
) -> None:
    """A line of cells for each name, filled where something holds.

    Parameters
    ----------
    axes : matplotlib.axes.Axes
    edges : (n + 1,) array_like
        Between the cells.
    holds : (m, n) array_like of bool
    names : sequence of str
        Of the m lines, from above.
    size : float
        Of the names [point].
    """
    axes.pcolormesh(
        np.asarray(edges),
        np.arange(len(names) + 1) - 0.5,
        np.asarray(holds, dtype=np.float64),
        cmap=ListedColormap(["#ECECEC", FOLLOWER]),
        vmin=0.0,
        vmax=1.0,
        edgecolor="white",
        linewidth=0.25,
    )
    name_lines(axes, names)
    axes.grid(visible=False)
    axes.tick_params(axis="y", labelsize=size)


def reliability(found: Mapping[str, ArrayLike]) -> Figure:
    """What was predicted and what came, with the number of cases below: a column for each.

    On the broken line both agree.

    Parameters
    ----------
    found : mapping of str to (n, 3) array_like
        By title: of cases whose predicted probabilities are alike the mean of those, the share that
        came true, and how many there are.
    """
    most = 1.0
    figure, grid = panels(2, len(found), 4.6, sharex=True, sharey="row", height_ratios=(2.6, 1.0))
    for (above, below), (title, bins) in zip(grid.T, found.items(), strict=True):
        predicted, observed, cases = np.asarray(bins, dtype=np.float64).reshape(-1, 3).T
        above.plot([0, 100], [0, 100], color=SOFT, linewidth=0.8, linestyle=_DASHES)
        curves(above, {**OURS, "markersize": 5.0}, 100.0 * predicted, 100.0 * observed)
        above.set_title(title, fontsize=7.5)
        most = max(most, float(cases.max(initial=1.0)))
        middle = 10.0 * np.minimum(10.0 * predicted // 1.0, 9.0) + 5.0
        bars = below.bar(middle, cases, width=8.6, color=FOLLOWER, alpha=0.55)
        below.bar_label(bars, [f"{n:,.0f}" for n in cases], padding=1.5, fontsize=6.0)
        below.set_xlabel("predicted [%]")
    most = max(
        float(np.asarray(bins).reshape(-1, 3)[:, 2].max(initial=1.0)) for bins in found.values()
    )
    grid[0, 0].set(xlim=(-4.0, 104.0), ylim=(-4.0, 104.0), ylabel="came true [%]")
    grid[1, 0].set(yscale="log", ylim=(0.7, 6.0 * most), ylabel="cases")
    grid[1, 0].minorticks_off()
    figure.align_ylabels(grid[:, 0])
    return figure
