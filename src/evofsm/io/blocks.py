"""Sees that the rows of an episode stand together in a file."""

from __future__ import annotations

from collections.abc import Sequence
from hashlib import blake2b

import numpy as np
from numpy.typing import NDArray

from evofsm.io.plain import Texts
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

    def see(self, piece: Piece, keys: Sequence[Texts], starts: NDArray[np.bool_]) -> None:
        """Look at the next rows, of which those at ``starts`` begin another episode.

        Raises
        ------
        ValueError
            If one of the episodes was there before.
        """
        rows = np.flatnonzero(starts)
        came_back = -1
        for row, key in zip(rows.tolist(), _keys(keys, rows), strict=True):
            digest = blake2b(repr(key).encode(), digest_size=16).digest()
            if digest in self._episodes:
                came_back = row if came_back < 0 else came_back
                self._blocks += 1
            elif len(self._episodes) < _MOST_EPISODES:
                self._episodes.add(digest)
                self._blocks += 1
        if came_back >= 0:
            names = ", ".join(self._names)
            values = ", ".join(key.at(came_back)[:40] for key in keys)
            raise ValueError(
                f"{piece.at(came_back)}: the episode {values} ({names}) comes back after another "
                f"one: up to {piece.unit} {piece.places[-1]}, {len(self._episodes):,} episodes "
                f"take turns in {self._blocks:,} blocks of rows, and each block would be taken for "
                f"an episode of its own; sort the file by {names} and then by time"
            )


def _keys(columns: Sequence[Texts], rows: NDArray[np.int64]) -> list[tuple[str, ...]]:
    """What tells the episodes of some rows from others."""
    texts = []
    for column in columns:
        places = np.searchsorted(column.firsts, rows, side="right") - 1
        texts.append([column.values[place] for place in places.tolist()])
    return [*zip(*texts, strict=True)] if texts else [()] * len(rows)
