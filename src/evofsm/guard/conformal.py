"""Alarms whose rate of errors is held, whatever the score and whatever comes.

Adaptive conformal inference (Gibbs & Candes, "Adaptive conformal inference under distribution
shift", NeurIPS 2021) on the score of an alarm. An update t brings a score and what came of it; it
is an error, err_t = 1, if the score lies above the threshold, which is the (1 - alpha_t) quantile
of the latest scores. Then ::

    alpha_{t+1} = alpha_t + step (rate - err_t),      alpha_1 = rate

so that errors raise the threshold, and each of the others lowers it a little.

**What is guaranteed.** Where alpha_t <= 0 the threshold is infinite and nothing is an error; where
alpha_t >= 1 it is minus infinite and everything is. So alpha_t never leaves
[-step (1 - rate), 1 + step rate]. The sum of both sides over T updates is
alpha_{T+1} - rate = step (T rate - sum err), hence ::

    -((1 - rate) / step + rate)  <=  sum err - T rate  <=  rate / step + 1 - rate

for *any* sequence of scores and outcomes: no distribution is assumed, none has to stay the same,
and nothing has to be independent. The right side is what a user has to fear: with ``rate=0.01``
and ``step=0.005`` never more than 2.99 errors above 1 % of the updates, after a shift as before it.
What it does not say stands in `ConformalAlarm`.
"""

from __future__ import annotations

import math
from bisect import bisect_left, insort
from collections import deque
from collections.abc import Mapping
from typing import Any, Literal, NamedTuple, Self, get_args

import numpy as np

from evofsm.fsm import positive, whole
from evofsm.store import Place, ranges, storage

#: Errors whose rate is held.
Errors = Literal["false alarms", "misses"]

# A rank that is off a whole number by rounding alone is that number.
_ROUNDING = 1e-9
_KIND = ranges.register(
    ranges.Kind(
        "conformalalarm",
        {"scores": ranges.Member(("n",), ranges.Range(-math.inf, math.inf))},
        {
            "rate": ranges.Range(ranges.SMALLEST, 1.0),
            "step": ranges.SIZE,
            "memory": ranges.FROM_1,
            "counted": ranges.COUNT,
            "errors": ranges.COUNT,
        },
    )
).name


class Held(NamedTuple):
    """Between which shares the rate of errors is guaranteed to lie, of the updates so far."""

    low: float
    high: float


