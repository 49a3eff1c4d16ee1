"""Figures of states: where they lie, how one leads to another, and under which action."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import FancyArrowPatch
from numpy.typing import NDArray

from evofsm.model import FSMModel
from evofsm.report.style import (
    DEAD_END,
    FOLLOWER,
    INK,
    LEADER,
    LEADER_DASHES,
    MOST_DISCS,
    WIDTH,
    draw_state,
    stretches,
)
from evofsm.studies.paper import CASES, PaperStudy, Run

_GAP, _FOLLOWER, _LEADER = 0, 1, 2
# Up to so many states a matrix has room for its values.
_MOST_VALUES = 8
# Up to so many states each has its number on an axis.
_MOST_TICKS = 12
_COLORS = "Blues"
_GAP_TICKS = (0, 2, 5, 10, 20, 40, 60, 80, 100, 150, 200, 300, 400)
_PALE, _DARK = "#D5D5D5", "#666666"
_VEIL = 0.4
_COLLISION: dict[str, Any] = {
    "marker": "X",
    "markersize": 8,
    "markeredgecolor": "white",
    "markeredgewidth": 0.7,
}
_END: dict[str, Any] = {"marker": "s", "markersize": 10, "markerfacecolor": "none"}


# -- In the space of observations -------------------------------------------------------------


def draw_space(study: PaperStudy) -> Figure:
    """States and trajectories in (gap, speed), a column for each case."""
    figure = Figure(figsize=(WIDTH, 5.2))
    grid = figure.subplots(
        2,
        len(CASES),
        sharex=True,
        sharey=True,
        gridspec_kw={
            "left": 0.07,
            "right": 0.985,
            "top": 0.88,
            "bottom": 0.09,
            "hspace": 0.07,
            "wspace": 0.07,
        },
    )
    observations = np.concatenate([run.episode.observations for run in study.last_round])
    _scale_space(grid[0, 0], observations)
    for column, run in enumerate(study.last_round):
        for axes, speed in zip(grid[:, column], (_FOLLOWER, _LEADER), strict=True):
            _draw_trajectory(axes, study, run, speed)
            _draw_centers(axes, study, speed)
        grid[0, column].set_title(run.name.capitalize())
        grid[1, column].set_xlabel("gap [m], root scale")
    grid[0, 0].set_ylabel("follower's speed [m/s]")
    grid[1, 0].set_ylabel("leader's speed [m/s]")
    _explain_space(figure, study)
    return figure


def _scale_space(axes: Axes, observations: NDArray[np.float64]) -> None:
    """Limits for all panels; by its root the gap has most room where it is small."""
    axes.set_xscale(
        "function",
        functions=(lambda x: np.sign(x) * np.sqrt(np.abs(x)), lambda x: np.sign(x) * x**2),
    )
    widest = float(observations[:, _GAP].max())
    axes.set_xlim(-0.12, 1.08 * widest)
    axes.set_xticks([tick for tick in _GAP_TICKS if tick <= widest])
    fastest = float(observations[:, 1:].max())
    axes.set_ylim(-0.07 * fastest, 1.1 * fastest)


def _draw_trajectory(axes: Axes, study: PaperStudy, run: Run, speed: int) -> None:
    gap = np.maximum(run.episode.observations[:, _GAP], 0.0)
    v = run.episode.observations[:, speed]
    color = FOLLOWER if speed == _FOLLOWER else LEADER
    axes.plot(gap, v, color=color, linestyle="-" if speed == _FOLLOWER else LEADER_DASHES)
    for first, last in stretches(run.state == study.dead_end):
        rows = slice(first, last + 1)
        axes.plot(
            gap[rows],
            v[rows],
            color=DEAD_END,
            alpha=_VEIL,
            linewidth=5.0,
            zorder=1.8,
            solid_capstyle="butt",
        )
    _draw_direction(axes, gap, v, color)
    axes.plot(
        gap[-1:],
        v[-1:],
        linestyle="none",
        color=INK,
        clip_on=False,
        zorder=7,
        **(_COLLISION if run.episode.collided else _END),
    )


def _draw_direction(axes: Axes, x: NDArray[np.float64], y: NDArray[np.float64], color: str) -> None:
    """Put two arrowheads on a trajectory, at a third and two thirds of its length as drawn."""
    drawn = axes.transData.transform(np.column_stack([x, y]))
    length = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(drawn, axis=0).T))])
    for share in (1 / 3, 2 / 3):
        row = int(np.searchsorted(length, share * length[-1]))
        before = int(np.searchsorted(length, max(share * length[-1] - 4.0, 0.0)))
        if before < row:
            axes.annotate(
                "",
                (x[row], y[row]),
                (x[before], y[before]),
                arrowprops={
                    "arrowstyle": "-|>",
                    "color": color,
                    "linewidth": 1.0,
                    "mutation_scale": 8.0,
                    "shrinkA": 0,
                    "shrinkB": 0,
                },
            )


def _draw_centers(axes: Axes, study: PaperStudy, speed: int) -> None:
    """Draw the centres; where two discs would meet, they move apart and point to their place."""
    centers = study.model.centers[:, (_GAP, speed)]
    places = centers
    numbered = len(centers) <= MOST_DISCS
    if numbered:
        drawn = _move_apart(axes.transData.transform(centers), 9.5 * axes.figure.dpi / 72.0)
        places = axes.transData.inverted().transform(drawn)
    for state, (center, (x, y)) in enumerate(zip(centers, places, strict=True)):
        axes.plot([center[0], x], [center[1], y], color=INK, linewidth=0.6, zorder=4.5)
        axes.plot(*center, marker="o", markersize=1.6, color=INK, zorder=4.5)
        draw_state(axes, x, y, state, study.dead_end, size=8.5, numbered=numbered)


def _move_apart(points: NDArray[np.float64], least: float) -> NDArray[np.float64]:
    """Push points away from each other until no two are closer than ``least``."""
    points = points.copy()
    for _ in range(100):
        quiet = True
        for i in range(len(points)):
            for j in range(i):
                apart = points[i] - points[j]
                distance = float(np.hypot(*apart))
                if distance >= 0.99 * least:
                    continue
                quiet = False
                way = apart / distance if distance > 0.0 else np.array([0.0, 1.0])
                points[i] += 0.5 * (least - distance) * way
                points[j] -= 0.5 * (least - distance) * way
        if quiet:
            break
    return points


def _explain_space(figure: Figure, study: PaperStudy) -> None:
    disc: dict[str, Any] = {"linestyle": "none", "markersize": 7.0}
    entries = {
        "centre of a state": Line2D(
            [], [], marker="o", markerfacecolor="white", markeredgecolor=INK, **disc
        ),
        "end of a run": Line2D([], [], color=INK, linestyle="none", **{**_END, "markersize": 7}),
    }
    if study.dead_end >= 0:
        veil = Line2D([], [], color=DEAD_END, alpha=_VEIL, linewidth=5.0, solid_capstyle="butt")
        entries |= {
            "collision": Line2D([], [], color=INK, linestyle="none", **_COLLISION),
            "the dead end": Line2D([], [], marker="h", color=DEAD_END, **disc),
            "recognised as the dead end": veil,
        }
    figure.legend(
        list(entries.values()),
        list(entries),
        loc="upper left",
        ncols=len(entries),
        bbox_to_anchor=(0.055, 0.995),
        columnspacing=1.4,
        handlelength=1.8,
    )


# -- As a graph -------------------------------------------------------------------------------


def draw_graph(study: PaperStudy) -> Figure:
    """The state graph twice: learnt probabilities, and changes of the recognised state."""
    figure = Figure(figsize=(WIDTH, 3.6))
    learnt, recognised = figure.subplots(
        1,
        2,
        gridspec_kw={"left": 0.0, "right": 1.0, "top": 0.94, "bottom": 0.05, "wspace": 0.0},
    )
    matrix = study.model.averaged_matrix("observed")
    _draw_nodes(learnt, [f"stays {_percent(value)}" for value in np.diag(matrix)], study.dead_end)
    _draw_edges(learnt, matrix, study.dead_end, widest=1.6, strongest=2)
    learnt.set_title("(a) learnt: probability of the next state, per step", x=0.03)
    _note_range(learnt, matrix)

    changes = study.model.changes - np.diag(np.diag(study.model.changes))
    share = study.model.visits / max(float(study.model.visits.sum()), 1.0)
    _draw_nodes(recognised, [f"{_percent(value)} of time" for value in share], study.dead_end)
    _draw_edges(recognised, changes, study.dead_end, widest=3.0, counted=True)
    recognised.set_title(f"(b) recognised: changes of state in {len(study.runs)} runs", x=0.03)
    return figure


def _percent(share: float) -> str:
    return f"{100 * share:.0f} %"


def _place(n: int) -> NDArray[np.float64]:
    """(n, 2) positions on a circle, the first on top, then clockwise."""
    angle = 0.5 * np.pi - 2.0 * np.pi * np.arange(n) / max(n, 1)
    return np.column_stack([np.cos(angle), np.sin(angle)])


def _draw_nodes(axes: Axes, notes: Sequence[str], dead_end: int) -> None:
    numbered = len(notes) <= MOST_DISCS
    for state, ((x, y), note) in enumerate(zip(_place(len(notes)), notes, strict=True)):
        draw_state(axes, x, y, state, dead_end, size=13.0, numbered=numbered)
        if not numbered and state != dead_end:
            note = str(state + 1)
        axes.annotate(
            f"dead end\n{note}" if state == dead_end else note,
            (x, y),
            xytext=(11.0 * x, 11.0 * y),
            textcoords="offset points",
            ha="center" if abs(x) < 0.2 else "left" if x > 0.0 else "right",
            va="center" if abs(y) < 0.5 else "bottom" if y > 0.0 else "top",
            fontsize=7.0 if numbered or state == dead_end else 5.5,
            color=DEAD_END if state == dead_end else INK,
        )
    axes.set_xlim(-1.75, 1.75)
    axes.set_ylim(-1.35, 1.35)
    axes.set_aspect("equal")
    axes.set_axis_off()


def _note_range(axes: Axes, matrix: NDArray[np.float64]) -> None:
    """Write from where to where the probabilities reach."""
    between = matrix[~np.eye(len(matrix), dtype=bool)]
    if len(between):
        axes.annotate(
            f"each arrow: {_percent(between.min())} to {_percent(between.max())}; "
            f"{'dark' if len(matrix) <= MOST_DISCS else 'drawn'}: the two likeliest of each state",
            (0.03, -0.03),
            xycoords="axes fraction",
            fontsize=7.0,
            color=INK,
            annotation_clip=False,
        )


def _draw_edges(
    axes: Axes,
    weights: NDArray[np.float64],
    dead_end: int,
    widest: float,
    strongest: int | None = None,
    counted: bool = False,
) -> None:
    """Draw an arrow from state to state, its width by weight; self-loops are left out.

    With ``strongest`` all but so many arrows of each state are pale.
    """
    n = len(weights)
    places = _place(n)
    between = weights * (1.0 - np.eye(n))
    heaviest = max(float(between.max(initial=0.0)), 1e-12)
    rank = np.argsort(np.argsort(-between, axis=1), axis=1)
    for i, j in np.argwhere(between > 0.005 * heaviest):
        pale = strongest is not None and rank[i, j] >= strongest
        if pale and n > MOST_DISCS:
            continue
        bend = 0.28 / float(np.hypot(*(places[j] - places[i])))
        axes.add_patch(
            FancyArrowPatch(
                places[i],
                places[j],
                connectionstyle=f"arc3,rad={bend}",
                arrowstyle="-|>",
                mutation_scale=6.5,
                shrinkA=7.5,
                shrinkB=8.5,
                linewidth=max(widest * between[i, j] / heaviest, 0.4),
                color=_PALE if pale else DEAD_END if j == dead_end else _DARK,
                zorder=1.5 if pale else 2.0,
            )
        )
        if counted and n <= MOST_DISCS:
            _write_on_arc(axes, places[i], places[j], bend, f"{weights[i, j]:.0f}")


def _write_on_arc(
    axes: Axes, start: NDArray[np.float64], end: NDArray[np.float64], bend: float, text: str
) -> None:
    """Write in the middle of an arrow that is bent by ``bend``."""
    dx, dy = end - start
    x, y = 0.5 * (start + end) + 0.5 * bend * np.array([dy, -dx])
    axes.annotate(
        text,
        (x, y),
        ha="center",
        va="center_baseline",
        fontsize=7.0,
        bbox={"boxstyle": "round,pad=0.12", "facecolor": "white", "edgecolor": "none"},
        zorder=3,
    )


# -- As matrices ------------------------------------------------------------------------------


def draw_matrices(model: FSMModel, dead_end: int) -> Figure:
    """The transition matrix of each action that was used, all on one scale."""
    used = [int(action) for action in np.flatnonzero(model.uses > 0.0)]
    columns = 4
    rows = max(1, math.ceil(len(used) / columns))
    # In inches: the matrices are squares, below a colour bar and a head of two lines each.
    left, gap, head, top, bottom = 0.45, 0.14, 0.36, 0.42, 0.42
    side = (WIDTH - left - 0.05 - (columns - 1) * gap) / columns
    height = top + rows * (side + head) + (rows - 1) * 0.06 + bottom
    figure = Figure(figsize=(WIDTH, height))
    scale = Normalize(0.0, float(model.transition_matrices[used].max(initial=0.0)) or 1.0)
    for number, action in enumerate(used):
        row, column = divmod(number, columns)
        x = left + column * (side + gap)
        y = height - top - (row + 1) * (side + head) - row * 0.06
        axes = figure.add_axes(
            (x / WIDTH, y / height, side / WIDTH, side / height),
        )
        _draw_matrix(axes, model, action, scale)
        _name_states(axes.xaxis, model.n_states, dead_end, number + columns >= len(used))
        _name_states(axes.yaxis, model.n_states, dead_end, column == 0)
        if column == 0:
            axes.set_ylabel("from state")
        if number + columns >= len(used):
            axes.set_xlabel("to state")
    bar = figure.add_axes((left / WIDTH, 1.0 - 0.17 / height, 2.4 / WIDTH, 0.1 / height))
    figure.colorbar(
        ScalarMappable(scale, _COLORS), cax=bar, orientation="horizontal"
    ).outline.set_visible(False)
    bar.grid(False)
    figure.text(
        (left + 2.55) / WIDTH,
        1.0 - 0.12 / height,
        "probability of the next state"
        + (", written in the cells in %" if model.n_states <= _MOST_VALUES else ""),
        va="center",
    )
    return figure


def _draw_matrix(axes: Axes, model: FSMModel, action: int, scale: Normalize) -> None:
    matrix = model.transition_matrices[action]
    axes.imshow(matrix, cmap=_COLORS, norm=scale, interpolation="nearest")
    axes.grid(False)
    for spine in axes.spines.values():
        spine.set_visible(False)
    name = f"a({action + 1})"
    if model.actions is not None:
        name += f"  {model.actions.label(action)}".replace("-", "−") + " m/s²"
    axes.set_title(f"{name}\n{model.uses[action]:,.0f} transitions", fontsize=7.0, pad=3.0)
    if model.n_states > _MOST_VALUES:
        return
    for i, j in np.ndindex(matrix.shape):
        axes.text(
            j,
            i,
            f"{100 * matrix[i, j]:.0f}",
            ha="center",
            va="center_baseline",
            fontsize=5.8,
            color="white" if scale(matrix[i, j]) > 0.68 else INK,
        )


def _name_states(axis: Axis, n: int, dead_end: int, shown: bool) -> None:
    """Put the states' numbers on an axis, the dead end's in its colour."""
    step = math.ceil(n / _MOST_TICKS)
    states = range(0, n, step)
    axis.set_ticks(states, [str(state + 1) for state in states] if shown else [])
    axis.set_tick_params(length=0, labelsize=7.0, pad=2.0)
    for state, label in zip(states, axis.get_ticklabels(), strict=False):
        if state == dead_end:
            label.set_color(DEAD_END)
            label.set_fontweight("bold")
