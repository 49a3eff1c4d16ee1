"""The figures of the paper's study: runs over time, states in space, and what leads to what."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from evofsm.driving.measures import is_dead_end
from evofsm.extras import needs
from evofsm.paper.claims import LARGEST_DIVERGENCE
from evofsm.paper.runs import CASES, Founding, PaperStudy, Run

with needs("matplotlib", "plot", "drawing figures"):
    from matplotlib.axes import Axes
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize
    from matplotlib.figure import Figure
    from matplotlib.patches import Patch
    from matplotlib.ticker import MaxNLocator

    from evofsm import plot
    from evofsm.paper.report.drawing import Sketch
    from evofsm.plot import DEAD_END, FOLLOWER, INK, LEADER, SOFT, THIRD, WIDTH, Look

# Height of a line of text [point].
_ROW = 10.0
# Opacity of what tints time, and of what tints a trajectory.
_TINT, _VEIL = 0.09, 0.4
_GAP, _FOLLOWER, _LEADER = 0, 1, 2
_GAP_TICKS = (0, 2, 5, 10, 20, 40, 60, 80, 100, 150, 200, 300, 400)
_END: Look = {"marker": "s", "markersize": 10, "markerfacecolor": "none"}


def sketches(study: PaperStudy) -> Iterator[Sketch]:
    """The figures in the order in which a reader wants them, still to be drawn.

    Parameters
    ----------
    study : PaperStudy
        With any number of rounds, states and collisions.
    """
    yield from (_sketch_case(study, run) for run in study.last_round)
    model, runs, n = study.model, len(study.runs), study.model.n_states
    yield Sketch(
        "divergence",
        "Divergence of forecast and recognised state",
        "Jensen–Shannon divergence of the one-step forecast and the distribution over states "
        "recognised then, in the last round: 0 where they are equal, 1 bit where they have "
        "nothing in common. A run's first forecast is set apart, as in the paper: it starts from "
        f"the uniform distribution. The paper's bound on all others is {LARGEST_DIVERGENCE:g} bit. "
        "Vertical lines as in the figures of the cases. The forecast may jump where the action "
        "changes: each action has a matrix of its own. The table of forecasts sets simpler ones "
        "beside it.",
        "Four panels, one for each case, with the divergence over time below the paper's bound "
        "or above it; the largest value is written beside its place.",
        partial(draw_divergence, study),
    )
    hexagon = f"; the hexagon is the dead end, {plot.label_of(study.dead_end)}"
    yield Sketch(
        "growth",
        "Growth of the number of states",
        f"{n} states were created in {runs} runs. Discs are numbered in the order of creation and "
        "stand where it happened, with the time within the run"
        f"{hexagon if study.dead_ends else ''}.",
        f"Steps of the number of states from 0 to {n} over {runs} runs.",
        partial(draw_growth, study),
    )
    yield Sketch(
        "space",
        "States and trajectories in the space of observations",
        "The last round over the gap: the follower's speed above (solid), the leader's below "
        "(dashed). Numbered discs are the states' centres; where two would overlap they are moved "
        "apart and point to their place. A state is recognised by the distance to its centre in "
        "all three variables, so neither plane alone decides which one it is. The gap is drawn by "
        "its root, to give the small gaps room.",
        "Eight panels, four cases by two speeds, with the trajectory of each case and the centres "
        f"of {n} states.",
        partial(draw_space, study),
    )
    yield Sketch(
        "graph",
        "State graph",
        "(a) What the machine has learnt: the probability that one state follows another in the "
        "next step, over all actions as often as each was used; arrows are as wide as they are "
        "probable, and staying is written beside the state. Belief is spread over all states, and "
        "so are the transitions that are learnt from it. (b) How often the most probable state "
        "changed from one to another; the width of an arrow is its count.",
        f"Two graphs of {n} states on a circle: learnt probabilities, and "
        "counted changes of the recognised state.",
        partial(draw_graph, study),
    )
    used = int((model.uses > 0.0).sum())
    idle = [plot.name_of(action) for action in range(model.n_actions) if not model.uses[action]]
    never = f" (never used: {', '.join(idle)})" if idle else ""
    yield Sketch(
        "matrices",
        "Transition matrices by action",
        f"One matrix for each of the {used} actions that were used{never}, all on one scale. "
        "A row holds the probabilities of the next state, given the present one. Where the rows of "
        "a matrix look alike, the forecast hardly depends on the present state.",
        f"{used} heat maps of {n} by {n} transition probabilities.",
        partial(draw_matrices, study),
    )


def _sketch_case(study: PaperStudy, run: Run) -> Sketch:
    episode, actions = run.episode, study.settings.actions
    tint = (
        "Tinted: a dead end, by an oracle who knows how both can brake, as long as it lasts; until "
        "the leader brakes it can still be left, as in case 3. "
        if in_dead_end(study, run).any()
        else ""
    )
    if study.dead_ends:
        tint += f"{plot.label_of(study.dead_end)} is the state in which collisions happen. "
    marked = ["change of the driver (dashed)"] if run.case in study.settings.switch_at else []
    marked += ["begin of the leader's full brake (dotted)"]
    marked += ["collision (solid, with a cross)"] if episode.collided else []
    end = f"in a collision at {episode.time[-1]:.1f} s"
    first, last = (
        f"{plot.name_of(index)}, {actions.label(index)}".replace("-", "−")
        for index in (0, actions.n_actions - 1)
    )
    return Sketch(
        f"case-{run.case}",
        f"Result of {run.name}",
        f"Last round (run {len(study.runs) - len(study.last_round) + run.case} of "
        f"{len(study.runs)}). {tint}Vertical lines: {', '.join(marked)}. Action a(r) is the "
        f"interval in which the acceleration lies, from {first}, to {last} m/s².",
        "Gap, speeds, acceleration, recognised state and action over time in "
        f"{run.name}, which ends {end if episode.collided else 'without a collision'}.",
        partial(draw_case, study, run),
    )


# -- Result of a case -----------------------------------------------------------------------------


class _Moment(NamedTuple):
    """Something that happens once in a run."""

    time: float
    text: str
    line: str  # dashes
    weight: str = "normal"


def draw_case(study: PaperStudy, run: Run) -> Figure:
    """Gap, speeds, acceleration, recognised state and action of one run, over time."""
    figure = Figure(figsize=(WIDTH, 7.4))
    panels: Sequence[Axes] = figure.subplots(
        5, 1, sharex=True, height_ratios=(1.2, 1.2, 1.0, 1.2, 1.0)
    )
    figure.subplots_adjust(left=0.105, right=0.91, top=0.915, bottom=0.06, hspace=0.13)
    gap, speeds, acceleration, state, action = panels
    episode, settings = run.episode, study.settings
    time, seen, q = episode.time, episode.observations, settings.actions.n_actions

    gap.plot(time, seen[:, _GAP], color=INK)
    gap.set(ylim=(0.0, 1.08 * seen[:, _GAP].max()), ylabel="gap [m]")
    if episode.collided:
        plot.draw_collision(gap, float(time[-1]), 0.0)
    speeds.plot(time, seen[:, _FOLLOWER], color=FOLLOWER, label="follower")
    dashes = plot.LEADER_DASHES
    speeds.plot(time, seen[:, _LEADER], color=LEADER, linestyle=dashes, label="leader")
    fastest = max(float(each.episode.observations[:, 1:].max()) for each in study.last_round)
    speeds.set(ylim=(0.0, 1.08 * fastest), ylabel="speed [m/s]")
    speeds.legend(loc="upper left")
    acceleration.axhline(0.0, color=SOFT, linewidth=0.6)
    acceleration.plot(time, episode.accelerations, color=FOLLOWER)
    values = np.concatenate([each.episode.accelerations for each in study.last_round])
    margin = 0.08 * max(float(np.ptp(values)), 0.1)
    acceleration.set_ylim(values.min() - margin, values.max() + margin)
    acceleration.set_ylabel("follower's\nacceleration [m/s²]")
    acceleration.yaxis.set_major_locator(MaxNLocator(5, integer=True))
    state.step(time, run.state, where="post", color=INK)
    plot.label_states(state.yaxis, study.model.n_states, study.dead_ends, called="collisions")
    state.set_ylabel("recognised\nstate")
    action.step(time, run.action, where="post", color=FOLLOWER)
    ticks = range(0, q, max(1, round((q - 1) / 4)))
    action.set_yticks(ticks, [plot.name_of(tick) for tick in ticks])
    action.set(ylim=(-1.0, q), ylabel="follower's\naction", xlabel="time [s]")
    action.set_xlim(0.0, settings.scenario.duration)

    hopeless = in_dead_end(study, run)
    moments = _moments(study, run)
    for axes in panels:
        for first, last in plot.stretches(hopeless):
            look: Look = {"color": DEAD_END, "alpha": _TINT, "linewidth": 0.0, "zorder": 0.4}
            axes.axvspan(time[first], time[last], **look)
        _draw_moments(axes, moments)
    _label_moments(gap, moments)
    figure.align_ylabels(panels)
    figure.text(0.105, 0.985, _title_of(study, run), va="top", fontsize=9.0, fontweight="bold")
    if hopeless.any():
        _explain_tint(figure, study)
    return figure


def _title_of(study: PaperStudy, run: Run) -> str:
    """The name of a run and how its follower drives."""
    manners = ("aggressive", "normal") if run.case in (1, 3) else ("normal", "aggressive")
    change = study.settings.switch_at.get(run.case)
    later = "" if change is None else f", {manners[1]} from {change:g} s"
    return f"{run.name.capitalize()}: {manners[0]} driver{later}"


def in_dead_end(study: PaperStudy, run: Run) -> NDArray[np.bool_]:
    """Whether, by the oracle, a full brake of the leader could not be survived, at each row."""
    leader = study.settings.scenario.leader
    return is_dead_end(run.episode.observations, study.settings.decel, leader.brake_decel)


def _explain_tint(figure: Figure, study: PaperStudy) -> None:
    patch = Patch(facecolor=DEAD_END, alpha=2.0 * _TINT, linewidth=0.0)
    text = (
        f"dead end: if the leader braked now ({study.settings.scenario.leader.brake_decel:g} "
        f"m/s²),\neven full braking ({study.settings.decel:g} m/s²) would be too late"
    )
    figure.legend(
        [patch], [text], loc="upper right", bbox_to_anchor=(0.99, 0.995), handlelength=1.6
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
    place: Look = {"xycoords": ("data", "axes fraction")}
    notes = [
        plot.write(axes, one.text, (one.time, 1.0), size=7.5, fontweight=one.weight, **place)
        for one in moments
    ]
    scale = 72.0 / axes.figure.dpi
    left, bottom, _, top = scale * np.array(axes.get_window_extent().extents)
    at = plot.in_points(axes, [(one.time, 0.0) for one in moments])[:, 0]
    plot.place_labels(
        notes,
        [(x, top) for x in at],
        lambda width, height: [
            (side * (0.5 * width + 3.0), 4.0 + _ROW * row + 0.5 * height)
            for row in range(len(moments) + 1)
            for side in (1.0, -1.0)
        ],
        [(x - 0.5, top, x + 0.5, top + 9.0 * _ROW) for x in at],
        (left, bottom, axes.figure.bbox.x1 * scale, top + 9.0 * _ROW),
    )
    for one, note in zip(moments, notes, strict=True):
        end = 1.0 + (note.get_position()[1] + 0.3 * _ROW) / (top - bottom)
        look: Look = {"linestyle": one.line, "linewidth": 0.8, "color": INK, "clip_on": False}
        axes.plot([one.time] * 2, [1.0, end], transform=axes.get_xaxis_transform(), **look)


# -- Divergence -----------------------------------------------------------------------------------


def draw_divergence(study: PaperStudy) -> Figure:
    """Divergence of forecast and recognised state over time, a panel for each case."""
    figure, grid = plot.panels(2, 2, 4.5, sharex=True, sharey=True)
    values = [LARGEST_DIVERGENCE]
    for axes, run in zip(grid.flat, study.last_round, strict=True):
        _draw_surprise(axes, run)
        _draw_moments(axes, _moments(study, run), SOFT)
        axes.set_title(_title_of(study, run))
        values += [float(np.nanmax(run.surprise)), run.first_surprise]
    first: Axes = grid[0, 0]
    duration = study.settings.scenario.duration
    first.set(ylim=(0.0, 1.12 * float(np.nanmax(values))), xlim=(-0.015 * duration, duration))
    first.yaxis.set_major_locator(MaxNLocator(4))
    for axes in grid[:, 0]:
        axes.set_ylabel("divergence [bit]")
    for axes in grid[1]:
        axes.set_xlabel("time [s]")
    figure.legend(*first.get_legend_handles_labels(), loc="outside upper left", ncols=4)
    return figure


def _draw_surprise(axes: Axes, run: Run) -> None:
    time, surprise = run.episode.time, run.surprise
    bound: Look = {"color": INK, "linestyle": "--", "linewidth": 0.8}
    name = f"the paper's bound, {LARGEST_DIVERGENCE:g} bit"
    axes.axhline(LARGEST_DIVERGENCE, label=name, **bound)
    axes.plot(time, surprise, color=FOLLOWER, linewidth=0.8, label="one-step forecasts")
    if np.isfinite(surprise).any():
        row = int(np.nanargmax(surprise))
        x, y = time[row], surprise[row]
        hollow: Look = {"marker": "o", "markerfacecolor": "none", "markeredgecolor": INK}
        plot.mark(axes, x, y, markersize=5, label="largest of them", **hollow)
        side = 1.0 if row < 0.9 * len(time) else -1.0
        plot.write(axes, f"{y:.3f}", (x, y), (6.0 * side, 0.0), ha="left" if side > 0 else "right")
    filled: Look = {"marker": "D", "markerfacecolor": THIRD, "markeredgecolor": INK, "zorder": 4}
    name = "the run's first forecast"
    plot.mark(
        axes, time[0], run.first_surprise, markersize=5, markeredgewidth=0.6, label=name, **filled
    )


# -- Growth of states -----------------------------------------------------------------------------


def draw_growth(study: PaperStudy) -> Figure:
    """Number of states over the runs, and when each was created."""
    runs, n = len(study.runs), study.model.n_states
    last = study.foundings[-1].run + 1
    figure = Figure(figsize=(WIDTH, 3.0), layout="constrained")
    if 2 * last > runs:
        axes: Axes = figure.subplots()
        _draw_foundings(axes, study, runs)
    else:
        axes, overview = figure.subplots(1, 2, sharey=True, width_ratios=(1.9, 1.0))
        _draw_foundings(axes, study, last)
        axes.set_title("Run 1" if last == 1 else f"Runs 1 to {last}")
        _draw_steps(overview, study, runs)
        overview.axvspan(0, last, color=SOFT, alpha=0.15, linewidth=0.0)
        overview.set(title=f"All {runs} runs", xlabel="runs driven")
    axes.set(ylim=(0.0, n + 0.9), ylabel="number of states")
    axes.yaxis.set_major_locator(MaxNLocator(8, integer=True))
    return figure


def _position(study: PaperStudy, founding: Founding) -> float:
    """Where a state was created, on an axis on which each run has the width 1."""
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
        names = [f"run {run + 1}: case {study.runs[run].case}" for run in range(runs)]
        axes.set_xticks(np.arange(runs) + 0.5, names)
        axes.tick_params(axis="x", length=0)
    else:
        axes.set_xlabel("runs driven")
    numbered = study.model.n_states <= plot.MOST_DISCS
    for count, one in enumerate(study.foundings, 1):
        x, dead_end = _position(study, one), one.state == study.dead_end
        plot.draw_state(axes, x, count, one.state, 9.0, dead_end=dead_end, numbered=numbered)
        if numbered:
            plot.write(axes, f"{one.time:.1f} s", (x, count), (7.0, -2.5), va="top")


# -- In the space of observations -----------------------------------------------------------------


def draw_space(study: PaperStudy) -> Figure:
    """States and trajectories in (gap, speed), a column for each case."""
    figure, grid = plot.panels(2, len(CASES), 5.2, sharex=True, sharey=True)
    first: Axes = grid[0, 0]
    observations = np.concatenate([run.episode.observations for run in study.last_round])
    widest, fastest = float(observations[:, _GAP].max()), float(observations[:, 1:].max())
    # By its root the gap has most room where it is small.
    root = (lambda x: np.sign(x) * np.sqrt(np.abs(x)), lambda x: np.sign(x) * x**2)
    first.set_xscale("function", functions=root)
    first.set(xlim=(-0.12, 1.08 * widest), ylim=(-0.07 * fastest, 1.1 * fastest))
    first.set_xticks([tick for tick in _GAP_TICKS if tick <= widest])
    for (above, below), run in zip(grid.T, study.last_round, strict=True):
        above.set_title(run.name.capitalize())
        below.set_xlabel("gap [m], root scale")
    first.set_ylabel("follower's speed [m/s]")
    grid[1, 0].set_ylabel("leader's speed [m/s]")
    _explain_space(figure, study)
    figure.draw_without_rendering()  # discs and arrowheads need to know where everything is
    for speed, row in zip((_FOLLOWER, _LEADER), grid, strict=True):
        for axes, run in zip(row, study.last_round, strict=True):
            _draw_trajectory(axes, study, run, speed)
            centers = study.model.centers[:, (_GAP, speed)]
            plot.draw_centers(axes, centers, study.dead_ends, 8.5)
    return figure


def _draw_trajectory(axes: Axes, study: PaperStudy, run: Run, speed: int) -> None:
    gap = np.maximum(run.episode.observations[:, _GAP], 0.0)
    v = run.episode.observations[:, speed]
    color, line = (FOLLOWER, "-") if speed == _FOLLOWER else (LEADER, plot.LEADER_DASHES)
    axes.plot(gap, v, color=color, linestyle=line)
    for begin, end in plot.stretches(run.state == study.dead_end):
        look: Look = {"color": DEAD_END, "alpha": _VEIL, "linewidth": 5.0, "solid_capstyle": "butt"}
        axes.plot(gap[begin : end + 1], v[begin : end + 1], zorder=1.8, **look)
    _draw_direction(axes, gap, v, color)
    if run.episode.collided:
        plot.draw_collision(axes, float(gap[-1]), float(v[-1]))
    else:
        plot.mark(axes, gap[-1], v[-1], color=INK, zorder=7, **_END)


def _draw_direction(axes: Axes, x: NDArray[np.float64], y: NDArray[np.float64], color: str) -> None:
    """Put two arrowheads on a trajectory, at a third and two thirds of its length as drawn."""
    drawn = axes.transData.transform(np.column_stack([x, y]))
    length = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(drawn, axis=0).T))])
    look: Look = {"arrowstyle": "-|>", "color": color, "linewidth": 1.0, "mutation_scale": 8.0}
    for share in (1 / 3, 2 / 3):
        row = int(np.searchsorted(length, share * length[-1]))
        before = int(np.searchsorted(length, max(share * length[-1] - 4.0, 0.0)))
        if before < row:
            arrow: Look = {**look, "shrinkA": 0, "shrinkB": 0}
            axes.annotate("", (x[row], y[row]), (x[before], y[before]), arrowprops=arrow)


def _explain_space(figure: Figure, study: PaperStudy) -> None:
    looks: dict[str, Look] = {
        "centre of a state": {"marker": "o", "markerfacecolor": "white", "markeredgecolor": INK},
        "end of a run": {**_END, "color": INK, "markersize": 7.0},
    }
    if study.dead_ends:
        veil: Look = {"linestyle": "-", "linewidth": 5.0, "alpha": _VEIL, "color": DEAD_END}
        looks |= {
            "collision": {"color": INK, **plot.COLLISION_MARK},
            "the dead end": {"marker": "h", "color": DEAD_END, "markersize": 7.0},
            "recognised as the dead end": {**veil, "solid_capstyle": "butt"},
        }
    plot.legend(figure, looks)


# -- As a graph, and as matrices ------------------------------------------------------------------


def draw_graph(study: PaperStudy) -> Figure:
    """The state graph twice: learnt probabilities, and changes of the recognised state."""
    model, runs = study.model, len(study.runs)
    figure = Figure(figsize=(WIDTH, 3.6))
    learnt, recognised = figure.subplots(1, 2)
    figure.subplots_adjust(0.0, 0.05, 1.0, 0.94, wspace=0.0)
    plot.graph(model, learnt, dead_ends=study.dead_ends)
    learnt.set_title("(a) learnt: probability of the next state, per step", x=0.03)
    changes = model.changes - np.diag(np.diag(model.changes))
    share = model.visits / max(float(model.visits.sum()), 1.0)
    notes = [f"{plot.percent(value)} of time" for value in share]
    plot.draw_chain(recognised, changes, notes, study.dead_ends, widest=3.0, counted=True)
    recognised.set_title(f"(b) recognised: changes of state in {runs} runs", x=0.03)
    return figure


def draw_matrices(study: PaperStudy) -> Figure:
    """The transition matrix of each action that was used, all on one scale."""
    model = study.model
    used = [int(action) for action in np.flatnonzero(model.uses > 0.0)]
    shown = used or [0]
    columns = 4
    rows = math.ceil(len(shown) / columns)
    figure = Figure(figsize=(WIDTH, 0.95 + 2.05 * rows), layout="compressed")
    scale = Normalize(0.0, float(model.transition_matrices[shown].max(initial=0.0)) or 1.0)
    for place, action in enumerate(shown):
        axes = figure.add_subplot(rows, columns, place + 1)
        plot.draw_matrix(axes, model.transition_matrices[action], scale, size=5.8)
        axes.set_title(plot.describe_action(model, action), fontsize=7.0, pad=3.0)
        lowest, leftmost = place + columns >= len(shown), place % columns == 0
        plot.label_states(axes.xaxis, model.n_states, study.dead_ends, shown=lowest)
        plot.label_states(axes.yaxis, model.n_states, study.dead_ends, shown=leftmost)
        axes.set(xlabel="to state" if lowest else "", ylabel="from state" if leftmost else "")
    written = ", written in the cells in %" if model.n_states <= plot.MOST_VALUES else ""
    figure.colorbar(
        ScalarMappable(scale, plot.HEAT_MAP),
        ax=figure.axes,
        location="top",
        shrink=0.5,
        aspect=40,
        anchor=(0.0, 1.0),
        label=f"probability of the next state{written}",
    ).outline.set_visible(False)
    return figure
