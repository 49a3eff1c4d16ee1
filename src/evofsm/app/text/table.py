"""Numbers in rows, as text: what studies hand to reports."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Table:
    """Rows under a header; the first column names the row.

    A cell may have several lines: what follows the first stands beside it, smaller.
    """

    title: str
    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    note: str = ""
    ours: tuple[int, ...] = ()  #: rows that are ours, to be set off
    in_words: bool = False  #: whether the cells are words, which may be broken into lines
    failing: tuple[int, ...] = ()  #: rows of which something that was asked for does not hold
    holding: tuple[int, ...] = ()  #: rows of which all that was asked for holds, if that is marked
