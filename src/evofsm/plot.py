"""Plots of a model, of beliefs and of a drive, on axes that are given or new, which they return.

They set no style. Data on the axes count states and actions from 0, labels from 1. Nothing rests on
colour alone. The same colours stand in ``io/graphs.py`` and ``cli/watch/live/page.css``.
"""

from __future__ import annotations

import math
from collections.abc import Collection
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from evofsm.driving import Episode
from evofsm.extras import needs
from evofsm.fsm.model import FSMModel, Policy
from evofsm.fsm.step import Trace

with needs("matplotlib", "plot", "plotting"):
    import matplotlib
    from matplotlib.colors import Normalize, to_hex, to_rgb
    from matplotlib.patches import FancyArrowPatch
    from matplotlib.patheffects import withStroke

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.axis import Axis
    from matplotlib.text import Annotation

__all__ = ["COLORS", "accelerations", "belief", "graph", "risk", "states", "transitions"]

Look = dict[str, Any]  # how something is drawn, as matplotlib is told
States = Collection[int]  # indices
Point = tuple[float, float]

#: Okabe and Ito's colours, which colour-blind readers can tell apart.
COLORS = {
    **{"ink": "#222222", "soft": "#777777", "third": "#CC79A7"},
    **{"follower": "#0072B2", "leader": "#009E73", "dead end": "#D55E00"},
}
# Up to so many states are drawn as discs with numbers, a matrix has room for its values, and each
# state has its number on an axis.
_DISCS, _VALUES, _TICKS = 20, 8, 12
# Of the arrows between states so many of each are dark; the widest of all [points].
_DARK, _WIDEST = 2, 1.6
# -- Of a model -----------------------------------------------------------------------------------


def states(
    model: FSMModel,
    ax: Axes | None = None,
    *,
    variables: tuple[int, int] = (0, 1),
    dead_ends: States = (),
) -> Axes:
    """Centres of the states in the plane of two variables.

    Where discs would overlap they are moved apart. What is on the axes before stays in view.

    Parameters
    ----------
    model : FSMModel
    ax : matplotlib.axes.Axes, optional
        Where to plot; without it on new axes of pyplot.
    variables : (int, int)
        Indices of the variables to the right and upward.
    dead_ends : collection of int
        Indices of states to mark by a hexagon, as `assess_states` finds them.

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
    >>> plot.states(model, Figure().subplots(), dead_ends=[1]).get_xlabel()
    'gap [m]'
    """
    _refuse_unknown(model.n_states, dead_ends)
    if wrong := [one for one in variables if not 0 <= one < model.n_variables]:
        raise ValueError(f"there is no variable {wrong[0]}: the model has {model.n_variables}")
    ax = _given_or_new(ax)
    centers = model.centers[:, list(variables)]
    ax.update_datalim(centers)
    ax.margins(0.1)
    ax.autoscale_view()
    limits = ax.axis()
    draw_centers(ax, centers, dead_ends, size=13.0)
    ax.axis(limits)
    across, up = map(model.labels.variable, variables)
    ax.set(xlabel=across, ylabel=up)
    return ax


