"""Alarms as events: how many were false, and how long before a collision the right one came.

A score raises an alarm where it is above a threshold, and an alarm holds for one second after it
was last raised: alarms no further apart are one. An alarm *comes true* if the target holds when it
comes on, or within five seconds from then while it is still on; if not, it is *false*. Without that
limit an alarm that is always on would never be false where all episodes end badly. A false alarm
that lasts is still one event, so the share of time without the target that is spent in alarm
stands beside every rate.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from evofsm.fsm.kernels import compiled
from studies.detection.watch import Cases, Exposure

#: An alarm holds for so long after it was raised [s].
HOLD = 1.0
#: An alarm that the target does not follow within so long is false [s].
PATIENCE = 5.0
#: For a rate to be measurable as many events must be expected: an upper 95 % bound on none.
_EXPECTED = 3.0
# Thresholds that are tried, evenly spread over the logarithm of how many decisions are above.
_TRIED = 400


class Alarms(NamedTuple):
    """Alarms above one threshold, counted."""

    false: int  #: events
    true: int  #: events
    false_decisions: int  #: in alarm while the target does not hold


def is_measurable(rate: float, hours: float) -> bool:
    """Whether so few false alarms per hour [1/h] can be told from none in so many hours."""
    return bool(hours * rate >= _EXPECTED)


def count_alarms(
    score: NDArray[np.float64], cases: Cases, threshold: float, interval: float
) -> Alarms:
    """Alarms of a score over some cases.

    Parameters
    ----------
    score : (n,) ndarray
        Of the cases.
    cases : Cases
    threshold : float
        An alarm is raised above it.
    interval : float
        Between decisions [s].
    """
    hold, patience = (round(seconds / interval) for seconds in (HOLD, PATIENCE))
    return Alarms(*_follow(score, cases.truth, cases.first, threshold, hold, patience)[:3])


def choose_threshold(
    score: NDArray[np.float64], cases: Cases, rate: float, interval: float
) -> float:
    """The lowest threshold such that it and all above it keep the rate of false alarms.

    Long alarms merge with short ones, so that a very low threshold may have few false alarms again;
    it is not chosen if a higher one has too many.

    Parameters
    ----------
    score : (n,) ndarray
        Of the cases; they are not those that are judged later.
    cases : Cases
    rate : float
        Highest number of false alarms per hour [1/h].
    interval : float
        Between decisions [s].

    Returns
    -------
    float
        Minus infinity if the target holds at every decision.
    """
    chosen = np.inf
    for threshold in _candidates(score[~cases.truth]):
        if count_alarms(score, cases, threshold, interval).false > rate * cases.hours:
            break
        chosen = threshold
    return chosen


def _candidates(negative: NDArray[np.float64]) -> Iterator[float]:
    """Scores of decisions at which the target does not hold, the highest first."""
    if len(negative) == 0:
        yield -np.inf
        return
    ordered = np.sort(negative)[::-1]
    places = np.unique(np.geomspace(1, len(ordered), _TRIED).astype(np.intp)) - 1
    yield from np.unique(ordered[places])[::-1].tolist()


def lead_times(
    score: NDArray[np.float64], exposure: Exposure, threshold: float
) -> NDArray[np.float64]:
    """From the first alarm that stays on, to the collision.

    Parameters
    ----------
    score : (n,) ndarray
        Of all decisions.
    exposure : Exposure
    threshold : float

    Returns
    -------
    (collisions,) ndarray
        [s], in the order of the episodes; 0 where there was none.
    """
    interval = exposure.family.interval
    first = np.append(0, np.cumsum([len(one.commands) for one in exposure.watched]))
    nothing = np.zeros(len(score), dtype=np.bool_)
    *_, since = _follow(score, nothing, first, threshold, round(HOLD / interval), 0)
    lead = np.where(since >= 0, exposure.ends - interval * since, 0.0)
    return np.asarray(lead[exposure.collided])


@compiled
def _follow(
    score: NDArray[np.float64],
    truth: NDArray[np.bool_],
    first: NDArray[np.intp],
    threshold: float,
    hold: int,
    patience: int,
) -> tuple[int, int, int, NDArray[np.intp]]:
    """Alarms that were false and true, decisions in false alarm, and those still on at the end.

    The last are the decisions at which they came on, for each episode; -1 where none is on.
    """
    false = true = false_decisions = 0
    since = np.full(len(first) - 1, -1)
    for episode in range(len(first) - 1):
        left, came_true, came_on = 0, False, 0
        for row in range(first[episode], first[episode + 1]):
            if score[row] > threshold:
                if left == 0:
                    came_on = row
                left = hold
            elif left > 0:
                left -= 1
                if left == 0:  # it was raised too long ago
                    true += came_true
                    false += not came_true
                    came_true = False
            if left > 0:
                came_true = came_true or (truth[row] and row <= came_on + patience)
                false_decisions += not truth[row]
        if left > 0:
            true += came_true
            false += not came_true
            since[episode] = came_on - first[episode]
    return false, true, false_decisions, since
