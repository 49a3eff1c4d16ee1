"""A run that was recorded, shown as one that is driven; a log of others is made such a run."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from os import PathLike
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evofsm.cli.learning import warnings_of
from evofsm.cli.options import BRAKES, Reading, reading_of
from evofsm.cli.show import warn
from evofsm.cli.watch.shown import (
    OF_CARS,
    Cars,
    Chronicle,
    Frame,
    Graph,
    Judged,
    Known,
    Start,
    graph_of,
    most_believed,
)
from evofsm.driving import guard_for_cars
from evofsm.driving.assumed import HIGHEST, Given, assumptions, guard_of_monitor
from evofsm.driving.measures import time_headway, time_to_collision
from evofsm.driving.naming import UNITS, VARIABLES
from evofsm.driving.trials import shadow_drive
from evofsm.fsm.naming import Labels
from evofsm.guard import TOLERANCE, Guard, Mode
from evofsm.io.foxglove import recording
from evofsm.io.logs import LONGEST_STEP, Chunk, Noted, episodes_of
from evofsm.io.runs import RecordedEpisode, Run, read_run

#: More rows of a log are not watched.
MOST_ROWS = 20_000

_LABELS = Labels(names=VARIABLES, units=UNITS)
# Why a reviser did not act, by its mode.
_IDLE = {
    "off": "the reviser was off",
    "shadow": "the reviser only watched, in shadow mode",
    "advise": "the reviser only advised",
}
_ACTIONS = ("proposed", "executed", "advised")
_PASSED = "the guard was not shown to help, so what was proposed passed"
_NO_STATE = -1
# Accelerations that differ by less are the same [m/s²].
_SAME_ACCEL = 0.05
# So much is played before what an episode of a log is worth a look for [s].
_BEFORE = 10.0
# Whoever wants to see something needs as many.
_FEWEST_ROWS = 10
# Times that differ by less are one [s].
_TICK = 5e-4


class Recording:
    """Shows the episodes of a log, frame by frame.

    What a log does not hold stays unknown: how hard a leader's braking could be survived, and so
    which states are dead ends; those in which a collision ended are marked instead.
    """

    def __init__(
        self, path: str | PathLike[str], stretches: Sequence[tuple[str, str]] = ()
    ) -> None:
        self._run: Run = read_run(path)
        self._name = self._run.about.get("source", Path(path).name)
        self._episodes = [e for e in self._run.episodes if len(e.columns["time"])]
        if not self._episodes:
            raise ValueError(f"{path} holds no episode with a decision")
        self._fails = ["Collision" * e.collided for e in self._episodes]
        self._names = [f"episode {k + 1}" for k in range(len(self._episodes))]
        self._order = list(range(len(self._episodes)))
        self._jumps = bool(stretches)
        if stretches:
            self._fails = [fails for _, fails in stretches]
            risks = [float(np.nanmax([0.0, *e.columns["risk_proposed"]])) for e in self._episodes]
            self._order.sort(key=lambda k: (not self._fails[k], -risks[k]))
            self._names = [
                f"{name} ({fails.partition(' ')[0].lower() or f'risk {risk:.1%}'})"
                for (name, fails), risk in zip(stretches, risks, strict=True)
            ]
        self._reviser = self._run.about.get("reviser", "least-risk")
        mode = self._run.about.get("mode", "act")
        self._mode = "off" if self._reviser == "none" else mode
        self.revising = self._mode == "act"
        self.start = self.restart(0)

    def restart(self, case: int | None = None) -> Start:
        """Show an episode from its start, or another one."""
        case = self.start.case if case is None else case
        if not 0 <= case < len(self._episodes):
            raise ValueError(f"episode is {case + 1}; there are 1 to {len(self._episodes)}")
        number = self._order[case]
        self._episode, self._fail, self._number = self._episodes[number], self._fails[number], 0
        self.start = self._begun(case)
        # Where it acts, what is executed is what it advises; else a proposal that can be executed.
        columns = self._episode.columns
        passed = (np.abs(columns["advised"] - columns["executed"]) > _SAME_ACCEL).any()
        idle = _IDLE.get(self._mode, _PASSED if passed else "")
        chronicle, self._frames = Chronicle(self.start.tolerance), list[Frame]()
        for number, frame in enumerate(_moved(self._episode, idle)):
            if number < len(columns["time"]):
                frame = self._decided(frame, number)
            else:
                frame = frame._replace(over=True, failed=bool(self._fail))
            self._frames.append(frame._replace(story=chronicle.tell(frame)))
        return self.start

    def choose(self, number: int) -> Start:
        """Show an episode by its number in the log, from 0."""
        return self.restart(self._order.index(number) if number in self._order else number)

    def step(self) -> Frame:
        """The next frame."""
        self._number += 1
        return self._frames[self._number - 1]

    def graph(self) -> Graph:
        """The states as they were after the last episode."""
        model = self._run.model
        if model is None:
            return Graph(self._number)
        return graph_of(model, _LABELS.place, number=self._number)

    def known(self) -> Known:
        """Nothing: a log holds no judge."""
        return Known()

    def _begun(self, case: int) -> Start:
        about, columns = self._run.about, self._episode.columns
        times = np.append(columns["time"], self._episode.end_time)
        commands = np.concatenate([[0.0], *(columns[name] for name in _ACTIONS)])
        unjudged = "no failure was known yet"
        if self._reviser not in ("least-risk", "none"):
            unjudged = f"{self._reviser} knows no risk"
        return Start(
            system=about.get("family", self._name),
            about="each row was judged afterwards." if self._jumps else f"from {self._name}.",
            cases=tuple(self._names[k] for k in self._order),
            case=case,
            tolerance=float(about.get("tolerance", TOLERANCE)),
            interval=float(np.median(np.diff(times))),
            names=OF_CARS,
            low=(float(np.nanmin(commands)),),
            high=(float(np.nanmax(commands)),),
            judge=about.get("judge", "kinematic"),
            mode=self._mode,
            unjudged="the reviser was off" if self._mode == "off" else unjudged,
            fails=self._fail,
            begins=self._worst() - _BEFORE if self._jumps else 0.0,
        )

    def _worst(self) -> float:
        """When it collided, or was in most danger [s]."""
        risks = self._episode.columns["risk_proposed"]
        if self._fail or np.isnan(risks).all():
            return self._episode.end_time
        return float(self._episode.columns["time"][np.nanargmax(risks)])

    def _decided(self, frame: Frame, number: int) -> Frame:
        """What was recognised, judged and decided."""
        row = {name: values[number] for name, values in self._episode.columns.items()}
        executed = Judged(*map(float, (row["risk_executed"], row["risk_low"], row["risk_high"])))
        risk = float(row["risk_proposed"])
        proposed, executes, advised = (float(row[name]) for name in _ACTIONS)
        revised = not frame.idle and abs(executes - proposed) > _SAME_ACCEL
        return frame._replace(
            proposed=(proposed,),
            executed=(proposed if frame.idle else executes,),
            advised=(advised,),
            revised=revised,
            advises=revised or abs(advised - executes) > _SAME_ACCEL,
            reason=str(row["reason"]),
            explanation=str(row["explanation"]),
            belief=most_believed(row["belief"]),
            state=None if row["state"] == _NO_STATE else int(row["state"]),
            # The log has the interval of what was executed only.
            proposed_risk=executed if risk == executed.risk else Judged(risk),
            executed_risk=executed,
        )


def _moved(episode: RecordedEpisode, idle: str) -> Iterator[Frame]:
    """Where the cars are at each decision and at the end, and how they got there."""
    columns = episode.columns
    time = np.append(columns["time"], episode.end_time)
    observed = np.column_stack([columns[name] for name in VARIABLES])
    observed = _held(np.vstack([observed, episode.end]))
    lasted, speeds = np.diff(time, prepend=math.nan), observed[:, 1:]
    with np.errstate(divide="ignore", invalid="ignore"):
        accelerations = np.diff(speeds, axis=0, prepend=math.nan) / lasted[:, None]
    moved = 0.5 * (speeds[1:, 0] + speeds[:-1, 0]) * lasted[1:]
    positions = np.insert(np.cumsum(moved), 0, 0.0)
    for number, (gap, speed, leader_speed) in enumerate(observed.tolist()):
        yield Frame(
            number=number,
            time=float(time[number]),
            observation=(gap, speed, leader_speed),
            here=_LABELS.place(observed[number]),
            idle=idle,
            cars=Cars(
                gap=gap,
                v_follower=speed,
                v_leader=leader_speed,
                a_follower=float(accelerations[number, 0]),
                a_leader=float(accelerations[number, 1]),
                x_follower=float(positions[number]),
                time_to_collision=float(time_to_collision(observed[number])),
                time_headway=float(time_headway(observed[number])),
                rear_ended=episode.rear_ended and number == len(columns["time"]),
            ),
        )


def _held(rows: NDArray[np.float64]) -> NDArray[np.float64]:
    """What was not seen is as it was seen last; before that, as it was seen first."""
    for column in rows.T:
        known = np.flatnonzero(np.isfinite(column))
        if len(known):
            latest = np.searchsorted(known, np.arange(len(column)), side="right") - 1
            column[:] = column[known[np.maximum(latest, 0)]]
    return rows


# -- A log of others -------------------------------------------------------------------------------


def record_log(
    path: str,
    out: Path,
    reading: Reading | None = None,
    *,
    judge: str = "kinematic",
    brakes: float = BRAKES,
    tolerance: float = TOLERANCE,
    collisions: Mapping[str, Sequence[float]] = MappingProxyType({}),
    show: Callable[[int], object] = lambda rows: None,
) -> tuple[list[tuple[str, str]], bool]:
    """Write the episodes of a log of cars as a run, decided on by a guard that learns on the way.

    An episode is over with a contact; where the cars come apart again, another one begins. So it is
    with ``collisions`` that a simulation counted [s], by the name of who follows whom.

    Returns what they are called, with how each failed, and whether rows after the first `MOST_ROWS`
    were left out; ``show`` is told how many were decided on.
    """
    reading = reading or reading_of()
    names = reading.columns.observe.names
    if len(names) != len(VARIABLES):
        raise ValueError(
            f"cars are watched by {', '.join(VARIABLES)}; --observe has to name the three columns "
            f"in this order, and names {', '.join(names)}"
        )
    noted = Noted()
    rows = _first(reading.traces([path], noted), MOST_ROWS + 1)
    taken, more, written = 0, False, list[tuple[str, str]]()
    about: dict[str, Any] = {"source": Path(path).name, "mode": "shadow", "judge": judge}
    guard = None
    with recording(out, about | {"controller": "as recorded", "tolerance": tolerance}) as log:
        for number, whole in enumerate(episodes_of(rows), 1):
            more = taken + len(whole.times) > MOST_ROWS
            whole = whole.rows(0, MOST_ROWS - taken)
            taken += len(whole.times)
            show(taken)
            name = "".join(whole.names) or f"episode {number}"
            for episode, fails in _stretches(whole, collisions.get(name, ())):
                if guard is None:
                    guard = _guard(judge, episode.dt, brakes, tolerance)
                began = float(episode.times[0])
                called = f"{name}, from {began:.1f} s" if whole.names else name
                written.append((called, fails))
                times, did = episode.times - began, episode.actions
                log.add(shadow_drive(guard, times, episode.observations, did, failed=bool(fails)))
        if guard is None:
            raise ValueError(f"{path}: nobody follows anybody for {_FEWEST_ROWS} rows")
        if guard.machine is not None:
            log.attach(guard.machine.model(names=VARIABLES))
    for warning in warnings_of(noted, reading.columns):
        warn(f"warning: {warning}")
    if judge == "kinematic":
        warn(assumptions(brakes, tolerance))
    return written, more


def _stretches(episode: Chunk, collisions: Sequence[float]) -> Iterator[tuple[Chunk, str]]:
    """Those of an episode that are long enough, and how each failed."""
    counted = np.zeros(len(episode.times), np.bool_)
    for time in collisions:  # who collides may be taken off the road before it is written down
        row = int(np.searchsorted(episode.times, time + _TICK)) - 1
        counted[row] |= row >= 0 and time - episode.times[row] < LONGEST_STEP * episode.dt
    touching = counted | (episode.observations[:, 0] <= 0.0)
    begins = np.flatnonzero(~touching & np.append(True, touching[:-1]))
    for first in begins.tolist():
        ends = np.flatnonzero(touching[first:])
        last = first + int(ends[0]) if len(ends) else len(touching) - 1
        if last + 1 - first < _FEWEST_ROWS:
            continue
        told = episode.failures is not None and last in episode.failures
        fails = "Failure (by the log)" if told else ""
        if touching[last]:
            fails = "Collision (by SUMO)" if episode.observations[last, 0] > 0.0 else "Collision"
        yield episode.rows(first, last + 1), fails


def _guard(judge: str, interval: float, brakes: float, tolerance: float) -> Guard:
    """States are learnt; what it was given stays, so that it says what `evofsm monitor` does."""
    if judge == "kinematic":
        return guard_of_monitor(interval, brakes, tolerance, Given)
    settings: dict[str, Any] = {"tolerance": tolerance, "mode": Mode.SHADOW, "judge": judge}
    return guard_for_cars(-brakes, HIGHEST, interval, **settings)


def _first(chunks: Iterable[Chunk], most: int) -> Iterator[Chunk]:
    """No more rows than that."""
    for chunk in chunks:
        yield chunk.rows(0, most)
        most -= len(chunk.times)
        if most <= 0:
            return