def graph(
    model: FSMModel, ax: Axes | None = None, *, policy: Policy = "observed", dead_ends: States = ()
) -> Axes:
    """The states on a circle, with arrows as wide as the next state is probable.

    Staying is written beside the state; the two likeliest ways out of each are dark. Axes, dead
    ends, result and errors are as in `states`; ``policy`` weighs actions as in ``averaged_matrix``.

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
    matrix, n = model.averaged_matrix(policy), model.n_states
    angle = 0.5 * np.pi - 2.0 * np.pi * np.arange(n) / n
    places = np.column_stack([np.cos(angle), np.sin(angle)])  # from the top, clockwise
    numbered = n <= _DISCS
    for state, (x, y) in enumerate(places):
        dead_end, note = state in dead_ends, f"stays {100 * matrix[state, state]:.0f} %"
        draw_state(ax, x, y, state, 13.0, dead_end=dead_end, numbered=numbered)
        if numbered or dead_end:  # among many there is room for dead ends alone
            ha = "center" if abs(x) < 0.2 else "left" if x > 0.0 else "right"
            va = "center" if abs(y) < 0.5 else "bottom" if y > 0.0 else "top"
            color = COLORS["dead end"] if dead_end else ink()
            said = f"dead end\n{note}" if dead_end else note
            write(ax, said, (x, y), (11.0 * x, 11.0 * y), ha=ha, va=va, color=color)
    ax.set(xlim=(-1.75, 1.75), ylim=(-1.35, 1.35), aspect="equal")
    ax.set_axis_off()
    between = matrix * (1.0 - np.eye(n))
    heaviest = max(float(between.max(initial=0.0)), 1e-12)
    rank = np.argsort(np.argsort(-between, axis=1), axis=1)
    for i, j in np.argwhere(between > 0.005 * heaviest):
        pale = rank[i, j] >= _DARK
        if pale and not numbered:
            continue
        way = places[j] - places[i]
        bend = 0.28 / float(np.hypot(*way))
        look: Look = {"connectionstyle": f"arc3,rad={bend}", "arrowstyle": "-|>"}
        look |= {"mutation_scale": 6.5, "shrinkA": 7.5, "shrinkB": 8.5}
        look |= {"linewidth": max(_WIDEST * between[i, j] / heaviest, 0.4)}
        look["color"] = ink(0.19) if pale else COLORS["dead end"] if j in dead_ends else ink(0.69)
        ax.add_patch(FancyArrowPatch(places[i], places[j], zorder=1.5 if pale else 2.0, **look))
    return ax


def transitions(
    model: FSMModel, ax: Axes | None = None, *, action: int | None = None, dead_ends: States = ()
) -> Axes:
    """Transition probabilities as a heat map, from state (row) to state (column).

    Axes, result and errors are as in `states`; a colour bar takes some of the axes' place. Without
    an ``action`` (from 0) all count as often as each was used. Dead ends have bold numbers.

    Examples
    --------
    >>> from matplotlib.figure import Figure
    >>> from evofsm import EvolvingFSM, plot
    >>> machine = EvolvingFSM(n_actions=2, radius=0.5)
    >>> trace = machine.learn_many([[0.0], [0.1], [2.0], [1.0]], [0, 0, 0, 0])
    >>> ax = plot.transitions(machine.model(), Figure().subplots(), action=0)
    >>> [text.get_text() for text in ax.texts]
    ['77 %', '23 %', '50 %', '50 %']
    """
    _refuse_unknown(model.n_states, dead_ends)
    if action is not None and not 0 <= action < model.n_actions:
        raise ValueError(f"there is no action {action}: the model has {model.n_actions}")
    ax = _given_or_new(ax)
    matrix = model.averaged_matrix() if action is None else model.transition_matrices[action]
    scale = Normalize(0.0, float(matrix.max()))
    image = ax.imshow(matrix, cmap="Blues", norm=scale, interpolation="nearest")
    ax.grid(False)
    ax.spines[:].set_visible(False)
    for i, j in np.ndindex(matrix.shape) if len(matrix) <= _VALUES else ():
        color = "white" if scale(matrix[i, j]) > 0.68 else COLORS["ink"]
        look: Look = {"ha": "center", "va": "center_baseline", "fontsize": points(7.0)}
        ax.text(j, i, f"{100 * matrix[i, j]:.0f} %", color=color, **look)
    title = "all actions, as used"
    if action is not None:
        interval = "" if model.actions is None else f"  {model.actions.label(action)}"
        title = f"a({action + 1}){interval}\n{model.uses[action]:,.0f} transitions"
    ax.set_title(title)
    for axis, way in ((ax.xaxis, "to"), (ax.yaxis, "from")):
        label_states(axis, model.n_states, dead_ends)
        axis.set_label_text(f"{way} state" + (" (bold: dead end)" if dead_ends else ""))
    ax.figure.colorbar(image, ax=ax, label="probability of the next state")
    return ax


# -- Of beliefs and drives ------------------------------------------------------------------------


def belief(
    belief: ArrayLike | Trace,
    ax: Axes | None = None,
    *,
    time: ArrayLike | None = None,
    dead_ends: States = (),
) -> Axes:
    """Beliefs over time, darker where more probable, with the most probable state as a line.

    Parameters
    ----------
    belief : (T, n) array_like, or Trace
        A distribution over states in each row; or a trace that holds beliefs.
    ax, dead_ends
        As in `states`; a colour bar takes some of the axes' place.
    time : (T,) array_like, optional
        When each row was observed [s], in rising order; without it rows are counted from 0.

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
    >>> plot.belief(trace, Figure().subplots()).lines[0].get_ydata()  # from 0: #2 at last
    array([0, 0, 0, 1])
    """
    held = belief.belief if isinstance(belief, Trace) else belief
    if held is None:
        raise ValueError("the trace holds no beliefs (learn_many(..., belief=True) keeps them)")
    rows = np.asarray(held, dtype=np.float64)
    if rows.ndim != 2 or rows.size == 0:
        raise ValueError(f"belief has shape {rows.shape}; it must be (T, n), not empty")
    n = rows.shape[1]
    _refuse_unknown(n, dead_ends)
    when = np.arange(1.0 * len(rows)) if time is None else np.asarray(time, dtype=np.float64)
    if when.shape != (len(rows),):
        raise ValueError(f"time has shape {when.shape}; {len(rows)} beliefs need ({len(rows)},)")
    ax = _given_or_new(ax)
    look: Look = {"cmap": "Blues", "norm": Normalize(0.0, 1.0), "shading": "nearest"}
    mesh = ax.pcolormesh(when, range(n), rows.T, rasterized=True, **look)
    ax.grid(False)
    if n <= _DISCS:  # among more it would hide the belief
        look = {"where": "mid", "color": COLORS["ink"], "label": "most probable state"}
        look["path_effects"] = [withStroke(linewidth=3.0, foreground="white")]
        ax.step(when, rows.argmax(axis=1), **look)
        _explain(ax)
    label_states(ax.yaxis, n, dead_ends, called="dead end")
    ax.set(ylabel="state", xlabel="observation" if time is None else "time [s]")
    # Below, for the words beside the rows stand to the right.
    ax.figure.colorbar(mesh, ax=ax, label="belief", location="bottom", aspect=40)
    return ax


def risk(drive: Episode, ax: Axes | None = None, *, tolerance: float | None = None) -> Axes:
    """Latent risk over time: of what was proposed, and of what was executed, with its interval.

    The drive was under a reviser that judges actions; its ``tolerance`` is drawn as a line.

    Raises
    ------
    ValueError
        If no decision of the drive was judged.
    """
    revisions = [decision.revision for decision in drive.decisions]
    proposed = np.array([revision.risk_proposed for revision in revisions])
    executed = np.array([revision.risk_executed for revision in revisions])
    if not np.isfinite(executed).any():
        why = "was there a reviser, and was its mode not OFF?"
        raise ValueError(f"no decision of this drive was judged ({why})")
    ax = _given_or_new(ax)
    between = np.array([revision.interval for revision in revisions]).T
    _draw_decisions(ax, drive, (proposed, executed), between, "follower", "90 % interval")
    if tolerance is not None:
        look: Look = {"linestyle": ":", "linewidth": 1.0, "label": f"tolerance, {tolerance:g}"}
        ax.axhline(tolerance, color=ink(), **look)
    ax.set(ylim=(-0.03, 1.03), ylabel="latent risk")
    return _finished(ax, drive, 0.0)


def accelerations(drive: Episode, ax: Axes | None = None) -> Axes:
    """What was proposed and what was executed, over time; where they differ it is shaded.

    Raises
    ------
    ValueError
        If nothing was decided in the drive.

    Examples
    --------
    >>> from matplotlib.figure import Figure
    >>> from evofsm import plot
    >>> from evofsm.driving import drive, guard_for_family, load_family
    >>> family = load_family("emergency")
    >>> driven = drive(guard_for_family(family), family.draw(0, 0))
    >>> plot.accelerations(driven, Figure().subplots()).get_ylabel()
    'acceleration [m/s²]'
    >>> plot.risk(driven, Figure().subplots(), tolerance=0.02).get_ylabel()
    'latent risk'
    """
    if not drive.decisions:
        raise ValueError("nothing was decided in this drive")
    ax = _given_or_new(ax)
    ax.axhline(0.0, color=COLORS["soft"], linewidth=0.6)
    both = drive.proposed, drive.executed
    _draw_decisions(ax, drive, both, both, "dead end", "revised")
    ax.set_ylabel("acceleration [m/s²]")
    return _finished(ax, drive, float(drive.executed[-1]))


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
    fill: Look = {"step": "post", "color": COLORS[color], "alpha": 0.25, "linewidth": 0.0}
    ax.fill_between(when, low, high, label=label, **fill)
    dashed: Look = {"color": COLORS["dead end"], "linestyle": "--", "label": "proposed"}
    ax.step(when, proposed, where="post", **dashed)
    ax.step(when, executed, where="post", color=COLORS["follower"], label="executed")


def _finished(ax: Axes, drive: Episode, y: float) -> Axes:
    """With a collision marked at height ``y``, and explained."""
    if drive.collided:
        draw_collision(ax, float(drive.time[-1]), y)
        ax.lines[-1].set_label("collision")
    ax.set_xlabel("time [s]")
    _explain(ax)
    return ax


def _explain(ax: Axes) -> None:
    """Put the legend above, where it hides nothing."""
    look: Look = {"loc": "lower left", "bbox_to_anchor": (0.0, 1.0), "borderaxespad": 0.2}
    ax.legend(fontsize=points(7.5), frameon=False, ncols=3, **look)


def _given_or_new(ax: Axes | None) -> Axes:
    if ax is not None:
        return ax
    from matplotlib import pyplot  # late: whoever gives axes needs none of it

    return pyplot.subplots(layout="constrained")[1]


def _refuse_unknown(n: int, dead_ends: States) -> None:
    if n == 0:
        raise ValueError("this model has no states: its machine had observed nothing")
    for state in dead_ends:
        if not 0 <= state < n:
            raise ValueError(f"dead_ends name state {state}, but there are states 0 to {n - 1}")


# -- Parts, in the paper's figures as well --------------------------------------------------------


def points(size: float) -> float:
    """A size of type in the style that holds, whose own is 8 points where it is ours."""
    return size * float(matplotlib.rcParams["font.size"]) / 8.0


def ink(share: float = 1.0) -> str:
    """The colour of type in the style that holds, of which a share is left on its ground."""
    type_, ground = (to_rgb(matplotlib.rcParams[key]) for key in ("text.color", "axes.facecolor"))
    red, green, blue = (share * a + (1.0 - share) * b for a, b in zip(type_, ground, strict=True))
    return to_hex((red, green, blue))


def write(
    axes: Axes, text: str, xy: Point, offset: Point = (0.0, 0.0), *, size: float = 7.0, **look: Any
) -> Annotation:
    """Write beside a place, ``offset`` points from it."""
    given = {"textcoords": "offset points", "annotation_clip": False, "va": "center", **look}
    return axes.annotate(text, xy, xytext=offset, fontsize=points(size), **given)


def mark(axes: Axes, x: float, y: float, **look: Any) -> None:
    """Mark a place, beyond the edge of the axes as well."""
    axes.plot([x], [y], **{"linestyle": "none", "clip_on": False, **look})


def draw_collision(axes: Axes, x: float, y: float) -> None:
    """Mark where a run ended in a collision."""
    look: Look = {"marker": "X", "markersize": 8, "markeredgecolor": "white"}
    mark(axes, x, y, color=COLORS["ink"], markeredgewidth=0.7, zorder=7, **look)


def draw_state(
    axes: Axes, x: float, y: float, state: int, size: float, *, dead_end: bool, numbered: bool
) -> None:
    """Draw a state: a disc, or a filled hexagon for a dead end, which is always numbered."""
    edge = COLORS["dead end" if dead_end else "ink"]
    fill, text = (edge, "white") if dead_end else ("white", edge)
    width = size * (1.18 if dead_end else 1.0 if numbered else 0.35)
    look: Look = {"marker": "h" if dead_end else "o", "markersize": width, "markerfacecolor": fill}
    mark(axes, x, y, markeredgecolor=edge, markeredgewidth=0.8, zorder=5.0 + 0.5 * dead_end, **look)
    if numbered or dead_end:
        look = {"ha": "center", "va": "center_baseline", "fontweight": "bold", "zorder": 6}
        axes.annotate(f"{state + 1}", (x, y), fontsize=min(0.72 * size, 8.5), color=text, **look)


def draw_centers(axes: Axes, centers: NDArray[np.float64], dead_ends: States, size: float) -> None:
    """Draw centres (n, 2); discs that would meet move apart and point to their place."""
    places = centers
    numbered = len(centers) <= _DISCS
    if numbered:
        scale = axes.figure.dpi / 72.0
        moved = _apart(axes.transData.transform(centers) / scale, size + 1.0)
        places = axes.transData.inverted().transform(moved * scale)
    for state, (center, (x, y)) in enumerate(zip(centers, places, strict=True)):
        axes.plot([center[0], x], [center[1], y], color=ink(), linewidth=0.6, zorder=4.5)
        axes.plot(*center, marker="o", markersize=1.6, color=ink(), zorder=4.5)
        draw_state(axes, x, y, state, size, dead_end=state in dead_ends, numbered=numbered)


def _apart(places: NDArray[np.float64], size: float) -> NDArray[np.float64]:
    """Places (n, 2), those nearer than a size pushed apart; the same ones to all sides."""
    turn = np.arange(len(places))
    aside = 1e-3 * np.column_stack([np.cos(turn), np.sin(turn)])
    for _ in range(200):
        way = places[:, None] - places
        distance = np.hypot(*way.T).T + np.eye(len(places)) * size
        push = np.maximum(size - distance, 0.0)
        if push.max(initial=0.0) < 0.01 * size:
            break
        way += aside[:, None] - aside
        places = places + 0.5 * np.sum((push / (distance + 1e-3))[:, :, None] * way, axis=1)
    return places


def label_states(axis: Axis, n: int, dead_ends: States = (), *, called: str = "") -> None:
    """Put the states' numbers, from 1, on an axis that counts them from 0; the dead ends' bold.

    On an upward axis the rows of dead ends are tinted as well where they are ``called`` something.
    """
    numbered = range(0, n, 1 if n <= _TICKS else math.ceil(n / 8))
    sign = "" if axis is axis.axes.xaxis else "#"  # which there is no room for
    axis.set_ticks(numbered, [f"{sign}{state + 1}" for state in numbered])
    axis.set_tick_params(length=0, labelsize=points(7.0), pad=2.0)
    for state, label in zip(numbered, axis.get_ticklabels(), strict=False):
        if state in dead_ends:
            label.set(color=COLORS["dead end"], fontweight="bold")
    if called:
        axis.axes.set_ylim(-0.6, n - 0.4)
        tint: Look = {"color": COLORS["dead end"], "alpha": 0.18, "linewidth": 0.0, "zorder": 0.5}
        look: Look = {"xycoords": ("axes fraction", "data"), "fontweight": "bold"}
        for state in dead_ends:
            axis.axes.axhspan(state - 0.5, state + 0.5, **tint)
            write(axis.axes, called, (1.0, state), (4.0, 0.0), color=COLORS["dead end"], **look)
