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
from math import sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

# Standard deviation of what may happen within a decision: the accelerations of the leader, of
# oneself against what is expected, and of oneself while brakes are not known [m/s²].
_LEADER, _OWN, _OWN_UNKNOWN = 4.0, 0.3, 2.0
# A gap may change by so much without any speed: intervals are not quite evenly driven [m].
_UNEVEN = 0.01
# Noise below this cannot be told from uneven driving, and counts as none [m, m/s, m/s].
_FINEST = (0.02, 0.03, 0.03)
# So many of the latest residuals tell the noise; fewer than the second say nothing.
_MEMORY, _FEWEST = 500, 20
# Slower than this one may stand still, where sensors seem better than they are [m/s].
_STANDING = 1.0
# A gap or a leader's speed that is so many standard deviations off belongs to another leader.
_ANOTHER_LEADER = 6.0
# Median of the absolute value of a standard normal variable.
_MEDIAN = 0.6745


class Estimate(NamedTuple):
    """Where one is, and how sure that is."""

    mean: tuple[float, float, float]  #: gap [m], speed of the follower and of the leader [m/s]
    covariance: tuple[tuple[float, float, float], ...]  #: (3, 3)

    def deviation(self, weights: Iterable[float]) -> float:
        """Standard deviation of a weighed sum of the three."""
        weights = tuple(weights)
        variance = sum(
            a * b * entry
            for a, row in zip(weights, self.covariance, strict=True)
            for b, entry in zip(weights, row, strict=True)
        )
        return sqrt(max(variance, 0.0))


