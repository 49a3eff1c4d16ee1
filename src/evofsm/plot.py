"""Plots of a model, a guard and a log, on axes given or new, which they return.

They set no style. Data on the axes count states and actions from 0, labels from 1. Nothing rests on
colour alone. The same colours stand in ``io/graphs.py`` and ``cli/watch/live/page.css``.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from evofsm.extras import needs
from evofsm.fsm.clusters import NOVELTY
from evofsm.fsm.model import FSMModel
from evofsm.fsm.proportions import usual_range
from evofsm.fsm.rules import reach, weights_of
from evofsm.fsm.validation import check_index, check_rows
from evofsm.guard import Guard, LearntRisk
from evofsm.guard.foresight import DATES
from evofsm.guard.learnt.failure import HELD, SAYS, SIZE, I, J, distances, telling
from evofsm.guard.learnt.rollout import FAILS

with needs("matplotlib", "plot", "plotting"):
    import matplotlib
    from matplotlib.colors import to_hex, to_rgb
    from matplotlib.dates import AutoDateLocator, ConciseDateFormatter
    from matplotlib.patches import Ellipse, FancyArrowPatch
    from matplotlib.transforms import Bbox

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.text import Annotation

__all__ = ["COLORS", "experience", "graph", "states"]

Look = dict[str, Any]  # how something is drawn, as matplotlib is told
States = Collection[int]  # indices
Point = tuple[float, float]

#: Okabe and Ito's colours, which colour-blind readers can tell apart.
COLORS = {
    **{"ink": "#222222", "soft": "#777777", "third": "#CC79A7"},
    **{"follower": "#0072B2", "leader": "#009E73", "dead end": "#D55E00"},
}
# Up to so many states are drawn as discs with numbers, and each has its number on an axis.
_DISCS, _TICKS = 20, 12
# Of the arrows between states so many of each are dark; the widest of all [points].
_DARK, _WIDEST = 2, 1.6
# Points on each side of the grid on which it is asked where a guard fails.
_GRID = 300

# -- Of a model -----------------------------------------------------------------------------------


def states(
    model: FSMModel,
    ax: Axes | None = None,
    *,
    variables: tuple[int, int] = (0, 1),
    dead_ends: States = (),
    rows: ArrayLike = (),
    failed: ArrayLike = (),
    ways: bool = False,
    alarm: ArrayLike = (),
) -> Axes:
    """Centres of the states in the plane of two variables.

    Where discs would overlap they are moved apart. What is on the axes before stays in view. What
    is far from nearly all else is not: such states are at the edge, such rows in the legend.

    Parameters
    ----------
    model : FSMModel
    ax : matplotlib.axes.Axes, optional
        Where to plot; without it on new axes of pyplot.
    variables : (int, int)
        Indices of the variables to the right and upward.
    dead_ends : collection of int
        Indices of states to mark by a hexagon, as `dead_ends_of` finds them.
    rows : (T, m) array_like, optional
        What was observed, as dots behind.
    failed : (T,) array_like of bool, or of int, optional
        With which of them an episode failed, or their numbers: crosses.
    ways : bool
        Whether to show how far each state of a `Novelty` reaches (an ellipse), the two likeliest
        ways out of each, as wide as they are likely, and a legend.
    alarm : (r, 14) array_like, optional
        Where a guard alarms, to tint, as `evofsm.guard.Foresight.where` has it.

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
    _refuse_unknown(model, dead_ends)
    if model.n_variables < 2:
        raise ValueError("a plane takes two variables; there is one")
    pair = [check_index("variable", k, model.n_variables) for k in variables]
    ax = _given_or_new(ax)
    box = [ax.dataLim.frozen()] if ax.has_data() else []
    centers, dots = model.centers[:, pair], np.reshape(rows, (-1, model.n_variables))[:, pair]
    fails = np.asarray(failed)
    if fails.dtype != np.bool_ or fails.shape != (len(dots),):
        fails = check_rows("failed", failed, len(dots))
    times = np.ceil(_GRID**2 * model.visits / max(float(model.visits.sum()), 1.0)).astype(int)
    every = dots if len(dots) else centers.repeat(times, axis=0)
    ends = np.transpose([usual_range(x, y) for x, y in zip(every.T, dots[fails].T, strict=True)])
    centers, in_view = np.clip(centers, *ends), ((centers >= ends[0]) & (centers <= ends[1])).all(1)
    if len(dots):
        look: Look = {"markersize": 1.5, "color": ink(0.3), "zorder": 1.2, "rasterized": True}
        ax.plot(*dots.T, ".", label="observed", **look)
    if np.any(fails):
        look = {"markersize": 5.0, "color": COLORS["dead end"], "zorder": 4.0}
        ax.plot(*dots[fails].T, "x", label="failed", **look)
    if ways and model.rule.table["rule"] == NOVELTY:
        weights = weights_of(model.rule, model.n_variables)[pair]
        radii = reach(model.rule, model.settings, model.width) / weights
        look = {"color": COLORS["leader"], "alpha": 0.1, "linewidth": 0.0, "zorder": 0.4}
        for k, center in enumerate(centers[in_view]):
            label = "" if k else "where a state reaches"
            ax.add_patch(Ellipse(center, *2.0 * radii, label=label, **look))
        ends = np.vstack([ends, centers[in_view] - radii, centers[in_view] + radii])
    ax.dataLim.set(Bbox.union([*box, Bbox([ends.min(0), ends.max(0)])]))
    ax.margins(0.1)
    ax.autoscale_view()
    limits = ax.axis()
    _tint(ax, pair, np.reshape(alarm, (-1, SIZE)), "where it alarms if nothing changes")
    if ways:
        leaves = model.changes * (1.0 - np.eye(model.n_states))
        shares = leaves / np.maximum(leaves.sum(1, keepdims=True), 1.0)
        for i, j in np.argwhere(shares > 0.0):
            if (shares[i] > shares[i, j]).sum() < _DARK:
                _arrow(ax, centers[i], centers[j], max(_WIDEST * shares[i, j], 0.4), ink(0.5))
        ax.plot([], [], color=ink(0.5), label="likeliest ways on")
        ax.plot([], [], "o", fillstyle="none", color=ink(), label="state")
        inside = np.all((dots >= limits[::2]) & (dots <= limits[1::2]), axis=1)
        if outside := len(dots) - int(inside.sum()):
            beyond = f"not in view: {outside:,} observed, of which {fails[~inside].sum():,} failed"
            ax.plot([], [], " ", label=beyond)
        if n_beyond := int((~in_view).sum()):
            ax.plot([], [], " ", label=f"at the edge: {n_beyond:,} states that lie beyond it")
        _explain(ax)
    draw_centers(ax, centers, dead_ends, size=13.0)
    ax.axis(limits)
    ax.set(xlabel=model.labels.variable(pair[0]), ylabel=model.labels.variable(pair[1]))
    return ax


