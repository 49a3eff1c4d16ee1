"""A log, played row by row beside a guard."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from types import MappingProxyType

import numpy as np

from evofsm.cli.foreseen import date
from evofsm.cli.learning import episodes_read, learn_chunk
from evofsm.cli.options import BRAKES, TOLERANCE, Reading, refuse_other_limit
from evofsm.cli.show import warn
from evofsm.cli.watch.session import Logged, Played, Session
from evofsm.driving.assumed import assumptions, guard_of_monitor
from evofsm.driving.naming import UNITS, VARIABLES
from evofsm.fsm.naming import Labels
from evofsm.guard import Foresight, Guard
from evofsm.guard.foresight import DATES
from evofsm.io.logs import LONGEST_STEP, Chunk, Noted

# Share by which the step of a log may differ from that of a guard.
_OTHER_STEP = 0.1
# Fewer rows of cars are not watched; times that differ by less are one [s].
_FEWEST_ROWS, _TICK = 10, 5e-4


def watched_log(
    path: str,
    reading: Reading,
    tolerance: float | None = None,
    case: int | None = None,
    guard: Guard | None = None,
    *,
    brakes: float = BRAKES,
    collisions: Mapping[str, Sequence[float]] = MappingProxyType({}),
) -> Session:
    """The episodes of a log, with a guard; of cars without one with what `evofsm monitor` has.

    Of cars an episode is over with a contact; where they come apart again, another one begins. So
    it is with ``collisions`` that a simulation counted [s], by the name of who follows whom.
    ``case`` is the number of the episode to begin with, from 1.
    """
    names = reading.columns.observe.names
    of_cars = reading.acts and len(names) == len(VARIABLES) and (not guard or names == VARIABLES)
    if guard is None and not of_cars:
        raise ValueError(f"{path} is of no cars: --guard names a guard (evofsm learn --guard)")
    episodes = episodes_read(path, reading, Noted(), dated=not of_cars)
    stretches = list(_of_cars(episodes, collisions) if of_cars else _whole(episodes))
    if not stretches:
        why = f"nobody follows anybody for {_FEWEST_ROWS}" if of_cars else "no episode has two"
        raise ValueError(f"{path}: {why} rows")
    labels = Labels(names=VARIABLES, units=UNITS) if of_cars else Labels(names=tuple(names))
    rows = [stretch.rows for stretch in stretches]
    refuse_other_limit(reading.acts, None, tolerance)
    if guard is None:
        risk = TOLERANCE if tolerance is None else tolerance
        guard = guard_of_monitor(rows[0].dt, brakes, risk)
        assert guard.machine is not None
        for chunk in rows:
            learn_chunk(guard.machine, chunk, guard.actions)
        warn(assumptions(brakes, risk))
    else:
        if tuple(names) != guard.variables or abs(rows[0].dt / guard.interval - 1.0) > _OTHER_STEP:
            holds = f"{', '.join(names)} every {rows[0].dt:.4g} s"
            wants = f"{', '.join(guard.variables)} every {guard.interval:.4g} s"
            raise ValueError(f"{path} is read as {holds}; this guard decides on {wants}")
        if tolerance is not None:
            guard.reviser.tolerance = tolerance  # type: ignore[attr-defined]
    guard.learn = False
    if isinstance(guard.judge, Foresight):
        stretches = list(_alarmed(guard.judge, guard.judge.alarm, stretches))
    system = Logged(path, stretches, labels, acts=reading.acts, of_cars=of_cars)
    return Session(system, guard, case=system.first if case is None else case - 1, on=False)


def _alarmed(judge: Foresight, rate: int | None, found: Sequence[Played]) -> Iterator[Played]:
    """With whether alarms come before the last row, with which nothing is decided."""
    runs = judge.runs([p.rows.observations for p in found], [bool(p.fails) for p in found])
    on = np.zeros(len(runs.rows), np.bool_) if rate is None else judge.tally(runs, rate)[1]
    for stretch, part in zip(found, np.split(on, runs.starts[1:]), strict=True):
        yield stretch._replace(alarms=bool((part[1:-1] & ~part[:-2]).any()))


def _whole(episodes: Iterable[Chunk]) -> Iterator[Played]:
    for number, episode in enumerate(episodes, 1):
        began = f", {date(episode.times[0])}" if episode.times[0] >= DATES else ""
        yield Played(f"episode {number}{began}", episode, "Failure (by the log)" * episode.failed)


def _of_cars(
    episodes: Iterable[Chunk], collisions: Mapping[str, Sequence[float]]
) -> Iterator[Played]:
    for number, whole in enumerate(episodes, 1):
        name = "".join(whole.names) or f"episode {number}"
        for rows, fails in _stretches(whole, collisions.get(name, ())):
            began = f", from {rows.times[0]:.1f} s" if whole.names else ""
            yield Played(name + began, rows, fails)


def _stretches(episode: Chunk, collisions: Sequence[float]) -> Iterator[tuple[Chunk, str]]:
    """Those of an episode that are long enough, and how each failed."""
    crashes = np.zeros(len(episode.times), np.bool_)
    for time in collisions:  # who collides may be taken off the road before it is written down
        row = int(np.searchsorted(episode.times, time + _TICK)) - 1
        crashes[row] |= row >= 0 and time - episode.times[row] < LONGEST_STEP * episode.dt
    contacts = crashes | (episode.observations[:, 0] <= 0.0)
    begins = np.flatnonzero(~contacts & np.append(True, contacts[:-1]))
    for first in begins.tolist():
        ends = np.flatnonzero(contacts[first:])
        last = first + int(ends[0]) if len(ends) else len(contacts) - 1
        if last + 1 - first < _FEWEST_ROWS:
            continue
        fails = "Failure (by the log)" * bool(episode.fails[last])
        if contacts[last]:
            fails = "Collision (by SUMO)" if episode.observations[last, 0] > 0.0 else "Collision"
        rows = episode.rows(first, last + 1)
        failures = np.array([last - first] if fails else [], np.int64)
        yield rows._replace(starts=np.zeros(1, np.int64), failures=failures), fails
