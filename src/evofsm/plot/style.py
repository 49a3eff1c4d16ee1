"""What all figures share: size, type, colours, and how a state looks."""

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
from numpy.typing import NDArray

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
FIRST = "#CC79A7"
#: Dashes of the leader's lines; the follower's are solid.
LEADER_DASHES = (0, (4, 1.6))

#: How a collision is marked.
COLLISION: Mapping[str, Any] = {
    "marker": "X",
    "markersize": 8,
    "markeredgecolor": "white",
    "markeredgewidth": 0.7,
}

#: Beyond so many states they are drawn as dots, without numbers.
MOST_DISCS = 20

_SETTINGS: Mapping[str, Any] = {
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
    """Write a figure as PNG and SVG; answers the paths by format."""
    paths = {kind: folder / f"{name}.{kind}" for kind in ("png", "svg")}
    figure.savefig(paths["png"], dpi=DPI)
    figure.savefig(paths["svg"], metadata={"Date": None})
    return paths


def label_of(state: int) -> str:
    """A state's name as people read it, counted from 1."""
    return f"#{state + 1}"


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


def dead_ends_of(dead_end: int) -> tuple[int, ...]:
    """The dead end of a study that has at most one, as those to mark; -1 stands for none."""
    return (dead_end,) if dead_end >= 0 else ()


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
    axes.plot(
        [x],
        [y],
        linestyle="none",
        marker="h" if dead_end else "o",
        markersize=(1.18 if dead_end else 1.0) * (size if numbered else 0.35 * size),
        markerfacecolor=DEAD_END if dead_end else "white",
        markeredgecolor=DEAD_END if dead_end else INK,
        markeredgewidth=0.8,
        clip_on=False,
        zorder=5.5 if dead_end else 5.0,
    )
    if numbered:
        axes.annotate(
            str(state + 1),
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
    axes.plot([x], [y], linestyle="none", color=INK, clip_on=False, zorder=7, **COLLISION)


def stretches(mask: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """First and last row of each stretch of rows in which ``mask`` holds."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(np.int8)))
    return [(int(first), int(end) - 1) for first, end in edges.reshape(-1, 2)]
