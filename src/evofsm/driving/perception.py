"""What is really there: noisy observations are filtered by what cars can do in one decision.

Judged as it is, every observation that is lucky by chance lets the follower move, and no unlucky
one moves it back. So the situation is *estimated*, with its uncertainty, by a Kalman filter
(Kalman 1960): a gap integrates the difference of the speeds, one's own speed follows what was
commanded, and a leader changes its speed within limits. How noisy the sensors are is learnt from
what kinematics leave unexplained; as long as that is nothing, the estimate is the observation.
"""

from __future__ import annotations

from bisect import bisect_left, insort
from collections import deque
from collections.abc import Iterable
from math import isnan, nan, sqrt
from typing import NamedTuple, TypeAlias

import numpy as np

from evofsm.driving.rehearsal import ONCOMING, Three
from evofsm.fsm.kernels import compiled

# Gap [m], speed of the follower and of the leader [m/s], or what is said of each of them.
Matrix: TypeAlias = tuple[Three, Three, Three]

# Standard deviation of what may happen within a decision: the accelerations of the leader, of
# oneself against what is expected, and of oneself while brakes are not known [m/s²].
_LEADER, _OWN, _OWN_UNKNOWN = 4.0, 0.3, 2.0
# A gap may change by so much without any speed: intervals are not quite evenly driven [m].
_UNEVEN = 0.01
# Noise below this cannot be told from uneven driving, and counts as none [m, m/s, m/s].
_FINEST = (0.02, 0.03, 0.03)
# So many of the latest residuals tell the noise; fewer than the second say nothing.
_MOST_RESIDUALS, _FEWEST_RESIDUALS = 500, 20
# Slower than this one may stand still, where sensors seem better than they are [m/s].
_STANDING = 1.0
# A gap or a leader's speed that is so many standard deviations off belongs to another leader.
_ANOTHER_LEADER = 6.0
# Median of the absolute value of a standard normal variable.
_MEDIAN = 0.6745
_SIX = sqrt(6.0)
_NO_NOISE = (0.0, 0.0, 0.0)
_NO_COVARIANCE = (_NO_NOISE, _NO_NOISE, _NO_NOISE)


class Estimate(NamedTuple):
    """Where one is, and how sure that is."""

    mean: Three  #: gap [m], speed of the follower and of the leader [m/s]
    covariance: Matrix

    def deviation(self, weights: Three) -> float:
        """Standard deviation of a weighed sum of the three."""
        if self.covariance is _NO_COVARIANCE:
            return 0.0
        variance = 0.0
        for u, row in zip(weights, self.covariance, strict=True):
            for v, covariance in zip(weights, row, strict=True):
                variance += u * v * covariance
        return sqrt(max(variance, 0.0))


class Perception:
    """Estimates gap and speeds every ``dt`` [s], and learns how noisy they are observed.

    What of ``residuals``, of gap, own and leader's speed, was learnt before it goes on with.
    """

    def __init__(self, dt: float, residuals: Iterable[Iterable[float]] = ((), (), ())) -> None:
        self.dt = dt
        #: Of what gap and both speeds did that kinematics do not explain.
        self.sizes = tuple(map(Sizes, residuals))
        #: Standard deviations of observed gap [m], own and leader's speed [m/s].
        self.noise = _noise(self.sizes, dt)
        self.clear()

    def clear(self) -> None:
        """An episode begins: nothing is known of where one is; the noise is that of before."""
        #: At the observation before.
        self.latest: Estimate | None = None
        #: Observations on end, up to that one, that lack something.
        self.unseen = 0
        self._seen: Three | None = None
        self._changes = nan, nan  # of both speeds, beyond what was expected

    def see(
        self, now: Three, realised: float, *, sure: bool = True, learn: bool = True
    ) -> Estimate:
        """Take in gap and speeds, and learn their noise; NaN, where not seen, is estimated.

        ``realised`` is the follower's acceleration since the observation before, as expected
        [m/s²], and ``sure`` whether that is known well.
        """
        estimate = self.estimate(now, realised, sure=sure)
        if not is_whole(now):
            self._seen, self._changes = None, (nan, nan)
            self.unseen += 1
        else:
            self.unseen = 0
            if learn and self._seen is not None:
                self._learn(self._seen, now, realised)
            self._seen = now
        if is_whole(estimate.mean):
            self.latest = estimate
        return estimate

    def estimate(self, now: Three, realised: float, *, sure: bool = True) -> Estimate:
        """What `see` would answer; nothing changes. NaN stays where nothing was seen before."""
        if self.noise == _NO_NOISE and is_whole(now):
            return Estimate(now, _NO_COVARIANCE)
        if self.latest is None:
            return Estimate(now, _diagonal(self.noise))
        doubt = _OWN if sure else _OWN_UNKNOWN
        return Estimate(*_filtered(*self.latest, now, self.noise, realised, doubt, self.dt))

    def _learn(self, before: Three, now: Three, realised: float) -> None:
        """Take in what kinematics do not explain; of who may stand nothing."""
        dt, (was, last) = self.dt, self._changes
        closing_sum = now[1] + before[1] - now[2] - before[2]
        self._changes = speed, leader = now[1] - before[1] - realised * dt, now[2] - before[2]
        self.sizes[0].add(now[0] - before[0] + 0.5 * dt * closing_sum)
        if min(now[1], before[1]) > _STANDING:
            self.sizes[1].add(speed - was)
        if min(now[2], before[2]) > _STANDING:
            self.sizes[2].add(leader - last)
        self.noise = _noise(self.sizes, dt)