def graph(model: FSMModel, ax: Axes | None = None, *, dead_ends: States = ()) -> Axes:
    """The states on a circle, with arrows as wide as the next state is probable.

    Staying is written beside the state; the two likeliest ways out of each are dark; actions are
    weighed by how often they were used. Axes, dead ends, result and errors are as in `states`.

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
    _refuse_unknown(model, dead_ends)
    ax = _given_or_new(ax)
    matrix, n = model.averaged_matrix, model.n_states
    angle = 0.5 * np.pi - 2.0 * np.pi * np.arange(n) / n
    places = np.column_stack([np.cos(angle), np.sin(angle)])  # from the top, clockwise
    has_numbers = n <= _DISCS
    for state, (x, y) in enumerate(places):
        dead_end, note = state in dead_ends, f"stays {100 * matrix[state, state]:.0f} %"
        draw_state(ax, x, y, state, 13.0, dead_end=dead_end, numbered=has_numbers)
        if has_numbers or dead_end:  # among many there is room for dead ends alone
            ha = "center" if abs(x) < 0.2 else "left" if x > 0.0 else "right"
            va = "center" if abs(y) < 0.5 else "bottom" if y > 0.0 else "top"
            color = COLORS["dead end"] if dead_end else ink()
            text = f"dead end\n{note}" if dead_end else note
            write(ax, text, (x, y), (11.0 * x, 11.0 * y), ha=ha, va=va, color=color)
    ax.set(xlim=(-1.75, 1.75), ylim=(-1.35, 1.35), aspect="equal")
    ax.set_axis_off()
    between = matrix * (1.0 - np.eye(n))
    heaviest = max(float(between.max(initial=0.0)), 1e-12)
    rank = np.argsort(np.argsort(-between, axis=1), axis=1)
    for i, j in np.argwhere(between > 0.005 * heaviest):
        pale = rank[i, j] >= _DARK
        if pale and not has_numbers:
            continue
        color = ink(0.19) if pale else COLORS["dead end"] if j in dead_ends else ink(0.69)
        wide = max(_WIDEST * between[i, j] / heaviest, 0.4)
        bend = 0.28 / float(np.hypot(*(places[j] - places[i])))
        _arrow(ax, places[i], places[j], wide, color, bend)
    return ax


def _arrow(ax: Axes, origin: Any, target: Any, width: float, color: str, bend: float = 0.2) -> None:
    look: Look = {"connectionstyle": f"arc3,rad={bend}", "arrowstyle": "-|>", "color": color}
    look |= {"mutation_scale": 6.5, "shrinkA": 7.5, "shrinkB": 8.5, "linewidth": width}
    ax.add_patch(FancyArrowPatch(origin, target, zorder=1.5 + 0.3 * width, **look))


def experience(
    guard: Guard, ax: Axes | None = None, *, variables: tuple[int, int] | None = None
) -> Axes:
    """What a guard has learnt of failure, over what was survived, in the plane of two variables.

    Dots were survived: where there are none nothing was seen, and where it fails is a guess. Discs
    are the machine's states, hexagons dead ends, and around each is how far it reaches where all
    other variables are as in its centre; elsewhere it reaches less far.

    Parameters
    ----------
    guard : Guard
        Its judge learns from which episodes failed (`LearntRisk`).
    ax : matplotlib.axes.Axes, optional
        As in `states`; its legend is above.
    variables : (int, int), optional
        As in `states`; without them the first of those that tell where it fails.

    Raises
    ------
    ValueError
        If the judge is another one, nothing was observed, or there is no such variable.

    Examples
    --------
    >>> from matplotlib.figure import Figure
    >>> from evofsm import Guard, plot
    >>> guard = Guard(low=-1.0, high=1.0, interval=0.1)
    >>> for speed in (0.0, 0.1, 0.3):
    ...     revision = guard.decide([5.0, speed], proposal=1.0)
    >>> guard.end(failed=True, observation=[5.0, 0.6])
    >>> plot.experience(guard, Figure().subplots(), variables=(1, 0)).get_xlabel()
    'variable 2'
    """
    judge = guard.judge
    if not isinstance(judge, LearntRisk) or not judge.n_variables:
        raise ValueError("the judge of this guard has not learnt where it fails")
    memory, m = judge.state, judge.n_variables
    fails = memory.forms[memory.forms[:, SAYS] == FAILS]
    failure_variables = telling(fails)
    pair = list(variables or dict.fromkeys([*failure_variables, *range(max(m, 2))]))[:2]
    pair = [check_index("variable", k, m) for k in pair]
    ax, label_of, color = _given_or_new(ax), judge.labels.variable, COLORS["dead end"]
    dots = np.concatenate([memory.survived, memory.brinks])
    label = "survived (blank: nothing was seen)"
    ax.plot(*dots[:, pair].T, ".", markersize=1.5, color=ink(0.4), label=label)
    ax.plot(*memory.failures[:, pair].T, "x", markersize=5.0, color=ink(), label="failed")
    sizes = 2.0 * memory.radii[:, None] * memory.survived.std(0)[pair]
    label = "dead end" + ", all else as in its centre" * (m > 2)
    for k, (centre, (wide, high)) in enumerate(zip(memory.centres[:, pair], sizes, strict=True)):
        look: Look = {"fill": False, "edgecolor": color, "label": "" if k else label, "zorder": 3.0}
        ax.add_patch(Ellipse(centre, wide, high, **look))
    centers = np.empty((0, 2)) if guard.machine is None else guard.machine.centers[:, pair]
    ax.update_datalim(centers)
    ax.autoscale_view()
    limits = ax.axis()
    _tint(ax, pair, np.where(np.arange(SIZE) == HELD, 0.0, fails), "fails, as learnt")
    draw_centers(ax, centers, (), 10.0)
    ax.axis(limits)
    ax.plot([], [], "o", fillstyle="none", color=ink(), label="state")
    if elsewhere := sorted({*failure_variables} - {*pair}):
        ax.plot([], [], " ", label=f"not in view: fails by {', '.join(map(label_of, elsewhere))}")
    _explain(ax, columns=2)
    ax.set(xlabel=label_of(pair[0]), ylabel=label_of(pair[1]))
    return ax


def _tint(ax: Axes, pair: list[int], table: NDArray[np.float64], label: str) -> None:
    """Tint where forms (r, SIZE) of two variables are passed, or by `HELD` nearly, with an edge."""
    limits, failure_color = ax.axis(), COLORS["dead end"]
    table = table[np.isin(table[:, [I, J]], pair).all(1)]
    if not len(table):
        return
    x, y = np.meshgrid(np.linspace(*limits[:2], _GRID), np.linspace(*limits[2:], _GRID))
    z = np.zeros((x.size, max(pair) + 1))
    z[:, pair] = np.column_stack([x.ravel(), y.ravel()])
    form = (-distances(table, z) - table[:, HELD, None]).max(0).reshape(x.shape)
    ax.contourf(x, y, form, [0.0, np.inf], colors=[failure_color], alpha=0.15, zorder=0.5)
    ax.contour(x, y, form, [0.0], colors=[failure_color], linewidths=1.2, zorder=2.0)
    look: Look = {"markersize": 8.0, "color": failure_color, "alpha": 0.3}
    ax.plot([], [], "s", label=label, **look)


# -- Of a log -------------------------------------------------------------------------------------


def history(
    axes: Sequence[Axes],
    time: ArrayLike,
    rows: ArrayLike,
    names: Sequence[str],
    alarms: ArrayLike,
    failures: ArrayLike,
    *,
    model: FSMModel | None = None,
    limits: Sequence[tuple[int, float]] = (),
) -> None:
    """What was seen over time, and below when alarms were on, and failures came.

    What is far from nearly all else of a variable is not in view, but counted.

    Parameters
    ----------
    axes : sequence of Axes
        One for each variable, then one for the states if there is a model, and one for alarms.
    time, rows, names : (T,) and (T, m) array_like, sequence of str
        The time in seconds, or as dates since 1970.
    alarms, failures : (T,) array_like
        1 while an alarm is on that a failure followed, and with a failure that was foreseen; 2
        where none followed, or it was not; else 0.
    model : FSMModel, optional
    limits : sequence of (int, float)
        Variables, by their index, and the values at which they alarm.
    """
    when, z = np.asarray(time, np.float64), np.asarray(rows, np.float64)
    fails, steps, is_dated = np.asarray(failures), np.diff(when), bool(when[0] >= DATES)
    unit, size = ("hours", 3600.0) if np.ptp(when) > 7200.0 else ("minutes", 60.0)
    if np.ptp(when) > 2e5 or is_dated:
        unit, size = "days", 86400.0
    step = float(np.median(steps)) if len(steps) else 0.0
    holes = np.flatnonzero((steps > 3.0 * step) | (steps < 0.0)) + 1  # there NaN ends lines
    x = (when - when[0] * (not is_dated)) / size
    line_x = np.insert(x, holes, x[holes - 1] + step / size)
    on = np.insert(np.asarray(alarms), holes, 0)
    kinds = ("right alarm", COLORS["follower"]), ("false alarm", COLORS["third"])
    for ax in axes:
        over = ax.get_xaxis_transform()
        for kind, (label, color) in enumerate(kinds, 1):
            look: Look = {"color": color, "alpha": 0.35, "linewidth": 1.5, "label": label}
            ax.fill_between(line_x, 0.0, 1.0, on == kind, transform=over, **look)
        for cross in x[fails > 0]:
            ax.axvline(cross, color=COLORS["dead end"], linewidth=0.8, linestyle="--")
    for k, (ax, name, values) in enumerate(zip(axes, names, z.T, strict=False)):
        ax.plot(line_x, np.insert(values, holes, np.nan), color=ink(), linewidth=0.6)
        at = [value for variable, value in limits if variable == k]
        low, high = usual_range(values, values[fails > 0])
        low, high = min(low, *at, high), max(high, *at, low)
        pad = 0.06 * (high - low) or 1.0
        ax.set_ylim(low - pad, high + pad)
        for value in at:
            ax.axhline(value, color=COLORS["leader"], linewidth=1.0)
            look = {"xycoords": ax.get_yaxis_transform(), "ha": "right"}
            ground = {"facecolor": ink(0.0), "alpha": 0.8, "linewidth": 0.0, "pad": 0.5}
            write(ax, f"{value:.4g}", (1.0, value), (-2.0, 5.5), bbox=ground, **look)
        write(ax, name, (0.0, 1.0), (0.0, 5.0), size=8.0, xycoords="axes fraction")
        if beyond := int(((values < low) | (values > high)).sum()):
            look = {"ha": "right", "xycoords": "axes fraction"}
            write(ax, f"{beyond:,} rows beyond this range", (1.0, 1.0), (0.0, 5.0), **look)
    if model is not None:
        sample = np.arange(0, len(z), max(len(z) // 2000, 1))
        nearest_states = [model.nearest(row).state for row in z[sample]]
        axes[-2].plot(x[sample], nearest_states, ".", markersize=1.5, color=COLORS["leader"])
        label_states(axes[-2], model.n_states)
        write(axes[-2], "state", (0.0, 1.0), (0.0, 5.0), size=8.0, xycoords="axes fraction")
    look = {"linestyle": "none", "marker": "X", "markersize": 5.0, "color": COLORS["dead end"]}
    for kind, label in enumerate(("failure, foreseen", "failure, not foreseen"), 1):
        there, face = x[fails == kind], COLORS["dead end"] if kind == 1 else "none"
        axes[-1].plot(there, np.full(len(there), 0.5), label=label, markerfacecolor=face, **look)
    _explain(axes[-1], columns=2)
    axes[-1].set(ylim=(0.0, 1.0), yticks=[], xlabel=f"time [{unit}]")
    if is_dated:
        ticks = AutoDateLocator(minticks=3, maxticks=9)  # type: ignore[no-untyped-call]
        formatter = ConciseDateFormatter(ticks)  # type: ignore[no-untyped-call]
        axes[-1].xaxis.set(major_locator=ticks, major_formatter=formatter, label_text="time")


def _explain(ax: Axes, columns: int = 3) -> None:
    """Put the legend above, where it hides nothing."""
    look: Look = {"loc": "lower left", "bbox_to_anchor": (0.0, 1.0), "borderaxespad": 0.2}
    ax.legend(fontsize=points(7.5), frameon=False, ncols=columns, **look)


def _given_or_new(ax: Axes | None) -> Axes:
    if ax is not None:
        return ax
    from matplotlib import pyplot  # late: whoever gives axes needs none of it

    return pyplot.subplots(layout="constrained")[1]


def _refuse_unknown(model: FSMModel, dead_ends: States) -> None:
    if not isinstance(model, FSMModel):
        raise TypeError(f"model is {model!r}; it must be a snapshot, such as machine.model()")
    if model.n_states == 0:
        raise ValueError("this model has no states: its machine had observed nothing")
    for state in dead_ends:
        check_index("state", state, model.n_states)


# -- Parts, in the paper's figures as well --------------------------------------------------------


def points(size: float) -> float:
    """A size of type in the style that holds, whose own is 8 points where it is ours."""
    return size * float(matplotlib.rcParams["font.size"]) / 8.0


def ink(share: float = 1.0) -> str:
    """The colour of type in the style that holds, of which a share is left on its ground."""
    type_, ground = (to_rgb(matplotlib.rcParams[key]) for key in ("text.color", "axes.facecolor"))
    rgb = [share * a + (1.0 - share) * b for a, b in zip(type_, ground, strict=True)]
    return to_hex((rgb[0], rgb[1], rgb[2]))


def write(
    axes: Axes, text: str, xy: Point, offset: Point = (0.0, 0.0), *, size: float = 7.0, **look: Any
) -> Annotation:
    """Write beside a place, ``offset`` points from it."""
    options = {"textcoords": "offset points", "annotation_clip": False, "va": "center", **look}
    return axes.annotate(text, xy, xytext=offset, fontsize=points(size), **options)


def draw_state(
    axes: Axes, x: float, y: float, state: int, size: float, *, dead_end: bool, numbered: bool
) -> None:
    """Draw a state: a disc, or a filled hexagon for a dead end, which is always numbered."""
    edge = COLORS["dead end" if dead_end else "ink"]
    fill, text = (edge, "white") if dead_end else ("white", edge)
    width = size * (1.18 if dead_end else 1.0 if numbered else 0.35)
    look: Look = {"marker": "h" if dead_end else "o", "markersize": width, "clip_on": False}
    look |= {"markerfacecolor": fill, "markeredgecolor": edge, "markeredgewidth": 0.8}
    axes.plot([x], [y], linestyle="none", zorder=5.0 + 0.5 * dead_end, **look)
    if numbered or dead_end:
        look = {"ha": "center", "va": "center_baseline", "fontweight": "bold", "zorder": 6}
        axes.annotate(f"{state + 1}", (x, y), fontsize=min(0.72 * size, 8.5), color=text, **look)


def draw_centers(axes: Axes, centers: NDArray[np.float64], dead_ends: States, size: float) -> None:
    """Draw centres (n, 2); discs that would meet move apart and point to their place."""
    places = centers
    has_numbers = len(centers) <= _DISCS
    if has_numbers:
        scale = axes.figure.dpi / 72.0
        disc_places = _apart(axes.transData.transform(centers) / scale, size + 1.0)
        places = axes.transData.inverted().transform(disc_places * scale)
    for state, (center, (x, y)) in enumerate(zip(centers, places, strict=True)):
        axes.plot([center[0], x], [center[1], y], color=ink(), linewidth=0.6, zorder=4.5)
        axes.plot(*center, marker="o", markersize=1.6, color=ink(), zorder=4.5)
        draw_state(axes, x, y, state, size, dead_end=state in dead_ends, numbered=has_numbers)


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


def label_states(ax: Axes, n: int) -> None:
    """Put the states' numbers, from 1, on an upward axis that counts them from 0."""
    ticks = range(0, n, 1 if n <= _TICKS else math.ceil(n / 8))
    ax.set_yticks(ticks, [f"#{state + 1}" for state in ticks])
    ax.tick_params("y", length=0, labelsize=points(7.0), pad=2.0)
