"""A quadrotor in a room: 12 variables, four rotors, and a guard told only which flights failed.

    python examples/quadrotor.py --picture quadrotor.png

Its controller holds its attitude well, but heads for places all around too greedily: it tilts as
far as that takes, and brakes too late. A guard learns while it flies so, is frozen, and is tried on
other flights, with each of some seeds: all that is drawn, and what the guard draws, is another.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from matplotlib import style
from matplotlib.figure import Figure
from numpy.typing import NDArray

from evofsm import Guard, plot
from evofsm.guard import Mode, run_episode

Vector = NDArray[np.float64]
# 1 kg, arms of 0.2 m, moments of inertia [kg m²], torque by thrust of a rotor [m], drag of the air
# [kg/s], and the largest thrust of a rotor [N]: four lift twice its weight.
MASS, ARM, INERTIA, TWIST, DRAG, MOST = 1.0, 0.2, np.array([0.01, 0.01, 0.02]), 0.02, 0.25, 5.0
G, DT, SUBSTEPS, STEPS = 9.81, 0.02, 4, 250  # decisions at 50 Hz, for 5 s
LEAST, LARGEST = np.array([-3.0, -3.0, 0.0]), np.array([3.0, 3.0, 3.0])  # the room [m]
TILT = np.radians(60.0)  # tilted further it has failed, as outside of the room
NOISE = 0.1  # of each rotor's thrust [N]
# Gusts: how likely one begins in a step, for how many (the last is left out), largest force [N].
GUST_BEGINS, GUST_STEPS, GUST = 0.01, (10, 31), 1.0
# Lift and torques of rotors in front, left, behind and right.
MIX = np.array([[1, 1, 1, 1], [0, ARM, 0, -ARM], [-ARM, 0, ARM, 0], [-TWIST, TWIST] * 2])


def change(state: Vector, thrusts: Vector, gust: Vector) -> Vector:
    """Of place, speed, roll, pitch, yaw, and body rates, per second: Newton and Euler.

    Mahony, Kumar and Corke, "Multirotor Aerial Vehicles", IEEE Robotics & Automation Magazine
    19(3), 2012, with z upwards, angles in the order yaw, pitch, roll, and drag by speed.
    """
    speed, (p, q, r) = state[3:6], state[9:]
    (sr, sp, sy), (cr, cp, cy) = np.sin(state[6:9]), np.cos(state[6:9])
    lift, *torques = MIX @ thrusts
    up = np.array([cy * sp * cr + sy * sr, sy * sp * cr - cy * sr, cp * cr])
    pull = (up * lift + gust - DRAG * speed) / MASS - np.array([0.0, 0.0, G])
    turn = [p + (q * sr + r * cr) * sp / cp, q * cr - r * sr, (q * sr + r * cr) / cp]
    spin = (torques - np.cross(state[9:], INERTIA * state[9:])) / INERTIA
    return np.concatenate([speed, pull, turn, spin])


class Quadrotor:
    """It hovers in the middle of the room at first; a step holds four thrusts [N] for 20 ms."""

    def reset(self, *, seed: int | None = None, options: object = None) -> tuple[Vector, Any]:
        """Draw where it starts, and the first place that it heads for."""
        self.chance, self.whim = (np.random.default_rng([seed or 0, k]) for k in (0, 1))
        place = 0.5 * (LEAST + LARGEST) + self.chance.uniform(-0.5, 0.5, 3)
        angles = self.chance.uniform(-0.05, 0.05, 3)
        self.state = np.concatenate([place, np.zeros(3), angles, np.zeros(3)])
        self.way, self.reached, self.gust, self.left = [place], 0, np.zeros(3), 0
        self.to = self.whim.uniform(LEAST + 0.5, LARGEST - 0.5)
        return self.state, {}

    def step(self, thrusts: Vector) -> tuple[Vector, float, bool, bool, Any]:
        """Gusts that no observation shows, noisy motors, and four steps of Heun's method."""
        self.left = max(0, self.left - 1)
        if self.left == 0:
            self.gust = np.zeros(3)
            if self.chance.random() < GUST_BEGINS:
                self.left, way = int(self.chance.integers(*GUST_STEPS)), self.chance.normal(size=3)
                self.gust = self.chance.uniform(0.0, GUST) * way / np.linalg.norm(way)
        given = np.clip(thrusts + NOISE * self.chance.normal(size=4), 0.0, MOST)
        for _ in range(SUBSTEPS):
            first = change(self.state, given, self.gust)
            then = change(self.state + DT / SUBSTEPS * first, given, self.gust)
            self.state = self.state + 0.5 * DT / SUBSTEPS * (first + then)
        place, tilted = self.state[:3], np.cos(self.state[6:8]).prod() < np.cos(TILT)
        self.way.append(place)
        failed = bool(tilted or np.any((place < LEAST) | (place > LARGEST)))
        return self.state, 0.0, failed, len(self.way) > STEPS, {}

    def greedy(self, seen: Vector) -> Vector:
        """Thrusts towards a place, then the next one: a spring, damped to a quarter of critical."""
        place, speed, angles, rates = seen[:3], seen[3:6], seen[6:9], seen[9:]
        if np.linalg.norm(self.to - place) < 0.3:
            self.reached += 1
            self.to = self.whim.uniform(LEAST + 0.5, LARGEST - 0.5)
        x, y, z = 4.0 * (self.to - place) - speed
        sine, cosine = np.sin(angles[2]), np.cos(angles[2])
        wanted = np.array([sine * x - cosine * y, cosine * x + sine * y, 0.0]) / G
        torques = INERTIA * (100.0 * (wanted - angles) - 20.0 * rates)
        lift = MASS * (G + z) / np.cos(angles[:2]).prod()
        return np.clip(np.linalg.solve(MIX, [lift, *torques]), 0.0, MOST)


