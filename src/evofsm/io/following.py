"""Follow pairs of vehicles through time, whatever told who follows whom."""

from __future__ import annotations

import math
from array import array
from collections.abc import Iterable, Iterator, Sequence
from itertools import chain
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from evofsm.driving import VARIABLES
from evofsm.io.tables import Piece

#: The action of a pair of vehicles: what the follower did until the next time.
ACTION = "a_follower"
#: What is known of a pair at one time.
COLUMNS = ("time", *VARIABLES, ACTION)

_ROWS_AT_ONCE = 8192
# Rows that pairs on the road may have waiting before all are handed on, each of 32 bytes. It
# bounds memory, at the price of one transition for each pair cut.
_MOST_WAITING = 1_000_000


class Following(NamedTuple):
    """A vehicle and the one that it follows, at one time."""

    who: tuple[str, str, str]  #: lane, follower, leader
    gap: float  #: bumper to bumper [m]
    v_follower: float  #: [m/s]
    v_leader: float  #: [m/s]


class Moment(NamedTuple):
    """All pairs that there are at one time."""

    time: float  #: [s]
    place: str  #: where it stands, for a message
    pairs: Sequence[Following]


class Episode(NamedTuple):
    """A pair for as long as it stays one: T times."""

    rows: NDArray[np.float64]  #: (T, 5) `COLUMNS`; the action is NaN in the last row
    was_cut: bool  #: the pair went on, in an episode of its own


class PairTable:
    """The pairs of a file, as a table with a row for each pair and time.

    Parameters
    ----------
    path : str
        For messages.
    moments : iterable of Moment
    """

    columns: tuple[str, ...] = COLUMNS

    def __init__(self, path: str, moments: Iterable[Moment]) -> None:
        self.path = path
        self._episodes = _pair_episodes(_forward(moments))

    def holds_dates(self, name: str) -> bool:
        """Never: the time of a moment is in seconds."""
        return False

    def pieces(self, *_: Sequence[str]) -> Iterator[Piece]:
        """All columns, whichever are asked for; episodes end to end, some thousand rows at once."""
        reached, waiting, count = 0, list[Episode](), 0
        for episode in chain(self._episodes, [None]):
            if episode is not None:
                waiting.append(episode)
                count += len(episode.rows)
            if count >= (_ROWS_AT_ONCE if episode is not None else 1):
                for piece in self._joined(waiting, reached):
                    reached += len(piece.places)
                    yield piece
                waiting, count = [], 0
        if reached == 0:
            raise ValueError(f"{self.path}: no vehicle ever follows another one on the same lane")

    def _joined(self, episodes: Sequence[Episode], reached: int) -> Iterator[Piece]:
        table = np.concatenate([episode.rows for episode in episodes])
        starts = np.cumsum([0, *(len(episode.rows) for episode in episodes[:-1])])
        cuts = sum(episode.was_cut for episode in episodes)
        for first in range(0, len(table), _ROWS_AT_ONCE):
            part = table[first : first + _ROWS_AT_ONCE]
            places = np.arange(reached + first + 1, reached + first + len(part) + 1)
            within = starts[(starts >= first) & (starts < first + len(part))] - first
            numbers = dict(zip(COLUMNS, part.T, strict=True))
            yield Piece(self.path, "row", places, numbers, {}, within, 0 if first else cuts)


def _forward(moments: Iterable[Moment]) -> Iterator[Moment]:
    """The same moments, once it is seen that time runs forward."""
    before = -math.inf
    for moment in moments:
        if not moment.time > before:
            raise ValueError(
                f"{moment.place}: time goes from {before:g} to {moment.time:g}; it must run "
                "forward (rows not sorted by time, or two recordings in one file?)"
            )
        before = moment.time
        yield moment


def _pair_episodes(moments: Iterable[Moment]) -> Iterator[Episode]:
    """Follow every pair through time; an episode comes out when it ends."""
    open_pairs: dict[tuple[str, str, str], array[float]] = {}
    waiting = 0
    for moment in moments:
        present: dict[tuple[str, str, str], array[float]] = {}
        for pair in moment.pairs:
            rows = open_pairs.pop(pair.who, None) or array("d")
            rows.extend((moment.time, pair.gap, pair.v_follower, pair.v_leader))
            present[pair.who] = rows
            waiting += 1
        for rows in open_pairs.values():
            waiting -= len(rows) // 4
            yield _episode(rows)
        open_pairs = present
        if waiting > _MOST_WAITING:
            for rows in open_pairs.values():
                yield _episode(rows, was_cut=True)
            open_pairs, waiting = {}, 0
    for rows in open_pairs.values():
        yield _episode(rows)


def _episode(rows: array[float], was_cut: bool = False) -> Episode:
    table = np.array(rows).reshape(-1, 4)
    times, speeds = table[:, 0], table[:, 2]
    with np.errstate(over="ignore"):
        actions = np.append(np.diff(speeds) / np.diff(times), np.nan)
    actions[np.isinf(actions)] = np.nan  # beyond any number: none is known
    return Episode(np.column_stack([table, actions]), was_cut)