class ConformalAlarm:
    """An alarm above a threshold that adapts, so that the rate of its errors is as stated.

    Parameters
    ----------
    rate : float
        That is held, above 0 and below 1: of ``"false alarms"``, the share of updates in which
        nothing happened that were in alarm; of ``"misses"``, the share of those in which something
        happened that were not.
    of : {"false alarms", "misses"}
    step : float
        How fast the threshold adapts. Larger ones hold the rate more tightly, smaller ones let the
        threshold waver less.
    memory : int
        Latest scores among which the threshold is, at least ``1 / rate``.

    Raises
    ------
    ValueError
        If one of them is out of range.

    Notes
    -----
    Scores are plain floats, the higher the more dangerous: a risk, minus a time to collision, a
    state's share of failures. Only their order matters, so they may be infinite, and in any unit.
    NaN counts as the most dangerous one.

    The guarantee (`held`) is on the rate of errors over all updates that count, and on nothing
    else. It says nothing of a single alarm, nor of the errors of the other kind: a score that tells
    nothing keeps its false alarms as rare, and sees no danger. A rate of false alarms is held by
    silence if need be (`threshold` is infinite then), a rate of misses by an alarm that is always
    on. Until about ``1 / rate`` updates were counted the alarm is silent, or always on.

    Updates are whatever the rate is to be of. Decisions a quarter of a second apart are much alike:
    the bound holds for them too, but a false alarm that lasts is many errors.

    Where the outcome is known only later, update then, and say with ``alarmed`` what the alarm said
    at the time. With a delay of d updates there may be d errors more on either side.

    Examples
    --------
    A score whose scale doubles half way; 5 % of what was safe may be in alarm:

    >>> alarm = ConformalAlarm(rate=0.05, step=0.02)
    >>> rng = np.random.default_rng(0)
    >>> for t in range(4000):
    ...     alarm.update((1.0 if t < 2000 else 2.0) * rng.exponential(), happened=False)
    >>> round(alarm.realised, 3), [round(share, 3) for share in alarm.held]
    (0.05, [0.038, 0.051])
    >>> alarm.alarms(1.0), alarm.alarms(9.0), alarm.alarms(float("nan"))
    (False, True, True)
    """

    def __init__(
        self,
        rate: float = 0.01,
        *,
        of: Errors = "false alarms",
        step: float = 0.005,
        memory: int = 1000,
    ) -> None:
        self.rate = positive("rate", rate)
        if self.rate >= 1.0:
            raise ValueError(f"rate is {rate:g}; it is a share of the updates, below 1")
        if of not in get_args(Errors):
            raise ValueError(f"of is {of!r}; it must be one of {', '.join(get_args(Errors))}")
        self.of: Errors = of
        self.step = positive("step", step)
        self.memory = whole("memory", memory)
        if self.memory * self.rate < 1.0 - _ROUNDING:
            raise ValueError(
                f"memory is {memory}; a rate of {rate:g} needs {math.ceil(1.0 / self.rate):,} "
                "scores at least"
            )
        #: Updates that counted: nothing happened in them, or, of misses, something.
        self.counted = 0
        #: Errors among them.
        self.errors = 0
        self._latest: deque[float] = deque()
        self._ordered: list[float] = []

    @property
    def level(self) -> float:
        """alpha_t: the share of the latest scores that is above the threshold."""
        return self.rate + self.step * (self.rate * self.counted - self.errors)

    @property
    def threshold(self) -> float:
        """Where the alarm is raised now.

        Scores above it are in alarm; of ``"misses"``, those at it are, too. Infinite while the
        alarm is silent, minus infinite while it is always on.
        """
        quantile = self._quantile
        return quantile if self.of == "false alarms" else -quantile

    @property
    def realised(self) -> float:
        """Share of errors so far; NaN before the first update that counts."""
        return self.errors / self.counted if self.counted else math.nan

    @property
    def held(self) -> Held:
        """Between which shares `realised` must lie now, whatever came (without delay)."""
        if not self.counted:
            return Held(0.0, 1.0)
        fewer = (1.0 - self.rate) / self.step + self.rate
        more = self.rate / self.step + 1.0 - self.rate
        low, high = self.rate - fewer / self.counted, self.rate + more / self.counted
        return Held(max(0.0, low), min(1.0, high))

    def alarms(self, score: float) -> bool:
        """Whether a score is in alarm now. Changes nothing.

        Raises
        ------
        TypeError
            If it is no number.
        """
        return self._errs(self._value(score)) == (self.of == "false alarms")

    def update(self, score: float, happened: bool, *, alarmed: bool | None = None) -> None:
        """Learn what came of a score.

        Parameters
        ----------
        score : float
            NaN counts as the most dangerous one.
        happened : bool
            Whether what the alarm is to warn of came. Of false alarms only updates in which nothing
            happened count, of misses only those in which something did.
        alarmed : bool, optional
            What the alarm said of it at the time; what it says now if not given.

        Raises
        ------
        TypeError
            If the score is no number.
        """
        value = self._value(score)
        if bool(happened) != (self.of == "misses"):
            return
        if alarmed is None:
            error = self._errs(value)
        else:
            error = bool(alarmed) == (self.of == "false alarms")
        self.counted += 1
        self.errors += error
        self._latest.append(value)
        insort(self._ordered, value)
        if len(self._latest) > self.memory:
            del self._ordered[bisect_left(self._ordered, self._latest.popleft())]

    def _value(self, score: float) -> float:
        """Of false alarms the score, of misses minus it: an error lies above the quantile."""
        value = float(score)
        value = math.inf if math.isnan(value) else value
        return value if self.of == "false alarms" else -value

    @property
    def _quantile(self) -> float:
        """Of the latest values, with the correction for few of them; infinite past either end."""
        n = len(self._ordered)
        above = math.floor(self.level * (n + 1) + _ROUNDING)
        if above < 1:
            return math.inf
        return -math.inf if above > n else self._ordered[n - above]

    def _errs(self, value: float) -> bool:
        quantile = self._quantile
        return value > quantile or quantile == -math.inf

    # -- Keeping it -----------------------------------------------------------------------------

    def save(self, path: Place, provenance: Mapping[str, Any] | None = None) -> None:
        """Write all of it to a file (arrays and a JSON header, nothing that can run).

        Parameters
        ----------
        path : path-like, or file open for writing bytes
        provenance : mapping, optional
            What it was updated with, for people; kept in the file.

        Raises
        ------
        OSError
            If it cannot be written.
        """
        names = ("rate", "of", "step", "memory", "counted", "errors")
        content = {name: getattr(self, name) for name in names}
        storage.write(path, _KIND, content, {"scores": np.array(self._latest)}, provenance)

    @classmethod
    def load(cls, path: Place) -> Self:
        """Read an alarm, which goes on as if it had never been kept.

        Raises
        ------
        OSError
            If there is no such file, or it may not be read.
        ValueError
            If the file holds something else or is damaged.
        """
        content, arrays = storage.read(path, _KIND)
        with storage.explained(path):
            counts = {name: int(content.pop(name)) for name in ("counted", "errors")}
            alarm = cls(**content)
            scores = arrays["scores"].tolist()
            if len(scores) != min(counts["counted"], alarm.memory):
                raise ValueError(f"{len(scores)} scores of {counts['counted']} updates are kept")
            if counts["errors"] > counts["counted"]:
                raise ValueError(f"{counts['errors']} errors of {counts['counted']} updates")
        alarm.counted, alarm.errors = counts["counted"], counts["errors"]
        alarm._latest, alarm._ordered = deque(scores), sorted(scores)
        return alarm

    def __repr__(self) -> str:
        return (
            f"{type(self).__name__}(rate={self.rate:g}, of={self.of!r}, {self.errors} errors of "
            f"{self.counted:,})"
        )
