"""A run that was recorded, shown as one that is driven."""

from __future__ import annotations

from os import PathLike
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from evofsm.cli.watch.shown import (
    OF_CARS,
    Chronicle,
    Frame,
    Graph,
    Judged,
    Known,
    Start,
    cars_of,
    graph_of,
)
from evofsm.driving.naming import UNITS, VARIABLES
from evofsm.fsm.naming import Labels
from evofsm.guard import TOLERANCE
from evofsm.io.runs import Run, read_run

_LABELS = Labels(names=VARIABLES, units=UNITS)
# Why a reviser did not act, by its mode.
_IDLE = {
    "off": "the reviser was off",
    "shadow": "the reviser only watched, in shadow mode",
}
_ACTIONS = ("proposed", "executed", "advised")
_PASSED = "the guard was not shown to help, so what was proposed passed"
_NO_STATE = -1
# Accelerations that differ by less are the same [m/s²].
_SAME_ACCEL = 0.05


class Recording:
    """Shows the episodes of a run, frame by frame.

    What it does not hold stays unknown: how hard a leader's braking could be survived, and so
    which states are dead ends; those in which a collision ended are marked instead.
    """

    def __init__(self, path: str | PathLike[str]) -> None:
        self._run: Run = read_run(path)
        self._name = Path(path).name
        self._episodes = [e for e in self._run.episodes if len(e.columns["time"])]
        if not self._episodes:
            raise ValueError(f"{path} holds no episode with a decision")
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
        self._episode, self._number = self._episodes[case], 0
        self.start = self._begun(case)
        # Where it acts, what is executed is what it advises; else a proposal that can be executed.
        episode, columns = self._episode, self._episode.columns
        has_passed = (np.abs(columns["advised"] - columns["executed"]) > _SAME_ACCEL).any()
        idle = _IDLE.get(self._mode, _PASSED if has_passed else "")
        chronicle, self._frames = Chronicle(self.start.tolerance), list[Frame]()
        times = np.append(columns["time"], episode.end_time)
        observations = np.column_stack([columns[name] for name in VARIABLES])
        observations = _held(np.vstack([observations, episode.end]))
        rows = zip(times.tolist(), observations, cars_of(times, observations), strict=True)
        for number, (time, row, cars) in enumerate(rows):
            here, observation = _LABELS.place(row), tuple(row.tolist())
            frame = Frame(number, time, observation, here=here, idle=idle, cars=cars)
            if number < len(columns["time"]):
                frame = self._decided(frame, number)
            else:
                cars = cars._replace(rear_ended=episode.rear_ended)
                frame = frame._replace(over=True, failed=episode.collided, cars=cars)
            self._frames.append(frame._replace(story=chronicle.tell(frame)))
        return self.start

    def step(self) -> Frame:
        """The next frame."""
        self._number += 1
        return self._frames[self._number - 1]

    def graph(self) -> Graph:
        """The states as they were after the last episode."""
        model = self._run.model
        if model is None:
            return Graph(self._number)
        return graph_of(model, number=self._number)

    def known(self) -> Known:
        """Nothing: a log holds no judge."""
        return Known()

    def _begun(self, case: int) -> Start:
        about, columns = self._run.about, self._episode.columns
        times = np.append(columns["time"], self._episode.end_time)
        commands = np.concatenate([[0.0], *(columns[name] for name in _ACTIONS)])
        reason = "no failure was known yet"
        if self._reviser not in ("least-risk", "none"):
            reason = f"{self._reviser} knows no risk"
        return Start(
            system=about.get("family", self._name),
            about=f"from {self._name}.",
            cases=tuple(f"episode {k + 1}" for k in range(len(self._episodes))),
            case=case,
            tolerance=float(about.get("tolerance", TOLERANCE)),
            interval=float(np.median(np.diff(times))),
            names=OF_CARS,
            low=(float(np.nanmin(commands)),),
            high=(float(np.nanmax(commands)),),
            judge=about.get("judge", "kinematic"),
            mode=self._mode,
            unjudged="the reviser was off" if self._mode == "off" else reason,
        )

    def _decided(self, frame: Frame, number: int) -> Frame:
        row = {name: values[number] for name, values in self._episode.columns.items()}
        executed = Judged(*map(float, (row["risk_executed"], row["risk_low"], row["risk_high"])))
        risk = float(row["risk_proposed"])
        proposal, action, advice = (float(row[name]) for name in _ACTIONS)
        is_revised = not frame.idle and abs(action - proposal) > _SAME_ACCEL
        return frame._replace(
            proposed=(proposal,),
            executed=(proposal if frame.idle else action,),
            advised=(advice,),
            revised=is_revised,
            advises=is_revised or abs(advice - action) > _SAME_ACCEL,
            reason=str(row["reason"]),
            explanation=str(row["explanation"]),
            state=None if row["state"] == _NO_STATE else int(row["state"]),
            # The log has the interval of what was executed only.
            proposed_risk=executed if risk == executed.risk else Judged(risk),
            executed_risk=executed,
        )


def _held(rows: NDArray[np.float64]) -> NDArray[np.float64]:
    """What was not seen is as it was seen last; before that, as it was seen first."""
    for column in rows.T:
        places = np.flatnonzero(np.isfinite(column))
        if len(places):
            latest = np.searchsorted(places, np.arange(len(column)), side="right") - 1
            column[:] = column[places[np.maximum(latest, 0)]]
    return rows
