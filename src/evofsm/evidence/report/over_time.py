"""Figures of runs: what happened in each case, how well it was foreseen, how states came."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from evofsm.driving import is_dead_end
from evofsm.evidence.paper.claims import LARGEST_DIVERGENCE
from evofsm.evidence.paper.runs import CASES, Founding, PaperStudy, Run
from evofsm.plot import (
    DEAD_END,
    FIRST,
    FOLLOWER,
    INK,
    LEADER,
    LEADER_DASHES,
    MOST_DISCS,
    SOFT,
    WIDTH,
    dead_ends_of,
    draw_collision,
    draw_state,
    name_rows,
    stretches,
)

# Height of a line of text [point], and width of a letter [inch].
_ROW = 10.0
_LETTER = 0.062
_VEIL = 0.09


class _Moment(NamedTuple):
    """Something that happens once in a run."""

    time: float
    text: str
    line: str  # dashes
    weight: str = "normal"


# -- Result of a case -------------------------------------------------------------------------


def draw_case(study: PaperStudy, run: Run) -> Figure:
    """Gap, speeds, acceleration, recognised state and action of one run, over time."""
    figure = Figure(figsize=(WIDTH, 7.4))
    panels: Sequence[Axes] = figure.subplots(
        5,
        1,
        sharex=True,
        gridspec_kw={
            "left": 0.105,
            "right": 0.91,
            "top": 0.915,
            "bottom": 0.06,
            "hspace": 0.13,
            "height_ratios": (1.2, 1.2, 1.0, 1.2, 1.0),
        },
    )
    gap, speeds, acceleration, state, action = panels
    _draw_gap(gap, run)
    _draw_speeds(speeds, study, run)
    _draw_acceleration(acceleration, study, run)
    _draw_states(state, study, run)
    _draw_actions(action, study, run)
    action.set_xlabel("time [s]")
    action.set_xlim(0.0, study.settings.scenario.duration)
    moments = _moments(study, run)
    for axes in panels:
        _shade(axes, run, in_dead_end(study, run))
        _draw_moments(axes, moments)
    _label_moments(gap, moments)
    figure.align_ylabels(panels)
    figure.text(0.105, 0.985, title_of(study, run), va="top", fontsize=9.0, fontweight="bold")
    if in_dead_end(study, run).any():
        _explain_shade(figure, study)
    return figure


def title_of(study: PaperStudy, run: Run) -> str:
    """The name of a run and how its follower drives."""
    manners = ("aggressive", "normal") if run.case in (1, 3) else ("normal", "aggressive")
    change = study.settings.switch_at.get(run.case)
    manner = f"{manners[0]} driver"
    if change is not None:
        manner += f", {manners[1]} from {change:g} s"
    return f"{run.name.capitalize()}: {manner}"


def _explain_shade(figure: Figure, study: PaperStudy) -> None:
    patch = Patch(facecolor=DEAD_END, alpha=2.0 * _VEIL, linewidth=0.0)
    text = (
        f"dead end: if the leader braked now ({study.settings.scenario.leader.brake_decel:g} "
        f"m/s²),\neven full braking ({study.settings.decel:g} m/s²) would be too late"
    )
    figure.legend(
        [patch], [text], loc="upper right", bbox_to_anchor=(0.99, 0.995), handlelength=1.6
    )


def _draw_gap(axes: Axes, run: Run) -> None:
    episode = run.episode
    gap = episode.observations[:, 0]
    axes.plot(episode.time, gap, color=INK)
    axes.set_ylim(0.0, 1.08 * gap.max())
    if episode.collided:
        draw_collision(axes, float(episode.time[-1]), 0.0)
    axes.set_ylabel("gap [m]")


def _draw_speeds(axes: Axes, study: PaperStudy, run: Run) -> None:
    time, observations = run.episode.time, run.episode.observations
    axes.plot(time, observations[:, 1], color=FOLLOWER, label="follower")
    axes.plot(time, observations[:, 2], color=LEADER, linestyle=LEADER_DASHES, label="leader")
    fastest = max(float(each.episode.observations[:, 1:].max()) for each in study.last_round)
    axes.set_ylim(0.0, 1.08 * fastest)
    axes.legend(loc="upper left")
    axes.set_ylabel("speed [m/s]")


def _draw_acceleration(axes: Axes, study: PaperStudy, run: Run) -> None:
    axes.axhline(0.0, color=SOFT, linewidth=0.6)
    axes.plot(run.episode.time, run.episode.accelerations, color=FOLLOWER)
    values = np.concatenate([each.episode.accelerations for each in study.last_round])
    low, high = float(values.min()), float(values.max())
    margin = 0.08 * max(high - low, 0.1)
    axes.set_ylim(low - margin, high + margin)
    axes.yaxis.set_major_locator(MaxNLocator(5, integer=True))
    axes.set_ylabel("follower's\nacceleration [m/s²]")


def _draw_states(axes: Axes, study: PaperStudy, run: Run) -> None:
    axes.step(run.episode.time, run.state + 1, where="post", color=INK)
    name_rows(axes, study.model.n_states, dead_ends_of(study.dead_end), called="collisions")
    axes.set_ylabel("recognised\nstate")


def _draw_actions(axes: Axes, study: PaperStudy, run: Run) -> None:
    q = study.settings.actions.n_actions
    axes.step(run.episode.time, run.action + 1, where="post", color=FOLLOWER)
    axes.set_ylim(0.0, q + 1.0)
    step = max(1, round((q - 1) / 4))
    ticks = range(1, q + 1, step)
    axes.set_yticks(ticks, [f"a({i})" for i in ticks])
    axes.set_ylabel("follower's\naction")


def in_dead_end(study: PaperStudy, run: Run) -> NDArray[np.bool_]:
    """Whether, by the oracle, a full brake of the leader could not be survived, at each row."""
    leader = study.settings.scenario.leader
    return is_dead_end(run.episode.observations, study.settings.decel, leader.brake_decel)


def _shade(axes: Axes, run: Run, rows: NDArray[np.bool_]) -> None:
    """Tint the time of some rows of a run."""
    for first, last in stretches(rows):
        axes.axvspan(
            run.episode.time[first],
            run.episode.time[last],
            color=DEAD_END,
            alpha=_VEIL,
            linewidth=0.0,
            zorder=0.4,
        )


def _moments(study: PaperStudy, run: Run) -> list[_Moment]:
    """What is marked in a run, in the order of time."""
    episode, end = run.episode, float(run.episode.time[-1])
    moments = []
    change = study.settings.switch_at.get(run.case)
    if change is not None and change <= end:
        manner = "normal" if run.case == 3 else "aggressive"
        moments.append(_Moment(change, f"driver turns {manner}, {change:g} s", "--"))
    decel = study.settings.scenario.leader.brake_decel
    braking = np.flatnonzero(episode.leader_accelerations <= -decel)
    if len(braking):
        time = float(episode.time[braking[0]])
        moments.append(_Moment(time, f"leader brakes, {time:.1f} s", ":"))
    if episode.collided:
        moments.append(_Moment(end, f"collision, {end:.1f} s", "-", "bold"))
    return sorted(moments)


def _draw_moments(axes: Axes, moments: Sequence[_Moment], color: str = INK) -> None:
    for moment in moments:
        axes.axvline(moment.time, color=color, linestyle=moment.line, linewidth=0.8, zorder=1.5)


def _label_moments(axes: Axes, moments: Sequence[_Moment]) -> None:
    """Write what happens above the panel, where no text meets another or another's line."""
    placed: list[tuple[int, float, float]] = []
    for moment in moments:
        others = [other.time for other in moments if other is not moment]
        row, side = _find_room(axes, moment, placed, others)
        top = 4.0 + _ROW * row
        axes.annotate(
            moment.text,
            (moment.time, 1.0),
            xycoords=("data", "axes fraction"),
            xytext=(3 * side, top),
            textcoords="offset points",
            ha="left" if side > 0 else "right",
            va="bottom",
            fontsize=7.5,
            fontweight=moment.weight,
            annotation_clip=False,
        )
        axes.annotate(
            "",
            (moment.time, 1.0),
            xycoords=("data", "axes fraction"),
            xytext=(0, top + 0.8 * _ROW),
            textcoords="offset points",
            arrowprops={
                "arrowstyle": "-",
                "linestyle": moment.line,
                "linewidth": 0.8,
                "color": INK,
                "shrinkA": 0,
                "shrinkB": 0,
            },
            annotation_clip=False,
        )


