"""Unrevised episodes as they were seen, and what was true in them.

Every decision is a case. What a measure may use is what the follower sees; what it is held
against is what a simulation knows.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from enum import StrEnum
from itertools import count, islice
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from evofsm.driving import Draw, Family, KinematicWorld, measures, training
from evofsm.guard import make_usable

#: A collision within so long counts as coming [s].
HORIZON = 5.0
# So many draws that are the same for two seeds are no chance, even where little is drawn.
_COMPARED = 20
#: The learning seed of draws on which thresholds are chosen and scores calibrated: no learner's.
CALIBRATION_SEED = 900


class Target(StrEnum):
    """What is to be seen coming."""

    DEAD_END = "dead_end"  #: even braking in full could not avoid a leader that brakes in full
    COLLISION = "collision"  #: within `HORIZON`, going on as driven


#: Targets in words.
WHAT = {Target.DEAD_END: "dead end", Target.COLLISION: f"collision within {HORIZON:g} s"}


class Watched(NamedTuple):
    """Decisions of one episode; n of them."""

    seen: NDArray[np.float64]  #: (n, 3) gap [m], v_follower, v_leader [m/s], as sensors show them
    true: NDArray[np.float64]  #: (n, 3) the same, as they were
    commands: NDArray[np.float64]  #: (n,) commanded after each [m/s²]
    end: float  #: of the episode, since the first decision [s]
    collided: bool


@dataclass(frozen=True, eq=False)
class Cases:
    """All decisions of some episodes whose truth is known, episode after episode."""

    rows: NDArray[np.intp]  #: (n,) where they are among all decisions
    truth: NDArray[np.bool_]  #: (n,)
    episode: NDArray[np.intp]  #: (n,) which they belong to
    first: NDArray[np.intp]  #: (episodes + 1,) case at which each begins, and where the last ends
    hours: float  #: that they cover


@dataclass(frozen=True, eq=False)
class Exposure:
    """Unrevised episodes of a family.

    Parameters
    ----------
    family : Family
    watched : tuple of Watched
    """

    family: Family
    watched: tuple[Watched, ...]
    _cases: dict[Target, Cases] = field(default_factory=dict, repr=False)  # found so far

    @property
    def collided(self) -> NDArray[np.bool_]:
        """(episodes,) ndarray: which ended in a collision."""
        return np.array([one.collided for one in self.watched], dtype=np.bool_)

    @property
    def ends(self) -> NDArray[np.float64]:
        """(episodes,) ndarray: how long each lasted [s]."""
        return np.array([one.end for one in self.watched])

    def cases(self, target: Target) -> Cases:
        """Decisions of which it is known whether the target holds.

        Whether a collision comes within the horizon is not known where the episode ends before
        that without one; such decisions are left out.
        """
        if target not in self._cases:
            self._cases[target] = self._find_cases(target)
        return self._cases[target]

    def _find_cases(self, target: Target) -> Cases:
        interval, family = self.family.interval, self.family
        rows, truths, lengths, row = [], [], [], 0
        for one in self.watched:
            n = len(one.commands)
            left = one.end - interval * np.arange(n)
            known = np.ones(n, dtype=np.bool_)
            if target is Target.DEAD_END:
                truth = measures.is_dead_end(one.true, family.decel, family.leader_decel)
            else:
                known = (left >= HORIZON) | one.collided
                truth = (left <= HORIZON) & one.collided
            rows.append(row + np.flatnonzero(known))
            truths.append(truth[known])
            lengths.append(int(known.sum()))
            row += n
        return Cases(
            np.concatenate(rows),
            np.concatenate(truths),
            np.repeat(np.arange(len(lengths)), lengths),
            np.append(0, np.cumsum(lengths)),
            sum(lengths) * interval / 3600.0,
        )


def watch(family: Family, draw: Draw) -> Watched:
    """Drive a draw as its controller likes, deciding every ``family.interval``."""
    scenario, controller = draw.scenario, draw.controller
    steps = scenario.steps(family.interval)
    seen: list[NDArray[np.float64]] = []
    commands: list[float] = []
    with KinematicWorld().open(scenario) as road:
        while not road.over:
            observation = road.observation
            proposal = controller.propose(observation, road.time)
            command = make_usable(proposal, family.actions).action
            seen.append(observation)
            commands.append(command)
            road.advance(command, steps)
        episode = road.episode()
    true = episode.observations[::steps][: len(commands)]
    return Watched(
        np.array(seen), true, np.array(commands), float(episode.time[-1]), episode.collided
    )


def expose(family: Family, draws: Iterable[Draw], hours: float) -> Exposure:
    """Watch draws until, for each target, so many hours of cases are there [h].

    Where nothing is drawn each case is driven once: again it would add hours, but no evidence.
    """
    watched: list[Watched] = []
    seconds = 0.0
    for draw in islice(draws, family.cases) if is_fixed(family) else draws:
        if seconds >= 3600.0 * hours:
            break
        one = watch(family, draw)
        watched.append(one)
        seconds += family.interval * len(one.commands) - (0.0 if one.collided else HORIZON)
    return Exposure(family, tuple(watched))


def is_fixed(family: Family) -> bool:
    """Whether all seeds draw the same.

    Examples
    --------
    >>> from evofsm.driving import load_family
    >>> is_fixed(load_family("r157")), is_fixed(load_family("ncap"))
    (True, False)
    """
    one, other = (
        [_without_unused_seed(family.draw(seed, index)) for index in range(_COMPARED)]
        for seed in (0, 1)
    )
    return one == other


def held_out_draws(family: Family, seed: int) -> Iterator[Draw]:
    """Draws that nothing learns from, without an end."""
    return (family.draw(seed, index, split="test") for index in count())


def calibration_draws(family: Family, seed: int) -> Iterator[Draw]:
    """Draws for thresholds and calibration, without an end; no learner sees them either."""
    return training(family, seed, CALIBRATION_SEED, 10**9)


def _without_unused_seed(draw: Draw) -> Draw:
    """The draw, but for the seed of a noise that there is not."""
    sensors = draw.scenario.sensors
    if sensors.gap_noise > 0.0 or sensors.speed_noise > 0.0:
        return draw
    without = replace(draw.scenario, sensors=replace(sensors, seed=0))
    return draw._replace(scenario=without)
