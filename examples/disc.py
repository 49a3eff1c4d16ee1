"""A point in the plane that must not enter a disc, which nobody tells the guard of.

    python examples/disc.py disc.png 2

The guard sees place and speed, and which episodes failed. It learns while one controller heads for
places all around; then, frozen, it guards another that heads straight for a goal on the other side.
The picture shows what it had learnt after 2, 10 and 40 episodes, and what came of that.
"""

from __future__ import annotations

import copy
import sys
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib import style
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from evofsm import Guard, plot
from evofsm.guard import LearntRisk, Mode, run_episode

Vector = NDArray[np.float64]
DT, RADIUS, LEARNT, DRAWN = 0.1, 0.8, (2, 10, 40), 5


class Disc:
    """It is accelerated by up to 1 m/s² along each axis, and fails within 0.8 m of the middle."""

    def reset(
        self, *, seed: int | None = None, options: object = None
    ) -> tuple[Vector, dict[str, bool]]:
        """Draw where it starts, and its goal on the other side."""
        self.chance = np.random.default_rng(seed)
        self.place = self.chance.uniform((-3.4, -2.5), (-2.6, 2.5))
        self.speed = self.chance.uniform(-0.2, 0.2, 2)
        self.goal = np.array([3.0, self.chance.uniform(-2.2, 2.2)])
        self.way = [self.place]
        return np.append(self.place, self.speed), {}

    def step(self, action: Vector) -> tuple[Vector, float, bool, bool, dict[str, bool]]:
        """Move for a tenth of a second."""
        self.place = self.place + DT * self.speed + 0.5 * DT**2 * action
        self.speed = self.speed + DT * action + 0.004 * self.chance.normal(size=2)
        self.way.append(self.place)
        failed = bool(np.hypot(*self.place) < RADIUS)
        self.arrived = bool(np.hypot(*(self.place - self.goal)) < 0.4)
        over = len(self.way) > 120
        return np.append(self.place, self.speed), 0.0, failed, self.arrived or over, {}

    def straight(self, seen: Vector) -> Vector:
        """Towards the goal, whatever is in between."""
        return np.clip(0.7 * (self.goal - seen[:2]) - seen[2:], -1.0, 1.0)


def curious(chance: np.random.Generator) -> Callable[[Vector], Vector]:
    """A controller that heads for places all around, one after the other."""
    to = chance.uniform(-2.2, 2.2, 2)

    def propose(seen: Vector) -> Vector:
        if np.abs(to - seen[:2]).max() < 0.3 or chance.random() < 0.02:
            to[:] = chance.uniform(-2.2, 2.2, 2)
        return np.clip(to - seen[:2] - 1.2 * seen[2:] + 0.1 * chance.normal(size=2), -1.0, 1.0)

    return propose


class Trial(NamedTuple):
    """What came of the straight controller."""

    ways: list[Vector]  # (T, 2) each
    failed: int
    arrived: int

    def __str__(self) -> str:
        return f"{self.failed} of {len(self.ways)} fail, {self.arrived} arrive"


def trial(guard: Guard, episodes: int) -> Trial:
    """Held-out episodes of the straight controller under a guard."""
    disc, ways, failed, arrived = Disc(), [], 0, 0
    for seed in range(episodes):
        *_, last = run_episode(disc, guard, disc.straight, seed=10_000 + seed)
        ways.append(np.array(disc.way))
        failed, arrived = failed + last.failed, arrived + disc.arrived
    return Trial(ways, failed, arrived)


def learn(seed: int, episodes: Sequence[int]) -> dict[int, Guard]:
    """Guards as they are after so many episodes of the curious controller."""
    low, high = -np.ones(2), np.ones(2)
    names, units = ("x", "y", "speed x", "speed y"), ("m", "m", "m/s", "m/s")
    judge = LearntRisk(DT, low, high, seed=seed, names=names, units=units)
    guard = Guard(low, high, interval=DT, judge=judge)
    disc, controller, found = Disc(), curious(np.random.default_rng(seed)), {}
    for episode in range(1, max(episodes) + 1):
        for _ in run_episode(disc, guard, controller, seed=100 * seed + episode):
            pass
        if episode in episodes:
            found[episode] = copy.deepcopy(guard)
            found[episode].freeze()
    return found


def draw(guards: dict[int, Guard], tried: dict[int, Trial]) -> Figure:
    """A panel for each guard: what it had learnt, and the first ways with it and without."""
    around = np.linspace(0.0, 2.0 * np.pi, 100)
    ring = RADIUS * np.column_stack([np.cos(around), np.sin(around)])
    ink, blue = "#222222", plot.COLORS["follower"]
    looks: dict[str, dict[str, Any]] = {
        "a controller alone": {"color": ink, "linestyle": (0, (3, 1.5)), "linewidth": 1.0},
        "the same, guarded": {"color": blue, "linewidth": 1.5},
        "the disc, which was not given": {"color": ink, "linestyle": ":"},
    }
    figure = Figure(figsize=(7.2, 3.3), layout="constrained")
    panels = figure.subplots(1, len(guards), sharex=True, sharey=True)
    for ax, (episodes, guard), letter in zip(panels, guards.items(), "abc", strict=True):
        plot.experience(guard, ax, variables=(0, 1))
        explained = ax.get_legend()
        explained.remove()
        drawn = (tried[0].ways[:DRAWN], tried[episodes].ways[:DRAWN], [ring])
        for ways, look in zip(drawn, looks.values(), strict=True):
            for way in ways:
                ends = "X" if np.hypot(*way[-1]) < RADIUS and way is not ring else ""
                ax.plot(*way.T, marker=ends, markevery=[-1], zorder=3.5, **look)
        seen = f"after {episodes} episodes, {guard.n_failed} failed"
        ax.set_title(f"$\\bf{{{letter}}}$  {seen}\nthen {tried[episodes]}")
        ax.set(aspect="equal", xlim=(-3.7, 3.7), ylim=(-3.2, 3.2))
        ax.label_outer()
    handles = [Line2D([], [], label=name, **look) for name, look in looks.items()]
    handles[0].set_marker("X")
    figure.legend(handles=[*explained.legend_handles, *handles], loc="outside upper left", ncols=3)
    return figure


def main(path: str = "disc.png", seed: int = 2, held_out: int = 50) -> dict[int, Trial]:
    """Learn, try, print and draw."""
    guards = learn(seed, LEARNT)
    low, high = -np.ones(2), np.ones(2)
    off = Guard(low, high, interval=DT, mode=Mode.OFF)
    tried = {after: trial(guard, held_out) for after, guard in {0: off, **guards}.items()}
    for after, one in tried.items():
        print(f"after {after:2} episodes: {one}" if after else f"controller alone:  {one}")
    with style.context(["default", "evofsm.paper.house"]):
        draw(guards, tried).savefig(path, metadata={"Software": None})
    return tried


if __name__ == "__main__":
    main(*sys.argv[1:2], *map(int, sys.argv[2:]))
