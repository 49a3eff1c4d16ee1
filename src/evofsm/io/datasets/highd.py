"""highD: vehicles on German motorways, from a drone.

R. Krajewski, J. Bock, L. Kloeker, L. Eckstein, "The highD dataset: a drone dataset of naturalistic
vehicle trajectories on German highways", IEEE ITSC 2018. ``x`` is the left edge of a vehicle's box
in the image and ``width`` its length; traffic runs to the left on one carriageway and to the right
on the other. The gap is taken from the boxes of both vehicles.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from evofsm.io.datasets.columns import header_and_rows, name_of, numbers, places
from evofsm.io.datasets.episodes import Episode, cut
from evofsm.io.datasets.join import Tracks

_COLUMNS = (("id",), ("frame",), ("x",), ("width",), ("xVelocity",), ("precedingId",))


def read_highd(path: Path) -> Iterator[Episode]:
    """Read ``NN_tracks.csv``; ``NN_recordingMeta.csv`` beside it tells the frame rate.

    Parameters
    ----------
    path : Path

    Yields
    ------
    Episode

    Raises
    ------
    ValueError
        Naming the file and the column that it lacks.
    OSError
        If there is no ``NN_recordingMeta.csv``.
    """
    rate = _frame_rate(path)
    rows = header_and_rows(path)
    columns = places(path, next(rows, []), _COLUMNS)
    vehicle, frame, left, length, velocity, ahead = numbers(path, rows, columns).T
    tracks = Tracks(path, vehicle, frame)
    follows, leader = tracks.followers(ahead)
    # To the right, from the follower's right edge to the leader's left one; else the other way.
    gap = np.where(
        velocity[follows] > 0.0,
        left[leader] - left[follows] - length[follows],
        left[follows] - left[leader] - length[leader],
    )
    speeds = np.abs(velocity)
    observations = np.column_stack([gap, speeds[follows], speeds[leader]])
    for mine, pair in tracks.pairs(follows, ahead[follows]):
        yield from cut(name_of(path), pair, frame[follows[mine]] / rate, observations[mine])


def _frame_rate(path: Path) -> float:
    """Frames a second."""
    meta = path.with_name(path.name.replace("_tracks", "_recordingMeta"))
    if meta == path:
        raise ValueError(f"{path}: files of highD are called NN_tracks.csv")
    rows = header_and_rows(meta)
    columns = places(meta, next(rows, []), [("frameRate",)])
    return float(numbers(meta, rows, columns)[0, 0])
