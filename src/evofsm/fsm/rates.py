"""How often something begins: counted over time, and how well that is known.

Of all states together the count is Poisson's, with Garwood's interval (1936). A state by itself has
too few; its rate is shrunk towards that of all, as empirical Bayes has it (Clayton & Kaldor,
"Empirical Bayes estimates of age-standardized relative risks for use in disease mapping",
Biometrics 43, 1987, with the moments of Marshall, "Mapping disease and mortality rates using
empirical Bayes estimators", Applied Statistics 40, 1991). With k_i onsets in a time e_i, ::

    r = sum k / sum e        v = sum e_i (k_i / e_i - r)^2 / sum e  -  r / mean e
    rate_i ~ Gamma(a + k_i, b + e_i),        b = r / v,  a = r b

Where states differ by no more than chance (v <= 0), all have the rate of all.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from evofsm.fsm.proportions import gamma_quantile, outward, poisson_bounds, two_digits

# Two-sided 90 %.
_TAILS = (0.05, 0.95)


class Rate(NamedTuple):
    """How often something began.

    Examples
    --------
    >>> Rate.of(3, 40.0)
    Rate(onsets=3, exposure=40.0, rate=0.075, low=0.0204, high=0.194)
    >>> print(Rate.of(0, 40.0))
    0 times in 40: at most 0.075
    """

    onsets: int  #: number of times
    exposure: float  #: in so much time [s], or so many observations
    rate: float  #: one by the other; NaN without exposure
    low: float  #: 90 % interval of the rate
    high: float

    @classmethod
    def of(cls, onsets: float, exposure: float) -> Rate:
        """The rate of what was counted, with its interval (Garwood 1936)."""
        if exposure <= 0.0:
            return cls(int(onsets), 0.0, math.nan, 0.0, math.inf)
        low, high = poisson_bounds(int(onsets))
        return cls(int(onsets), float(exposure), onsets / exposure, low / exposure, high / exposure)

    def __repr__(self) -> str:
        return (
            f"{type(self).__name__}(onsets={self.onsets}, exposure={self.exposure}, "
            f"rate={self.rate:.3g}, low={self.low:.3g}, high={self.high:.3g})"
        )

    def __str__(self) -> str:
        low, high = two_digits(self.low, math.floor), two_digits(self.high, math.ceil)
        bounds = f"{low:.2g} to {high:.2g}" if self.onsets else f"at most {high:.2g}"
        times = "once" if self.onsets == 1 else f"{self.onsets:,} times"
        return f"{times} in {self.exposure:.4g}: {bounds}"


class FailureRecord(NamedTuple):
    """How often it failed, in the words of a safety review, with what that rests on.

    The intervals are Garwood's (1936), exact if failures come at a constant rate and independently
    of each other (of more than 50 failures they are right to four digits). Each end by itself holds
    with 95 %. They speak of the conditions in which it was run, and of nothing else.

    Examples
    --------
    >>> print(FailureRecord(0, hours=12.0))
    0 failures in 12 h: at most 0.25 per hour, 95 %
    >>> record = FailureRecord(3, hours=40.0, kilometres=2500.0, episodes=4000)
    >>> print(record)  # doctest: +NORMALIZE_WHITESPACE
    3 failures in 4,000 episodes, 40 h, 2,500 km: 0.075 per hour (0.020 to 0.20),
    1.2 per 1,000 km (0.32 to 3.2), 90 %
    >>> record.per_1000_km
    Rate(onsets=3, exposure=2.5, rate=1.2, low=0.327, high=3.1)
    """

    failures: int
    hours: float  #: that were run [h]
    kilometres: float | None = None  #: that were driven [km]; None where nothing drives
    episodes: int | None = None

    @property
    def per_hour(self) -> Rate:
        """Failures in an hour, with their 90 % interval."""
        return Rate.of(self.failures, self.hours)

    @property
    def per_1000_km(self) -> Rate | None:
        """Failures in 1,000 km, with their 90 % interval; None where nothing drives."""
        return None if self.kilometres is None else Rate.of(self.failures, self.kilometres / 1000.0)

    def __str__(self) -> str:
        episodes, km = self.episodes, self.kilometres
        failures = _counted(self.failures, "failure")
        ran = [] if episodes is None else [_counted(episodes, "episode")]
        ran += [f"{_exposure(self.hours)} h", *([] if km is None else [f"{_exposure(km)} km"])]
        per_km = self.per_1000_km
        rates = [(self.per_hour, "per hour")] + ([(per_km, "per 1,000 km")] if per_km else [])
        said = [_bounded(rate, unit) for rate, unit in rates if rate.exposure > 0.0]
        if not said:
            return f"{failures} in {', '.join(ran)}: nothing is known"
        if self.failures == 0:
            return f"{failures} in {', '.join(ran)}: at most {', '.join(said)}, 95 %"
        return f"{failures} in {', '.join(ran)}: {', '.join(said)}, 90 %"


def _counted(number: int, what: str) -> str:
    return f"{number:,} {what}" if number == 1 else f"{number:,} {what}s"


def _bounded(rate: Rate, unit: str) -> str:
    """A rate and its bounds, rounded outward."""
    if rate.onsets == 0:
        return f"{_two_digits(rate.high, math.ceil)} {unit}"
    low, high = _two_digits(rate.low, math.floor), _two_digits(rate.high, math.ceil)
    return f"{_two_digits(rate.rate, round)} {unit} ({low} to {high})"


def _two_digits(value: float, rounded: Callable[[float], int]) -> str:
    """Of a number above 0."""
    places = max(1 - math.floor(math.log10(value)), 0)
    return f"{two_digits(value, rounded):,.{places}f}"


def _exposure(value: float) -> str:
    """Rounded down: less would not be claimed."""
    if value < 10.0:
        return f"{outward(math.floor, value, 2):g}"
    return f"{math.floor(round(value, 6)):,}"


class OnsetRates(NamedTuple):
    """How often something unexpected began in each of n states, shrunk towards all of them."""

    rate: NDArray[np.float64]  #: (n,) [1/s], or for each observation
    low: NDArray[np.float64]  #: (n,) 90 % interval
    high: NDArray[np.float64]  #: (n,)
    pooled: Rate  #: of all states together


def shrunk_rates(counts: NDArray[np.float64], exposure: NDArray[np.float64]) -> OnsetRates:
    """Rates of n states, by counts and exposures (n,) of each.

    Examples
    --------
    >>> found = shrunk_rates(np.array([0.0, 0.0, 20.0]), np.array([100.0, 1.0, 100.0]))
    >>> found.rate.round(3), round(found.pooled.rate, 3)
    (array([0.01 , 0.092, 0.189]), 0.1)
    """
    pooled = Rate.of(float(counts.sum()), float(exposure.sum()))
    mean = pooled.rate
    seen = exposure > 0.0
    variance = 0.0
    if pooled.onsets and seen.sum() > 1:
        k, e = counts[seen], exposure[seen]
        variance = float((e * (k / e - mean) ** 2).sum() / e.sum() - mean / e.mean())
    if not variance > 0.0:
        same = np.ones(len(counts))
        return OnsetRates(mean * same, pooled.low * same, pooled.high * same, pooled)
    b = mean / variance
    shapes, times = mean * b + counts, b + exposure
    low, high = (
        np.array([gamma_quantile(share, shape) for shape in shapes]) / times for share in _TAILS
    )
    return OnsetRates(shapes / times, low, high, pooled)
