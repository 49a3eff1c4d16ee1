"""Numbers as people read them, on pages and in the terminal; `NONE` where there is none."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable

from evofsm.fsm.proportions import outward

#: Where a number does not apply.
NONE = "–"


def percent(share: float | None, sign: str = " %") -> str:
    """A share; one that is small but not 0 is not shown as 0."""
    if share is None or not math.isfinite(share):
        return NONE
    value = 100.0 * share
    return f"{value:.{_places(value)}f}{sign}"


def _places(percentage: float) -> int:
    return 2 if 0.0 < percentage < 0.05 else 1


def bare_percent(share: float | None) -> str:
    """A share in percent; the sign stands elsewhere."""
    return percent(share, "")


def number(value: float | None, decimals: int) -> str:
    """A number, if it is one."""
    return NONE if value is None or not math.isfinite(value) else f"{value:.{decimals}f}"


def decimals(n: int) -> Callable[[float | None], str]:
    """How a column writes numbers, with ``n`` decimals.

    >>> decimals(2)(0.125), decimals(2)(None)
    ('0.12', '–')
    """
    return lambda value: number(value, n)


def count(value: float | None) -> str:
    """A count, or the median of counts."""
    if value is None or not math.isfinite(value):
        return NONE
    return f"{value:,.1f}".removesuffix(".0")


def interval(low: float | None, high: float | None, show: Callable[[float], str]) -> str:
    """From and to, if they are known."""
    if low is None or high is None or not (math.isfinite(low) and math.isfinite(high)):
        return NONE
    return f"{show(low)}–{show(high)}"


def span(n: int) -> Callable[[float | None, float | None], str]:
    """How a column writes intervals: rounded outward, to ``n`` decimals.

    >>> span(1)(0.27, 2.0), span(1)(0.0, 0.71)
    ('0.2–2.0', '0.0–0.8')
    """
    return lambda low, high: _outward(low, high, lambda end: n)


def _outward(low: float | None, high: float | None, places: Callable[[float], int]) -> str:
    """From and to, rounded outward to as many decimals as ``places`` says of each."""
    known = [end for end in (low, high) if end is not None and math.isfinite(end)]
    if len(known) < 2:
        return NONE
    ends = zip((math.floor, math.ceil), known, strict=True)
    return "–".join(f"{outward(to, end, places(end)):.{places(end)}f}" for to, end in ends)


def within(n: int, ends: int) -> Callable[[float, float, float], str]:
    """How a column writes a number and, in brackets, its `span`, with so many decimals each.

    >>> within(3, 2)(0.5, 0.25, 0.75)
    '0.500 (0.25–0.75)'
    """
    return lambda value, low, high: f"{number(value, n)} ({span(ends)(low, high)})"


def percents(low: float, high: float) -> str:
    """From and to, in percent, rounded outward; the sign stands elsewhere.

    >>> percents(0.0, 0.00735), percents(0.00012, 0.5)
    ('0.0–0.8', '0.01–50.0')
    """
    return _outward(100.0 * low, 100.0 * high, _places)


def listed(names: Iterable[str]) -> str:
    """One, two and three."""
    *most, last = names
    return f"{', '.join(most)} and {last}" if most else last


def seeds_text(n: int) -> str:
    """How many learning seeds."""
    return f"{n} learning seed{'' if n == 1 else 's'}"


def part(number: float, whole: float) -> str:
    """So many of so many."""
    return f"{count(number)} of {whole:,.0f}"
