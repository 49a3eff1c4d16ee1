"""The figures of the closed-loop study: what policies reach, and what learning does to it."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from functools import partial
from itertools import cycle, pairwise

import numpy as np

from evofsm.cli import percent
from evofsm.driving import TOLD
from evofsm.extras import needs
from evofsm.paper.report.drawing import Sketch
from studies.closed_loop.comparison import (
    Line,
    front,
    ours,
    settings,
    table_groups,
    unrevised,
)
from studies.closed_loop.machine import MACHINE
from studies.closed_loop.over_seeds import (
    OURS,
    WINDOW,
    Spread,
    along_stream,
    learning_curve,
)
from studies.closed_loop.stages import SAFE_RATE
from studies.closed_loop.study import ClosedLoop, TradeOff
from studies.policies import Group

with needs("matplotlib", "plot", "drawing figures"):
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.patheffects import withStroke

    from evofsm import plot
    from evofsm.plot import (
        DEAD_END,
        FOLLOWER,
        INK,
        LEADER,
        SOFT,
        Look,
        curves,
        level,
        panels,
        write,
    )

#: A group by colour and by shape, so that neither is needed.
_LOOKS: dict[str, Look] = {
    Group.BOUND: {**plot.PLAIN, "markersize": 6.0},
    Group.FIXED: {**plot.FIXED, "markersize": 4.5},
    Group.TUNED: {"marker": "^", "color": LEADER, "markersize": 6.0},
    Group.MATCHED: {**plot.OTHER, "marker": "D", "markersize": 5.0},
    Group.LEARNT: {**plot.OURS, "markersize": 8.0},
}
_MACHINE: Look = {**plot.OURS, "marker": "s", "markersize": 7.0}
_MACHINE_CURVE: Look = {"color": LEADER, "marker": "s", "linestyle": (0, (4, 1.6))}
_SETTINGS: Look = {**plot.OURS, "linestyle": "-", "linewidth": 1.6, "markersize": 3.0}
_TUNED: Look = {"color": LEADER, "alpha": 0.8, "zorder": 2.0, "marker": "."}
_DASHES = ((0, (4, 1.6)), (0, (1, 1.2)), (0, (5, 1.2, 1, 1.2)))
# Text of what matters less.
_GREY = "#555555"
# Points that are closer share a label [point].
_CLOSE = 5.0
# Distances of a label from its point that are tried, and from which on a thread joins them [point].
_DISTANCES, _FAR = (8.0, 14.0, 22.0, 32.0, 46.0, 62.0, 80.0), 10.0
_PERCENTS = (0, 1, 3, 10, 30, 100)


def sketches(study: ClosedLoop) -> Iterator[Sketch]:
    """The figures that apply."""
    if study.rows:
        yield Sketch(
            "trade-off",
            "Collisions against mobility",
            "Best is the lower right corner. Points: all policies on the held-out episodes, with "
            "95 % intervals; ours is the median over seeds after all training. Solid line: ours "
            f"over its tolerance (the point's is {percent(study.plan.tolerance)}), one seed, on "
            "the first held-out episodes. Broken lines: of the tuned baselines the settings that "
            "none beats on both axes (small dots: the others), on the training episodes they were "
            "tuned on. The vertical scale is linear up to 1 % and logarithmic beyond, to show 0.",
            "Scatter of collision rate over mobility, a named point for each policy.",
            partial(draw_trade_off, study),
        )
    if study.curve:
        yield Sketch(
            "learning",
            "Learning curve",
            f"Tests with learning frozen, on {study.curve[0].held_out:,} held-out episodes each. "
            f"Line: median over {len({one.learning_seed for one in study.curve})} learning seeds; "
            "band: their range. The last panel counts the states of the machine."
            + (
                f" Dashed: {MACHINE}, told {TOLD['learnt']}, on fewer episodes; its states are "
                "made by another rule, and decide nothing."
                if learning_curve(study, MACHINE)
                else ""
            ),
            "Collision rate, mobility and number of states over the number of training episodes.",
            partial(draw_learning, study),
        )
    if study.streams:
        yield Sketch(
            "stream",
            "Collisions along a stream that shifts",
            f"Mean over the last {WINDOW} episodes and at most "
            f"{len({one.learning_seed for one in study.streams})} learning seeds (the mean begins "
            "anew at the shift); band: the middle 80 % of seeds. Nobody is told of the shift. "
            "rss-unchanged is the safe distance, told the limits that were true before it.",
            "Collision rate over the episodes of the stream, a curve for each policy.",
            partial(draw_stream, study),
        )
    if study.reliabilities:
        yield Sketch(
            "reliability",
            "Reliability of the probabilities",
            "Above: of the cases with a predicted probability in each tenth, how many came true. "
            "On the broken line a prediction means what it says; above it, risk is understated. "
            "Below: how many cases there were. Cases of one episode depend on one another.",
            "Reliability diagrams with the number of cases in each bin.",
            lambda: plot.reliability({one.title: one.bins for one in study.reliabilities}),
        )


# -- Collisions against mobility ------------------------------------------------------------------


def draw_trade_off(study: ClosedLoop) -> Figure:
    """Every policy in (mobility, collisions), with intervals, and what settings trade."""
    figure, ((axes,),) = panels(1, 1, 5.2)
    mine = (ours(study), ours(study, policy=MACHINE))
    lines = [
        line
        for _, found in table_groups(study)
        for line in found
        if math.isfinite(line.mobility) and (not line.is_ours or line in mine)
    ]
    # What hardly moves is drawn at the left edge.
    values = [line.mobility_low for line in lines if line.mobility > 0.5]
    values += [p.mobility for p in study.trade_offs if p.policy == OURS and p.mobility > 0.5]
    left = max(0.0, min([0.9, *values]) - 0.04)
    right = max([1.0, *(line.mobility_high for line in lines)]) + 0.04 * (1.0 - left)
    _scale_collisions(axes)
    axes.set(xlim=(left, right), xlabel="mobility: distance, in that of the unrevised driver")
    looks = {str(one): _LOOKS[one] for one in Group if any(line.group == one for line in lines)}
    if any(line.policy == MACHINE for line in lines):
        looks[f"the same, told {TOLD['learnt']}"] = _MACHINE
    dashes = cycle(_DASHES)
    for policy, points in settings(study).items():
        if policy == OURS:
            axes.plot(*_places(points), zorder=3.0, **_SETTINGS)
            looks["ours over its tolerance"] = _SETTINGS
        else:
            axes.plot(*_places(points), linestyle="none", markersize=2.0, **_TUNED)
            broken: Look = {**_TUNED, "linewidth": 0.9, "linestyle": next(dashes)}
            axes.plot(*_places(front(points)), markersize=4.0, **broken)
            looks.setdefault("best of the tuned settings, in training", broken)
    for line in lines:
        _draw_policy(axes, line, left)
    plot.legend(figure, looks, 3)
    figure.draw_without_rendering()  # labels need to know where everything is
    _label_policies(axes, study, lines, left)
    return figure


def _scale_collisions(axes: Axes) -> None:
    """Percent with room for what is rare, and for 0."""
    axes.set_yscale("symlog", linthresh=1.0, linscale=0.7)
    axes.set(ylim=(-0.5, 140.0), ylabel="collisions [% of episodes]")
    axes.set_yticks(_PERCENTS, [str(tick) for tick in _PERCENTS])
    axes.minorticks_off()


def _places(points: Iterable[TradeOff | Line]) -> tuple[list[float], list[float]]:
    """Mobility, and collisions in percent."""
    every = list(points)
    return [p.mobility for p in every], [100.0 * p.collision_rate for p in every]


def _look(line: Line) -> Look:
    return _MACHINE if line.policy == MACHINE else _LOOKS[line.group]


def _draw_policy(axes: Axes, line: Line, left: float) -> None:
    look = _look(line)
    x, y = max(line.mobility, left), 100.0 * line.collision_rate
    if line.mobility >= left:
        bars: Look = {"color": look["color"], "linewidth": 0.8, "alpha": 0.45, "zorder": 2.5}
        axes.hlines(y, line.mobility_low, line.mobility_high, **bars)
        axes.vlines(x, 100.0 * line.collision_low, 100.0 * line.collision_high, **bars)
    edge: Look = {"markeredgecolor": "white", "markeredgewidth": 0.6}
    plot.mark(axes, x, y, zorder=6 if line.is_ours else 5, **edge, **look)


def _label_policies(axes: Axes, study: ClosedLoop, lines: Sequence[Line], left: float) -> None:
    """Name every point; those that lie together share a label."""
    if not lines:
        return
    here = np.column_stack(_places(lines))
    here[:, 0] = np.maximum(here[:, 0], left)
    drawn = plot.in_points(axes, here)
    labels: list[list[int]] = []
    free = list(range(len(lines)))
    while free:
        first = free[0]
        near = [
            i
            for i in free
            if lines[i].is_ours == lines[first].is_ours
            and np.hypot(*(drawn[i] - drawn[first])) < _CLOSE
        ]
        free = [i for i in free if i not in near]
        labels.append(near)
    # Ours first, then those that need most room.
    texts = {near[0]: _names([lines[i] for i in near], left) for near in labels}
    labels.sort(key=lambda near: (not lines[near[0]].is_ours, -len(texts[near[0]])))
    notes = []
    for first, *others in labels:
        line = lines[first]
        same = all(lines[i].group == line.group for i in others)
        color = _look(line)["color"] if same else INK
        look: Look = {"color": _GREY if color == SOFT else color, "linespacing": 1.15, "zorder": 7}
        size, weight = (7.5, "bold") if line.is_ours else (7.0, "normal")
        note = write(axes, texts[first], tuple(here[first]), size=size, fontweight=weight, **look)
        note.set_path_effects([withStroke(linewidth=1.8, foreground="white")])
        note.set_in_layout(False)
        notes.append(note)
    small = np.column_stack(_places(study.trade_offs))
    for one, other in pairwise(np.column_stack(_places(settings(study).get(OURS, ())))):
        small = np.vstack(
            [small, *(one + share * (other - one) for share in (0.1, 0.25, 0.5, 0.75))]
        )
    taken = np.vstack([_boxes(drawn, 4.0), _boxes(plot.in_points(axes, small), 1.5)])
    frame = np.array(axes.get_window_extent().extents) * 72.0 / axes.figure.dpi
    anchors = [drawn[first] for first, *_ in labels]
    around = partial(plot.around, distances=_DISTANCES)
    sizes = plot.place_labels(notes, anchors, around, taken, frame)
    for note, size in zip(notes, sizes, strict=True):
        place = np.array(note.get_position())
        near_by = np.clip(0.0, place - 0.5 * size, place + 0.5 * size)
        if math.hypot(*near_by) > _FAR:
            thread: Look = {"arrowstyle": "-", "color": SOFT, "linewidth": 0.5, "shrinkA": 0}
            write(axes, "", note.xy, tuple(near_by), arrowprops=thread, zorder=4.0)


def _names(lines: Sequence[Line], left: float) -> str:
    return ",\n".join(
        dict.fromkeys(
            f"← {line.policy}: {line.mobility:.2f}" if line.mobility < left else line.policy
            for line in lines
        )
    )


def _boxes(places: plot.Rows, half: float) -> plot.Rows:
    """(n, 4) squares around places (n, 2)."""
    return np.hstack([places - half, places + half])


# -- Learning -------------------------------------------------------------------------------------


def draw_learning(study: ClosedLoop) -> Figure:
    """Collisions, mobility and states over training episodes: median and range over seeds."""
    figure, grid = panels(3, 1, 5.6, sharex=True, height_ratios=(1.3, 1.3, 0.8))
    collisions, mobility, states = grid[:, 0]
    by_policy = [learning_curve(study), learning_curve(study, MACHINE)]
    _scale_collisions(collisions)
    for mine, look in zip(by_policy, (plot.OURS, _MACHINE_CURVE), strict=True):
        if mine:
            at = [stage.episodes for stage in mine]
            _draw_band(collisions, look, at, [stage.collision_rate for stage in mine], 100.0)
            _draw_band(mobility, look, at, [stage.mobility for stage in mine])
            _draw_band(states, look, at, [stage.states for stage in mine])
    stages = [stage for mine in by_policy for stage in mine]
    episodes = sorted({stage.episodes for stage in by_policy[0] or stages})
    _name_level(collisions, 100.0 * SAFE_RATE, f"safe: {percent(SAFE_RATE)}")
    if alone := unrevised(study):
        rate = alone.collision_rate
        _name_level(collisions, 100.0 * rate, f"unrevised: {percent(rate)}")
        _name_level(mobility, alone.mobility, "unrevised")
    values = [1.0, *(m for stage in stages for m in stage.mobility if math.isfinite(m))]
    margin = 0.08 * max(max(values) - min(values), 0.02)
    mobility.set(ylabel="mobility", ylim=(min(values) - margin, max(values) + margin))
    states.set_ylabel("states")
    states.set_ylim(bottom=0.0)
    states.set_xscale("symlog", linthresh=1.0, linscale=0.5)
    states.set_xticks(episodes, [str(k) for k in episodes])
    states.minorticks_off()
    states.set(xlim=(-0.15, 1.08 * max([1, *episodes])), xlabel="training episodes")
    figure.align_ylabels(grid[:, 0])
    return figure


def _draw_band(
    axes: Axes, look: Look, x: Sequence[int], values: Sequence[Spread], scale: float = 1.0
) -> None:
    """Median and range over seeds."""
    low, middle, high = scale * np.array(values).T
    curves(axes, look, x, middle, low, high)


def _name_level(axes: Axes, y: float, text: str) -> None:
    level(axes, y)
    place: Look = {"xycoords": ("axes fraction", "data")}
    write(axes, text, (1.0, y), (4.0, 0.0), color=_GREY, **place)


# -- After a shift --------------------------------------------------------------------------------


def draw_stream(study: ClosedLoop) -> Figure:
    """Collisions along the stream, averaged over episodes and seeds."""
    figure, ((axes,),) = panels(1, 1, 3.1)
    before = study.plan.shift.before
    looks: dict[str, Look] = {
        OURS: {"color": FOLLOWER, "linewidth": 1.6},
        MACHINE: {"color": LEADER, "linewidth": 1.4},
        "rss-unchanged": {"color": DEAD_END, "linestyle": (0, (4, 1.6))},
    }
    streams = along_stream(study)
    last = max(len(stream.mean) for stream in streams)
    notes = []
    for policy, *rates in streams:
        look = looks.get(policy, {"color": SOFT, "linestyle": ":"})
        episode = np.arange(1, len(rates[0]) + 1)
        for part in (slice(0, before), slice(before, None)):
            curves(axes, look, episode[part], *(100.0 * rate[part] for rate in rates))
        weight = "bold" if policy == OURS else "normal"
        end = (last + 0.5, 100.0 * rates[0][-1])
        notes.append(write(axes, policy, end, size=7.5, fontweight=weight, color=look["color"]))
    axes.axvline(before + 0.5, color=INK, linewidth=0.8)
    place: Look = {"xycoords": ("data", "axes fraction"), "ha": "center", "va": "bottom"}
    write(axes, "shift, unsaid", (before + 0.5, 1.0), (0.0, 3.0), size=7.5, **place)
    axes.set(xlim=(0.5, last + 0.5), xlabel="episode of the stream")
    axes.set(ylim=(-3.0, 103.0), ylabel=f"collisions [%], last {WINDOW} episodes")
    figure.draw_without_rendering()
    heights = sorted(np.arange(-60.0, 61.0, 2.0), key=abs)
    plot.place_labels(
        notes,
        plot.in_points(axes, [note.xy for note in notes]),
        lambda width, height: [(5.0 + 0.5 * width, y) for y in heights],
    )
    return figure
