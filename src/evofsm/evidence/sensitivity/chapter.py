"""The sensitivity study as a chapter: shares, reaches, strips and maps."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from evofsm.app import NONE, Table, count, listed, number, percent
from evofsm.evidence.paper.runs import CASES
from evofsm.evidence.report.asked import Asked, failures, tables_of_asked
from evofsm.evidence.report.chapter import Chapter
from evofsm.evidence.report.html import Setting
from evofsm.evidence.sensitivity.designs import NEAR, PAIRS, Design
from evofsm.evidence.sensitivity.parameters import PARAMETERS, Parameter, Standing, parameter
from evofsm.evidence.sensitivity.setting import SCALES, SPEED_NOISE, Row, Scaling
from evofsm.evidence.sensitivity.shares import Index, Share, first_order, share_of, worst_sweeps
from evofsm.evidence.sensitivity.study import Reach, Sensitivity
from evofsm.extras import needs

with needs("matplotlib", "plot", "drawing figures"):
    from matplotlib import colormaps
    from matplotlib.axes import Axes
    from matplotlib.colors import BoundaryNorm, ListedColormap
    from matplotlib.figure import Figure
    from matplotlib.patches import Patch

    from evofsm.evidence.report.drawing import Sketch
    from evofsm.plot import DEAD_END, FIRST, FOLLOWER, INK, LEADER, SOFT, WIDTH

_STANDINGS = {Standing.OPEN: "open", Standing.STATED: "stated", Standing.ADDED: NONE}
#: The claims in a few words; in full they stand in `evofsm.evidence.paper`.
_SHORT = {
    "collisions_by_case": "collisions by case",
    "brake_at_11": "brake at 11 s",
    "brake_at_15": "brake at 15 s",
    "states_after_each_run": "no state after run 4",
    "states_final": "7 states",
    "dead_end_state": "one collision state",
    "dead_end_share": "all in the dead end",
    "case3_leaves_dead_end": "case 3 leaves it",
    "case4_enters_dead_end": "case 4 comes to it",
    "jsd_max_by_case": "divergence < 0.15",
}
_COLLISIONS = "collisions_by_case"
_CENTRED: Any = {"ha": "center", "va": "center", "fontsize": 6.5}
_HOLDS, _BREAKS = FOLLOWER, "#ECECEC"
# Of a claim that rarely breaks, and one that rarely holds.
_OFTEN, _SELDOM = 0.9, 0.5
# A parameter that may move less than this, of its recovered value, in both directions together.
_LITTLE = 0.1


class _Space(NamedTuple):
    """Settings over which shares are taken."""

    name: str
    column: str  #: its name in a table
    design: Design
    marker: str
    colour: str
    hatch: str
    same_collisions: bool = False  #: only those in which the cases end as in the paper

    def rows(self, study: Sensitivity) -> list[Row]:
        """Its settings."""
        rows = study.of(self.design)
        return [row for row in rows if row.verdicts[_COLLISIONS]] if self.same_collisions else rows

    def share(self, study: Sensitivity, claim: str | None = None) -> Share:
        """Share of its settings with which a claim holds, or all of them."""
        rows = self.rows(study)
        return share_of([row.holds if claim is None else row.verdicts[claim] for row in rows])


_OPEN = _Space("what the paper leaves open", "left open", Design.OPEN, "o", FOLLOWER, "")
_SAME = _Space(
    *("the same, where cases end as in the paper", "same ends", Design.OPEN, "^", FIRST, "..."),
    same_collisions=True,
)
_ALL = _Space("everything", "all", Design.ALL, "s", DEAD_END, "///")
_NEAR = _Space(f"within ±{100 * NEAR:g} % of recovered", "near", Design.NEAR, "D", LEADER, "xxx")
_SPACES = (_OPEN, _SAME, _ALL, _NEAR)


def tell(study: Sensitivity) -> Chapter:
    """What the study found."""
    sketches = [
        _sketch_shares(study),
        _sketch_sweeps(study),
        _sketch_maps(study),
        _sketch_deciders(study),
        _sketch_counts(study),
    ]
    return Chapter(
        id=study.plan.id,
        title=study.plan.question,
        about=_about(study),
        headline=_headline(study),
        answer=tuple(_answer(study)),
        losses=tuple(_losses(study)),
        fails=failures(asked := list(_what_was_asked(study))),
        tables=(
            _table_of_claims(study),
            _table_of_harm(study),
            _table_of_parameters(study),
            *tables_of_asked(asked),
        ),
        sketches=tuple(sketches),
        plan=tuple(_plan(study)),
        packages=("scipy",),
    )


def short_name(claim: str) -> str:
    """A claim in a few words, by its id."""
    return _SHORT.get(claim, claim.replace("_", " "))


# -- Words ----------------------------------------------------------------------------------------


def _about(study: Sensitivity) -> str:
    gap, speed, _ = SCALES
    return (
        f"The paper's {len(study.claims)} claims were checked with {len(study.rows):,} settings, "
        "each time on all 80 runs and by the checks of evofsm paper, in the closed-form world. "
        "Sweeps move one parameter away from the recovered setting, maps two. Latin hypercubes "
        "fill all that the paper leaves open, everything at once, and the numbers within "
        f"±{100 * NEAR:g} % of the recovered ones. A share is one of this space, as stated here: "
        "with other ranges it is another. "
        "Noise is white, new in every row and every run; the machine sees it, the driver "
        f"does not; the speeds have {SPEED_NOISE:g} m/s for each metre of the gap. Standardised: "
        f"divided by {gap:g} m and {speed:g} m/s, the radius keeps its number. "
        "That all collisions happen in one state, and that all happen in the dead end, is one "
        "claim in two wordings."
    )


def _interval(share: Share) -> str:
    return f"95 %: {percent(share.low, '')} to {percent(share.high)}"


def _ids(study: Sensitivity) -> list[str]:
    return [claim.id for claim in study.claims]


def _what_was_asked(study: Sensitivity) -> Iterator[Asked]:
    for space in (_OPEN, _NEAR):
        share = space.share(study)
        yield Asked(
            f"All {len(study.claims)} claims hold together over {space.name}"
            if space is _OPEN
            else f"All {len(study.claims)} claims hold together {space.name}",
            f"in most settings (more than {100 * _SELDOM:g} %)",
            f"in {percent(share.value)} of {share.tried:,} ({_interval(share)})",
            share.value > _SELDOM,
        )


def _headline(study: Sensitivity) -> str:
    share = _OPEN.share(study)
    often = sum(_OPEN.share(study, claim).value > _OFTEN for claim in _ids(study))
    return (
        f"All {len(study.claims)} claims hold together in {percent(share.value)} of "
        f"{share.tried:,} settings that the paper leaves open ({_interval(share)}); "
        f"{often or 'none'} of them hold{'s' if often == 1 else ''} in more than "
        f"{100 * _OFTEN:g} %."
    )


def _answer(study: Sensitivity) -> Iterator[str]:
    same, everything, near = (space.share(study) for space in (_SAME, _ALL, _NEAR))
    yield (
        f"In {same.tried:,} of them the cases end as in the paper, which is a matter of traffic "
        f"and not of the machine; all the other claims hold in {percent(same.value)} of these "
        f"({_interval(same)})."
    )
    yield (
        f"With everything varied all hold in {percent(everything.value)} of {everything.tried:,} "
        f"({_interval(everything)}), within ±{100 * NEAR:g} % of the recovered setting in "
        f"{percent(near.value)} of {near.tried:,} ({_interval(near)})."
    )
    rows = _OPEN.rows(study)
    held = np.array([row.held for row in rows])
    states = np.array([row.n_states for row in rows])
    low, high = np.quantile(states, [0.1, 0.9])
    yield (
        f"In the median {count(float(np.median(held)))} of {len(study.claims)} claims hold, with "
        f"{count(float(np.median(states)))} states ({low:.0f} to {high:.0f} in 80 % of settings; "
        f"7 in {percent(float(np.mean(states == 7)))})."
    )
    named = [
        f"{one.label} ({100 * index.value:.0f} %)"
        for one, index in _ranked(study, _OPEN, held)[:3]
        if index.counts
    ]
    if named:
        yield (
            "How many claims hold is decided first by "
            f"{listed(named)}; in brackets: share of the variance that each explains alone."
        )
    free = [reach.parameter.label for reach in study.reaches if _is_free(reach)]
    if free:
        yield (
            f"Over all that was tried, {listed(free)} alone break"
            f"{'s' if len(free) == 1 else ''} no claim."
        )


def _varied(study: Sensitivity, design: Design) -> list[Parameter]:
    return [parameter(name) for name in study.of(design)[0].varied]


def _is_free(reach: Reach) -> bool:
    return reach.low_is_end and reach.high_is_end


def _losses(study: Sensitivity) -> Iterator[str]:
    """All that speaks against the claims, the most important first."""
    share, near = _OPEN.share(study), _NEAR.share(study)
    if share.value < _SELDOM:
        yield (
            f"The reproduction is one of few settings: all claims together hold in "
            f"{percent(share.value)} of what the paper leaves open ({_interval(share)})."
        )
    shares = {claim: _OPEN.share(study, claim).value for claim in _ids(study)}
    seldom = [
        f"{short_name(claim)} ({percent(value)})"
        for claim, value in sorted(shares.items(), key=lambda one: one[1])
        if value < _SELDOM
    ]
    if seldom:
        yield f"In less than half of what is left open hold: {listed(seldom)}."
    if near.value < _OFTEN:
        nearby = {claim: _NEAR.share(study, claim).value for claim in _ids(study)}
        least = min(nearby, key=nearby.__getitem__)
        yield (
            f"Even within ±{100 * NEAR:g} % of the recovered setting all hold in only "
            f"{percent(near.value)}; least often: {short_name(least)} ({percent(nearby[least])})."
        )
    for reach in sorted(study.reaches, key=_room):
        if _room(reach) < _LITTLE:
            yield _narrow(reach)
    yield from _lost_choices(study)
    yield from _lost_to_noise(study)


def _room(reach: Reach) -> float:
    """Width of a reach, in units of the recovered value."""
    recovered = reach.parameter.recovered
    return (reach.high - reach.low) / recovered if recovered > 0.0 else float("inf")


def _narrow(reach: Reach) -> str:
    one = reach.parameter
    sides = [
        f"{side} it {listed(map(short_name, broken))} break{'s' if len(broken) == 1 else ''}"
        for side, broken in (("below", reach.broken_below), ("above", reach.broken_above))
        if broken
    ]
    return (
        f"{one.label[0].upper()}{one.label[1:]} alone may lie between {one.show(reach.low, 4)} "
        f"and {one.show(reach.high, 4)}{_unit(one)} (recovered: {one.show(one.recovered)}): "
        f"{'; '.join(sides)}."
    )


def _lost_choices(study: Sensitivity) -> Iterator[str]:
    orders = study.of(Design.SWEEP, "order")
    kept = [row.setting.order for row in orders if row.holds]
    if len(kept) < len(orders):
        worst = min(orders, key=lambda row: row.held)
        yield (
            f"The order of the cases matters: with {len(kept)} of {len(orders)} orders all claims "
            f"hold; with {', '.join(map(str, worst.setting.order))} only {worst.held} do."
        )
    for row in study.of(Design.SWEEP, "scaling"):
        if row.setting.scaling is Scaling.STANDARDISED and not row.holds:
            yield (
                f"On standardised observations {row.held} of {len(study.claims)} claims hold, with "
                f"{row.n_states} states; broken: {listed(map(short_name, _broken(row)))}."
            )


def _lost_to_noise(study: Sensitivity) -> Iterator[str]:
    reach = next((one for one in study.reaches if one.parameter.name == "noise"), None)
    sweep = study.of(Design.SWEEP, "noise")
    if reach is None or reach.high_is_end:
        return
    most = max(sweep, key=lambda row: row.n_states)
    yield (
        f"With more than {100 * reach.high:.2g} cm of noise on the gap the first claim breaks: "
        f"{listed(map(short_name, reach.broken_above))}; at {100 * most.setting.noise:.2g} cm "
        f"there are {most.n_states} states instead of 7."
    )


def _broken(row: Row) -> list[str]:
    return [claim for claim, holds in row.verdicts.items() if not holds]


def _plan(study: Sensitivity) -> Iterator[Setting]:
    plan = study.plan
    yield Setting("seed of draws and noise", str(plan.seed))
    runs = plan.rounds * len(CASES)
    yield Setting("settings in all", f"{len(study.rows):,}, each of {runs} runs and 4 more")
    for space in (_OPEN, _ALL, _NEAR):
        points = len(space.rows(study))
        yield Setting(space.name, f"{points:,} points of a Latin hypercube")
    yield Setting("sweeps", f"{len(PARAMETERS)}, {plan.levels} values each; all of what is chosen")
    yield Setting("maps", f"{len(PAIRS)}, {plan.side} × {plan.side}")
    yield Setting("search for edges", f"{len(study.of(Design.EDGE))}, by {plan.halvings} halvings")
    yield Setting("world", "in closed form; SUMO agrees with it")


# -- Tables ---------------------------------------------------------------------------------------


def _table_of_claims(study: Sensitivity) -> Table:
    claims: list[str | None] = [*_ids(study), None]
    return Table(
        "In what share of settings each claim holds [%]",
        ("claim", *(space.column for space in _SPACES)),
        tuple(
            (
                "all of them" if claim is None else short_name(claim),
                *(_cell(space.share(study, claim)) for space in _SPACES),
            )
            for claim in claims
        ),
        "Left open: all that the paper leaves open is drawn. Same ends: those of them in which "
        "the cases end as in the paper. All: everything is drawn, also what the paper states, the "
        f"scaling and noise. Near: numbers within ±{100 * NEAR:g} % of the recovered ones. In "
        "brackets: 95 % interval. The claims in full: "
        + "; ".join(f"{short_name(claim.id)}: {claim.claim}" for claim in study.claims)
        + ".",
        ours=(len(claims) - 1,),
    )


def _cell(share: Share) -> str:
    """A share in percent with its interval; small ones with more digits."""
    if not share.tried:
        return NONE
    return f"{_brief(share.value)} ({_brief(share.low)}–{_brief(share.high)})"


def _brief(share: float) -> str:
    """In percent, with a decimal where it is below ten."""
    value = 100.0 * share
    return number(value, 1).removesuffix(".0") if value < 9.95 else number(value, 0)


def _table_of_harm(study: Sensitivity) -> Table:
    rows = []
    for claim in _ids(study):
        worst = worst_sweeps(study.rows, claim)[0]
        alone = (NONE, NONE)
        if worst.kept < 1.0:
            alone = worst.parameter.label, _brief(worst.kept)
        rows.append((short_name(claim), *alone, *_decider(study, claim)))
    return Table(
        "Which parameter breaks, and which decides, each claim",
        ("claim", "alone most harmful", "holds [%]", "decides most", "explains [%]"),
        tuple(rows),
        "Alone most harmful: with all others as recovered, the claim still holds with this share "
        "of the parameter's other values. Decides most: explains the most of the variance of the "
        "verdict where all that the paper leaves open is drawn.",
    )


def _decider(study: Sensitivity, claim: str) -> tuple[str, str]:
    """The parameter that explains most of a claim's verdict alone, and how much."""
    verdicts = [row.verdicts[claim] for row in _OPEN.rows(study)]
    best, index = _ranked(study, _OPEN, verdicts)[0]
    return (best.label, f"{100.0 * index.value:.0f}") if index.counts else (NONE, NONE)


