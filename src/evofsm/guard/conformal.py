"""Alarms whose error rate is held, whatever the score and whatever comes.

Adaptive conformal inference (Gibbs & Candes, "Adaptive conformal inference under distribution
shift", NeurIPS 2021) on the score of an alarm. Update t brings a score and its outcome. It is an
error, err_t = 1, if the score lies above the threshold, the (1 - alpha_t) quantile of the latest
scores. Then ::

    alpha_{t+1} = alpha_t + step (rate - err_t),      alpha_1 = rate

so that an error raises the threshold, and every other update lowers it a little. Where alpha_t <= 0
the threshold is infinite and nothing is an error; where alpha_t >= 1 everything is. So alpha_t
never leaves [-step (1 - rate), 1 + step rate], and the sum over T updates is bounded::

    -((1 - rate) / step + rate)  <=  sum err - T rate  <=  rate / step + 1 - rate

for *any* sequence of scores and outcomes: no distribution is assumed, nothing has to stay the same
or be independent. With ``rate=0.01`` and ``step=0.005`` there are never more than 2.99 errors above
1 % of the updates.
"""

from __future__ import annotations

import math
from bisect import bisect_left, insort
from collections import deque
from typing import Literal, get_args

from evofsm.fsm.validation import positive, whole

#: Kinds of errors, of which one has its rate held.
Errors = Literal["false alarms", "misses"]

# A rank this close to an integer differs from it by rounding alone.
_ROUNDING = 1e-9


class ConformalAlarm:
    """An alarm above a threshold that adapts, so that its error rate is as stated; pickle keeps it.

    Parameters
    ----------
    rate : float
        To be held, in (0, 1). Of ``"false alarms"``: the share of updates without an event that
        were in alarm. Of ``"misses"``: the share of updates with an event that were not.
    of : {"false alarms", "misses"}
    step : float
        How fast the threshold adapts. A larger step holds the rate more tightly; under a smaller
        one the threshold wavers less.
    memory : int
        Number of latest scores that the threshold is a quantile of, at least ``1 / rate``.

    Raises
    ------
    ValueError
        If one of them is out of range.

    Notes
    -----
    Scores are floats, the higher the more dangerous: a risk, minus a time to collision, a state's
    share of failures. Only their order matters, so any unit and infinities will do. NaN counts as
    the most dangerous score.

    The guarantee (`held`) is about the error rate over all updates that count, not about the other
    kind of errors: a rate of false alarms is held by silence if need be, a rate of misses by an
    alarm that is always on. A delay of the outcome by d updates allows for d more errors.

    Examples
    --------
    A score whose scale doubles half way; 5 % of the safe updates may be in alarm:

    >>> import numpy as np
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
        #: Updates that counted: those without an event; of misses, those with one.
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
        """Scores above it are in alarm; of ``"misses"``, those at it as well.

        Infinite while the alarm is silent, minus infinity while it is always on.
        """
        return self._quantile if self.of == "false alarms" else -self._quantile

    @property
    def realised(self) -> float:
        """Share of errors so far; NaN before the first update that counts."""
        return self.errors / self.counted if self.counted else math.nan

    @property
    def held(self) -> tuple[float, float]:
        """(low, high): where `realised` must lie now, whatever came (without delay)."""
        if not self.counted:
            return 0.0, 1.0
        fewer = (1.0 - self.rate) / self.step + self.rate
        more = self.rate / self.step + 1.0 - self.rate
        low, high = self.rate - fewer / self.counted, self.rate + more / self.counted
        return max(0.0, low), min(1.0, high)

    def alarms(self, score: float) -> bool:
        """Whether a score is in alarm now. Changes nothing."""
        value, quantile = self._value(score), self._quantile
        errs = value > quantile or quantile == -math.inf
        return errs == (self.of == "false alarms")

    def update(self, score: float, happened: bool, *, alarmed: bool | None = None) -> None:
        """Learn whether the event came that a score is to warn of.

        Of false alarms only updates without it count, of misses only those with it. ``alarmed``
        says whether it was in alarm at the time; without it, whether it is now counts.
        """
        value = self._value(score)
        if bool(happened) != (self.of == "misses"):
            return
        in_alarm = self.alarms(score) if alarmed is None else bool(alarmed)
        error = in_alarm == (self.of == "false alarms")
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
        """Of the latest values, corrected for few of them; infinite past either end."""
        n = len(self._ordered)
        above = math.floor(self.level * (n + 1) + _ROUNDING)
        if above < 1:
            return math.inf
        return -math.inf if above > n else self._ordered[n - above]
