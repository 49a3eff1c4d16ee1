"""What is really there: noisy observations are filtered by what cars can do in one decision.

Judged as it is, every observation that is lucky by chance lets the follower move, and no unlucky
one moves it back. So the situation is *estimated*, with its uncertainty, by a Kalman filter
(Kalman 1960): a gap integrates the difference of the speeds, one's own speed follows what was
commanded, and a leader changes its speed within limits. How noisy the sensors are is learnt from
what kinematics leave unexplained; as long as that is nothing, the estimate is the observation.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import isnan, nan, sqrt
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from evofsm.driving.leaders import latest_of_each
from evofsm.driving.rehearsal import Three
from evofsm.fsm.kernels import compiled, kernel

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
_MEMORY, _FEWEST = 500, 20
# Slower than this one may stand still, where sensors seem better than they are [m/s].
_STANDING = 1.0
# A gap or a leader's speed that is so many standard deviations off belongs to another leader.
_ANOTHER_LEADER = 6.0
# Median of the absolute value of a standard normal variable.
_MEDIAN = 0.6745
_NOTHING = (0.0, 0.0, 0.0)
_EXACT = (_NOTHING, _NOTHING, _NOTHING)
_NAMES = ("noise_gap", "noise_speed", "noise_leader")


class Estimate(NamedTuple):
    """Where one is, and how sure that is."""

    mean: Three  #: gap [m], speed of the follower and of the leader [m/s]
    covariance: Matrix

    def deviation(self, weights: Three) -> float:
        """Standard deviation of a weighed sum of the three."""
        return 0.0 if self.covariance == _EXACT else _deviation(self.covariance, weights)


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
    ...     estimate = perception.see((30.0 - 2.5 * step, 20.0, 10.0), 0.0)
    >>> estimate.mean, perception.noise  # nothing is left unexplained
    ((25.0, 20.0, 10.0), (0.0, 0.0, 0.0))
    """

    def __init__(self, dt: float) -> None:
        self.dt = dt
        #: Standard deviations of observed gap [m], own and leader's speed [m/s].
        self.noise = _NOTHING
        # Of the latest residuals that kinematics do not explain, of gap and both speeds: their
        # absolute values in rings, and sorted; from the medians, so that a few odd ones do
        # not matter.
        self._sizes, self._sorted = np.empty((3, _MEMORY)), np.empty((3, _MEMORY))
        self._added = np.zeros(3, np.int64)
        self.clear()

    def clear(self) -> None:
        """An episode begins: nothing is known of where one is; the noise is that of before."""
        self._latest: Estimate | None = None
        self._asked: tuple[Three, float, bool] | None = None
        self._seen: Three | None = None
        self._changes = nan, nan  # of both speeds, beyond what was expected

    def see(
        self, now: Three, realised: float, *, sure: bool = True, learn: bool = True
    ) -> Estimate:
        """Take in an observation, and learn the noise from it if told to.

        Parameters
        ----------
        now : tuple of three floats
            Gap [m], speed of the follower and of the leader [m/s]; NaN where it was not seen,
            which is then estimated from what was seen before, and teaches nothing of the noise.
        realised : float
            Acceleration of the follower since the observation before, as expected [m/s²].
        sure : bool
            Whether that is known well.
        learn : bool
        """
        estimate = self.estimate(now, realised, sure=sure)
        if not is_whole(now):
            self._seen, self._changes = None, (nan, nan)
        else:
            if learn and self._seen is not None:
                rings, before = (self._sizes, self._sorted, self._added), self._seen
                self.noise, self._changes = _take_in(
                    *rings, before, now, realised, self._changes, self.dt
                )
            self._seen = now
        self._asked = None
        if is_whole(estimate.mean):
            self._latest = estimate
        return estimate

    def estimate(self, now: Three, realised: float, *, sure: bool = True) -> Estimate:
        """What `see` would answer; nothing changes. NaN stays where nothing was seen before."""
        if self.noise == _NOTHING and is_whole(now):
            return Estimate(now, _EXACT)
        if self._latest is None:
            return Estimate(now, _diagonal(self.noise))
        if self._asked != (now, realised, sure):  # whoever judges and then learns asks twice
            doubt = _OWN if sure else _OWN_UNKNOWN
            filtered = _filtered(*self._latest, now, self.noise, realised, doubt, self.dt)
            self._asked, self._answer = (now, realised, sure), Estimate(*filtered)
        return self._answer

    def learnt(self) -> dict[str, NDArray[np.float64]]:
        """The residuals by name, the oldest first, for a file."""
        return {
            name: np.roll(ring, -added)[-added:] if added > _MEMORY else ring[:added].copy()
            for name, ring, added in zip(_NAMES, self._sizes, self._added.tolist(), strict=True)
        }

    def merge(self, others: Sequence[Perception]) -> None:
        """Take in what others' sensors left unexplained; of too many the latest of each."""
        every = [one.learnt() for one in (*others, self)]
        self.restore({name: np.array(latest_of_each([e[name] for e in every])) for name in _NAMES})

    def restore(self, arrays: Mapping[str, NDArray[np.float64]]) -> None:
        """Take over what `learnt` returned."""
        for k, name in enumerate(_NAMES):
            latest = np.abs(arrays[name][-_MEMORY:])
            count = self._added[k] = len(latest)
            self._sizes[k, :count], self._sorted[k, :count] = latest, np.sort(latest)
        self.noise = _noise(_deviations(self._sorted, self._added), self.dt)
        self._asked = None


