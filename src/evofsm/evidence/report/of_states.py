"""Figures of states: where they lie, how one leads to another, and under which action."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from evofsm.core import FSMModel
from evofsm.evidence.paper.runs import CASES, PaperStudy, Run
from evofsm.plot import (
    COLLISION,
    COLORS,
    DEAD_END,
    FOLLOWER,
    INK,
    LEADER,
    LEADER_DASHES,
    MOST_VALUES,
    WIDTH,
    dead_ends_of,
    draw_centers,
    draw_chain,
    draw_collision,
    draw_matrix,
    label_states,
    name_action,
    percent,
    plot_graph,
    stretches,
)

_GAP, _FOLLOWER, _LEADER = 0, 1, 2
_GAP_TICKS = (0, 2, 5, 10, 20, 40, 60, 80, 100, 150, 200, 300, 400)
_VEIL = 0.4
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
            draw_centers(
                axes, study.model.centers[:, (_GAP, speed)], dead_ends_of(study.dead_end), 8.5
            )
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
    if run.episode.collided:
        draw_collision(axes, float(gap[-1]), float(v[-1]))
    else:
        axes.plot(gap[-1:], v[-1:], linestyle="none", color=INK, clip_on=False, zorder=7, **_END)


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
            "collision": Line2D([], [], color=INK, linestyle="none", **COLLISION),
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
    plot_graph(study.model, learnt, dead_ends=dead_ends_of(study.dead_end))
    learnt.set_title("(a) learnt: probability of the next state, per step", x=0.03)

    changes = study.model.changes - np.diag(np.diag(study.model.changes))
    share = study.model.visits / max(float(study.model.visits.sum()), 1.0)
    notes = [f"{percent(value)} of time" for value in share]
    draw_chain(recognised, changes, notes, dead_ends_of(study.dead_end), widest=3.0, counted=True)
    recognised.set_title(f"(b) recognised: changes of state in {len(study.runs)} runs", x=0.03)
    return figure


# -- As matrices ------------------------------------------------------------------------------


def draw_matrices(model: FSMModel, dead_end: int) -> Figure:
    """The transition matrix of each action that was used, all on one scale."""
    dead_ends = dead_ends_of(dead_end)
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
        draw_matrix(axes, model.transition_matrices[action], scale, size=5.8)
        axes.set_title(name_action(model, action), fontsize=7.0, pad=3.0)
        label_states(axes.xaxis, model.n_states, dead_ends, number + columns >= len(used))
        label_states(axes.yaxis, model.n_states, dead_ends, column == 0)
        if column == 0:
            axes.set_ylabel("from state")
        if number + columns >= len(used):
            axes.set_xlabel("to state")
    bar = figure.add_axes((left / WIDTH, 1.0 - 0.17 / height, 2.4 / WIDTH, 0.1 / height))
    figure.colorbar(
        ScalarMappable(scale, COLORS), cax=bar, orientation="horizontal"
    ).outline.set_visible(False)
    bar.grid(False)
    figure.text(
        (left + 2.55) / WIDTH,
        1.0 - 0.12 / height,
        "probability of the next state"
        + (", written in the cells in %" if model.n_states <= MOST_VALUES else ""),
        va="center",
    )
    return figure
