"""A run that was recorded, shown as one that is driven; a log of others is made such a run."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evofsm.cli.learning import warnings_of
from evofsm.cli.options import BRAKES
from evofsm.cli.show import warn
from evofsm.cli.watch.shown import (
    Cars,
    Chronicle,
    Frame,
    Graph,
    Judged,
    Known,
    Start,
    graph_of,
    most_believed,
    numbers,
)
from evofsm.driving import guard_for_cars
from evofsm.driving.assumed import HIGHEST, Given, assumptions, guard_of_monitor
from evofsm.driving.measures import time_headway, time_to_collision
from evofsm.driving.naming import UNITS, VARIABLES
from evofsm.driving.trials import shadow_drive
from evofsm.fsm.naming import Labels
from evofsm.guard import TOLERANCE, Guard, Mode
from evofsm.io.foxglove import recording
from evofsm.io.logs import Chunk, LogColumns, Noted, episodes_of, read_traces
from evofsm.io.rosbag import Topics
from evofsm.io.runs import RecordedEpisode, Run, read_run
from evofsm.io.vehicles import VehicleLengths

#: More rows of a log are not watched.
MOST_ROWS = 20_000

_LABELS = Labels(names=VARIABLES, units=UNITS)
# So many of a log's episodes can be chosen among.
_MOST_EPISODES = 500
_NONE = -1
# Accelerations that differ by less are the same [m/s²].
_SAME = 0.05
# So much is played before what an episode of a log is worth a look for [s].
_BEFORE = 10.0
# Whoever wants to see something needs as many.
_FEWEST_ROWS = 10


class Recording:
    """Shows the episodes of a log, frame by frame.

    What a log does not hold stays unknown: how hard a leader's braking could be survived, and so
    which states are dead ends; those in which a collision ended are marked instead.
    """

    def __init__(self, path: str | PathLike[str], names: Sequence[str] = ()) -> None:
        self._run: Run = read_run(path)
        self._name = self._run.about.get("source", Path(path).name)
        self._episodes = [one for one in self._run.episodes if len(one.columns["time"])]
        if not self._episodes:
            raise ValueError(f"{path} holds no episode with a decision")
        self._names = [f"episode {k + 1}" for k in range(len(self._episodes))]
        self._order = list(range(len(self._episodes)))
        self._jumps = bool(names)
        if names:
            risks = [
                float(np.nanmax([0.0, *one.columns["risk_proposed"]])) for one in self._episodes
            ]
            rank = [(-one.collided, -risk) for one, risk in zip(self._episodes, risks, strict=True)]
            self._order.sort(key=rank.__getitem__)
            self._names = [
                f"{name} ({'collision' if one.collided else f'risk {risk:.1%}'})"
                for one, risk, name in zip(self._episodes, risks, names, strict=True)
            ]
        self._tolerance = float(self._run.about.get("tolerance", TOLERANCE))
        self.revising = self._run.about.get("mode", "act") == "act"
        self.start = self.restart(0)

    def restart(self, case: int | None = None) -> Start:
        """Show an episode from its start, or another one."""
        case = self.start.case if case is None else case
        if not 0 <= case < len(self._episodes):
            raise ValueError(f"episode is {case + 1}; there are 1 to {len(self._episodes)}")
        self._episode = self._episodes[self._order[case]]
        self._frames = list(_frames(self._episode, revising=self.revising))
        self._number = 0
        self._chronicle = Chronicle(self._tolerance)
        self.start = self._begun(case)
        return self.start

    def choose(self, number: int) -> Start:
        """Show an episode by its number in the log, from 0."""
        return self.restart(self._order.index(number) if number in self._order else number)

    def step(self) -> Frame:
        """The next frame."""
        number, decisions = self._number, len(self._episode.columns["time"])
        frame = self._frames[number]
        if number < decisions:
            frame = frame._replace(**_decided(self._episode.columns, number))
        else:
            collided, rear_ended = self._episode.collided, self._episode.rear_ended
            assert frame.cars is not None
            cars = frame.cars._replace(rear_ended=rear_ended)
            frame = frame._replace(over=True, failed=collided, cars=cars)
        self._number += 1
        return frame._replace(story=self._chronicle.tell(frame))

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
        commands = np.concatenate([columns["proposed"], columns["executed"], [0.0]])
        return Start(
            system=about.get("family", self._name),
            about=f"recorded in {self._name}",
            cases=tuple(self._names[k] for k in self._order[:_MOST_EPISODES]),
            case=case,
            tolerance=self._tolerance,
            interval=float(np.median(np.diff(times))),
            names=tuple(_LABELS.variable(k) for k in range(len(VARIABLES))),
            low=(float(np.nanmin(commands)),),
            high=(float(np.nanmax(commands)),),
            learnt=0,
            judge=about.get("judge", "kinematic"),
            shadow=not self.revising,
            begins=self._worst() - _BEFORE if self._jumps else 0.0,
        )

    def _worst(self) -> float:
        """When it collided, or was in most danger [s]."""
        risks = self._episode.columns["risk_proposed"]
        if self._episode.collided or np.isnan(risks).all():
            return self._episode.end_time
        return float(self._episode.columns["time"][np.nanargmax(risks)])


def _decided(columns: Any, number: int) -> dict[str, Any]:
    """What was recognised, judged and decided, by the names of a frame."""
    state, before = (int(columns["state"][k]) for k in (number, max(0, number - 1)))
    executed = Judged(
        *(float(columns[name][number]) for name in ("risk_executed", "risk_low", "risk_high"))
    )
    proposed = float(columns["risk_proposed"][number])
    # The log has the interval of what was executed only.
    is_kept = proposed == executed.risk
    actions = {name: numbers(columns[name][number]) for name in ("proposed", "executed", "advised")}
    return {
        **actions,
        "revised": abs(actions["executed"][0] - actions["proposed"][0]) > _SAME,
        **{name: str(columns[name][number]) for name in ("reason", "explanation")},
        "belief": most_believed(columns["belief"][number]),
        "state": None if state == _NONE else state,
        "event": "moved" if state != before else "",
        "proposed_risk": executed if is_kept else Judged(proposed),
        "executed_risk": executed,
    }


def _frames(episode: RecordedEpisode, *, revising: bool) -> Iterator[Frame]:
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
            revising=revising,
            cars=Cars(
                gap=gap,
                v_follower=speed,
                v_leader=leader_speed,
                a_follower=float(accelerations[number, 0]),
                a_leader=float(accelerations[number, 1]),
                x_follower=float(positions[number]),
                time_to_collision=float(time_to_collision(observed[number])),
                time_headway=float(time_headway(observed[number])),
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
    columns: LogColumns | None = None,
    lengths: VehicleLengths | None = None,
    topics: Topics | None = None,
    *,
    judge: str = "kinematic",
    brakes: float = BRAKES,
    tolerance: float = TOLERANCE,
    show: Callable[[int], object] = lambda rows: None,
) -> tuple[list[str], bool]:
    """Write the episodes of a log of cars as a run, decided on by a guard that learns on the way.

    Returns what they are called, and whether rows after the first `MOST_ROWS` were left out;
    ``show`` is told how many were decided on.
    """
    names = VARIABLES if columns is None else columns.observe.names
    if len(names) != len(VARIABLES):
        raise ValueError(
            f"cars are watched by {', '.join(VARIABLES)}; --observe has to name the three columns "
            f"in this order, and names {', '.join(names)}"
        )
    noted = Noted()
    reading = read_traces([path], columns, lengths, noted=noted, topics=topics)
    taken, more, called = 0, False, list[str]()
    about: dict[str, Any] = {"source": Path(path).name, "mode": "shadow", "judge": judge}
    guard = None
    with recording(out, about | {"controller": "as recorded", "tolerance": tolerance}) as log:
        for episode in episodes_of(_first(reading, MOST_ROWS + 1)):
            more = taken + len(episode.times) > MOST_ROWS
            episode = episode.rows(0, MOST_ROWS - taken)
            taken += len(episode.times)
            show(taken)
            if len(episode.times) >= _FEWEST_ROWS:
                if guard is None:
                    guard = _guard(judge, episode.dt, brakes, tolerance)
                called += episode.names or [f"episode {len(called) + 1}"]
                log.add(
                    shadow_drive(
                        guard,
                        episode.times - episode.times[0],
                        episode.observations,
                        episode.actions,
                        failed=episode.failures is not None and len(episode.failures) > 0,
                    )
                )
        if guard is None:
            raise ValueError(f"{path}: nobody follows anybody for {_FEWEST_ROWS} rows")
        if guard.machine is not None:
            log.attach(guard.machine.model(names=VARIABLES))
    for warning in warnings_of(noted, columns):
        warn(f"warning: {warning}")
    if judge == "kinematic":
        warn(assumptions(brakes, tolerance))
    return called, more


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
