"""What was asked of a study, and whether it came out: marks and colours follow this alone."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

from studies.old.shim import Column, Table


class Asked(NamedTuple):
    """Something that was asked for, and what came out."""

    claim: str
    asked: str
    measured: str
    met: bool


def at_most(what: str, value: float, most: float, show: Callable[[float], str]) -> Asked:
    """That a number be no larger than another one.

    >>> at_most("episodes that fail", 3, 2, str)
    Asked(claim='episodes that fail', asked='≤ 2', measured='3', met=False)
    """
    return Asked(what, f"≤ {show(most)}", show(value), value <= most)


def at_least(what: str, value: float, least: float, show: Callable[[float], str]) -> Asked:
    """That a number be no smaller than another one."""
    return Asked(what, f"≥ {show(least)}", show(value), value >= least)


def failures(asked: Sequence[Asked]) -> tuple[str, ...] | None:
    """A sentence for each that is not met; None where nothing could be judged."""
    if not asked:
        return None
    return tuple(
        f"{one.claim}: {one.measured}, where {one.asked} was asked." for one in asked if not one.met
    )


def tables_of_asked(asked: Sequence[Asked]) -> tuple[Table, ...]:
    """All of it in a table; none where nothing could be judged."""
    columns: tuple[Column[Asked], ...] = (
        Column("target", "claim"),
        Column("asked", "asked"),
        Column("measured", "measured"),
        Column("met", lambda one: "yes" if one.met else "no"),
    )
    title = "What was asked for"
    table = Table.of(title, columns, asked, in_words=True, failing=lambda one: not one.met)
    return (table,) if asked else ()
