"""What is to be broken: a case is played, and its score says how close it came to failing."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from statistics import NormalDist
from typing import Protocol

import numpy as np

from evofsm.driving import (
    Draw,
    Episode,
    Family,
    KinematicWorld,
    drive,
    guard_for_family,
    load_family,
    teach,
    training,
    unrevised_guard,
)
from evofsm.guard import Guard
from studies.breaks import seldom
from studies.breaks.amounts import NOBODY, SELDOM, TOY
from studies.breaks.splitting import Chance

#: How likely the toy fails.
KNOWN = 1e-5
_NORMAL = NormalDist()

# Where evofsm drive --out puts what was learnt.
_GUARD = "guard.evofsm"
_JUDGES = {"LatentRisk": "kinematic", "LearntRisk": "learnt"}


class Subject(Protocol):
    """Whatever may fail."""

    def score(self, chance: Chance) -> float:
        """How close a case came to failing; infinite where it failed."""
        ...


@dataclass(frozen=True)
class Toy:
    """Fails where some normal numbers add up to more than they do in one case of 100,000."""

    probability: float = KNOWN
    numbers: int = 6

    def score(self, chance: Chance) -> float:
        """The sum, in its standard deviations."""
        # A chance of 0 is none that a normal number has; the smallest is as good.
        drawn = (
            _NORMAL.inv_cdf(max(chance(f"number {k}"), 1e-300)) for k in range(1, self.numbers + 1)
        )
        total = sum(drawn) / math.sqrt(self.numbers)
        return math.inf if total >= _NORMAL.inv_cdf(1.0 - self.probability) else total


@dataclass(frozen=True)
class Cars:
    """A family's own controller in the closed-form world, under a frozen guard or none."""

    family: str
    judge: str
    switches: tuple[str, ...] = ()
    train: int = 0
    learnt: str | None = None
    seed: int = 0

    def score(self, chance: Chance) -> float:
        """The braking that was needed at the worst moment [m/s²]."""
        return needed_braking(self.play(load(self.family, self.switches).draw_by(chance)))

    def play(self, draw: Draw) -> Episode:
        """Drive one draw."""
        family = load(self.family, self.switches)
        if self.judge != NOBODY:
            return drive(_guard(self), draw)
        limits = draw.controller.parameters[:, 7:9]
        if limits.min() >= family.actions.low and limits.max() <= family.actions.high:
            # Exactly what the framework makes of it, without leaving compiled code.
            return KinematicWorld().run(draw.scenario, draw.controller, family.interval)
        return drive(unrevised_guard(family), draw)


def subject_of(
    family: str, judge: str, switches: Sequence[str], train: int, learnt: str | None, seed: int
) -> Subject:
    """What a family and a judge make."""
    if family == TOY:
        return Toy()
    return Cars(family, judge, tuple(switches), train, learnt, seed)


def needed_braking(episode: Episode) -> float:
    """How hard the follower had to brake at the worst moment not to collide [m/s²].

    Parameters
    ----------
    episode : Episode

    Returns
    -------
    float
        As if the leader went on as it did, until it stands; infinite where they collided.
    """
    if episode.collided:
        return math.inf
    gap, speed, ahead = episode.observations.T
    accelerations = episode.leader_accelerations
    closing = np.maximum(speed - ahead, 0.0)
    slows = accelerations < 0.0
    stops = ahead[slows] ** 2 / (-2.0 * accelerations[slows])
    to_stop = speed[slows] ** 2 / (2.0 * (gap[slows] + stops))
    return float(max((closing**2 / (2.0 * gap)).max(), to_stop.max(initial=0.0)))


@lru_cache(maxsize=8)
def load(name: str, switches: tuple[str, ...] = ()) -> Family:
    """A family by its name or file, with switches."""
    family = seldom.family if name == SELDOM else load_family(name)
    return family.with_switches(switches)


def check_learnt(folder: str | None, judge: str) -> None:
    """Raise where a folder holds what another judge learnt."""
    if folder is not None and judge != NOBODY:
        held = _JUDGES[type(Guard.load(Path(folder) / _GUARD).judge).__name__]
        if held != judge:
            raise ValueError(f"{folder} holds the judge {held!r}, not {judge!r}: --judge {held}")


@lru_cache(maxsize=8)
def _guard(cars: Cars) -> Guard:
    """Taught, then frozen; the same in every process."""
    family = load(cars.family, cars.switches)
    if cars.learnt:
        guard = Guard.load(Path(cars.learnt) / _GUARD)
    else:
        guard = guard_for_family(family, judge=cars.judge, seed=cars.seed)
        teach(guard, training(family, cars.seed, 0, cars.train))
    guard.freeze()
    frozen = guard.copy(states=False)
    frozen.freeze()
    return frozen