def is_whole(observation: Three) -> bool:
    """Whether all three are there."""
    gap, own, leader = observation
    return not isnan(gap + own + leader)


# -- The filter ---------------------------------------------------------------------------------


@compiled
def _diagonal(deviations: Three) -> Matrix:
    """Covariance of what is not correlated."""
    gap, own, leader = deviations
    return (gap * gap, 0.0, 0.0), (0.0, own * own, 0.0), (0.0, 0.0, leader * leader)


@compiled
def _filtered(
    before: Three,
    covariance: Matrix,
    observation: Three,
    noise: Three,
    realised: float,
    doubt: float,
    dt: float,
) -> tuple[Three, Matrix]:
    """One step of the filter, to the next mean and covariance, by what was seen (not NaN).

    ``doubt`` is the standard deviation of the acceleration that was ``realised`` [m/s²].
    """
    mean, spread = _predicted(before, covariance, realised, doubt, dt)
    variances = _diagonal(noise)
    whole = not np.isnan(observation[0] + observation[1] + observation[2])
    for i in (0, 2):
        off, expected = observation[i] - mean[i], spread[i, i] + variances[i][i]
        if whole and off * off > _ANOTHER_LEADER * _ANOTHER_LEADER * expected:
            return observation, variances
    for i in range(3):
        if np.isnan(observation[i]):
            continue
        _correct(mean, spread, i, observation[i], variances[i][i])
    return (mean[0], max(mean[1], 0.0), max(mean[2], 0.0)), (
        (spread[0, 0], spread[0, 1], spread[0, 2]),
        (spread[1, 0], spread[1, 1], spread[1, 2]),
        (spread[2, 0], spread[2, 1], spread[2, 2]),
    )


