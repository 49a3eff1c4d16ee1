"""The figures of the closed-loop study: what policies reach, and what learning does to it."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from itertools import cycle, pairwise
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patheffects import withStroke
from matplotlib.transforms import Bbox

from evofsm.app import count, percent
from evofsm.driving import Group
from evofsm.evidence.closed_loop.calibration import Reliability
from evofsm.evidence.closed_loop.comparison import (
    Line,
    front,
    ours,
    settings,
    table_groups,
    unrevised,
)
from evofsm.evidence.closed_loop.over_seeds import (
    OURS,
    WINDOW,
    Spread,
    along_stream,
    learning_curve,
)
from evofsm.evidence.closed_loop.study import SAFE_RATE, ClosedLoop, TradeOff
from evofsm.plot import DEAD_END, FIRST, FOLLOWER, INK, LEADER, SOFT, WIDTH

#: A group by colour and by shape, so that neither is needed.
_LOOKS: dict[str, dict[str, Any]] = {
    Group.BOUND: {"marker": "X", "color": SOFT, "markersize": 6.0},
    Group.FIXED: {"marker": "s", "color": DEAD_END, "markersize": 4.5},
    Group.TUNED: {"marker": "^", "color": LEADER, "markersize": 6.0},
    Group.MATCHED: {"marker": "D", "color": FIRST, "markersize": 5.0},
    Group.LEARNT: {"marker": "o", "color": FOLLOWER, "markersize": 8.0},
}
_DASHES: tuple[Any, ...] = ((0, (4, 1.6)), (0, (1, 1.2)), (0, (5, 1.2, 1, 1.2)))
# Of a letter and of a line, for a first guess at where a text ends [point].
_LETTER, _ROW = 3.8, 8.6
# Where a label may stand [degree], and how far to the side of that.
_DIRECTIONS = (
    *((angle, 0) for angle in (90, 270, 0, 180)),
    *((angle, aside) for angle in (90, 270) for aside in (-1, 1)),
    *((angle, 0) for angle in (45, 135, 225, 315, 20, 160, 200, 340, 70, 110)),
)
# Points that are closer share a label [point].
_CLOSE = 5.0
_PERCENTS = (0, 1, 3, 10, 30, 100)


# -- Collisions against mobility ------------------------------------------------------------------


def draw_trade_off(study: ClosedLoop) -> Figure:
    """Every policy in (mobility, collisions), with intervals, and what settings trade."""
    figure = Figure(figsize=(WIDTH, 5.2))
    axes = figure.add_axes((0.085, 0.09, 0.895, 0.79))
    mine = ours(study)
    lines = [
        line
        for _, found in table_groups(study)
        for line in found
        if math.isfinite(line.mobility) and (not line.is_ours or line == mine)
    ]
    _scale_collisions(axes)
    low = _left_end(study, lines)
    axes.set_xlim(low, max([1.0, *(line.mobility_high for line in lines)]) + 0.04 * (1.0 - low))
    axes.set_xlabel("mobility: distance, in that of the unrevised driver")
    _draw_settings(axes, study)
    for line in lines:
        _draw_policy(axes, line, low)
    _label_policies(axes, study, lines, low)
    _explain_groups(figure, study, lines)
    return figure


def _scale_collisions(axes: Axes) -> None:
    """Percent with room for what is rare, and for 0."""
    axes.set_yscale("symlog", linthresh=1.0, linscale=0.7)
    axes.set_ylim(-0.5, 140.0)
    axes.set_yticks(_PERCENTS, [str(tick) for tick in _PERCENTS])
    axes.minorticks_off()
    axes.set_ylabel("collisions [% of episodes]")


def _left_end(study: ClosedLoop, lines: Sequence[Line]) -> float:
    """Where the axis begins: what hardly moves is drawn at its edge."""
    values = [line.mobility_low for line in lines if line.mobility > 0.5]
    values += [p.mobility for p in study.trade_offs if p.policy == OURS and p.mobility > 0.5]
    return max(0.0, min([0.9, *values]) - 0.04)


def _draw_settings(axes: Axes, study: ClosedLoop) -> None:
    dashes = cycle(_DASHES)
    for policy, points in settings(study).items():
        if policy == OURS:
            look: dict[str, Any] = {"color": FOLLOWER, "linewidth": 1.6, "markersize": 3.0}
            axes.plot(*_places(points), marker="o", zorder=3.0, **look)
        else:
            look = {"color": LEADER, "alpha": 0.8, "zorder": 2.0, "marker": "."}
            axes.plot(*_places(points), linestyle="none", markersize=2.0, **look)
            line = {"linewidth": 0.9, "linestyle": next(dashes), "markersize": 4.0}
            axes.plot(*_places(front(points)), **line, **look)


def _places(points: Iterable[TradeOff]) -> tuple[list[float], list[float]]:
    """Mobility, and collisions in percent."""
    return [p.mobility for p in points], [100.0 * p.collision_rate for p in points]


def _draw_policy(axes: Axes, line: Line, left: float) -> None:
    look = _LOOKS[line.group]
    x, y = max(line.mobility, left), 100.0 * line.collision_rate
    beyond = line.mobility < left
    if not beyond:
        axes.errorbar(
            [x],
            [y],
            xerr=[[max(x - line.mobility_low, 0.0)], [max(line.mobility_high - x, 0.0)]],
            yerr=[[y - 100.0 * line.collision_low], [100.0 * line.collision_high - y]],
            fmt="none",
            ecolor=look["color"],
            elinewidth=0.8,
            alpha=0.45,
            zorder=2.5,
        )
    axes.plot(
        [x],
        [y],
        linestyle="none",
        markeredgecolor="white",
        markeredgewidth=0.6,
        zorder=6 if line.is_ours else 5,
        clip_on=False,
        **look,
    )


class _Label(NamedTuple):
    """A text for points that lie together."""

    x: float
    y: float
    text: str
    color: str
    bold: bool


def _label_policies(axes: Axes, study: ClosedLoop, lines: Sequence[Line], left: float) -> None:
    """Name every point; those that lie together share a label."""
    labels: list[_Label] = []
    here = np.array([(max(line.mobility, left), 100.0 * line.collision_rate) for line in lines])
    if not len(here):
        return
    scale = 72.0 / axes.figure.dpi
    drawn = axes.transData.transform(here) * scale
    free = list(range(len(lines)))
    while free:
        first = free[0]
        near = [i for i in free if np.hypot(*(drawn[i] - drawn[first])) < _CLOSE]
        near = [i for i in near if lines[i].is_ours == lines[first].is_ours]
        free = [i for i in free if i not in near]
        names = [_point_name(lines[i], left) for i in near]
        same = len({lines[i].group for i in near}) == 1
        labels.append(
            _Label(
                float(drawn[first, 0]),
                float(drawn[first, 1]),
                ",\n".join(dict.fromkeys(names)),
                _LOOKS[lines[first].group]["color"] if same else INK,
                lines[first].is_ours,
            )
        )
    places = list(zip(*_places(study.trade_offs), strict=True))
    own = zip(*_places(settings(study).get(OURS, ())), strict=True)
    places += [
        (x0 + share * (x1 - x0), y0 + share * (y1 - y0))
        for (x0, y0), (x1, y1) in pairwise(own)
        for share in (0.1, 0.25, 0.5, 0.75)
    ]
    small = axes.transData.transform(places) * scale if places else np.empty((0, 2))
    boxes = [Bbox.from_bounds(x - 4.0, y - 4.0, 8.0, 8.0) for x, y in drawn]
    boxes += [Bbox.from_bounds(x - 1.5, y - 1.5, 3.0, 3.0) for x, y in small]
    frame = axes.get_window_extent()
    frame = Bbox(frame.get_points() * scale)
    # Ours first, then those with least room.
    for label in sorted(labels, key=lambda one: (not one.bold, -len(one.text))):
        boxes.append(_put(axes, label, boxes, frame, scale))


def _point_name(line: Line, left: float) -> str:
    beyond = line.mobility < left
    return f"← {line.policy}: {line.mobility:.2f}" if beyond else line.policy


def _put(axes: Axes, label: _Label, taken: Sequence[Bbox], frame: Bbox, scale: float) -> Bbox:
    """Write a label as near as there is room, with a thread to its point where that is far."""
    rows = label.text.split("\n")
    width = (_LETTER + 1.1 * label.bold) * max(len(row) for row in rows)
    height = _ROW * len(rows)
    best, cost = Bbox.null(), math.inf
    for distance in (8.0, 14.0, 22.0, 32.0, 46.0, 62.0, 80.0):
        for angle, aside in _DIRECTIONS:
            across, up = math.cos(math.radians(angle)), math.sin(math.radians(angle))
            x = label.x + distance * across + 0.5 * width * (across - 1.0)
            x += aside * (0.5 * width - 4.0)
            y = label.y + distance * up + 0.5 * height * (up - 1.0)
            box = Bbox.from_bounds(x, y, width, height)
            overlap = sum(_shared(box, other) for other in taken)
            outside = width * height - _shared(box, frame)
            worse = distance + 20.0 * overlap + 20.0 * outside
            if worse < cost:
                best, cost = box, worse
    x, y = axes.transData.inverted().transform((label.x / scale, label.y / scale))
    here = (float(x), float(y))
    near_x, near_y = min(max(label.x, best.x0), best.x1), min(max(label.y, best.y0), best.y1)
    if math.hypot(near_x - label.x, near_y - label.y) > 10.0:
        axes.annotate(
            "",
            here,
            (near_x - label.x, near_y - label.y),
            textcoords="offset points",
            arrowprops={"arrowstyle": "-", "color": SOFT, "linewidth": 0.5, "shrinkA": 0},
            zorder=4.0,
        )
    axes.annotate(
        label.text,
        here,
        (0.5 * (best.x0 + best.x1) - label.x, 0.5 * (best.y0 + best.y1) - label.y),
        textcoords="offset points",
        ha="center",
        va="center",
        fontsize=7.5 if label.bold else 7.0,
        fontweight="bold" if label.bold else "normal",
        color=label.color if label.color != SOFT else "#555555",
        linespacing=1.15,
        path_effects=[withStroke(linewidth=1.8, foreground="white")],
        zorder=7,
        annotation_clip=False,
    )
    return best


def _shared(one: Bbox, other: Bbox) -> float:
    """Area of what two boxes share."""
    both = Bbox.intersection(one, other)
    return float(both.width * both.height) if both is not None else 0.0


def _explain_groups(figure: Figure, study: ClosedLoop, lines: Sequence[Line]) -> None:
    handles = {
        str(group): Line2D([], [], linestyle="none", **_LOOKS[group])
        for group in Group
        if any(line.group == group for line in lines)
    }
    policies = set(settings(study))
    if OURS in policies:
        handles["ours over its tolerance"] = Line2D(
            [], [], color=FOLLOWER, linewidth=1.6, marker="o", markersize=3.0
        )
    if policies - {OURS}:
        handles["best of the tuned settings, in training"] = Line2D(
            [], [], color=LEADER, linewidth=0.8, linestyle=_DASHES[0], marker=".", markersize=2.5
        )
    figure.legend(
        list(handles.values()),
        list(handles),
        loc="upper left",
        bbox_to_anchor=(0.075, 0.995),
        ncols=3,
        columnspacing=1.4,
        handletextpad=0.5,
    )


# -- Learning -------------------------------------------------------------------------------------


def draw_learning(study: ClosedLoop) -> Figure:
    """Collisions, mobility and states over training episodes: median and range over seeds."""
    figure = Figure(figsize=(WIDTH, 5.6))
    panels: Sequence[Axes] = figure.subplots(
        3,
        1,
        sharex=True,
        gridspec_kw={
            "left": 0.095,
            "right": 0.86,
            "top": 0.985,
            "bottom": 0.075,
            "hspace": 0.12,
            "height_ratios": (1.3, 1.3, 0.8),
        },
    )
    collisions, mobility, states = panels
    stages = learning_curve(study)
    episodes = [stage.episodes for stage in stages]
    _scale_collisions(collisions)
    _draw_band(collisions, episodes, [stage.collision_rate for stage in stages], 100.0)
    _draw_band(mobility, episodes, [stage.mobility for stage in stages])
    _draw_band(states, episodes, [stage.states for stage in stages])
    _draw_level(collisions, 100.0 * SAFE_RATE, f"safe: {percent(SAFE_RATE)}")
    alone = unrevised(study)
    if alone:
        _draw_level(
            collisions,
            100.0 * alone.collision_rate,
            f"unrevised: {percent(alone.collision_rate)}",
        )
        _draw_level(mobility, alone.mobility, "unrevised")
    mobility.set_ylabel("mobility")
    mobility.set_ylim(*_with_margin([1.0, *(m for stage in stages for m in stage.mobility)]))
    states.set_ylabel("states")
    states.set_ylim(bottom=0.0)
    states.set_xscale("symlog", linthresh=1.0, linscale=0.5)
    states.set_xticks(episodes, [str(k) for k in episodes])
    states.minorticks_off()
    states.set_xlim(-0.15, 1.08 * max([1, *episodes]))
    states.set_xlabel("training episodes")
    figure.align_ylabels(panels)
    return figure


def _draw_band(
    axes: Axes, x: Sequence[float], values: Iterable[Spread], scale: float = 1.0
) -> None:
    """Median and range over seeds."""
    low, middle, high = scale * np.array(list(values)).T
    axes.fill_between(x, low, high, color=FOLLOWER, alpha=0.2, linewidth=0.0)
    axes.plot(x, middle, color=FOLLOWER, marker="o", markersize=3.5, clip_on=False, zorder=4)


def _draw_level(axes: Axes, y: float, text: str) -> None:
    axes.axhline(y, color=SOFT, linewidth=0.8, linestyle=(0, (4, 2)), zorder=1.5)
    axes.annotate(
        text,
        (1.0, y),
        xycoords=("axes fraction", "data"),
        xytext=(4, 0),
        textcoords="offset points",
        va="center",
        fontsize=7.0,
        color="#555555",
        annotation_clip=False,
    )


def _with_margin(values: Iterable[float]) -> tuple[float, float]:
    found = [value for value in values if math.isfinite(value)] or [0.0, 1.0]
    margin = 0.08 * max(max(found) - min(found), 0.02)
    return min(found) - margin, max(found) + margin


# -- After a shift --------------------------------------------------------------------------------


def draw_stream(study: ClosedLoop) -> Figure:
    """Collisions along the stream, averaged over episodes and seeds."""
    figure = Figure(figsize=(WIDTH, 3.1))
    axes = figure.add_axes((0.085, 0.14, 0.78, 0.77))
    before = study.plan.shift.before
    looks: dict[str, dict[str, Any]] = {
        OURS: {"color": FOLLOWER, "linestyle": "-", "linewidth": 1.6},
        "rss-unchanged": {"color": DEAD_END, "linestyle": (0, (4, 1.6))},
    }
    ends: list[tuple[float, str, str]] = []
    streams = along_stream(study)
    for policy, mean, low, high in streams:
        look = looks.get(policy, {"color": SOFT, "linestyle": ":"})
        episode = np.arange(1, len(mean) + 1)
        for part in (slice(0, before), slice(before, None)):
            axes.fill_between(
                episode[part],
                100.0 * low[part],
                100.0 * high[part],
                facecolor=look["color"],
                alpha=0.16,
                linewidth=0.0,
            )
            axes.plot(episode[part], 100.0 * mean[part], **look)
        ends.append((100.0 * float(mean[-1]), policy, look["color"]))
    _label_ends(axes, ends)
    axes.axvline(before + 0.5, color=INK, linewidth=0.8)
    axes.annotate(
        "shift, unsaid",
        (before + 0.5, 1.0),
        xycoords=("data", "axes fraction"),
        xytext=(0, 3),
        textcoords="offset points",
        ha="center",
        fontsize=7.5,
    )
    axes.set_ylim(-3.0, 103.0)
    axes.set_xlim(0.5, max(len(stream.mean) for stream in streams) + 0.5)
    axes.set_xlabel("episode of the stream")
    axes.set_ylabel(f"collisions [%], last {WINDOW} episodes")
    return figure


def _label_ends(axes: Axes, ends: Sequence[tuple[float, str, str]]) -> None:
    """Name lines at their right ends, no two names on one another."""
    place = -math.inf
    for y, text, color in sorted(ends):
        place = max(y, place + 7.0)
        axes.annotate(
            text,
            (1.0, place),
            xycoords=("axes fraction", "data"),
            xytext=(5, 0),
            textcoords="offset points",
            va="center",
            fontsize=7.5,
            fontweight="bold" if text == OURS else "normal",
            color=color,
            annotation_clip=False,
        )


# -- Calibration ----------------------------------------------------------------------------------


def draw_reliability(found: Sequence[Reliability]) -> Figure:
    """What was predicted and what came, with the number of cases below."""
    figure = Figure(figsize=(WIDTH, 4.6))
    grid = figure.subplots(
        2,
        len(found),
        sharex=True,
        squeeze=False,
        gridspec_kw={
            "left": 0.085,
            "right": 0.985,
            "top": 0.90,
            "bottom": 0.095,
            "hspace": 0.09,
            "wspace": 0.16,
            "height_ratios": (2.6, 1.0),
        },
    )
    most = max(max((one.cases for one in each.bins), default=1) for each in found)
    for column, one in enumerate(found):
        _draw_diagram(grid[0, column], one)
        _draw_cases(grid[1, column], one, most)
    grid[0, 0].set_ylabel("came true [%]")
    grid[1, 0].set_ylabel("cases")
    figure.align_ylabels(grid[:, 0])
    return figure


def _draw_diagram(axes: Axes, one: Reliability) -> None:
    axes.plot([0, 100], [0, 100], color=SOFT, linewidth=0.8, linestyle=(0, (4, 2)))
    axes.annotate(
        "perfect", (72, 72), xytext=(4, -10), textcoords="offset points", fontsize=7, color=SOFT
    )
    axes.plot(
        [100.0 * each.predicted for each in one.bins],
        [100.0 * each.observed for each in one.bins],
        color=FOLLOWER,
        marker="o",
        markersize=5.0,
        clip_on=False,
        zorder=4,
    )
    axes.set_ylim(-4.0, 104.0)
    axes.set_xlim(-4.0, 104.0)
    axes.set_title(
        f"{one.what[:1].upper()}{one.what[1:]}\nBrier {one.brier:.3f}, of the base rate "
        f"{one.base_brier:.3f}",
        fontsize=7.5,
    )


def _draw_cases(axes: Axes, one: Reliability, most: int) -> None:
    x = [10.0 * min(int(10.0 * each.predicted), 9) + 5.0 for each in one.bins]
    y = [each.cases for each in one.bins]
    axes.bar(x, y, width=8.6, color=FOLLOWER, alpha=0.55)
    for place, cases in zip(x, y, strict=True):
        axes.annotate(
            count(cases),
            (place, cases),
            xytext=(0, 1.5),
            textcoords="offset points",
            ha="center",
            fontsize=6.0,
        )
    axes.set_yscale("log")
    axes.set_ylim(0.7, 6.0 * most)
    axes.minorticks_off()
    axes.set_xlabel("predicted [%]")