def _find_room(
    axes: Axes, moment: _Moment, placed: list[tuple[int, float, float]], lines: Sequence[float]
) -> tuple[int, int]:
    """Row and side (1 right, -1 left) of a text; what it takes is added to ``placed``."""
    low, high = axes.get_xlim()
    # From letters to the unit of the axis.
    width = len(moment.text) * _LETTER * (high - low) / (WIDTH * axes.get_position().width)
    edge = high + (1.0 - axes.get_position().x1) / axes.get_position().width * (high - low)
    for row in range(len(placed) + 1):
        for side in (1, -1):
            first, last = sorted((moment.time, moment.time + side * width))
            free = low <= first and last <= edge and not any(first < x < last for x in lines)
            if free and not any(row == r and first < b and a < last for r, a, b in placed):
                placed.append((row, first, last))
                return row, side
    # Nowhere: above all others, towards the middle.
    row, side = len(placed), 1 if moment.time < 0.5 * (low + high) else -1
    placed.append((row, low, high))
    return row, side


# -- Divergence -------------------------------------------------------------------------------


def draw_divergence(study: PaperStudy) -> Figure:
    """Divergence of forecast and recognised state over time, a panel for each case."""
    figure = Figure(figsize=(WIDTH, 4.5))
    grid = figure.subplots(
        2,
        2,
        sharex=True,
        sharey=True,
        gridspec_kw={
            "left": 0.085,
            "right": 0.985,
            "top": 0.89,
            "bottom": 0.095,
            "hspace": 0.24,
            "wspace": 0.07,
        },
    )
    values = [LARGEST_DIVERGENCE]
    for axes, run in zip(grid.flat, study.last_round, strict=True):
        _draw_surprise(axes, run)
        _draw_moments(axes, _moments(study, run), SOFT)
        axes.set_title(title_of(study, run))
        values += [float(np.nanmax(run.surprise)), run.first_surprise]
    first: Axes = grid[0, 0]
    first.set_ylim(0.0, 1.12 * float(np.nanmax(values)))
    first.yaxis.set_major_locator(MaxNLocator(4))
    first.set_xlim(-0.015 * study.settings.scenario.duration, study.settings.scenario.duration)
    for axes in grid[:, 0]:
        axes.set_ylabel("divergence [bit]")
    for axes in grid[1]:
        axes.set_xlabel("time [s]")
    handles, labels = first.get_legend_handles_labels()
    figure.legend(handles, labels, loc="upper left", ncols=4, bbox_to_anchor=(0.07, 1.0))
    return figure


