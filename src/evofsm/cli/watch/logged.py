"""A log that others wrote, with what a guard in shadow mode says of each row."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

from evofsm.driving import VARIABLES, guard_for_cars, shadow_drive
from evofsm.guard import TOLERANCE, Mode
from evofsm.io.foxglove import recording
from evofsm.io.logs import Chunk, episodes_of, read_traces
from evofsm.io.rosbag import Topics

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
    reading = read_traces([path], topics=topics)
    taken, more = 0, False
    about: dict[str, Any] = {"source": Path(path).name, "mode": "shadow", "judge": judge}
    guard = None
    with recording(out, about | {"controller": "as recorded", "tolerance": tolerance}) as log:
        for episode in episodes_of(_first(reading, MOST_ROWS + 1)):
            more = taken + len(episode.times) > MOST_ROWS
            episode = episode.rows(0, MOST_ROWS - taken)
            taken += len(episode.times)
            progress(taken)
            if len(episode.times) >= _FEWEST_ROWS:
                if guard is None:
                    guard = guard_for_cars(
                        _LOWEST,
                        _HIGHEST,
                        episode.dt,
                        mode=Mode.SHADOW,
                        tolerance=tolerance,
                        judge=judge,
                    )
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
    return more


def _first(chunks: Iterable[Chunk], most: int) -> Iterator[Chunk]:
    """No more rows than that."""
    for chunk in chunks:
        yield chunk.rows(0, most)
        most -= len(chunk.times)
        if most <= 0:
            return
