"""NGSIM: every vehicle on a stretch of road, ten times a second, from cameras.

US Federal Highway Administration, "Next Generation Simulation (NGSIM) Vehicle Trajectories".
Speeds are in ft/s and lengths in ft. ``Space_Headway`` is from front to front, so that the gap is
what the length of the vehicle ahead leaves of it.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from evofsm.io.datasets.columns import header_and_rows, name_of, numbers, places
from evofsm.io.datasets.episodes import Episode, cut
from evofsm.io.datasets.join import Tracks

_FOOT = 0.3048
_PER_SECOND = 10.0
_COLUMNS = (
    ("Vehicle_ID",),
    ("Frame_ID",),
    ("v_Length",),
    ("v_Vel",),
    ("Preceding", "Preceeding"),
    ("Space_Headway", "Space_Hdwy"),
)


def read_ngsim(path: Path) -> Iterator[Episode]:
    """Read trajectories of one place and period; whoever has a vehicle ahead is a follower.

    Parameters
    ----------
    path : Path
        CSV with a header, of one recording: identities begin anew in the next one.

    Yields
    ------
    Episode

    Raises
    ------
    ValueError
        Naming the file and the column that it lacks, or if it holds several recordings.
    """
    rows = header_and_rows(path)
    columns = places(path, next(rows, []), _COLUMNS)
    vehicle, frame, length, speed, ahead, headway = numbers(path, rows, columns).T
    tracks = Tracks(path, vehicle, frame)
    follows, leader = tracks.followers(ahead)
    gap = headway[follows] - length[leader]
    observations = _FOOT * np.column_stack([gap, speed[follows], speed[leader]])
    for mine, pair in tracks.pairs(follows, ahead[follows]):
        yield from cut(name_of(path), pair, frame[follows[mine]] / _PER_SECOND, observations[mine])
