"""Numbers as people read them, on pages and in the terminal; `NONE` where there is none."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable

#: Where a number does not apply.
NONE = "–"


def percent(share: float | None, sign: str = " %") -> str:
    """A share; one that is small but not 0 is not shown as 0."""
    if share is None or not math.isfinite(share):
        return NONE
    return f"{100.0 * share:.{_places(share)}f}{sign}"


def _places(share: float) -> int:
    return 2 if 0.0 < share < 0.0005 else 1


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
    return lambda low, high: interval(
        _rounded(math.floor, low, n), _rounded(math.ceil, high, n), decimals(n)
    )


def _rounded(to: Callable[[float], int], value: float | None, n: int) -> float | None:
    """What is off ``n`` decimals by rounding alone is that number."""
    if value is None or not math.isfinite(value):
        return value
    return to(round(value * 10.0**n, 6)) / 10.0**n


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
    ends = [
        f"{_rounded(to, 100.0 * share, _places(share)):.{_places(share)}f}"
        for to, share in ((math.floor, low), (math.ceil, high))
        if math.isfinite(share)
    ]
    return "–".join(ends) if len(ends) == 2 else NONE


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
