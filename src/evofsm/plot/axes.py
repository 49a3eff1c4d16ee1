"""Plots of a model, of beliefs and of a drive, each on axes that are given, or on new ones.

They draw in whatever style holds, and set none. Data on the axes are counted from 0, as in the
code, and labels from 1. The functions whose names begin with ``draw_`` or ``label_`` draw parts of
them, in the figures of the studies as well.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from evofsm.driving import Episode
from evofsm.extras import needs
from evofsm.fsm import FSMModel, Policy, Trace, variable_label

with needs("matplotlib", "plot", "plotting"):
    from matplotlib.colors import Normalize
    from matplotlib.patches import FancyArrowPatch
    from matplotlib.patheffects import withStroke

    from evofsm.plot.placing import around, in_points, settle
    from evofsm.plot.style import (
        DEAD_END,
        FOLLOWER,
        INK,
        MOST_DISCS,
        SOFT,
        Look,
        draw_collision,
        draw_state,
        ink,
        label_of,
        name_of,
        points,
        write,
    )

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.image import AxesImage

#: Of probabilities, from 0 on.
HEAT_MAP = "Blues"
#: Up to so many states a matrix has room for its values.
MOST_VALUES = 8
# Up to so many states each has its number on an axis, beyond about 8 have.
_MOST_TICKS = 12
# How much of the colour of type arrows have.
_PALE, _DARK = 0.19, 0.6923


# -- Of a model -------------------------------------------------------------------------------


def states(
    model: FSMModel,
    ax: Axes | None = None,
    *,
    variables: tuple[int, int] = (0, 1),
    dead_ends: Collection[int] = (),
) -> Axes:
    """Centres of the states in the plane of two variables.

    A state is recognised by the distance in all variables, so that no plane alone decides. Where
    discs would overlap they are moved apart and point to their place. What is on the axes before,
    observations for example, sets their limits as well.

    Parameters
    ----------
    model : FSMModel
    ax : matplotlib.axes.Axes, optional
        Where to plot; without it on new axes of pyplot.
    variables : (int, int)
        Indices of the variables to the right and upward.
    dead_ends : collection of int
        Indices of states to mark by a hexagon, as `by_state.assess_states` finds them.

    Returns
    -------
    matplotlib.axes.Axes
        Those that were plotted on.

    Raises
    ------
    ValueError
        If there are no states, or no such variable or state.

    Examples
    --------
    >>> from matplotlib.figure import Figure
    >>> from evofsm import EvolvingFSM, plot
    >>> machine = EvolvingFSM(n_actions=1, radius=0.5)
    >>> trace = machine.learn_many([[0.0, 3.0], [0.1, 3.0], [2.0, 5.0], [1.0, 4.0]], [0] * 4)
    >>> model = machine.model(names=["gap", "speed"], units=["m", "m/s"])
    >>> ax = plot.states(model, Figure().subplots(), dead_ends=[1])
    >>> ax.get_xlabel(), ax.get_ylabel()
    ('gap [m]', 'speed [m/s]')
    """
    _refuse_unknown(model.n_states, dead_ends)
    for variable in variables:
        if not 0 <= variable < model.n_variables:
            raise ValueError(f"there is no variable {variable}: the model has {model.n_variables}")
    ax = _given_or_new(ax)
    centers = model.centers[:, list(variables)]
    ax.update_datalim(centers)
    ax.margins(0.1)
    ax.autoscale_view()
    limits = ax.axis()
    draw_centers(ax, centers, dead_ends, size=13.0)
    ax.axis(limits)
    ax.set_xlabel(variable_label(model, variables[0]))
    ax.set_ylabel(variable_label(model, variables[1]))
    return ax


def graph(
    model: FSMModel,
    ax: Axes | None = None,
    *,
    policy: Policy = "observed",
    dead_ends: Collection[int] = (),
) -> Axes:
    """The states on a circle, with arrows as wide as the next state is probable.

    Staying is written beside the state; the two likeliest ways out of each state stand out.

    Parameters
    ----------
    model : FSMModel
    ax : matplotlib.axes.Axes, optional
        Where to plot; without it on new axes of pyplot.
    policy : {"observed", "marginal"}
        How actions are weighed, as in ``averaged_matrix``.
    dead_ends : collection of int
        Indices of states to mark by a hexagon and in words.

    Returns
    -------
    matplotlib.axes.Axes
        Those that were plotted on.

    Raises
    ------
    ValueError
        If there are no states, or no such state or policy.

    Examples
    --------
    >>> from matplotlib.figure import Figure
    >>> from evofsm import EvolvingFSM, plot
    >>> machine = EvolvingFSM(n_actions=1, radius=0.5)
    >>> trace = machine.learn_many([[0.0], [0.1], [2.0], [1.0]], [0, 0, 0, 0])
    >>> ax = plot.graph(machine.model(), Figure().subplots())
    >>> "stays 77 %" in [text.get_text() for text in ax.texts]
    True
    """
    _refuse_unknown(model.n_states, dead_ends)
    ax = _given_or_new(ax)
    matrix = model.averaged_matrix(policy)
    notes = [f"stays {percent(value)}" for value in np.diag(matrix)]
    draw_chain(ax, matrix, notes, dead_ends, widest=1.6, strongest=2)
    between = matrix[~np.eye(len(matrix), dtype=bool)]
    if len(between):
        strong = "dark" if ink() < ink(0.0) else "bright"  # the ground is light, or is not
        write(
            ax,
            f"each arrow: {percent(between.min())} to {percent(between.max())}; "
            f"{strong if len(matrix) <= MOST_DISCS else 'drawn'}: the two likeliest of each state",
            (0.03, -0.03),
            xycoords="axes fraction",
            va="baseline",
            color=ink(),
        )
    return ax


def transitions(
    model: FSMModel,
    ax: Axes | None = None,
    *,
    action: int | None = None,
    dead_ends: Collection[int] = (),
) -> Axes:
    """Transition probabilities as a heat map, from state (row) to state (column).

    Parameters
    ----------
    model : FSMModel
    ax : matplotlib.axes.Axes, optional
        Where to plot; without it on new axes of pyplot. A colour bar takes some of their place.
    action : int, optional
        Index of an action, from 0; without it all actions as often as each was used.
    dead_ends : collection of int
        Indices of states whose numbers are bold.

    Returns
    -------
    matplotlib.axes.Axes
        Those that were plotted on.

    Raises
    ------
    ValueError
        If there are no states, or no such state or action.

    Examples
    --------
    >>> from matplotlib.figure import Figure
    >>> from evofsm import EvolvingFSM, plot
    >>> machine = EvolvingFSM(n_actions=2, radius=0.5)
    >>> trace = machine.learn_many([[0.0], [0.1], [2.0], [1.0]], [0, 0, 0, 0])
    >>> ax = plot.transitions(machine.model(), Figure().subplots(), action=0)
    >>> [text.get_text() for text in ax.texts]  # in %
    ['77', '23', '50', '50']
    """
    _refuse_unknown(model.n_states, dead_ends)
    if action is not None and not 0 <= action < model.n_actions:
        raise ValueError(f"there is no action {action}: the model has {model.n_actions}")
    ax = _given_or_new(ax)
    matrix = model.averaged_matrix() if action is None else model.transition_matrices[action]
    image = draw_matrix(ax, matrix, Normalize(0.0, float(matrix.max())), size=7.0)
    ax.set_title("all actions, as used" if action is None else describe_action(model, action))
    for axis, way in ((ax.xaxis, "to"), (ax.yaxis, "from")):
        label_states(axis, model.n_states, dead_ends)
        axis.set_label_text(f"{way} state" + (" (bold: dead end)" if dead_ends else ""))
    written = ", written in %" if model.n_states <= MOST_VALUES else ""
    ax.figure.colorbar(image, ax=ax, label=f"probability of the next state{written}")
    return ax


# -- Of beliefs -------------------------------------------------------------------------------


def belief(
    belief: ArrayLike | Trace,
    ax: Axes | None = None,
    *,
    time: ArrayLike | None = None,
    dead_ends: Collection[int] = (),
) -> Axes:
    """A belief as bars; or many of them over time, with the most probable state as a line.

    Parameters
    ----------
    belief : (n,) or (T, n) array_like, or Trace
        One distribution over states, or one in each row; a trace that holds beliefs.
    ax : matplotlib.axes.Axes, optional
        Where to plot; without it on new axes of pyplot. Over time, a colour bar takes some of
        their place.
    time : (T,) array_like, optional
        When each row was observed [s], in rising order; without it rows are counted from 0.
    dead_ends : collection of int
        Indices of states to mark in words.

    Returns
    -------
    matplotlib.axes.Axes
        Those that were plotted on.

    Raises
    ------
    ValueError
        If the trace holds no beliefs, or shapes do not fit.

    Examples
    --------
    >>> from matplotlib.figure import Figure
    >>> from evofsm import EvolvingFSM, plot
    >>> machine = EvolvingFSM(n_actions=1, radius=0.5)
    >>> trace = machine.learn_many([[0.0], [0.1], [2.0], [1.0]], [0] * 4, belief=True)
    >>> ax = plot.belief(trace, Figure().subplots(), time=[0.0, 0.1, 0.2, 0.3])
    >>> ax.get_xlabel(), ax.lines[0].get_ydata()  # from 0: #2 at last
    ('time [s]', array([0, 0, 0, 1]))
    >>> plot.belief(machine.belief, Figure().subplots()).get_ylabel()
    'belief'
    """
    if isinstance(belief, Trace):
        if belief.belief is None:
            raise ValueError("the trace holds no beliefs (learn_many(..., belief=True) keeps them)")
        belief = belief.belief
    rows = np.asarray(belief, dtype=np.float64)
    if rows.ndim not in (1, 2) or rows.size == 0:
        raise ValueError(f"belief has shape {rows.shape}; it must be (n,) or (T, n), not empty")
    _refuse_unknown(rows.shape[-1], dead_ends)
    if rows.ndim == 1:
        if time is not None:
            raise ValueError("time is given, but only one belief: (n,)")
        return _plot_one_belief(rows, _given_or_new(ax), dead_ends)
    when = np.arange(1.0 * len(rows)) if time is None else np.asarray(time, dtype=np.float64)
    if when.shape != (len(rows),):
        raise ValueError(f"time has shape {when.shape}; {len(rows)} beliefs need ({len(rows)},)")
    ax = _given_or_new(ax)
    _plot_beliefs(rows, when, ax, dead_ends)
    ax.set_xlabel("observation" if time is None else "time [s]")
    return ax


def _plot_one_belief(row: NDArray[np.float64], ax: Axes, dead_ends: Collection[int]) -> Axes:
    bars = ax.bar(range(len(row)), row, color=FOLLOWER)
    for state in dead_ends:
        bars[state].set(color=DEAD_END, hatch="///", edgecolor="white")
        look: Look = {"ha": "center", "va": "bottom", "fontweight": "bold", "color": DEAD_END}
        write(ax, "dead end", (state, row[state]), (0.0, 2.0), **look)
    label_states(ax.xaxis, len(row), dead_ends)
    ax.set(ylim=(0.0, 1.0), xlabel="state", ylabel="belief")
    return ax


def _plot_beliefs(
    rows: NDArray[np.float64], when: NDArray[np.float64], ax: Axes, dead_ends: Collection[int]
) -> None:
    n = rows.shape[1]
    scale = Normalize(0.0, 1.0)
    mesh = ax.pcolormesh(
        when, range(n), rows.T, cmap=HEAT_MAP, norm=scale, shading="nearest", rasterized=True
    )
    ax.grid(False)
    if n <= MOST_DISCS:  # among more it would hide the belief
        look: Look = {"where": "mid", "color": INK, "label": "most probable state"}
        (line,) = ax.step(when, rows.argmax(axis=1), **look)
        line.set_path_effects([withStroke(linewidth=3.0, foreground="white")])
        _explain(ax)
    label_states(ax.yaxis, n, dead_ends, called="dead end")
    ax.set_ylabel("state")
    # Below, for the words beside the rows stand to the right.
    ax.figure.colorbar(mesh, ax=ax, label="belief", location="bottom", aspect=40)


# -- Of a drive -------------------------------------------------------------------------------


def risk(drive: Episode, ax: Axes | None = None, *, tolerance: float | None = None) -> Axes:
    """Latent risk over time: of what was proposed, and of what was executed, with its interval.

    Parameters
    ----------
    drive : Episode
        Under a reviser that judges actions.
    ax : matplotlib.axes.Axes, optional
        Where to plot; without it on new axes of pyplot.
    tolerance : float, optional
        The reviser's, drawn as a line.

    Returns
    -------
    matplotlib.axes.Axes
        Those that were plotted on.

    Raises
    ------
    ValueError
        If no decision of the drive was judged.

    Examples
    --------
    >>> from matplotlib.figure import Figure
    >>> from evofsm import plot
    >>> from evofsm.driving import IDM, Leader, Scenario, drive, guard_for_cars
    >>> leader = Leader(IDM(1.2, 25.0, 1.0, 1.0, 2.5), brake_decel=4.0, brake_time=12.0)
    >>> guard, scenario = guard_for_cars(-4.0, 2.5), Scenario(leader, initial_gap=10.0)
    >>> episode = drive(guard, scenario, controller=lambda observation: 2.0)
    >>> ax = plot.risk(episode, Figure().subplots(), tolerance=0.02)
    >>> ax.get_ylabel()
    'latent risk'
    """
    revisions = [decision.revision for decision in drive.decisions]
    proposed = np.array([revision.risk_proposed for revision in revisions])
    executed = np.array([revision.risk_executed for revision in revisions])
    if not np.isfinite(executed).any():
        raise ValueError(
            "no decision of this drive was judged (was there a reviser, and was its mode not OFF?)"
        )
    ax = _given_or_new(ax)
    between = np.array([revision.interval for revision in revisions]).T
    _draw_decisions(ax, drive, (proposed, executed), between, FOLLOWER, "90 % interval")
    if tolerance is not None:
        label = f"tolerance, {tolerance:g}"
        ax.axhline(tolerance, color=ink(), linestyle=":", linewidth=1.0, label=label)
    ax.set(ylim=(-0.03, 1.03), ylabel="latent risk")
    _finish(ax, drive, 0.0)
    return ax


def accelerations(drive: Episode, ax: Axes | None = None) -> Axes:
    """What was proposed and what was executed, over time; where they differ it is shaded.

    Parameters
    ----------
    drive : Episode
    ax : matplotlib.axes.Axes, optional
        Where to plot; without it on new axes of pyplot.

    Returns
    -------
    matplotlib.axes.Axes
        Those that were plotted on.

    Raises
    ------
    ValueError
        If nothing was decided in the drive.

    Examples
    --------
    >>> from matplotlib.figure import Figure
    >>> from evofsm import plot
    >>> from evofsm.driving import IDM, Leader, Scenario, drive, guard_for_cars
    >>> driver = IDM(1.2, 25.0, 1.0, 1.0, 2.5, lowest=-2.5, highest=2.5)
    >>> scenario = Scenario(Leader(driver, brake_decel=2.0, brake_time=5.0), initial_gap=10.0)
    >>> episode = drive(guard_for_cars(-2.5, 2.5), scenario, controller=driver)
    >>> ax = plot.accelerations(episode, Figure().subplots())
    >>> ax.get_ylabel()
    'acceleration [m/s²]'
    """
    if not drive.decisions:
        raise ValueError("nothing was decided in this drive")
    ax = _given_or_new(ax)
    ax.axhline(0.0, color=SOFT, linewidth=0.6)
    both = drive.proposed, drive.executed
    _draw_decisions(ax, drive, both, both, DEAD_END, "revised")
    ax.set_ylabel("acceleration [m/s²]")
    _finish(ax, drive, float(drive.executed[-1]))
    return ax


def _draw_decisions(
    ax: Axes, drive: Episode, values: ArrayLike, between: ArrayLike, color: str, label: str
) -> None:
    """Draw what was proposed and executed (2, D), and a band (2, D), until the end of the drive."""
    times = [decision.situation.time for decision in drive.decisions]
    when = np.array([*times, float(drive.time[-1])])
    (proposed, executed), (low, high) = (
        np.pad(np.asarray(rows, dtype=np.float64), ((0, 0), (0, 1)), mode="edge")
        for rows in (values, between)
    )
    fill: Look = {"step": "post", "color": color, "alpha": 0.25, "linewidth": 0.0}
    ax.fill_between(when, low, high, label=label, **fill)
    ax.step(when, proposed, where="post", color=DEAD_END, linestyle="--", label="proposed")
    ax.step(when, executed, where="post", color=FOLLOWER, label="executed")


def _finish(ax: Axes, drive: Episode, y: float) -> None:
    """Mark a collision at height ``y``, and explain."""
    if drive.collided:
        draw_collision(ax, float(drive.time[-1]), y)
        ax.lines[-1].set_label("collision")
    ax.set_xlabel("time [s]")
    _explain(ax)


def _explain(ax: Axes) -> None:
    """Put the legend above, where it hides nothing."""
    ax.legend(
        loc="lower left",
        bbox_to_anchor=(0.0, 1.0),
        borderaxespad=0.2,
        columnspacing=1.2,
        fontsize=points(7.5),
        frameon=False,
        ncols=3,
    )


# -- Where to plot ----------------------------------------------------------------------------


def _given_or_new(ax: Axes | None) -> Axes:
    if ax is not None:
        return ax
    from matplotlib import pyplot  # late: whoever gives axes needs none of it

    return pyplot.subplots(layout="constrained")[1]


def _refuse_unknown(n: int, dead_ends: Collection[int]) -> None:
    if n == 0:
        raise ValueError("this model has no states: its machine had observed nothing")
    for state in dead_ends:
        if not 0 <= state < n:
            raise ValueError(f"dead_ends name state {state}, but there are states 0 to {n - 1}")


# -- Parts, in the figures of studies as well ------------------------------------------------------


def percent(share: float) -> str:
    """A share in whole percent: there is no room for more in a graph."""
    return f"{100 * share:.0f} %"


def draw_centers(
    axes: Axes, centers: NDArray[np.float64], dead_ends: Collection[int], size: float
) -> None:
    """Draw centres (n, 2); discs that would meet move apart and point to their place."""
    places = centers
    numbered = len(centers) <= MOST_DISCS
    if numbered:
        anchors = in_points(axes, centers)
        sizes = np.full_like(anchors, size + 1.0)
        moved = anchors + settle(anchors, sizes, _moves)
        places = axes.transData.inverted().transform(moved * axes.figure.dpi / 72.0)
    for state, (center, (x, y)) in enumerate(zip(centers, places, strict=True)):
        axes.plot([center[0], x], [center[1], y], color=ink(), linewidth=0.6, zorder=4.5)
        axes.plot(*center, marker="o", markersize=1.6, color=ink(), zorder=4.5)
        draw_state(axes, x, y, state, size, dead_end=state in dead_ends, numbered=numbered)


def _moves(width: float, height: float) -> NDArray[np.float64]:
    """Offsets that are tried for a disc: none, then all around, ever further away."""
    return np.vstack([np.zeros(2), around(0.0, 0.0, width * np.arange(0.25, 5.0, 0.25))])


def draw_chain(
    axes: Axes,
    weights: NDArray[np.float64],
    notes: Sequence[str],
    dead_ends: Collection[int],
    widest: float,
    strongest: int | None = None,
    counted: bool = False,
) -> None:
    """Draw states on a circle, with notes, and arrows between them as wide as their weights.

    With ``strongest`` all but so many arrows of each state are pale; ``counted`` weights are
    written on the arrows.
    """
    n = len(notes)
    angle = 0.5 * np.pi - 2.0 * np.pi * np.arange(n) / max(n, 1)
    places = np.column_stack([np.cos(angle), np.sin(angle)])  # from the top, clockwise
    numbered = n <= MOST_DISCS
    for state, ((x, y), note) in enumerate(zip(places, notes, strict=True)):
        dead_end = state in dead_ends
        draw_state(axes, x, y, state, 13.0, dead_end=dead_end, numbered=numbered)
        if not numbered and not dead_end:
            note = label_of(state)[1:]
        write(
            axes,
            f"dead end\n{note}" if dead_end else note,
            (x, y),
            (11.0 * x, 11.0 * y),
            size=7.0 if numbered or dead_end else 5.5,
            ha="center" if abs(x) < 0.2 else "left" if x > 0.0 else "right",
            va="center" if abs(y) < 0.5 else "bottom" if y > 0.0 else "top",
            color=DEAD_END if dead_end else ink(),
        )
    axes.set(xlim=(-1.75, 1.75), ylim=(-1.35, 1.35), aspect="equal")
    axes.set_axis_off()
    between = weights * (1.0 - np.eye(n))
    heaviest = max(float(between.max(initial=0.0)), 1e-12)
    rank = np.argsort(np.argsort(-between, axis=1), axis=1)
    for i, j in np.argwhere(between > 0.005 * heaviest):
        pale = strongest is not None and rank[i, j] >= strongest
        if pale and not numbered:
            continue
        way = places[j] - places[i]
        bend = 0.28 / float(np.hypot(*way))
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
                color=ink(_PALE) if pale else DEAD_END if j in dead_ends else ink(_DARK),
                zorder=1.5 if pale else 2.0,
            )
        )
        if counted and numbered:
            middle = 0.5 * (places[i] + places[j]) + 0.5 * bend * np.array([way[1], -way[0]])
            box: Look = {"boxstyle": "round,pad=0.12", "facecolor": ink(0.0), "edgecolor": "none"}
            look: Look = {"ha": "center", "va": "center_baseline", "zorder": 3}
            write(axes, f"{weights[i, j]:.0f}", tuple(middle), bbox=box, **look)


def draw_matrix(
    axes: Axes, matrix: NDArray[np.float64], scale: Normalize, size: float
) -> AxesImage:
    """Draw a transition matrix, its values in type of this ``size`` where there is room."""
    image = axes.imshow(matrix, cmap=HEAT_MAP, norm=scale, interpolation="nearest")
    axes.grid(False)
    axes.spines[:].set_visible(False)
    if len(matrix) <= MOST_VALUES:
        for i, j in np.ndindex(matrix.shape):
            look: Look = {"ha": "center", "va": "center_baseline", "fontsize": points(size)}
            color = "white" if scale(matrix[i, j]) > 0.68 else INK
            axes.text(j, i, f"{100 * matrix[i, j]:.0f}", color=color, **look)
    return image


def describe_action(model: FSMModel, action: int) -> str:
    """What an action is, and how many transitions were learnt with it."""
    name = name_of(action)
    if model.actions is not None:
        name += f"  {model.actions.label(action)}".replace("-", "−") + " m/s²"
    return f"{name}\n{model.uses[action]:,.0f} transitions"


def label_states(
    axis: Axis,
    n: int,
    dead_ends: Collection[int] = (),
    *,
    shown: bool = True,
    called: str = "",
) -> None:
    """Put the states' numbers, from 1, on an axis that counts them from 0; the dead ends' bold.

    On an upward axis the rows of dead ends are tinted as well where they are ``called`` something.
    """
    states = range(0, n, 1 if n <= _MOST_TICKS else math.ceil(n / 8))
    sign = "#" if axis is axis.axes.xaxis else ""  # which there is no room for
    axis.set_ticks(states, [label_of(state).strip(sign) for state in states] if shown else [])
    axis.set_tick_params(length=0, labelsize=points(7.0), pad=2.0)
    for state, label in zip(states, axis.get_ticklabels(), strict=False):
        if state in dead_ends:
            label.set(color=DEAD_END, fontweight="bold")
    if called:
        axes = axis.axes
        axes.set_ylim(-0.6, n - 0.4)
        for state in dead_ends:
            axes.axhspan(
                state - 0.5, state + 0.5, color=DEAD_END, alpha=0.18, linewidth=0.0, zorder=0.5
            )
            look: Look = {"xycoords": ("axes fraction", "data"), "fontweight": "bold"}
            write(axes, called, (1.0, state), (4.0, 0.0), color=DEAD_END, **look)
