"""The figures of the sensitivity study."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from studies.old import plot
from studies.old.drawing import Sketch
from studies.old.scores import share_of
from studies.sensitivity.designs import PAIRS, Design
from studies.sensitivity.parameters import PARAMETERS, Parameter, parameter
from studies.sensitivity.setting import Row
from studies.sensitivity.spaces import ALL, NEARBY, OPEN, SAME, Space, short_name
from studies.sensitivity.study import Sensitivity

if TYPE_CHECKING:
    from matplotlib.figure import Figure


_LOOKS: dict[Space, plot.Look] = {
    OPEN: plot.OURS,
    SAME: plot.OTHER,
    ALL: plot.FIXED,
    NEARBY: plot.TOLD,
}
# More states are counted as so many.
_MOST_STATES = 13


def sketches(study: Sensitivity) -> Iterator[Sketch]:
    """All figures."""
    yield Sketch(
        "shares",
        "In what share of settings each claim holds",
        "Bars: 95 % intervals, often smaller than the mark.",
        "Dots with intervals: share of settings with which each claim holds, in three spaces.",
        partial(draw_shares, study),
    )
    yield Sketch(
        "sweeps",
        "One parameter at a time: which claims hold",
        "Each row is a claim, each column a value of one parameter, all others being as recovered; "
        "blue: the claim holds. The line marks the recovered value. Ranges are spaced as their "
        "axes say.",
        "Twelve strips, one for each parameter, that show for each claim where it holds.",
        partial(draw_sweeps, study),
    )
    yield Sketch(
        "maps",
        "Two parameters at a time: how many claims hold",
        "Star: the recovered setting. Cells with a dot: all claims hold. Numbers: states at the "
        "end, in a few cells. The others are as recovered.",
        "Six maps of the number of claims that hold over pairs of parameters.",
        partial(draw_maps, study),
    )
    yield Sketch(
        "deciders",
        "Which parameter decides which claim",
        "Share of the variance of a verdict that a parameter explains alone [%], the others being "
        "drawn over their ranges; what is missing to 100 % lies in their interplay. Empty: no more "
        "than chance. Grey: as recovered.",
        "Two matrices of first-order sensitivity indices, parameters by claims.",
        partial(draw_deciders, study),
    )
    yield Sketch(
        "counts",
        "How many states there are, and how many claims hold",
        "Bands: 95 % intervals. The broken line marks the paper: 7 states, all claims.",
        "For three spaces the share of settings by the number of states, and by the number of "
        "claims that hold.",
        partial(draw_counts, study),
    )


def draw_shares(study: Sensitivity) -> Figure:
    """A row for each claim, and one for all of them."""
    claims: list[str | None] = [*study.ids, None]
    figure, ((axes,),) = plot.panels(1, 1, 4.5)
    looks = {}
    shifts = np.linspace(-0.28, 0.28, len(_LOOKS))
    for shift, (space, look) in zip(shifts, _LOOKS.items(), strict=True):
        shares = [space.share(study, claim) for claim in claims]
        reach = 100.0 * np.array([(one.value, one.low, one.high) for one in shares])
        plot.dots(axes, {**look, "markersize": 3.6}, np.arange(len(claims)) + shift, *reach.T)
        looks[f"{space.name} ({shares[0].tried:,})"] = look
    plot.name_lines(
        axes, [short_name(claim) for claim in claims], striped=True, bold=("all of them",)
    )
    axes.set_xlim(0.0, 100.0)
    axes.set_xlabel("settings with which it holds [%]")
    plot.legend(figure, looks, columns=2)
    return figure


def draw_sweeps(study: Sensitivity) -> Figure:
    """A panel for each parameter: claims by values."""
    columns = 3
    rows = -(-len(PARAMETERS) // columns)
    figure, grid = plot.panels(rows, columns, 1.72 * rows + 0.35, sharey=True)
    for axes, one in zip(grid.flat, PARAMETERS, strict=False):
        sweep = sorted(study.of(Design.SWEEP, one.name), key=partial(_place, one))
        holds = [[row.verdicts[claim] for row in sweep] for claim in study.ids]
        edges = _edges(np.array([_place(one, row) for row in sweep]))
        plot.strips(axes, edges, holds, [short_name(claim) for claim in study.ids])
        plot.level(axes, one.place_of(one.recovered), across=False, color=plot.INK, zorder=3.0)
        axes.set_title(one.axis, pad=3.0)
        _tick(axes.set_xticks, one)
        axes.tick_params(axis="x", labelsize=7.0, pad=1.5)
    for axes in grid.flat[len(PARAMETERS) :]:
        axes.set_visible(False)
    return figure


def draw_maps(study: Sensitivity) -> Figure:
    """A panel for each pair: number of claims that hold."""
    n = len(study.claims)
    figure, grid = plot.panels(2, 3, 5.1)
    for axes, names in zip(grid.flat, PAIRS, strict=True):
        one, other = map(parameter, names)
        x, y, held, states = _map_of(study.of(Design.MAP, *names), one, other)
        edges = _edges(x), _edges(y)
        limits = -0.5, n + 0.5
        drawn = plot.heat(axes, held, limits, steps=n + 1, colors="cividis", edges=edges)
        star = one.place_of(one.recovered), other.place_of(other.recovered)
        labelled = set(_labelled(x, y, star))
        for j, i in np.ndindex(held.shape):
            color = "white" if held[j, i] < 0.6 * n else plot.INK
            if (j, i) in labelled:
                text = f"{states[j, i]:.0f}"
                axes.text(x[i], y[j], text, ha="center", va="center", fontsize=6.5, color=color)
            elif held[j, i] == n:
                axes.plot(x[i], y[j], ".", color=plot.INK, markersize=2.2)
        look = {"marker": "*", "markersize": 11.0, "color": "white", "markeredgecolor": plot.INK}
        axes.plot(*star, clip_on=False, zorder=6, **look)
        axes.set_xlabel(one.axis)
        axes.set_ylabel(other.axis, labelpad=2.0)
        _tick(axes.set_xticks, one)
        _tick(axes.set_yticks, other)
    bar = figure.colorbar(drawn, ax=grid, ticks=range(n + 1), shrink=0.7)
    bar.set_label(f"claims that hold, of {n}")
    return figure


def _map_of(
    rows: Sequence[Row], one: Parameter, other: Parameter
) -> tuple[NDArray[np.float64], ...]:
    """Places to the right and upward, and there claims that hold and states."""
    x, y = (np.unique([_place(each, row) for row in rows]) for each in (one, other))
    held, states = np.full((2, len(y), len(x)), np.nan)
    for row in rows:
        at = np.searchsorted(y, _place(other, row)), np.searchsorted(x, _place(one, row))
        held[at], states[at] = row.held, row.n_states
    return x, y, held, states


def _labelled(
    x: NDArray[np.float64], y: NDArray[np.float64], star: tuple[float, float]
) -> Iterator[tuple[int, int]]:
    """Cells that are given a number: a few, well inside, and none under the star."""
    right, up = (np.linspace(0, len(one) - 1, 6).round().astype(int)[1:-1] for one in (x, y))
    for j in up.tolist():
        for i in right.tolist():
            if np.hypot(x[i] - star[0], y[j] - star[1]) > 0.09:
                yield j, i


def draw_deciders(study: Sensitivity) -> Figure:
    """First-order indices of every parameter on every claim."""
    names = [*map(short_name, study.ids), "number that hold"]
    figure, grid = plot.panels(1, 2, 4.2, sharey=True)
    for axes, space in zip(grid.flat, (OPEN, ALL), strict=True):
        rows = space.rows(study)
        explained: list[list[bool] | list[int]] = [
            *([row.verdicts[claim] for row in rows] for claim in study.ids),
            [row.held for row in rows],
        ]
        indices = np.full((len(PARAMETERS), len(names)), np.nan)
        for j, values in enumerate(explained):
            for one, index in space.ranked(study, values):
                indices[PARAMETERS.index(one), j] = 100.0 * index.value if index.counts else 0.0
        axes.set_facecolor("#ECECEC")
        plot.heat(
            axes,
            indices,
            (0.0, 80.0),
            colors="Blues",
            text=lambda value: f"{value:.0f}" if value > 0.0 else "",
        )
        plot.name_lines(axes, [one.label for one in PARAMETERS])
        plot.level(axes, len(names) - 1.5, across=False, linestyle="-", zorder=3.0)
        axes.set_title(f"{space.name} is varied [%]")
        axes.set_xticks(range(len(names)), names, rotation=55, ha="right", rotation_mode="anchor")
        axes.tick_params(labelsize=7.0)
    return figure


def draw_counts(study: Sensitivity) -> Figure:
    """Shares of settings by the number of states and of claims that hold."""
    n = len(study.claims)
    figure, ((left, right),) = plot.panels(1, 2, 2.7, sharey=True)
    spaces = (OPEN, ALL, NEARBY)
    for space in spaces:
        rows = space.rows(study)
        states = np.minimum([row.n_states for row in rows], _MOST_STATES)
        held = np.array([row.held for row in rows])
        for axes, values, first, last in ((left, states, 1, _MOST_STATES), (right, held, 0, n)):
            shares = [share_of(values == k) for k in range(first, last + 1)]
            reach = 100.0 * np.array([(one.value, one.low, one.high) for one in shares])
            plot.curves(axes, _LOOKS[space], range(first, last + 1), *reach.T)
    left.set_xticks(
        range(1, _MOST_STATES + 1), [*map(str, range(1, _MOST_STATES)), f"≥{_MOST_STATES}"]
    )
    right.set_xticks(range(n + 1))
    for axes, title, paper in ((left, "states at the end", 7), (right, "claims that hold", n)):
        axes.set_xlabel(title)
        plot.level(axes, paper, across=False, color=plot.INK)
    left.set_ylabel("settings [%]")
    left.set_ylim(bottom=0.0)
    plot.legend(figure, {space.name: {"linestyle": "-", **_LOOKS[space]} for space in spaces})
    return figure


def _place(one: Parameter, row: Row) -> float:
    return one.place_of(getattr(row.setting, one.name))


def _edges(places: NDArray[np.float64]) -> NDArray[np.float64]:
    """Between neighbouring places, and half a step beyond the first and the last."""
    between = 0.5 * (places[1:] + places[:-1])
    first, last = 2.0 * places[0] - between[0], 2.0 * places[-1] - between[-1]
    return np.concatenate([[first], between, [last]])


def _tick(set_ticks: Any, one: Parameter) -> None:
    """Ends and middle of a range; names of few choices, or of the first and last."""
    if one.choices:
        shown = one.choices if len(one.choices) <= 3 else (one.choices[0], one.choices[-1])
        set_ticks([one.place_of(value) for value in shown], [one.show(value) for value in shown])
    else:
        set_ticks([0.0, 0.5, 1.0], [one.show(one.value_at(place)) for place in (0.0, 0.5, 1.0)])