class Spread:
    """Standard deviation of the latest residuals, from their median: few odd ones do not matter.

    Examples
    --------
    >>> spread = Spread()
    >>> for residual in 10 * [-1.0, 0.5, 0.6745, 50.0, 0.6745]:
    ...     spread.add(residual)
    >>> spread.deviation
    1.0
    """

    def __init__(self) -> None:
        self.sizes: deque[float] = deque()
        self._sorted: list[float] = []

    @property
    def deviation(self) -> float:
        """Of the residuals; 0 while there are few."""
        if len(self.sizes) < _FEWEST:
            return 0.0
        return self._sorted[len(self._sorted) // 2] / _MEDIAN

    def add(self, residual: float) -> None:
        """Take in one more."""
        size = abs(residual)
        if len(self.sizes) == _MEMORY:
            del self._sorted[bisect_left(self._sorted, self.sizes.popleft())]
        self.sizes.append(size)
        insort(self._sorted, size)


class Perception:
    """Estimates gap and speeds, and learns how noisy they are observed.

    Parameters
    ----------
    dt : float
        Time between observations [s].

    Examples
    --------
    >>> perception = Perception(dt=0.25)
    >>> for step in range(3):
    ...     estimate = perception.see([30.0 - 2.5 * step, 20.0, 10.0], 0.0)
    >>> estimate.mean, perception.noise  # nothing is left unexplained
    ((25.0, 20.0, 10.0), (0.0, 0.0, 0.0))
    """

    def __init__(self, dt: float) -> None:
        self.dt = dt
        #: What gap, own speed and leader's speed did that kinematics do not explain.
        self.spreads = (Spread(), Spread(), Spread())
        #: Standard deviations of observed gap [m], own and leader's speed [m/s].
        self.noise = (0.0, 0.0, 0.0)
        self.clear()

    def clear(self) -> None:
        """An episode begins: nothing is known of where one is; the noise is that of before."""
        self._latest: Estimate | None = None
        self._seen: tuple[float, float, float] | None = None
        self._changes: tuple[float, float] | None = None

    def see(
        self, observation: ArrayLike, realised: float, *, sure: bool = True, learn: bool = True
    ) -> Estimate:
        """Take in an observation, and learn the noise from it if told to.

        Parameters
        ----------
        observation : (3,) array_like
            Gap [m], speed of the follower and of the leader [m/s].
        realised : float
            Acceleration of the follower since the observation before, as expected [m/s²].
        sure : bool
            Whether that is known well.
        learn : bool
        """
        self._latest = self.estimate(observation, realised, sure=sure)
        gap, own, leader = np.asarray(observation, dtype=np.float64).tolist()
        if learn:
            self._learn((gap, own, leader), realised)
        self._seen = (gap, own, leader)
        return self._latest

    def estimate(self, observation: ArrayLike, realised: float, *, sure: bool = True) -> Estimate:
        """What `see` would answer; nothing changes."""
        gap, own, leader = np.asarray(observation, dtype=np.float64).tolist()
        variances = [level * level for level in self.noise]
        fresh = Estimate((gap, own, leader), _diagonal(variances))
        if self._latest is None or not any(variances):
            return fresh
        mean, covariance = self._predict(self._latest, realised, _OWN if sure else _OWN_UNKNOWN)
        for i, value in ((0, gap), (2, leader)):
            if (value - mean[i]) ** 2 > _ANOTHER_LEADER**2 * (covariance[i][i] + variances[i]):
                return fresh
        for i, value in enumerate((gap, own, leader)):
            _correct(mean, covariance, i, value, variances[i])
        a, b, c = covariance
        return Estimate(
            (mean[0], max(mean[1], 0.0), max(mean[2], 0.0)),
            ((a[0], a[1], a[2]), (b[0], b[1], b[2]), (c[0], c[1], c[2])),
        )

    def _predict(
        self, before: Estimate, realised: float, doubt: float
    ) -> tuple[list[float], list[list[float]]]:
        """Where one should be now, and how sure that is."""
        dt, (gap, own, leader) = self.dt, before.mean
        reached = max(own + realised * dt, 0.0)
        mean = [gap + (leader - 0.5 * (own + reached)) * dt, reached, leader]
        (gg, gv, gu), (_, vv, vu), (_, _, uu) = before.covariance
        # F P Fᵀ, where only the gap changes with the others.
        to_v, to_u = gv + (vu - vv) * dt, gu + (uu - vu) * dt
        gg += 2.0 * (gu - gv) * dt + (uu - 2.0 * vu + vv) * dt * dt
        # An acceleration changes a speed, and the gap by half an interval of it.
        v, u, half = (doubt * dt) ** 2, (_LEADER * dt) ** 2, 0.5 * dt
        gg += half * half * (v + u) + _UNEVEN**2
        to_v, to_u = to_v - half * v, to_u + half * u
        return mean, [[gg, to_v, to_u], [to_v, vv + v, vu], [to_u, vu, uu + u]]

    def _learn(self, now: tuple[float, float, float], realised: float) -> None:
        if self._seen is None:
            return
        (gap, own, leader), (gap_before, own_before, leader_before) = now, self._seen
        closing = own + own_before - leader - leader_before
        self.spreads[0].add(gap - gap_before + 0.5 * self.dt * closing)
        moving = min(own, own_before) > _STANDING, min(leader, leader_before) > _STANDING
        changes = own - own_before - realised * self.dt, leader - leader_before
        if self._changes is not None:
            for k in (0, 1):
                if moving[k]:
                    self.spreads[k + 1].add(changes[k] - self._changes[k])
        self._changes = changes
        self._measure_noise()

    def _measure_noise(self) -> None:
        gap, *speeds = (spread.deviation for spread in self.spreads)
        # The second difference of a noisy speed has 6 times its variance; that of a gap against
        # the trapezoid of four noisy speeds twice its own, and some of theirs.
        own, leader = (speed / sqrt(6.0) for speed in speeds)
        of_speeds = 0.5 * self.dt**2 * (own**2 + leader**2)
        gap = sqrt(max(gap**2 - of_speeds, 0.0) / 2.0)
        levels = zip((gap, own, leader), _FINEST, strict=True)
        gap, own, leader = (level if level >= finest else 0.0 for level, finest in levels)
        self.noise = (gap, own, leader)

    # -- Keeping it -----------------------------------------------------------------------------

    def learnt(self) -> dict[str, NDArray[np.float64]]:
        """The residuals by name, for a file."""
        names = ("noise_gap", "noise_speed", "noise_leader")
        return {
            name: np.array(spread.sizes) for name, spread in zip(names, self.spreads, strict=True)
        }

    def restore(self, arrays: dict[str, NDArray[np.float64]]) -> None:
        """Take over what `learnt` answered."""
        for spread, name in zip(self.spreads, self.learnt(), strict=True):
            for size in arrays[name].tolist():
                spread.add(size)
        self._measure_noise()


def _diagonal(variances: list[float]) -> tuple[tuple[float, float, float], ...]:
    gap, own, leader = variances
    return (gap, 0.0, 0.0), (0.0, own, 0.0), (0.0, 0.0, leader)


def _correct(
    mean: list[float], covariance: list[list[float]], i: int, value: float, variance: float
) -> None:
    """Take in one observed component: a scalar Kalman update, in place."""
    row = list(covariance[i])
    total = row[i] + variance
    off = (value - mean[i]) / total
    for j in range(3):
        mean[j] += row[j] * off
        gain = row[j] / total
        for k in range(3):
            covariance[j][k] -= gain * row[k]
