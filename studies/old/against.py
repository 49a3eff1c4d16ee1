"""Where it loses, found by code: who does better at the same question."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable
from typing import Any, TypeVar

R = TypeVar("R")


def ahead(
    rows: Iterable[R],
    ours: Callable[[R], bool],
    question: Callable[[R], Hashable],
    better: Callable[[R, R], bool],
    best: Callable[[R], Any] | None = None,
) -> list[tuple[R, R]]:
    """Pairs of a row that does better than ours at the same question, and ours.

    Parameters
    ----------
    rows : iterable
        Ours and its rivals.
    ours : callable
        Whether a row is ours; one for each question.
    question : callable
        What a row was asked.
    better : callable
        Whether the first of two rows is better than the second, ours.
    best : callable, optional
        Only the row for which this is largest is returned for each question, of equals the first.

    Examples
    --------
    >>> rows = [("a", "ours", 1.0), ("a", "ttc", 2.0), ("a", "rss", 3.0), ("b", "ours", 9.0)]
    >>> more = lambda one, mine: one[2] > mine[2]
    >>> ahead(rows, lambda r: r[1] == "ours", lambda r: r[0], more, best=lambda r: r[2])
    [(('a', 'rss', 3.0), ('a', 'ours', 1.0))]
    """
    every = list(rows)
    mine = {question(row): row for row in every if ours(row)}
    pairs = [
        (row, own)
        for row in every
        if not ours(row) and (own := mine.get(question(row))) is not None and better(row, own)
    ]
    if best is None:
        return pairs
    return [
        max((pair for pair in pairs if question(pair[0]) == asked), key=lambda pair: best(pair[0]))
        for asked in dict.fromkeys(question(row) for row, _ in pairs)
    ]
