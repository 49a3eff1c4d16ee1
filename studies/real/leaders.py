"""Leaders' hard brakes in real drives, and what they make of alarms beside ordinary driving.

Leaders are watched as `LatentRisk` watches them. In shadow mode every row is a decision, and what
the driver did is the proposal.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial
from itertools import groupby, pairwise
from pathlib import Path
from typing import NamedTuple, TypeVar

from evofsm.driving import REAL_DRIVES, LatentRisk, LeaderBrakes
from evofsm.fsm import IntervalActions
from evofsm.guard import ActionReviser, Guard, Mode, is_spoken
from studies.datasets.checksums import find_checksums
from studies.datasets.episodes import Episode
from studies.datasets.layouts import Layout, read_episodes
from studies.old.frame import Progress, silent
from studies.old.shim import in_order
from studies.real.cases import runs_in

#: What is taken to be known in shadow mode, in the order in which it is reported.
TOLD = ("nothing", "own brakes", "and the shipped table", "and leaders of the other runs")
# Brakes of one run that are closer in time are of one wave, whoever brakes [s].
_ONE_WAVE = 10.0
# No driver in a car does more [m/s²].
_HIGHEST, _INTERVAL = 12.0, 0.5


class Braked(NamedTuple):
    """Leaders of some drives."""

    source: str  #: the names of runs up to their first underscore
    runs: int
    brakes: LeaderBrakes
    hardest: float  #: [m/s²]; 0 where none was hard
    waves: int  #: hard brakes, those of a run that are less than 10 s apart counted once

    @property
    def seen(self) -> int:
        """How many were hard."""
        return sum(self.brakes.counts)


class Alarms(NamedTuple):
    """Decisions in shadow mode beside some drives, and the alarms among them."""

    source: str
    told: str  #: one of `TOLD`
    runs: int
    decisions: int
    alarms: int


class Limits(NamedTuple):
    """What is told of one's own car."""

    lowest: float = -8.0  #: hardest braking that can be commanded [m/s²]
    decel: float = 7.0  #: that it brings [m/s²]


class _Run(NamedTuple):
    name: str
    braked: tuple[tuple[float, float], ...]  #: time [s] and deceleration [m/s²] of hard brakes
    gentle: int
    hours: float

    @property
    def source(self) -> str:
        return self.name.split("_")[0]


_Counted = TypeVar("_Counted", _Run, Alarms)


class LeaderStudy(NamedTuple):
    """All that was counted."""

    braked: list[Braked]  #: by source, then of all
    alarms: list[Alarms]  #: by source, then of all; by what was told
    verified: int  #: files whose checksum was held against a list


def run_leaders(
    folder: Path,
    limits: Limits,
    most: int | None = None,
    progress: Progress = silent,
    workers: int | None = None,
) -> LeaderStudy:
    """Count leaders' hard brakes in a folder of runs, and alarms in shadow mode.

    Parameters
    ----------
    folder : Path
        As `read_folder` takes it.
    limits : Limits
    most : int, optional
        Alarms are counted in so many runs, the first in the order of their names; in all unless
        told. Brakes are counted in all.
    progress, workers
        As `Study.run` takes them.

    Raises
    ------
    ValueError
        If the folder holds no runs, or a file is not what it should be.
    """
    paths = runs_in(folder)
    listed = find_checksums(folder)
    counted = in_order([partial(_watch_leaders, path) for path in paths], workers)
    told = [(k, what) for k in range(len(paths[:most])) for what in TOLD]
    tasks = [
        partial(_shadow, paths[k], limits if what != TOLD[0] else None, _table(counted, k, what))
        for k, what in told
    ]
    found = [
        Alarms(counted[k].source, what, 1, *counts)
        for (k, what), counts in zip(told, in_order(tasks, workers, progress), strict=True)
    ]
    return LeaderStudy(
        [_braked(source, runs) for source, runs in _by_source(counted)],
        [
            _added(source, what, [one for one in some if one.told == what])
            for source, some in _by_source(found)
            for what in TOLD
        ],
        sum(path.name in listed for path in paths),
    )