def _draw_surprise(axes: Axes, run: Run) -> None:
    time, surprise = run.episode.time, run.surprise
    axes.axhline(
        LARGEST_DIVERGENCE,
        color=INK,
        linestyle="--",
        linewidth=0.8,
        label=f"the paper's bound, {LARGEST_DIVERGENCE:g} bit",
    )
    axes.plot(time, surprise, color=FOLLOWER, linewidth=0.8, label="one-step forecasts")
    if np.isfinite(surprise).any():
        row = int(np.nanargmax(surprise))
        axes.plot(
            [time[row]],
            [surprise[row]],
            linestyle="none",
            marker="o",
            markersize=5,
            markerfacecolor="none",
            markeredgecolor=INK,
            label="largest of them",
        )
        axes.annotate(
            f"{surprise[row]:.3f}",
            (time[row], surprise[row]),
            xytext=(6 if row < 0.9 * len(time) else -6, 0),
            textcoords="offset points",
            ha="left" if row < 0.9 * len(time) else "right",
            va="center",
            fontsize=7.0,
        )
    axes.plot(
        [time[0]],
        [run.first_surprise],
        linestyle="none",
        marker="D",
        markersize=5,
        markerfacecolor=FIRST,
        markeredgecolor=INK,
        markeredgewidth=0.6,
        clip_on=False,
        zorder=4,
        label="the run's first forecast",
    )


# -- Growth of states -------------------------------------------------------------------------


def draw_growth(study: PaperStudy) -> Figure:
    """Number of states over the runs, and when each was founded."""
    runs = len(study.runs)
    last = study.foundings[-1].run + 1
    figure = Figure(figsize=(WIDTH, 3.0))
    margins = {"left": 0.06, "right": 0.985, "top": 0.89, "bottom": 0.15, "wspace": 0.1}
    if 2 * last > runs:
        axes: Axes = figure.subplots(gridspec_kw=margins)
        _draw_foundings(axes, study, runs)
    else:
        axes, overview = figure.subplots(
            1, 2, sharey=True, gridspec_kw={**margins, "width_ratios": (1.9, 1.0)}
        )
        _draw_foundings(axes, study, last)
        axes.set_title("Run 1" if last == 1 else f"Runs 1 to {last}")
        _draw_steps(overview, study, runs)
        overview.axvspan(0, last, color=SOFT, alpha=0.15, linewidth=0.0)
        overview.set_title(f"All {runs} runs")
        overview.set_xlabel("runs driven")
    axes.set_ylim(0.0, study.model.n_states + 0.9)
    axes.yaxis.set_major_locator(MaxNLocator(8, integer=True))
    axes.set_ylabel("number of states")
    return figure


def _position(study: PaperStudy, founding: Founding) -> float:
    """Where a founding stands on an axis on which each run has the width 1."""
    return founding.run + founding.time / study.settings.scenario.duration


def _draw_steps(axes: Axes, study: PaperStudy, runs: int) -> None:
    positions = [0.0, *(_position(study, one) for one in study.foundings), float(runs)]
    counts = [*range(study.model.n_states + 1), study.model.n_states]
    axes.step(positions, counts, where="post", color=INK)
    axes.set_xlim(-0.015 * runs, runs)


def _draw_foundings(axes: Axes, study: PaperStudy, runs: int) -> None:
    _draw_steps(axes, study, runs)
    axes.grid(False, axis="x")
    for run in range(1, runs, 2):
        axes.axvspan(run, run + 1, color=SOFT, alpha=0.1, linewidth=0.0, zorder=0.4)
    if runs <= 2 * len(CASES):
        axes.set_xticks(
            [run + 0.5 for run in range(runs)],
            [f"run {run + 1}: case {study.runs[run].case}" for run in range(runs)],
        )
        axes.tick_params(axis="x", length=0)
    else:
        axes.set_xlabel("runs driven")
    numbered = study.model.n_states <= MOST_DISCS
    for count, founding in enumerate(study.foundings, 1):
        x, state = _position(study, founding), founding.state
        draw_state(axes, x, count, state, 9.0, dead_end=state == study.dead_end, numbered=numbered)
        if numbered:
            axes.annotate(
                f"{founding.time:.1f} s",
                (x, count),
                xytext=(7, -2.5),
                textcoords="offset points",
                va="top",
                fontsize=7.0,
            )
