"""The plain layout: one row per pair and time step, with the gap and both speeds in SI units."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np

from evofsm.driving import VARIABLES
from evofsm.io.following import ACTION
from evofsm.io.tables import CsvTable, Piece
from studies.datasets.columns import name_of
from studies.datasets.episodes import Episode, cut

_NUMBERS = ("time", *VARIABLES, ACTION)
_LABELS = ("pair", "segment")


def read_pairs(path: Path) -> Iterator[Episode]:
    """Read ``run, pair, segment, time, gap, v_follower, v_leader, a_follower``.

    The run is the file. Rows of one segment stand together, in the order of time; a pair's episode
    ends where its segment does.
    """
    table = CsvTable(str(path))
    for name in (*_NUMBERS, *_LABELS):
        if name not in table.columns:
            raise ValueError(
                f"{path} has no column {name!r}; it has {', '.join(table.columns[:12])} "
                "(a file of another layout?)"
            )
    pieces = [piece for piece in table.pieces(_NUMBERS, _LABELS) if len(piece.places)]
    if not pieces:
        raise ValueError(f"{path} has a header but no rows")
    columns = [[piece.numbers[name] for name in _NUMBERS] for piece in pieces]
    rows = np.concatenate([np.column_stack(one) for one in columns])
    begins = list(_segments(pieces))
    ends = [first for first, _ in begins[1:]] + [len(rows)]
    for (first, (pair, _)), end in zip(begins, ends, strict=True):
        part = rows[first:end]
        yield from cut(name_of(path), pair, part[:, 0], part[:, 1:4], part[:, 4])


def _segments(pieces: Iterable[Piece]) -> Iterator[tuple[int, tuple[str, ...]]]:
    """First row of every segment, and what it is called."""
    rows_before, latest = 0, ("", "")
    for piece in pieces:
        texts = [piece.texts[name] for name in _LABELS]
        for row in np.unique(np.concatenate([text.firsts for text in texts])).tolist():
            label = (texts[0].at(row), texts[1].at(row))
            if label != latest:
                yield rows_before + row, label
            latest = label
        rows_before += len(piece.places)
