"""A follower and its leader for as long as both were seen, whatever layout they come from."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from evofsm.io.logs import LONGEST_STEP, Chunk

#: Shorter episodes are left out [s].
SHORTEST = 2.0


class Episode(NamedTuple):
    """T consecutive rows of one pair, evenly spaced in time."""

    run: str  #: recording it comes from: the file, without folder and ending
    pair: str  #: who follows whom, as the recording names them
    times: NDArray[np.float64]  #: (T,) [s]
    observations: NDArray[np.float64]  #: (T, 3) gap, bumper to bumper [m]; both speeds [m/s]
    accelerations: NDArray[np.float64]  #: (T,) of the follower from each row on [m/s²]
    dt: float  #: time from a row to the next [s]


def as_chunks(episodes: Iterable[Episode]) -> Iterator[Chunk]:
    """Episodes as the chunks that a machine learns from, one of them each.

    Parameters
    ----------
    episodes : iterable of Episode

    Yields
    ------
    Chunk

    Examples
    --------
    >>> rows = np.array([[20.0, 10.0, 10.0], [20.0, 10.0, 10.0]])
    >>> episode = Episode("day-1", "v1-v2", np.array([0.0, 0.1]), rows, np.zeros(2), 0.1)
    >>> [(chunk.source, chunk.starts.tolist()) for chunk in as_chunks([episode])]
    [('day-1, v1-v2', [0])]
    """
    for episode in episodes:
        yield Chunk(
            source=f"{episode.run}, {episode.pair}",
            observations=episode.observations,
            actions=episode.accelerations,
            times=episode.times,
            starts=np.zeros(1, np.int64),
            dt=episode.dt,
        )


def cut(
    run: str,
    pair: str,
    times: NDArray[np.float64],
    observations: NDArray[np.float64],
    accelerations: NDArray[np.float64] | None = None,
) -> Iterator[Episode]:
    """Episodes of one pair: parted where a value is missing, no gap is left, or time has a hole.

    Parameters
    ----------
    run, pair : str
        As `Episode` has them.
    times : (T,) ndarray
        [s], rising.
    observations : (T, 3) ndarray
        Gap [m] and both speeds [m/s]; NaN where one is missing.
    accelerations : (T,) ndarray, optional
        Of the follower [m/s²]; without them the change of its speed to the next row, and NaN in
        an episode's last row.

    Yields
    ------
    Episode
        Of `SHORTEST` or longer.
    """
    steps = np.diff(times)
    if len(steps) == 0:
        return
    dt = round(float(np.median(steps)), 6)
    usable = np.isfinite(observations).all(axis=1) & (observations[:, 0] > 0.0)
    follows = usable[1:] & usable[:-1] & (steps < LONGEST_STEP * dt) & (steps > dt / LONGEST_STEP)
    starts = np.flatnonzero(np.append(True, ~follows))
    for first, end in zip(starts, [*starts[1:], len(times)], strict=True):
        if not usable[first] or (end - first - 1) * dt < SHORTEST - 1e-9:
            continue
        rows = slice(first, end)
        if accelerations is None:
            changes = np.append(np.diff(observations[rows, 1]) / dt, np.nan)
        else:
            changes = accelerations[rows].copy()
        yield Episode(run, pair, times[rows].copy(), observations[rows].copy(), changes, dt)
