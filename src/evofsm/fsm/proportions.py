"""How well a share or a rate is known that was counted."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from evofsm.fsm.kernels import compiled
from evofsm.fsm.validation import counted

# Two-sided 90 %.
_QUANTILE = 1.645
# From so many events on their distribution is taken to be a power of a normal one, and from so
# many cases of each kind on Wilson's interval is near enough.
_MANY_EVENTS, _MANY_CASES = 50, 100


@compiled
def wilson_bounds(share: float, count: float, quantile: float = _QUANTILE) -> tuple[float, float]:
    """Interval of a share (Wilson 1927).

    Parameters
    ----------
    share, count : float
        The share, in [0, 1], and of how many cases.
    quantile : float
        Of a standard normal variable, at the upper end; that of 90 % unless told otherwise.

    Raises
    ------
    ValueError
        If the share is none.
    """
    if abs(share - 0.5) > 0.5 + 1e-6:  # with room for rounding
        raise ValueError("share must lie between 0 and 1 (is it a count?)")
    spread = quantile * quantile / count
    centre = (share + 0.5 * spread) / (1.0 + spread)
    reach = math.sqrt(spread * (share * (1.0 - share) + 0.25 * spread)) / (1.0 + spread)
    return max(centre - reach, 0.0), min(centre + reach, 1.0)


@lru_cache(maxsize=1024)
def binomial_bounds(count: int, of: int) -> tuple[float, float]:
    """90 % interval of a share where ``count`` ``of`` so many were seen (Clopper & Pearson 1934).

    Each end by itself holds with 95 %; from a hundred of each kind on it is Wilson's, near enough.

    >>> binomial_bounds(0, 3), binomial_bounds(3, 3)
    ((0.0, 0.6315968501359613), (0.36840314986403866, 1.0))
    """
    if 2 * count > of:
        low, high = binomial_bounds(of - count, of)
        return 1.0 - high, 1.0 - low
    if count >= _MANY_CASES:
        return wilson_bounds(count / of, of)
    return _share(count - 1, of, 0.95) if count else 0.0, _share(count, of, 0.05)


def _share(most: int, of: int, chance: float) -> float:
    """The chance of each of so many cases of which at most ``most`` happen with that chance."""
    low, high = 0.0, 1.0
    k, ways = np.arange(most + 1), [math.log(math.comb(of, k)) for k in range(most + 1)]
    for _ in range(60):
        share = 0.5 * (low + high)
        terms = np.exp(ways + k * math.log(share) + (of - k) * math.log1p(-share))
        low, high = (share, high) if terms.sum() > chance else (low, share)
    return high


@lru_cache(maxsize=1024)
def poisson_bounds(count: int) -> tuple[float, float]:
    """90 % interval of the expected number of events where ``count`` were seen (Garwood 1936)."""
    return _mean(count - 1, 0.95) if count else 0.0, _mean(count, 0.05)


def _mean(most: int, share: float) -> float:
    """Of a Poisson variable that is at most so many with this probability, 0.05 or 0.95."""
    if most >= _MANY_EVENTS:  # Wilson & Hilferty 1931, of a gamma variable
        width, shape = _QUANTILE if share < 0.5 else -_QUANTILE, most + 1.0
        return float(shape * (1.0 - 1.0 / (9.0 * shape) + width / (3.0 * math.sqrt(shape))) ** 3)
    low, high = 0.0, 2.0 * most + 20.0
    for _ in range(60):
        mean = 0.5 * (low + high)
        terms = (mean**k / math.factorial(k) for k in range(most + 1))
        low, high = (mean, high) if math.exp(-mean) * sum(terms) > share else (low, mean)
    return high


def bounds_text(low: float, high: float) -> str:
    """Bounds of a share in percent, rounded outward, but for those that say nothing.

    Within one percent of 0 or of 1 they have the first digit that shows them.
    """
    least = _percent(low, math.floor)
    most = _percent(high, math.ceil)
    if low <= 0.0 and high < 1.0:
        return f"at most {most} %"
    return f"at least {least} %" if high >= 1.0 and low > 0.0 else f"{least} to {most} %"


def _percent(share: float, rounded: Callable[[float], int]) -> str:
    apart = 100.0 * min(share, 1.0 - share)
    decimals = max(-math.floor(math.log10(apart)), 0) if 1e-9 < apart < 1.0 else 0
    return f"{min(max(outward(rounded, 100.0 * share, decimals), 0.0), 100.0):.{decimals}f}"


def outward(rounded: Callable[[float], int], value: float, decimals: int) -> float:
    """A number with so many decimals, rounded by ``math.floor`` or ``math.ceil``."""
    scale = 10.0**decimals
    return rounded(round(value * scale, 6)) / scale  # 0.1 + 0.2 is 0.3


class FailureRecord(NamedTuple):
    """How often it failed, with what that rests on.

    The intervals are Garwood's (1936), of failures that come at a constant rate, independently of
    each other. Each end by itself holds with 95 %, in the conditions in which it was run.
    """

    failures: int
    hours: float  #: that were run [h]
    kilometres: float | None = None  #: that were driven [km]; None where nothing drives
    episodes: int | None = None

    def __str__(self) -> str:
        exposures = [] if self.episodes is None else [counted(self.episodes, "episode")]
        rates = []
        for exposure, unit, per, words in (
            (self.hours, "h", 1.0, "per hour"),
            (self.kilometres, "km", 1000.0, "per 1,000 km"),
        ):
            if exposure is not None:
                small = min(max(exposure, 1e-9), 0.1)  # has two digits
                few = f"{outward(math.floor, exposure, 1 - math.floor(math.log10(small))):g}"
                many = f"{math.floor(exposure + 1e-6):,}"
                exposures.append(f"{few if exposure < 10.0 else many} {unit}")
            if exposure:
                rates.append(_rate(self.failures, exposure / per, words))
        verdict = f"{', '.join(rates)}, 90 %, two-sided" if rates else "nothing is known"
        if rates and self.failures == 0:
            verdict = f"at most {', '.join(rates)}, 95 %, one-sided"
        return f"{counted(self.failures, 'failure')} in {', '.join(exposures)}: {verdict}"


def _rate(failures: int, exposure: float, words: str) -> str:
    low, high = (bound / exposure for bound in poisson_bounds(failures))
    if failures == 0:
        return f"{_two_digits(high, math.ceil)} {words}"
    bounds = f"{_two_digits(low, math.floor)} to {_two_digits(high, math.ceil)}"
    return f"{_two_digits(failures / exposure, round)} {words} ({bounds})"


def _two_digits(value: float, rounded: Callable[[float], int]) -> str:
    decimals = 1 - math.floor(math.log10(value))
    return f"{outward(rounded, value, decimals):,.{max(decimals, 0)}f}"


def usual_range(values: NDArray[np.float64], failed: NDArray[np.float64]) -> tuple[float, float]:
    """Ends of all values but a few far ones, and of the nearest quarter of those that failed."""
    values, failed = values[np.isfinite(values)], failed[np.isfinite(failed)]
    low, high = np.quantile(values, [0.01, 0.99]).tolist() if len(values) else (0.0, 1.0)
    reach = 0.5 * (high - low) or math.inf
    inside = values[(values >= low - reach) & (values <= high + reach)]
    low, high = float(inside.min(initial=low)), float(inside.max(initial=high))
    beyond = np.abs(failed - np.clip(failed, low, high))
    near = failed[beyond <= np.quantile(beyond, 0.25)] if len(failed) else failed
    return float(near.min(initial=low)), float(near.max(initial=high))
