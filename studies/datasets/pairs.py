"""The plain layout: one row per pair and time step, with the gap and both speeds in SI units."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import polars

from studies.datasets.columns import name_of
from studies.datasets.episodes import Episode, cut

_NUMBERS = ("time", "gap", "v_follower", "v_leader", "a_follower")
_LABELS = ("pair", "segment")


def read_pairs(path: Path) -> Iterator[Episode]:
    """Read ``run, pair, segment, time, gap, v_follower, v_leader, a_follower``.

    The run is the file. Rows of one segment stand together, in the order of time; a pair's episode
    ends where its segment does.
    """
    kinds = dict.fromkeys(_NUMBERS, polars.Float64) | dict.fromkeys(_LABELS, polars.String)
    try:
        table = polars.read_csv(path, schema_overrides=kinds)
    except polars.exceptions.PolarsError as error:
        raise ValueError(f"{path}: {str(error).partition(chr(10))[0]}") from error
    for name in (*_NUMBERS, *_LABELS):
        if name not in table.columns:
            raise ValueError(
                f"{path} has no column {name!r}; it has {', '.join(table.columns[:12])} "
                "(a file of another layout?)"
            )
    segments = table.with_columns(place=polars.struct(_LABELS).rle_id()).partition_by("place")
    for part in segments:
        rows = part.select(_NUMBERS).to_numpy()
        yield from cut(name_of(path), part["pair"][0], rows[:, 0], rows[:, 1:4], rows[:, 4])
    if not segments:
        raise ValueError(f"{path} has a header but no rows")