def _ranked(study: Sensitivity, space: _Space, of: ArrayLike) -> list[tuple[Parameter, Index]]:
    """What is varied, with its index; what explains most comes first."""
    rows = space.rows(study)
    found = [(one, first_order(rows, of, one)) for one in _varied(study, space.design)]
    return sorted(found, key=lambda pair: -np.nan_to_num(pair[1].value, nan=-1.0))


def _table_of_parameters(study: Sensitivity) -> Table:
    reaches = {reach.parameter.name: _reach_text(reach) for reach in study.reaches}
    rows = []
    for one in PARAMETERS:
        sweep = study.of(Design.SWEEP, one.name)
        rows.append(
            (
                one.label + (f" [{one.unit}]" if one.unit else ""),
                _STANDINGS[one.standing],
                one.show(one.recovered),
                f"{one.show(one.low)}–{one.show(one.high)}"
                if one.is_number
                else f"all {len(one.choices)}",
                reaches.get(one.name, NONE)
                if one.is_number
                else f"{sum(row.holds for row in sweep)} of {len(sweep)}",
                *(_index(study, space, one) for space in (_OPEN, _ALL)),
            )
        )
    return Table(
        "Parameters, how far each alone may move, and what it decides",
        ("parameter", "paper", "found", "tried", "all hold", "open [%]", "all [%]"),
        tuple(rows),
        "Paper: left open, stated, or not in it. Found: the recovered value. Tried: the plausible "
        "range. All hold: from where to where all claims hold, the others being as recovered; ≤ "
        "and ≥: to the end of the range. Last two columns: share of the variance of the number of "
        "claims that hold which the parameter explains alone, where what the paper leaves open, or "
        "everything, is drawn. Ranges: "
        + "; ".join(f"{one.label}: {one.why}" for one in PARAMETERS)
        + ".",
    )


