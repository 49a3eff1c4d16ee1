"""Who is where in a recording of many vehicles, and who follows whom."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray


class Tracks:
    """Rows of many vehicles, found by vehicle and frame.

    Parameters
    ----------
    path : Path
        For messages.
    vehicle, frame : (T,) ndarray
        Whole numbers of at least 0.

    Raises
    ------
    ValueError
        If a vehicle has two rows of one frame.

    Examples
    --------
    >>> tracks = Tracks(Path("a.csv"), np.array([7.0, 7.0, 8.0]), np.array([1.0, 2.0, 1.0]))
    >>> tracks.rows_of(np.array([8.0, 8.0]), np.array([1.0, 2.0]))  # 8 has no frame 2
    array([ 2, -1])
    """

    def __init__(
        self, path: Path, vehicle: NDArray[np.float64], frame: NDArray[np.float64]
    ) -> None:
        self._vehicle, self._frame = vehicle, frame
        self._frames = float(frame.max()) + 1.0
        keys = self._keys(vehicle, frame)
        self._order = np.argsort(keys, kind="stable")
        self._sorted = keys[self._order]
        twice = np.flatnonzero(self._sorted[1:] == self._sorted[:-1])
        if len(twice):
            row = self._order[twice[0]]
            raise ValueError(
                f"{path}: vehicle {vehicle[row]:g} is in frame {frame[row]:g} twice (several "
                "recordings in one file? each needs a file of its own)"
            )

    def rows_of(
        self, vehicle: NDArray[np.float64], frame: NDArray[np.float64]
    ) -> NDArray[np.int64]:
        """Row of each vehicle in each frame; -1 where it is in none."""
        keys = self._keys(vehicle, frame)
        at = np.minimum(np.searchsorted(self._sorted, keys), len(self._sorted) - 1)
        return np.where(self._sorted[at] == keys, self._order[at], -1)

    def followers(self, ahead: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Rows of those that have a vehicle ahead which is in sight, and the rows of that.

        Parameters
        ----------
        ahead : (T,) ndarray
            Vehicle ahead of each row; 0 where there is none.
        """
        rows = np.flatnonzero(ahead > 0.0)
        leader = self.rows_of(ahead[rows], self._frame[rows])
        return rows[leader >= 0], leader[leader >= 0]

    def pairs(
        self, follows: NDArray[np.int64], ahead: NDArray[np.float64]
    ) -> Iterator[tuple[NDArray[np.int64], str]]:
        """Places in ``follows`` of each pair, in the order of time, and its name.

        Parameters
        ----------
        follows : (k,) ndarray
            Rows of followers.
        ahead : (k,) ndarray
            Vehicle ahead of each.
        """
        follower, frame = self._vehicle[follows], self._frame[follows]
        order = np.lexsort((frame, ahead, follower))
        changed = np.diff(follower[order]) != 0.0
        changed |= np.diff(ahead[order]) != 0.0
        for part in np.split(order, np.flatnonzero(changed) + 1):
            if len(part):
                yield part, f"v{ahead[part[0]]:g}-v{follower[part[0]]:g}"

    def _keys(
        self, vehicle: NDArray[np.float64], frame: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        return vehicle * self._frames + frame
