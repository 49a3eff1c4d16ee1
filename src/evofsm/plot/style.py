"""What all figures share: size, type, colours, and how a state looks.

The same colours stand in ``io/graphs.py`` and ``cli/watch/live/page.css``.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import matplotlib.style
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_hex, to_rgb
from matplotlib.figure import Figure
from matplotlib.text import Annotation
from numpy.typing import NDArray

#: How something is drawn, as matplotlib is told.
Look = dict[str, Any]

#: Width of every figure [inch]: that of a page's text.
WIDTH = 7.2
DPI = 160

# Okabe and Ito's colours, which colour-blind readers can tell apart. None stands alone: lines
# differ in dashes, marks in shape or label.
INK = "#222222"
SOFT = "#777777"
FOLLOWER = "#0072B2"
LEADER = "#009E73"
DEAD_END = "#D55E00"
THIRD = "#CC79A7"
#: Dashes of the leader's lines; the follower's are solid.
LEADER_DASHES = (0, (4, 1.6))

#: How a collision is marked.
COLLISION_MARK: Mapping[str, Any] = {
    "marker": "X",
    "markersize": 8,
    "markeredgecolor": "white",
    "markeredgewidth": 0.7,
}

#: Beyond so many states they are drawn as dots, without numbers.
MOST_DISCS = 20

_SETTINGS: Mapping[str, Any] = {
    "figure.dpi": DPI,  # as it is saved: texts are as wide when they are placed
    "font.family": "DejaVu Sans",  # comes with matplotlib: looks the same everywhere
    "font.size": 8.0,
    "text.color": INK,
    "axes.edgecolor": "#444444",
    "axes.labelcolor": INK,
    "axes.linewidth": 0.6,
    "axes.labelsize": 8.0,
    "axes.titlesize": 8.5,
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.unicode_minus": True,
    "grid.color": "#E4E4E4",
    "grid.linewidth": 0.5,
    "xtick.color": "#444444",
    "ytick.color": "#444444",
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "xtick.labelsize": 7.5,
    "ytick.labelsize": 7.5,
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "xtick.major.size": 2.5,
    "ytick.major.size": 2.5,
    "lines.linewidth": 1.2,
    "legend.frameon": False,
    "legend.fontsize": 7.5,
    "legend.handlelength": 2.4,
    "legend.borderaxespad": 0.2,
    "hatch.linewidth": 0.5,
    "path.simplify_threshold": 0.2,
    "svg.hashsalt": "evofsm",  # the same study gives the same file
}


@contextmanager
def house_style() -> Iterator[None]:
    """Draw in this style, whatever the user's is; theirs stands again afterwards."""
    with matplotlib.style.context(["default", dict(_SETTINGS)]):
        yield


def save(figure: Figure, folder: Path, name: str) -> dict[str, Path]:
    """Write a figure as PNG and SVG; returns the paths by format."""
    paths = {kind: folder / f"{name}.{kind}" for kind in ("png", "svg")}
    figure.savefig(paths["png"], dpi=DPI)
    figure.savefig(paths["svg"], metadata={"Date": None})
    return paths


def label_of(state: int) -> str:
    """A state's name in text, counted from 1.

    >>> label_of(3)
    '#4'
    """
    return f"#{state + 1}"


def name_of(action: int) -> str:
    """An action's name in text, counted from 1.

    >>> name_of(16)
    'a(17)'
    """
    return f"a({action + 1})"


def points(size: float) -> float:
    """A size of type that is ``size`` points in this style, in the style that holds [point]."""
    return size * float(matplotlib.rcParams["font.size"]) / float(_SETTINGS["font.size"])


def ink(share: float = 1.0) -> str:
    """The colour of type in the style that holds, of which a share is left on its ground."""
    pairs = zip(
        to_rgb(matplotlib.rcParams["text.color"]),
        to_rgb(matplotlib.rcParams["axes.facecolor"]),
        strict=True,
    )
    red, green, blue = (share * type_ + (1.0 - share) * ground for type_, ground in pairs)
    return to_hex((red, green, blue))


def write(
    axes: Axes,
    text: str,
    xy: tuple[float, float],
    offset: tuple[float, float] = (0.0, 0.0),
    *,
    size: float = 7.0,
    **look: Any,
) -> Annotation:
    """Write beside a place, ``offset`` points from it, in type of a size of this style."""
    given = {"textcoords": "offset points", "annotation_clip": False, "va": "center", **look}
    return axes.annotate(text, xy, xytext=offset, fontsize=points(size), **given)


def mark(axes: Axes, x: float, y: float, **look: Any) -> None:
    """Mark a place, beyond the edge of the axes as well."""
    axes.plot([x], [y], **{"linestyle": "none", "clip_on": False, **look})


def draw_state(
    axes: Axes,
    x: float,
    y: float,
    state: int,
    size: float,
    *,
    dead_end: bool = False,
    numbered: bool = True,
) -> None:
    """Draw a state: a disc, or a filled hexagon for a dead end; the latter is always numbered."""
    numbered = numbered or dead_end
    color = DEAD_END if dead_end else INK
    mark(
        axes,
        x,
        y,
        marker="h" if dead_end else "o",
        markersize=(1.18 if dead_end else 1.0) * (size if numbered else 0.35 * size),
        markerfacecolor=DEAD_END if dead_end else "white",
        markeredgecolor=color,
        markeredgewidth=0.8,
        zorder=5.5 if dead_end else 5.0,
    )
    if numbered:
        axes.annotate(
            label_of(state)[1:],
            (x, y),
            ha="center",
            va="center_baseline",
            fontsize=min(0.72 * size, 8.5),
            fontweight="bold",
            color="white" if dead_end else INK,
            zorder=6,
            annotation_clip=False,
        )


def draw_collision(axes: Axes, x: float, y: float) -> None:
    """Mark where a run ended in a collision."""
    mark(axes, x, y, color=INK, zorder=7, **COLLISION_MARK)


def stretches(mask: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """First and last row of each stretch of rows in which ``mask`` holds."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(np.int8)))
    return [(int(first), int(end) - 1) for first, end in edges.reshape(-1, 2)]