def _reach_text(reach: Reach) -> str:
    one = reach.parameter
    low, high = one.show(reach.low, 4), one.show(reach.high, 4)
    at_low, at_high = reach.low_is_end and reach.low > 0.0, reach.high_is_end
    return f"{'≤' if at_low else ''}{low} to {'≥' if at_high else ''}{high}"


def _index(study: Sensitivity, space: _Space, one: Parameter) -> str:
    if one not in _varied(study, space.design):
        return NONE
    rows = space.rows(study)
    index = first_order(rows, [row.held for row in rows], one)
    return f"{100.0 * index.value:.0f}" if index.counts else "0"


def _unit(one: Parameter) -> str:
    return f" {one.unit}" if one.unit else ""


# -- Figures --------------------------------------------------------------------------------------


def _sketch_shares(study: Sensitivity) -> Sketch:
    return Sketch(
        "shares",
        "In what share of settings each claim holds",
        "Bars: 95 % intervals, often smaller than the mark.",
        "Dots with intervals: share of settings with which each claim holds, in three spaces.",
        partial(draw_shares, study),
    )


def _sketch_sweeps(study: Sensitivity) -> Sketch:
    return Sketch(
        "sweeps",
        "One parameter at a time: which claims hold",
        "Each row is a claim, each column a value of one parameter, all others being as recovered. "
        "The line marks the recovered value. Ranges are spaced as their axes say.",
        "Twelve strips, one for each parameter, that show for each claim where it holds.",
        partial(draw_sweeps, study),
    )


