"""The figures of the paper's study: runs over time, and what leads to what."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from functools import partial

import numpy as np

from evofsm import plot
from evofsm.extras import needs
from evofsm.paper.claims import LARGEST_DIVERGENCE
from evofsm.paper.page import Figure
from evofsm.paper.runs import PaperStudy, Run
from evofsm.plot import COLORS, Look

with needs("matplotlib", "plot", "drawing figures"):
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as Drawn
    from matplotlib.patches import Patch

#: Width of a figure [inch]: that of a page's text.
WIDTH = 7.2
_LEADER_LINE: Look = {"color": COLORS["leader"], "linestyle": (0, (4, 1.6))}
_FOLLOWER: Look = {"color": COLORS["follower"]}
# What tints time.
_TINT: Look = {"color": COLORS["dead end"], "alpha": 0.09, "linewidth": 0.0, "zorder": 0.4}


def figures(study: PaperStudy) -> Iterator[Figure]:
    """The figures of any study, in the order in which a reader wants them, still to be drawn."""
    for run in study.last_round:
        yield Figure(
            f"case-{run.case}",
            f"Result of {run.name}",
            "Last round. Tinted: a dead end, by an oracle who knows how both can brake; until the "
            "leader brakes it can still be left, as in case 3. Vertical lines: the driver changes "
            "(dashed), the leader's full brake (dotted), collision (solid). c, e: of the follower; "
            "action a(r) is the interval in which its acceleration lies, from the lowest to the "
            "highest.",
            partial(draw_case, study, run),
        )
    yield Figure(
        "divergence",
        "Divergence of forecast and recognised state",
        "Jensen–Shannon divergence of the one-step forecast and the belief recognised then, in "
        "the last round: 0 bit where they are equal, 1 bit where they have nothing in common. It "
        "may jump where the action changes: each has a matrix of its own.",
        partial(draw_divergence, study),
    )
    yield Figure(
        "graph",
        "State graph",
        "The learnt probability that one state follows another in the next step, over all actions "
        "by use, and beside a state that it stays. Wide beliefs make this far less than was "
        f"counted: {np.trace(study.model.changes) / study.model.changes.sum():.1%} of steps stay.",
        partial(draw_graph, study),
    )


def _letter(panels: Iterable[Axes], offset: plot.Point = (-14.0, 9.0)) -> None:
    """Name panels a, b, ... so many points from their upper left corners."""
    for name, axes in zip("abcdefgh", panels, strict=False):
        look: Look = {"xycoords": "axes fraction", "fontweight": "bold"}
        plot.write(axes, name, (0.0, 1.0), offset, size=8.5, **look)


def draw_case(study: PaperStudy, run: Run) -> Drawn:
    """Gap, speeds, acceleration, recognised state and action of one run, over time."""
    figure = Drawn(figsize=(WIDTH, 6.7))
    panels = figure.subplots(5, 1, sharex=True, height_ratios=(1.2, 1.2, 1.1, 1.3, 1.0))
    figure.subplots_adjust(left=0.105, right=0.91, top=0.88, bottom=0.07, hspace=0.16)
    gap, speeds, acceleration, state, action = panels
    episode, settings = run.episode, study.settings
    time, (gaps, followers, leaders) = episode.time, episode.observations.T
    gap.plot(time, gaps, color=COLORS["ink"])
    gap.set(ylim=(0.0, 1.08 * gaps.max()), ylabel="gap [m]")
    if episode.collided:
        look: Look = {"marker": "X", "markersize": 8, "color": COLORS["ink"], "clip_on": False}
        gap.plot([time[-1]], [0.0], markeredgecolor="white", markeredgewidth=0.7, zorder=7, **look)
    speeds.plot(time, followers, label="follower", **_FOLLOWER)
    speeds.plot(time, leaders, label="leader", **_LEADER_LINE)
    speeds.set(ylim=(0.0, None), ylabel="speed [m/s]")
    speeds.legend(loc="upper left")
    acceleration.axhline(0.0, color=COLORS["soft"], linewidth=0.6)
    acceleration.plot(time, episode.accelerations, **_FOLLOWER)
    acceleration.set_ylabel("acceleration\n[m/s²]")
    state.step(time, run.state, where="post", color=COLORS["ink"])
    plot.label_states(state, study.model.n_states)
    state.set(ylim=(-0.6, study.model.n_states - 0.4), ylabel="recognised\nstate")
    look = {"xycoords": ("axes fraction", "data"), "color": COLORS["dead end"]}
    for dead_end in study.dead_ends:
        state.axhspan(dead_end - 0.5, dead_end + 0.5, **{**_TINT, "alpha": 0.18})
        plot.write(state, "collisions", (1.0, dead_end), (4.0, 0.0), fontweight="bold", **look)
    action.step(time, run.action, where="post", **_FOLLOWER)
    n_actions = settings.actions.n_actions
    ticks = range(0, n_actions, max(1, round((n_actions - 1) / 4)))
    action.set_yticks(ticks, [f"a({tick + 1})" for tick in ticks])
    end = settings.scenario.duration
    action.set(xlim=(0.0, end), ylim=(-1.0, n_actions), ylabel="action", xlabel="time [s]")
    _tint(figure, panels, study, run)
    moments = _moments(study, run)
    for axes in panels:
        _draw_moments(axes, moments)
    for place, (at, text, _) in enumerate(moments):
        before = at / end > (0.93 if place == len(moments) - 1 else 0.5)
        height = 7.0 + 13.0 * place * before  # each text that ends there in a row of its own
        look = {"ha": "right" if before else "left", "xycoords": ("data", "axes fraction")}
        look["fontweight"] = "bold" if text.startswith("collision") else "normal"
        plot.write(gap, text, (at, 1.0), (-3.0 if before else 3.0, height), size=7.5, **look)
    figure.align_ylabels(panels)
    _letter(panels, (-51.0, 3.0))
    figure.text(0.105, 0.985, _title_of(study, run), va="top", fontsize=9.0, fontweight="bold")
    return figure


def _title_of(study: PaperStudy, run: Run) -> str:
    manners = ("aggressive", "normal") if run.case in (1, 3) else ("normal", "aggressive")
    change = study.settings.switch_at.get(run.case)
    later = "" if change is None else f", {manners[1]} from {change:g} s"
    return f"{run.name.capitalize()}: {manners[0]} driver{later}"


def _tint(figure: Drawn, panels: Sequence[Axes], study: PaperStudy, run: Run) -> None:
    time, settings = run.episode.time, study.settings
    hopeless = study.in_dead_end(run)
    for axes in panels:
        height: Look = {"transform": axes.get_xaxis_transform(), "where": hopeless}
        axes.fill_between(time, 0.0, 1.0, **height, **_TINT)
    if hopeless.any():
        decel = settings.scenario.leader.brake_decel
        text = f"dead end: if the leader braked now ({decel:g} m/s²),\n"
        text += f"even full braking ({settings.decel:g} m/s²) would be too late"
        patch = Patch(**{**_TINT, "alpha": 0.18})
        figure.legend([patch], [text], loc="upper right", bbox_to_anchor=(0.99, 0.995))


def _moments(study: PaperStudy, run: Run) -> list[tuple[float, str, str]]:
    """What happens once in a run, in the order of time: when, in words, and its dashes."""
    episode, end = run.episode, float(run.episode.time[-1])
    moments = []
    change = study.settings.switch_at.get(run.case)
    if change is not None and change <= end:
        manner = "normal" if run.case == 3 else "aggressive"
        moments.append((change, f"driver turns {manner}, {change:g} s", "--"))
    decel = study.settings.scenario.leader.brake_decel
    braking = np.flatnonzero(episode.leader_accelerations <= -decel)
    if len(braking):
        time = float(episode.time[braking[0]])
        moments.append((time, f"leader brakes, {time:.1f} s", ":"))
    if episode.collided:
        moments.append((end, f"collision, {end:.1f} s", "-"))
    return sorted(moments)


def _draw_moments(axes: Axes, moments: Sequence[tuple[float, str, str]]) -> None:
    for time, _, dashes in moments:
        axes.axvline(time, color=COLORS["ink"], linestyle=dashes, linewidth=0.8, zorder=1.5)


def draw_divergence(study: PaperStudy) -> Drawn:
    """Divergence of forecast and recognised state over time, a panel for each case."""
    figure = Drawn(figsize=(WIDTH, 4.2), layout="constrained")
    grid = figure.subplots(2, 2, sharex=True, sharey=True)
    bound: Look = {"color": COLORS["ink"], "linestyle": "--", "linewidth": 0.8}
    for axes, run in zip(grid.flat, study.last_round, strict=True):
        time, surprise = run.episode.time, run.surprise
        name = f"the paper's bound, {LARGEST_DIVERGENCE:g} bit"
        axes.axhline(LARGEST_DIVERGENCE, label=name, **bound)
        axes.plot(time, surprise, linewidth=0.8, label="one-step forecasts", **_FOLLOWER)
        _draw_moments(axes, _moments(study, run))
        axes.set_title(_title_of(study, run))
    highest = max(LARGEST_DIVERGENCE, *(np.nanmax(run.surprise) for run in study.last_round))
    grid[0, 0].set(xlim=(0.0, study.settings.scenario.duration), ylim=(0.0, 1.12 * highest))
    for left_axes, lower_axes in zip(grid[:, 0], grid[1], strict=True):
        left_axes.set_ylabel("divergence [bit]")
        lower_axes.set_xlabel("time [s]")
    _letter(grid.flat)
    figure.legend(*grid[0, 0].get_legend_handles_labels(), loc="outside upper left", ncols=4)
    return figure


def draw_graph(study: PaperStudy) -> Drawn:
    """What leads to what, as the machine has learnt it."""
    figure = Drawn(figsize=(WIDTH, 3.6), layout="constrained")
    plot.graph(study.model, figure.subplots(), dead_ends=study.dead_ends)
    return figure
