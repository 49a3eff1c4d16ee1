"""Numbers as people read them, on pages and in the terminal."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable

#: Where a number does not apply.
NONE = "–"


def percent(share: float, sign: str = " %") -> str:
    """A share; one that is small but not 0 is not shown as 0."""
    if not math.isfinite(share):
        return NONE
    value = 100.0 * share
    decimals = 2 if 0.0 < value < 0.05 else 1
    return f"{value:.{decimals}f}{sign}"


def number(value: float, decimals: int) -> str:
    """A number, if it is one."""
    return f"{value:.{decimals}f}" if math.isfinite(value) else NONE


def count(value: float) -> str:
    """A count, or the median of counts."""
    return f"{value:,.1f}".removesuffix(".0") if math.isfinite(value) else NONE


def interval(low: float, high: float, show: Callable[[float], str]) -> str:
    """From and to, if they are known."""
    if not (math.isfinite(low) and math.isfinite(high)):
        return NONE
    return f"{show(low)}–{show(high)}"


def percents(low: float, high: float) -> str:
    """From and to, in percent; the sign stands elsewhere."""
    return interval(low, high, lambda share: percent(share, ""))


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