def _sketch_maps(study: Sensitivity) -> Sketch:
    return Sketch(
        "maps",
        "Two parameters at a time: how many claims hold",
        "Star: the recovered setting. Cells with a dot: all claims hold. Numbers: states at the "
        "end, in a few cells. The others are as recovered.",
        "Six maps of the number of claims that hold over pairs of parameters.",
        partial(draw_maps, study),
    )


def _sketch_deciders(study: Sensitivity) -> Sketch:
    return Sketch(
        "deciders",
        "Which parameter decides which claim",
        "Share of the variance of a verdict that a parameter explains alone [%], the others being "
        "drawn over their ranges; what is missing to 100 % lies in their interplay. Empty: no more "
        "than chance.",
        "Two matrices of first-order sensitivity indices, parameters by claims.",
        partial(draw_deciders, study),
    )


def _sketch_counts(study: Sensitivity) -> Sketch:
    return Sketch(
        "counts",
        "How many states there are, and how many claims hold",
        "The broken line marks the paper: 7 states, all claims.",
        "Two histograms for three spaces: number of states, and number of claims that hold.",
        partial(draw_counts, study),
    )


def draw_shares(study: Sensitivity) -> Figure:
    """A row for each claim, and one for all of them."""
    claims: list[str | None] = [*_ids(study), None]
    figure = Figure(figsize=(WIDTH, 4.5))
    axes = figure.add_axes((0.215, 0.1, 0.755, 0.79))
    lines = np.arange(len(claims))
    for shift, space in zip(np.linspace(-0.28, 0.28, len(_SPACES)), _SPACES, strict=True):
        shares = [space.share(study, claim) for claim in claims]
        value = 100.0 * np.array([share.value for share in shares])
        reach = 100.0 * np.array([[one.low, one.high] for one in shares]).T
        axes.errorbar(
            value,
            lines + shift,
            xerr=np.abs(reach - value),
            fmt=space.marker,
            color=space.colour,
            markersize=3.6,
            elinewidth=1.0,
            clip_on=False,
            label=f"{space.name} ({shares[0].tried:,})",
        )
    for line in lines[:-2]:
        axes.axhline(line + 0.5, color="#E4E4E4", linewidth=0.5)
    axes.axhline(len(claims) - 1.5, color=SOFT, linewidth=0.8)
    axes.set_yticks(
        lines, ["all of them" if claim is None else short_name(claim) for claim in claims]
    )
    axes.set_ylim(len(claims) - 0.5, -0.5)
    axes.set_xlim(0.0, 100.0)
    axes.set_xlabel("settings with which it holds [%]")
    axes.grid(axis="y", visible=False)
    axes.tick_params(axis="y", length=0.0)
    _legend(figure, axes, columns=2)
    return figure