class Flights(NamedTuple):
    """What came of some flights."""

    ways: list[Vector]  # (T + 1, 3) each
    failed: list[bool]
    kept: float  # share of proposals that were executed as they were
    places: float  # reached in a flight

    def __str__(self) -> str:
        length = np.mean([np.linalg.norm(np.diff(way, axis=0), axis=1).sum() for way in self.ways])
        bound = 1.0 - 0.025 ** (1.0 / len(self.ways))  # where none fails (95 %)
        fail = f"{sum(self.failed)} fail" if any(self.failed) else f"0 (at most {bound:.0%}) fail"
        return f"{fail}, {length:.1f} m, {self.places:.1f} places"


def fly(guard: Guard, seeds: Sequence[int]) -> Flights:
    """The greedy controller under a guard, which learns from its flights unless it is frozen."""
    craft, ways, failed, kept, reached = Quadrotor(), [], [], [], 0
    for seed in seeds:
        for one in run_episode(craft, guard, craft.greedy, seed=seed):
            kept.append(np.array_equal(one.revision.executed, one.revision.proposed))
        ways.append(np.array(craft.way))
        failed.append(one.failed)
        reached += craft.reached
    return Flights(ways, failed, float(np.mean(kept)), reached / len(seeds))


def trial(seed: int, episodes: int, held_out: int) -> tuple[Flights, Flights, Flights]:
    """Flights while a guard learns, and others: alone, and under it, frozen."""
    low, high = np.zeros(4), np.full(4, MOST)
    guard = Guard(low=low, high=high, interval=DT, seed=seed)
    learning = fly(guard, range(1000 * seed, 1000 * seed + episodes))
    guard.freeze()
    others = range(10_000 + 1000 * seed, 10_000 + 1000 * seed + held_out)
    off = Guard(low=low, high=high, interval=DT, mode=Mode.OFF)
    return learning, fly(off, others), fly(guard, others)


def draw(alone: Flights, guarded: Flights, count: int = 6) -> Figure:
    """The first flights from above and from the side; the frames are the room."""
    figure = Figure(figsize=(6.2, 5.0), layout="constrained")
    panels = figure.subplots(2, 2, sharex="row", sharey="row", height_ratios=(2.2, 1.0))
    for column, name, flights in zip(panels.T, "ab", (alone, guarded), strict=True):
        for way, failed in zip(flights.ways[:count], flights.failed, strict=False):
            look: dict[str, Any] = {"linewidth": 1.2, "markevery": [-1], "clip_on": False}
            look |= {"color": plot.COLORS["dead end" if failed else "follower"]}
            look |= {"marker": "X" if failed else "o", "markersize": 7 if failed else 4}
            column[0].plot(way[:, 0], way[:, 1], **look)
            column[1].plot(DT * np.arange(len(way)), way[:, 2], **look)
        who = "alone" if flights is alone else "under the guard"
        title = f"$\\bf{{{name}}}$  {who}: {sum(flights.failed)} of {len(flights.ways)} fail"
        column[0].set_title(title, pad=12)
        column[0].set(aspect="equal", xlim=(-3, 3), ylim=(-3, 3), xlabel="x [m]")
        column[1].set(xlim=(0, DT * STEPS), ylim=(0, 3), yticks=range(4), xlabel="time [s]")
        for ax in column:
            ax.spines[:].set_visible(True)
    panels[0, 0].set_ylabel("y [m]")
    panels[1, 0].set_ylabel("height [m]")
    return figure


def main(arguments: Sequence[str] | None = None) -> list[tuple[Flights, Flights, Flights]]:
    """Learn, try, print and draw."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    for name, default in (("seeds", 5), ("episodes", 60), ("held-out", 30)):
        parser.add_argument(f"--{name}", type=int, default=default)
    parser.add_argument("--picture", help="file to draw flights of the first seed to")
    given = parser.parse_args(arguments)
    tried, one = [], partial(trial, episodes=given.episodes, held_out=given.held_out)
    with ProcessPoolExecutor(min(given.seeds, os.cpu_count() or 1)) as workers:
        for seed, (learning, alone, guarded) in enumerate(workers.map(one, range(given.seeds))):
            tried.append((learning, alone, guarded))
            quarters = np.array_split(learning.failed, 4)
            counts = ", ".join(f"{np.sum(quarter)} of {len(quarter)}" for quarter in quarters)
            print(f"seed {seed}: while it learns {counts} fail, by quarters")
            print(f"  {given.held_out} others, alone {alone}; guarded {guarded}, ", end="")
            print(f"{guarded.kept:.2f} of proposals kept", flush=True)
    for name, flights in zip(("alone", "guarded"), list(zip(*tried, strict=True))[1:], strict=True):
        failed = sum(sum(each.failed) for each in flights)
        print(f"{name}: {failed} of {given.seeds * given.held_out} fail")
    if given.picture:
        with style.context(["default", "evofsm.paper.house"]):
            draw(*tried[0][1:]).savefig(given.picture, metadata={"Software": None})
    return tried


if __name__ == "__main__":
    main()
