"""A log that others wrote, with what a guard in shadow mode says of each row."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from evofsm.driving import VARIABLES, guard_for_cars, shadow_drive
from evofsm.guard import TOLERANCE, Mode
from evofsm.io import LoggedRow, Topics, read_traces, recording, rows_of

#: More rows of a log are not watched.
MOST_ROWS = 20_000

# What a car can do at most [m/s²]; nobody says of a log what this one could.
_LOWEST, _HIGHEST = -8.0, 4.0
# Whoever wants to see something needs as many.
_FEWEST_ROWS = 10


def record_log(
    path: str,
    out: Path,
    *,
    topics: Topics | None = None,
    judge: str = "kinematic",
    tolerance: float = TOLERANCE,
    progress: Callable[[int], object] = lambda rows: None,
) -> bool:
    """Write the episodes of a log as a run, decided on by a guard that learns on the way.

    Parameters
    ----------
    path : str
        Any log that `evofsm.io.read_traces` reads, of cars that follow each other.
    out : Path
        Of the run.
    topics : Topics, optional
        Of a bag of ROS 2.
    judge : "kinematic" or "learnt"
        Of the guard.
    tolerance : float
        Of the guard.
    progress : callable, optional
        Told how many rows were decided on.

    Returns
    -------
    bool
        Whether rows after the first `MOST_ROWS` were left out.

    Raises
    ------
    ValueError
        If the log cannot be read, or no episode has ten rows.
    """
    dt = np.nan
    taken = 0

    def rows() -> Iterator[LoggedRow]:
        nonlocal dt
        for chunk in read_traces([path], topics=topics):
            dt = chunk.dt
            yield from rows_of([chunk])

    reading = rows()
    about: dict[str, Any] = {"source": Path(path).name, "mode": "shadow", "judge": judge}
    guard = None
    with recording(out, about | {"controller": "as recorded", "tolerance": tolerance}) as log:
        for episode in _episodes(islice(reading, MOST_ROWS)):
            taken += len(episode)
            progress(taken)
            if len(episode) < _FEWEST_ROWS:
                continue
            if guard is None:
                guard = guard_for_cars(
                    _LOWEST, _HIGHEST, dt, mode=Mode.SHADOW, tolerance=tolerance, judge=judge
                )
            log.add(
                shadow_drive(
                    guard,
                    [row.time - episode[0].time for row in episode],
                    [[row.values[name] for name in VARIABLES] for row in episode],
                    [row.action for row in episode],
                    failed=episode[-1].failed,
                )
            )
        if guard is None:
            raise ValueError(f"{path}: nobody follows anybody for {_FEWEST_ROWS} rows")
        if guard.machine is not None:
            log.attach(guard.machine.model(names=VARIABLES))
    return next(reading, None) is not None


def _episodes(rows: Iterable[LoggedRow]) -> Iterator[list[LoggedRow]]:
    """Rows from one beginning to the next."""
    waiting: list[LoggedRow] = []
    for row in rows:
        if row.begins and waiting:
            yield waiting
            waiting = []
        waiting.append(row)
    if waiting:
        yield waiting
