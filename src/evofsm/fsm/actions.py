"""Turn a continuous action into one of a fixed set of intervals: the paper's Section 2.1.2."""

from __future__ import annotations

import math
from bisect import bisect_right
from dataclasses import dataclass
from functools import cached_property
from typing import Literal, SupportsIndex, overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

from evofsm.fsm.validation import Floats, check_index

# Digits to which an edge is rounded, so that -2.5 + 3 * 0.3 is the edge -1.6.
_DIGITS = 9
# More would be a mistake, and take all the memory there is.
_MOST = 100_000


@dataclass(frozen=True)
class IntervalActions:
    """Intervals ``[a, b)`` of equal width over ``[low, high]``; the last one ends at ``high``.

    Parameters
    ----------
    low, high : float
        Range of the action, for an acceleration in [m/s²].
    width : float
        Width of an interval, in the same unit; the last one may be narrower.
    outside : {"error", "clip"}
        Whether a value beyond the range is refused or put into the end interval.

    Examples
    --------
    >>> actions = IntervalActions(low=-2.5, high=2.5, width=0.3)
    >>> actions.n_actions
    17
    >>> actions.encode(-2.2), actions.interval(1), actions.center(0), actions.label(16)
    (1, (-2.2, -1.9), -2.35, '[2.3, 2.5]')
    >>> actions.encode([-2.5, 0.0, 2.5])
    array([ 0,  8, 16])
    """

    low: float
    high: float
    width: float
    outside: Literal["error", "clip"] = "error"

    def __post_init__(self) -> None:
        for name in ("low", "high", "width"):
            if not math.isfinite(getattr(self, name)):
                raise ValueError(f"{name} is {getattr(self, name)}; it must be finite")
            object.__setattr__(self, name, float(getattr(self, name)))
        if not self.low < self.high:
            raise ValueError(f"low is {self.low} and high is {self.high}; low must be below high")
        if not self.width * _MOST >= self.high - self.low:
            raise ValueError(f"width is {self.width}; it must make 1 to {_MOST:,} intervals")
        if self.outside not in ("error", "clip"):
            raise ValueError(f"outside is {self.outside!r}; it must be 'error' or 'clip'")
        if not (np.diff(self.edges) > 0.0).all():
            raise ValueError(f"width is {self.width}: rounded edges coincide; use a larger unit")

    @property
    def n_actions(self) -> int:
        """Number of intervals."""
        return len(self.edges) - 1

    @cached_property
    def edges(self) -> Floats:
        """(n_actions + 1,) ndarray: where intervals meet, ``low`` and ``high`` included."""
        count = math.ceil(round((self.high - self.low) / self.width, _DIGITS))
        inner = np.round(self.low + np.arange(1, count) * self.width, _DIGITS)
        edges = np.concatenate([[self.low], inner, [self.high]])
        edges.setflags(write=False)
        return edges

    @overload
    def encode(self, a: float) -> int: ...
    @overload
    def encode(self, a: ArrayLike) -> NDArray[np.int64]: ...
    def encode(self, a: ArrayLike) -> int | NDArray[np.int64]:
        """Index, from 0, of the interval in which each value lies: the paper's Section 2.1.2."""
        if type(a) is float and self.low <= a <= self.high:  # one number, as every decision asks
            return bisect_right(self.edges, a, 1, self.n_actions) - 1
        values = np.asarray(a)
        if values.dtype.kind not in "fiub":
            fault = f"is {a!r}" if values.ndim == 0 else f"has dtype {values.dtype}"
            raise TypeError(f"action {fault}; it must be a real number, or an array of them")
        values = values.astype(np.float64, copy=False)
        if np.isnan(values).any():
            raise ValueError("action is NaN; it has no interval")
        beyond = (values < self.low) | (values > self.high)
        if self.outside == "error" and beyond.any():
            limits = f"outside [{self.low}, {self.high}]"
            fix = 'widen the range, or use outside="clip" to put it into the end interval'
            raise ValueError(f"action {values[beyond].flat[0]} is {limits}; {fix}")
        index = np.searchsorted(self.edges[1:-1], values, side="right")
        return int(index) if values.ndim == 0 else index.astype(np.int64)

    def interval(self, i: SupportsIndex) -> tuple[float, float]:
        """Lower and upper edge of interval ``i`` (from 0)."""
        i = check_index("interval", i, self.n_actions)
        return float(self.edges[i]), float(self.edges[i + 1])

    def center(self, i: SupportsIndex) -> float:
        """Middle of interval ``i`` (from 0), the action that stands for all in it."""
        lower, upper = self.interval(i)
        return round((lower + upper) / 2.0, _DIGITS)

    def label(self, i: SupportsIndex) -> str:
        """Interval ``i`` (from 0) as people write it; of clipped ends the inner edge alone."""
        lower, upper = self.interval(i)
        if self.outside == "clip" and self.n_actions > 1:  # end intervals hold what is beyond
            if lower == self.low:
                return f"< {upper:g}"
            if upper == self.high:
                return f"≥ {lower:g}"
        return f"[{lower:g}, {upper:g}{']' if upper == self.high else ')'}"