def is_whole(observation: Three) -> bool:
    """Whether all three are there."""
    gap, speed, leader = observation
    return not isnan(gap + speed + leader)


@compiled
def _diagonal(deviations: Three) -> Matrix:
    gap, speed, leader = deviations
    return (gap * gap, 0.0, 0.0), (0.0, speed * speed, 0.0), (0.0, 0.0, leader * leader)


@compiled
def _filtered(
    before: Three,
    covariance: Matrix,
    now: Three,
    noise: Three,
    realised: float,
    doubt: float,
    dt: float,
) -> tuple[Three, Matrix]:
    """One step of the filter, to the next mean and covariance, by what was seen (not NaN).

    ``doubt`` is the standard deviation of the acceleration that was ``realised`` [m/s²].
    """
    gap, speed, leader = before
    next_speed = max(speed + realised * dt, 0.0)
    mean = np.array([gap + (leader - 0.5 * (speed + next_speed)) * dt, next_speed, leader])
    (gg, gv, gu), (_, vv, vu), (_, _, uu) = covariance
    # F P Fᵀ, where only the gap changes with the others.
    to_v, to_u = gv + (vu - vv) * dt, gu + (uu - vu) * dt
    gg += 2.0 * (gu - gv) * dt + (uu - 2.0 * vu + vv) * dt * dt
    # An acceleration changes a speed, and the gap by half an interval of it.
    v, u, half = (doubt * dt) ** 2, (_LEADER * dt) ** 2, 0.5 * dt
    gg += half * half * (v + u) + _UNEVEN**2
    to_v, to_u = to_v - half * v, to_u + half * u
    spread = np.array([[gg, to_v, to_u], [to_v, vv + v, vu], [to_u, vu, uu + u]])

    variances = _diagonal(noise)
    whole = not np.isnan(now[0] + now[1] + now[2])
    for i in (0, 2):
        off, variance = now[i] - mean[i], spread[i, i] + variances[i][i]
        if whole and off * off > _ANOTHER_LEADER * _ANOTHER_LEADER * variance:
            return now, variances
    for i in range(3):
        if np.isnan(now[i]):
            continue
        row = spread[i].copy()
        total = row[i] + variances[i][i]
        off = (now[i] - mean[i]) / total
        for j in range(3):
            mean[j] += row[j] * off
            gain = row[j] / total
            for k in range(3):
                spread[j, k] -= gain * row[k]
    mean[2] = mean[2] if mean[2] < ONCOMING else max(mean[2], 0.0)
    return (mean[0], max(mean[1], 0.0), mean[2]), (
        (spread[0, 0], spread[0, 1], spread[0, 2]),
        (spread[1, 0], spread[1, 1], spread[1, 2]),
        (spread[2, 0], spread[2, 1], spread[2, 2]),
    )


class Sizes:
    """Absolute values of the latest residuals, and their deviation: robust, from the median."""

    def __init__(self, sizes: Iterable[float] = ()) -> None:
        self.latest = deque(map(abs, sizes), maxlen=_MOST_RESIDUALS)
        self._sorted = sorted(self.latest)

    def add(self, residual: float) -> None:
        """Take in one more, if it is a number; the oldest goes where there is no room."""
        if isnan(residual):
            return
        if len(self.latest) == _MOST_RESIDUALS:
            del self._sorted[bisect_left(self._sorted, self.latest[0])]
        self.latest.append(abs(residual))
        insort(self._sorted, abs(residual))

    def deviation(self) -> float:
        """0 while there are few."""
        n = len(self._sorted)
        return self._sorted[n // 2] / _MEDIAN if n >= _FEWEST_RESIDUALS else 0.0


def _noise(sizes: Iterable[Sizes], dt: float) -> Three:
    """Standard deviation of the noise on gap and both speeds, from that of their residuals."""
    # The second difference of a noisy speed has 6 times its variance; that of a gap against
    # the trapezoid of four noisy speeds twice its own, and some of theirs.
    gap, speed, leader = [s.deviation() for s in sizes]
    speed, leader = speed / _SIX, leader / _SIX
    gap = sqrt(max(gap**2 - 0.5 * dt**2 * (speed**2 + leader**2), 0.0) / 2.0)
    pairs = zip((gap, speed, leader), _FINEST, strict=True)
    gap, speed, leader = (size if size >= finest else 0.0 for size, finest in pairs)
    return gap, speed, leader
