"""Where texts and marks go so that none hides another; all sizes and places are in points."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.text import Annotation
from numpy.typing import ArrayLike, NDArray

# Cost of a covered area [per point²], where a distance costs 1 [per point].
_COVERED = 20.0

Rows = NDArray[np.float64]


def in_points(axes: Axes, xy: ArrayLike) -> Rows:
    """(n, 2) places of data in points, from the lower left corner of the figure."""
    places = np.asarray(xy, dtype=np.float64).reshape(-1, 2)
    drawn: Rows = axes.transData.transform(places) * 72.0 / axes.figure.dpi
    return drawn


def around(width: float, height: float, distances: Iterable[float]) -> Rows:
    """(k, 2) offsets of the centre of a box that lies at some distances from its anchor."""
    angles = np.radians(
        (90, 270, 0, 180, *(90, 90, 270, 270), *range(45, 360, 90), *range(20, 360, 50))
    )
    ways = np.column_stack([np.cos(angles), np.sin(angles)])
    ends = np.sign(ways.round(9))  # of several ways the box is equally far
    ends[4:8, 0] = (-0.9, 0.9, -0.9, 0.9)  # above and below, to one side
    half = 0.5 * np.array([width, height])
    return np.concatenate([distance * ways + half * ends for distance in distances])


def settle(
    anchors: ArrayLike,
    sizes: ArrayLike,
    offsets: Callable[[float, float], ArrayLike],
    taken: ArrayLike = (),
    frame: ArrayLike | None = None,
) -> Rows:
    """Place boxes one after another, each where it is near its anchor and covers least.

    Parameters
    ----------
    anchors : (n, 2) array_like
        What each box belongs to.
    sizes : (n, 2) array_like
        Width and height of each box.
    offsets : callable
        Returns, for a width and a height, (k, 2) offsets of the centre from the anchor that are
        tried; of several that cost the same the first is taken.
    taken : (m, 4) array_like
        Boxes that must stay free: left, lower, right and upper edge.
    frame : (4,) array_like, optional
        The box to stay within.

    Returns
    -------
    (n, 2) ndarray
        Offsets of the centres from the anchors.

    Examples
    --------
    >>> settle([[0, 0], [1, 0]], [[4, 4], [4, 4]], lambda w, h: [[0, 0], [0, h], [9, 0]]).tolist()
    [[0.0, 0.0], [0.0, 4.0]]
    """
    boxes = np.asarray(taken, dtype=np.float64).reshape(-1, 4)
    found = []
    for anchor, size in zip(np.asarray(anchors), np.asarray(sizes), strict=True):
        tried = np.asarray(offsets(*size), dtype=np.float64)
        centers = anchor + tried
        candidates = np.hstack([centers - 0.5 * size, centers + 0.5 * size])
        cost = np.hypot(*np.maximum(np.abs(tried) - 0.5 * size, 0.0).T)
        cost += _COVERED * _shared(candidates, boxes).sum(axis=1)
        if frame is not None:
            cost -= _COVERED * _shared(candidates, np.array([frame]))[:, 0]
        best = int(np.argmin(cost.round(6)))
        found.append(tried[best])
        boxes = np.vstack([boxes, candidates[best]])
    return np.array(found).reshape(-1, 2)


def _shared(these: Rows, those: Rows) -> Rows:
    """Areas that boxes (k, 4) share with others (m, 4); (k, m)."""
    low = np.maximum(these[:, None, :2], those[:, :2])
    high = np.minimum(these[:, None, 2:], those[:, 2:])
    shared: Rows = np.maximum(high - low, 0.0).prod(axis=2)
    return shared


def place_labels(
    labels: Sequence[Annotation],
    anchors: ArrayLike,
    offsets: Callable[[float, float], ArrayLike],
    taken: ArrayLike = (),
    frame: ArrayLike | None = None,
) -> Rows:
    """Move texts with an offset in points to where `settle` puts them; returns their sizes.

    Their anchors (n, 2) are given in points as well; the texts are centred at their places.
    """
    sizes = np.array([label.get_window_extent().size for label in labels]).reshape(-1, 2)
    sizes *= 72.0 / labels[0].figure.dpi if labels else 1.0
    for label, offset in zip(labels, settle(anchors, sizes, offsets, taken, frame), strict=True):
        label.set(position=offset, ha="center", va="center")
    return sizes