def _by_car(path: Path) -> Iterator[list[Episode]]:
    """Episodes of a run, those of a pair together."""
    episodes = sorted(read_episodes([path], Layout.PAIRS), key=lambda one: one.pair)
    for _, of_pair in groupby(episodes, key=lambda one: one.pair):
        yield list(of_pair)


def _watch_leaders(path: Path) -> _Run:
    """Every leader of a run, as a follower's `LatentRisk` sees it."""
    braked, gentle, rows, seconds = [], 0, 0, 0.0
    for episodes in _by_car(path):
        risk = LatentRisk(Limits().lowest, episodes[0].dt)
        for episode in episodes:
            for time, row in zip(episode.times.tolist(), episode.observations, strict=True):
                before = len(risk.manoeuvres)
                risk.learn(row, 0.0)
                if len(risk.manoeuvres) > before:
                    braked.append((time, risk.manoeuvres.decels[-1]))
            before = len(risk.manoeuvres)
            risk.start_episode()
            if len(risk.manoeuvres) > before:
                braked.append((float(episode.times[-1]), risk.manoeuvres.decels[-1]))
            rows += len(episode.times)
            seconds += len(episode.times) * episode.dt
        gentle += risk.manoeuvres.gentle
    return _Run(path.name.split(".")[0], tuple(sorted(braked)), gentle, seconds / 3600.0)


def _shadow(path: Path, limits: Limits | None, leaders: LeaderBrakes | None) -> tuple[int, int]:
    """Decisions beside every driver of a run, and alarms; without limits nothing is told."""
    decisions = alarms = 0
    lowest = (limits or Limits()).lowest
    actions = IntervalActions(low=lowest, high=_HIGHEST, width=_INTERVAL, outside="clip")
    for episodes in _by_car(path):
        dt = episodes[0].dt
        risk = LatentRisk(lowest, dt, leaders=leaders)
        if limits is not None:
            risk.brakes.trust(limits.decel)
        reviser = ActionReviser(risk, actions, mode=Mode.SHADOW)
        guard = Guard.of(reviser, interval=dt)
        for episode in episodes:
            guard.begin()
            rows = (episode.times.tolist(), episode.observations, episode.accelerations.tolist())
            for time, row, did in zip(*rows, strict=True):
                alarms += is_spoken(reviser, guard.decide(row, did, time))
            guard.end()
            decisions += len(episode.times)
    return decisions, alarms


def _table(runs: Sequence[_Run], k: int, told: str) -> LeaderBrakes | None:
    """Leaders' brakes to begin with in run ``k``."""
    if told == TOLD[2]:
        return REAL_DRIVES
    return _counted([*runs[:k], *runs[k + 1 :]]) if told == TOLD[3] and len(runs) > 1 else None


def _counted(runs: Sequence[_Run]) -> LeaderBrakes:
    return LeaderBrakes.counted(
        [decel for run in runs for _, decel in run.braked],
        sum(run.gentle for run in runs),
        sum(run.hours for run in runs),
        f"{len(runs)} runs",
    )


def _braked(source: str, runs: Sequence[_Run]) -> Braked:
    waves = 0
    for run in runs:
        times = [time for time, _ in run.braked]
        waves += bool(times) + sum(b - a >= _ONE_WAVE for a, b in pairwise(times))
    hardest = max((decel for run in runs for _, decel in run.braked), default=0.0)
    return Braked(source, len(runs), _counted(runs), hardest, waves)


def _added(source: str, told: str, some: Sequence[Alarms]) -> Alarms:
    decisions, alarms = sum(one.decisions for one in some), sum(one.alarms for one in some)
    return Alarms(source, told, len(some), decisions, alarms)


def _by_source(some: Sequence[_Counted]) -> Iterator[tuple[str, list[_Counted]]]:
    for source in dict.fromkeys(one.source for one in some):
        yield source, [one for one in some if one.source == source]
    yield "all", list(some)
