"""Sees that the rows of an episode stand together in a file."""

from __future__ import annotations

from collections.abc import Sequence
from hashlib import blake2b

import numpy as np
from numpy.typing import NDArray

from evofsm.io.tables import Piece

# Episodes of a file that are kept in mind, some 30 MB; of those after them nothing is known.
_MOST_EPISODES = 1 << 18


class Blocks:
    """The blocks of rows of one file, each of one episode.

    An episode that comes back after another one would be cut there, and what leads from one of its
    rows to the next would be lost without a word.

    Parameters
    ----------
    names : sequence of str
        Columns that tell the episodes apart.
    """

    def __init__(self, names: Sequence[str]) -> None:
        self._names = names
        self._episodes: set[bytes] = set()
        self._blocks = 0  # of these episodes
        self._latest: tuple[str, ...] | None = None

    def starts(self, piece: Piece) -> NDArray[np.bool_]:
        """The rows of the next piece that begin another episode.

        Raises
        ------
        ValueError
            If one of the episodes was there before.
        """
        keys = [piece.texts[name] for name in self._names]
        starts = np.zeros(len(piece.places), np.bool_)
        for key in keys:
            starts[key.firsts] = True
        starts[0] = self._latest != tuple(key.at(0) for key in keys)
        self._latest = tuple(key.at(len(starts) - 1) for key in keys)
        came_back = None
        for row in np.flatnonzero(starts).tolist():
            episode = repr([key.at(row) for key in keys])
            digest = blake2b(episode.encode(), digest_size=16).digest()
            if digest in self._episodes:
                came_back = row if came_back is None else came_back
            elif len(self._episodes) < _MOST_EPISODES:
                self._episodes.add(digest)
            else:
                continue
            self._blocks += 1
        if came_back is not None:
            names = ", ".join(self._names)
            values = ", ".join(key.at(came_back)[:40] for key in keys)
            raise ValueError(
                f"{piece.at(came_back)}: the episode {values} ({names}) comes back after another "
                f"one: up to {piece.unit} {piece.places[-1]}, {len(self._episodes):,} episodes "
                f"take turns in {self._blocks:,} blocks of rows, and each block would be taken for "
                f"an episode of its own; sort the file by {names} and then by time"
            )
        return starts