def _legend(figure: Figure, axes: Axes, columns: int) -> None:
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(handles, labels, loc="upper right", ncols=columns, bbox_to_anchor=(0.985, 0.995))


def draw_sweeps(study: Sensitivity) -> Figure:
    """A panel for each parameter: claims by values."""
    columns = 3
    rows = -(-len(PARAMETERS) // columns)
    figure = Figure(figsize=(WIDTH, 1.72 * rows + 0.35))
    grid = figure.subplots(rows, columns, squeeze=False, sharey=True)
    figure.subplots_adjust(0.185, 0.04, 0.98, 0.935, wspace=0.1, hspace=0.4)
    for axes, one in zip(grid.flat, PARAMETERS, strict=False):
        _draw_strip(axes, study, one)
    for axes in grid.flat[len(PARAMETERS) :]:
        axes.set_visible(False)
    figure.legend(
        handles=[
            Patch(facecolor=_HOLDS, label="the claim holds"),
            Patch(facecolor=_BREAKS, edgecolor=SOFT, linewidth=0.4, label="it does not"),
        ],
        loc="upper right",
        ncols=2,
        bbox_to_anchor=(0.99, 0.998),
    )
    return figure


def _draw_strip(axes: Axes, study: Sensitivity, one: Parameter) -> None:
    claims = _ids(study)
    sweep = sorted(study.of(Design.SWEEP, one.name), key=lambda row: _place(one, row))
    places = np.array([_place(one, row) for row in sweep])
    verdicts = np.array([[row.verdicts[claim] for row in sweep] for claim in claims])
    axes.pcolormesh(
        _edges(places),
        np.arange(len(claims) + 1) - 0.5,
        verdicts.astype(float),
        cmap=ListedColormap([_BREAKS, _HOLDS]),
        vmin=0.0,
        vmax=1.0,
        edgecolor="white",
        linewidth=0.25,
    )
    axes.axvline(one.place_of(one.recovered), color=INK, linewidth=1.0, linestyle=(0, (2, 1.5)))
    axes.set_title(_axis(one), pad=3.0)
    axes.set_ylim(len(claims) - 0.5, -0.5)
    axes.set_yticks(np.arange(len(claims)), [short_name(claim) for claim in claims])
    axes.tick_params(axis="y", length=0.0, labelsize=6.8)
    axes.tick_params(axis="x", labelsize=7.0, pad=1.5)
    axes.grid(visible=False)
    _ticks_of(axes, one)


def draw_maps(study: Sensitivity) -> Figure:
    """A panel for each pair: number of claims that hold."""
    n = len(study.claims)
    figure = Figure(figsize=(WIDTH, 5.1))
    grid = figure.subplots(2, 3)
    figure.subplots_adjust(0.085, 0.085, 0.885, 0.98, wspace=0.42, hspace=0.27)
    colours = colormaps["cividis"].resampled(n + 1)
    norm = BoundaryNorm(np.arange(n + 2) - 0.5, n + 1)
    for axes, names in zip(grid.flat, PAIRS, strict=True):
        mesh = _draw_map(axes, study, names, colours, norm)
    bar = figure.colorbar(mesh, cax=figure.add_axes((0.91, 0.2, 0.017, 0.66)), ticks=range(n + 1))
    bar.set_label(f"claims that hold, of {n}")
    bar.ax.tick_params(length=0.0)
    return figure


def _draw_map(
    axes: Axes, study: Sensitivity, names: tuple[str, str], colours: Any, norm: BoundaryNorm
) -> Any:
    one, other = map(parameter, names)
    rows = study.of(Design.MAP, *names)
    x, y = (np.unique([_place(each, row) for row in rows]) for each in (one, other))
    held, states = np.full((2, len(y), len(x)), np.nan)
    for row in rows:
        at = np.searchsorted(y, _place(other, row)), np.searchsorted(x, _place(one, row))
        held[at], states[at] = row.held, row.n_states
    mesh = axes.pcolormesh(_edges(x), _edges(y), held, cmap=colours, norm=norm)
    labelled = set(_labelled(x, y, (one.place_of(one.recovered), other.place_of(other.recovered))))
    for j, i in labelled:
        dark = held[j, i] < 0.6 * len(study.claims)
        axes.text(
            x[i],
            y[j],
            f"{states[j, i]:.0f}",
            **_CENTRED,
            color="white" if dark else INK,
        )
    full = [(j, i) for j, i in np.argwhere(held == len(study.claims)) if (j, i) not in labelled]
    axes.plot([x[i] for _, i in full], [y[j] for j, _ in full], ".", color=INK, markersize=2.2)
    axes.plot(
        [one.place_of(one.recovered)],
        [other.place_of(other.recovered)],
        marker="*",
        markersize=11.0,
        color="white",
        markeredgecolor=INK,
        markeredgewidth=0.9,
        clip_on=False,
        zorder=6,
    )
    axes.set_xlabel(_axis(one))
    axes.set_ylabel(_axis(other), labelpad=2.0)
    axes.grid(visible=False)
    _ticks_of(axes, one)
    _ticks_of(axes, other, vertical=True)
    return mesh


def _labelled(
    x: NDArray[np.float64], y: NDArray[np.float64], star: tuple[float, float]
) -> Iterator[tuple[int, int]]:
    """Cells that are given a number: a few, well inside, and none under the star."""
    for j in _some(len(y)):
        for i in _some(len(x)):
            if np.hypot(x[i] - star[0], y[j] - star[1]) > 0.09:
                yield int(j), int(i)


def _some(number: int) -> NDArray[np.int64]:
    """Four indices, well inside."""
    return np.unique(np.linspace(0, number - 1, 6).round().astype(np.int64)[1:-1])


def draw_deciders(study: Sensitivity) -> Figure:
    """First-order indices of every parameter on every claim."""
    names = [*map(short_name, _ids(study)), "number that hold"]
    figure = Figure(figsize=(WIDTH, 4.0))
    grid = figure.subplots(1, 2, sharey=True)
    figure.subplots_adjust(0.145, 0.3, 0.99, 0.94, wspace=0.05)
    for axes, space in zip(grid, (_OPEN, _ALL), strict=True):
        rows = space.rows(study)
        explained: list[list[bool] | list[int]] = [
            *([row.verdicts[claim] for row in rows] for claim in _ids(study)),
            [row.held for row in rows],
        ]
        indices = np.zeros((len(PARAMETERS), len(names)))
        for j, values in enumerate(explained):
            for one, index in _ranked(study, space, values):
                indices[PARAMETERS.index(one), j] = index.value if index.counts else 0.0
        axes.imshow(100.0 * indices, cmap="Blues", vmin=0.0, vmax=80.0, aspect="auto")
        for i, j in np.argwhere(indices > 0.0):
            axes.text(
                j,
                i,
                f"{100.0 * indices[i, j]:.0f}",
                **_CENTRED,
                color="white" if indices[i, j] > 0.45 else INK,
            )
        for i, one in enumerate(PARAMETERS):
            if one not in _varied(study, space.design):
                axes.text(0.0, i, "as recovered", va="center", fontsize=6.5, color=SOFT)
        axes.axvline(len(names) - 1.5, color=SOFT, linewidth=0.6)
        axes.set_title(f"{space.name} is varied [%]")
        axes.set_xticks(range(len(names)), names, rotation=55, ha="right", rotation_mode="anchor")
        axes.set_yticks(range(len(PARAMETERS)), [one.label for one in PARAMETERS])
        axes.tick_params(length=0.0, labelsize=7.0)
        axes.grid(visible=False)
    return figure


def draw_counts(study: Sensitivity) -> Figure:
    """Histograms of states and of claims that hold."""
    most, n = 13, len(study.claims)
    figure = Figure(figsize=(WIDTH, 2.7))
    left, right = figure.subplots(1, 2)
    figure.subplots_adjust(0.075, 0.165, 0.99, 0.865, wspace=0.17)
    for place, space in enumerate((_OPEN, _ALL, _NEAR)):
        rows = space.rows(study)
        states = np.minimum([row.n_states for row in rows], most)
        held = np.array([row.held for row in rows])
        for axes, values, first, last in ((left, states, 1, most), (right, held, 0, n)):
            shares = [100.0 * np.mean(values == k) for k in range(first, last + 1)]
            x = np.arange(first, last + 1) + 0.27 * (place - 1)
            style: dict[str, Any] = {"edgecolor": "white", "linewidth": 0.3, "hatch": space.hatch}
            axes.bar(x, shares, 0.27, color=space.colour, label=space.name, **style)
    left.set_xticks(range(1, most + 1), [*map(str, range(1, most)), f"≥{most}"])
    right.set_xticks(range(n + 1))
    for axes, title, paper in ((left, "states at the end", 7), (right, "claims that hold", n)):
        axes.set_xlabel(title)
        axes.axvline(paper, color=INK, linewidth=0.9, linestyle=(0, (4, 1.6)), zorder=0)
        axes.grid(axis="x", visible=False)
    left.set_ylabel("settings [%]")
    _legend(figure, left, columns=3)
    return figure


def _place(one: Parameter, row: Row) -> float:
    return one.place_of(getattr(row.setting, one.name))


def _edges(places: NDArray[np.float64]) -> NDArray[np.float64]:
    """Between neighbouring places, and half a step beyond the first and the last."""
    between = 0.5 * (places[1:] + places[:-1])
    first, last = places[0] - (between[0] - places[0]), places[-1] + (places[-1] - between[-1])
    return np.concatenate([[first], between, [last]])


def _axis(one: Parameter) -> str:
    return f"{one.label} {one.symbol}".strip() + (f" [{one.unit}]" if one.unit else "")


def _ticks_of(axes: Axes, one: Parameter, *, vertical: bool = False) -> None:
    """Ends, middle and quarters of a range; names of choices where they are few."""
    if one.choices:
        few = len(one.choices) <= 3
        shown = one.choices if few else (one.choices[0], one.choices[-1])
        places = [one.place_of(value) for value in shown]
        texts = [one.show(value) for value in shown]
    else:
        places = [0.0, 0.5, 1.0]
        texts = [one.show(one.value_at(place)) for place in places]
    (axes.set_yticks if vertical else axes.set_xticks)(places, texts)