@compiled
def _predicted(
    before: Three, covariance: Matrix, realised: float, doubt: float, dt: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Where one should be now, and how sure that is."""
    gap, own, leader = before
    reached = max(own + realised * dt, 0.0)
    mean = np.array([gap + (leader - 0.5 * (own + reached)) * dt, reached, leader])
    (gg, gv, gu), (_, vv, vu), (_, _, uu) = covariance
    # F P Fᵀ, where only the gap changes with the others.
    to_v, to_u = gv + (vu - vv) * dt, gu + (uu - vu) * dt
    gg += 2.0 * (gu - gv) * dt + (uu - 2.0 * vu + vv) * dt * dt
    # An acceleration changes a speed, and the gap by half an interval of it.
    v, u, half = (doubt * dt) ** 2, (_LEADER * dt) ** 2, 0.5 * dt
    gg += half * half * (v + u) + _UNEVEN**2
    to_v, to_u = to_v - half * v, to_u + half * u
    return mean, np.array([[gg, to_v, to_u], [to_v, vv + v, vu], [to_u, vu, uu + u]])


@compiled
def _correct(
    mean: NDArray[np.float64],
    covariance: NDArray[np.float64],
    i: int,
    value: float,
    variance: float,
) -> None:
    """Take in one observed component: a scalar Kalman update, in place."""
    row = covariance[i].copy()
    total = row[i] + variance
    off = (value - mean[i]) / total
    for j in range(3):
        mean[j] += row[j] * off
        gain = row[j] / total
        for k in range(3):
            covariance[j, k] -= gain * row[k]


@compiled
def _deviation(covariance: Matrix, weights: Three) -> float:
    variance = 0.0
    for j in range(3):
        for k in range(3):
            variance += weights[j] * weights[k] * covariance[j][k]
    return sqrt(max(variance, 0.0))


# -- The noise ----------------------------------------------------------------------------------


@compiled
def _take_in(
    sizes: NDArray[np.float64],
    ordered: NDArray[np.float64],
    added: NDArray[np.int64],
    before: Three,
    now: Three,
    realised: float,
    changes: tuple[float, float],
    dt: float,
) -> tuple[Three, tuple[float, float]]:
    residuals, changes = _unexplained(before, now, realised, changes, dt)
    _add(sizes, ordered, added, residuals)
    return _noise(_deviations(ordered, added), dt), changes


@compiled
def _unexplained(
    before: Three, now: Three, realised: float, changes: tuple[float, float], dt: float
) -> tuple[Three, tuple[float, float]]:
    """What the gap and both speeds did that kinematics do not explain; NaN where that is not said.

    And by how much both speeds changed, beyond what was expected; ``changes`` is that of the
    interval before.
    """
    (gap_before, own_before, leader_before), (gap, own, leader) = before, now
    closing = own + own_before - leader - leader_before
    own_change, leader_change = own - own_before - realised * dt, leader - leader_before
    own_moves = min(own, own_before) > _STANDING
    leader_moves = min(leader, leader_before) > _STANDING
    residuals = (
        gap - gap_before + 0.5 * dt * closing,
        own_change - changes[0] if own_moves else nan,
        leader_change - changes[1] if leader_moves else nan,
    )
    return residuals, (own_change, leader_change)


@compiled
def _noise(deviations: Three, dt: float) -> Three:
    """Standard deviation of the noise on gap and both speeds, from that of their residuals."""
    # The second difference of a noisy speed has 6 times its variance; that of a gap against
    # the trapezoid of four noisy speeds twice its own, and some of theirs.
    own, leader = deviations[1] / sqrt(6.0), deviations[2] / sqrt(6.0)
    of_speeds = 0.5 * dt**2 * (own**2 + leader**2)
    gap = sqrt(max(deviations[0] ** 2 - of_speeds, 0.0) / 2.0)
    return (
        gap if gap >= _FINEST[0] else 0.0,
        own if own >= _FINEST[1] else 0.0,
        leader if leader >= _FINEST[2] else 0.0,
    )


@compiled
def _add(
    sizes: NDArray[np.float64],
    ordered: NDArray[np.float64],
    added: NDArray[np.int64],
    residuals: Three,
) -> None:
    """Put each residual's size in place of the oldest of its row; ``ordered`` stays sorted."""
    for k in range(3):
        if np.isnan(residuals[k]):
            continue
        size, place, row = abs(residuals[k]), added[k] % _MEMORY, ordered[k]
        i = added[k]
        if added[k] >= _MEMORY:  # the oldest leaves, and what is larger than it closes up
            i = _place_in(row, sizes[k, place])
            while i + 1 < _MEMORY and row[i + 1] < size:
                row[i] = row[i + 1]
                i += 1
        while i > 0 and row[i - 1] > size:
            row[i] = row[i - 1]
            i -= 1
        row[i] = sizes[k, place] = size
        added[k] += 1


@kernel
def _place_in(ordered: NDArray[np.float64], size: float) -> int:
    """Where a number stands, or the first of those equal to it."""
    low, high = 0, len(ordered)
    while low < high:
        middle = (low + high) // 2
        if ordered[middle] < size:
            low = middle + 1
        else:
            high = middle
    return low


@kernel
def _deviation_of(ordered: NDArray[np.float64], count: int) -> float:
    return float(ordered[count // 2]) / _MEDIAN if count >= _FEWEST else 0.0


@compiled
def _deviations(ordered: NDArray[np.float64], added: NDArray[np.int64]) -> Three:
    return (
        _deviation_of(ordered[0], min(added[0], _MEMORY)),
        _deviation_of(ordered[1], min(added[1], _MEMORY)),
        _deviation_of(ordered[2], min(added[2], _MEMORY)),
    )
