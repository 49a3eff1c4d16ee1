"""Recordings of every vehicle on a stretch of road: NGSIM and highD.

NGSIM, from cameras, ten times a second: US Federal Highway Administration, "Next Generation
Simulation (NGSIM) Vehicle Trajectories". Speeds are in ft/s and lengths in ft. ``Space_Headway`` is
from front to front, so that the gap is what the length of the vehicle ahead leaves of it.

highD, vehicles on German motorways, from a drone: R. Krajewski, J. Bock, L. Kloeker, L. Eckstein,
"The highD dataset: a drone dataset of naturalistic vehicle trajectories on German highways", IEEE
ITSC 2018. ``x`` is the left edge of a vehicle's box in the image and ``width`` its length; traffic
runs to the left on one carriageway and to the right on the other. The gap is taken from the boxes
of both vehicles.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from studies.datasets.columns import name_of, read_columns
from studies.datasets.episodes import Episode, cut

_FOOT = 0.3048
_NGSIM_RATE = 10.0  # frames a second
_NGSIM = (
    *(("Vehicle_ID",), ("Frame_ID",), ("v_Length",), ("v_Vel",)),
    *(("Preceding", "Preceeding"), ("Space_Headway", "Space_Hdwy")),
)
_HIGHD = (("id",), ("frame",), ("x",), ("width",), ("xVelocity",), ("precedingId",))


def read_ngsim(path: Path) -> Iterator[Episode]:
    """Read NGSIM's trajectories of one recording: identities begin anew in the next one."""
    vehicle, frame, length, speed, ahead, headway = read_columns(path, _NGSIM)

    def observe(follower: NDArray[np.int64], leader: NDArray[np.int64]) -> NDArray[np.float64]:
        gap = headway[follower] - length[leader]
        return _FOOT * np.column_stack([gap, speed[follower], speed[leader]])

    yield from _episodes(path, vehicle, frame, _NGSIM_RATE, ahead, observe)


def read_highd(path: Path) -> Iterator[Episode]:
    """Read highD's ``NN_tracks.csv``; ``NN_recordingMeta.csv`` beside it holds the frame rate."""
    meta = path.with_name(path.name.replace("_tracks", "_recordingMeta"))
    if meta == path:
        raise ValueError(f"{path}: files of highD are called NN_tracks.csv")
    rate = float(read_columns(meta, [("frameRate",)])[0, 0])
    vehicle, frame, left, length, velocity, ahead = read_columns(path, _HIGHD)
    speed = np.abs(velocity)

    def observe(follower: NDArray[np.int64], leader: NDArray[np.int64]) -> NDArray[np.float64]:
        # To the right, from the follower's right edge to the leader's left one; else the other way.
        gap = np.where(
            velocity[follower] > 0.0,
            left[leader] - left[follower] - length[follower],
            left[follower] - left[leader] - length[leader],
        )
        return np.column_stack([gap, speed[follower], speed[leader]])

    yield from _episodes(path, vehicle, frame, rate, ahead, observe)


def _episodes(
    path: Path,
    vehicle: NDArray[np.float64],
    frame: NDArray[np.float64],
    rate: float,
    ahead: NDArray[np.float64],
    observe: Callable[[NDArray[np.int64], NDArray[np.int64]], NDArray[np.float64]],
) -> Iterator[Episode]:
    """The episodes of everybody whose vehicle ``ahead`` (0: none) is in sight in the same frame.

    ``observe`` makes observations of the rows of a follower and of its leader.
    """
    frames = float(frame.max()) + 1.0
    keys = vehicle * frames + frame
    order = np.argsort(keys, kind="stable")
    ordered = keys[order]
    if (ordered[1:] == ordered[:-1]).any():
        row = order[np.argmax(ordered[1:] == ordered[:-1])]
        raise ValueError(
            f"{path}: vehicle {vehicle[row]:g} is in frame {frame[row]:g} twice (several "
            "recordings in one file? each needs a file of its own)"
        )
    follower = np.flatnonzero(ahead > 0.0)
    wanted = ahead[follower] * frames + frame[follower]
    place = np.minimum(np.searchsorted(ordered, wanted), len(ordered) - 1)
    seen = ordered[place] == wanted
    follower, leader = follower[seen], order[place[seen]]
    by_pair = np.lexsort((frame[follower], ahead[follower], vehicle[follower]))
    follower, leader = follower[by_pair], leader[by_pair]
    pairs = np.column_stack([ahead[follower], vehicle[follower]])
    begins = np.flatnonzero((np.diff(pairs, axis=0) != 0.0).any(axis=1)) + 1
    for rows in np.split(np.arange(len(pairs)), begins):
        if len(rows):
            name = "v{:g}-v{:g}".format(*pairs[rows[0]])
            mine = follower[rows]
            yield from cut(name_of(path), name, frame[mine] / rate, observe(mine, leader[rows]))
