"""How good a foresight is: calibration, alarms at a fixed recall, and how early they come."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from studies.foresight.data import Cases
from studies.old.scores import brier, interval, isotonic, resampled

#: Recall at which false alarms are counted, and false-alarm rate at which lead times are.
RECALL, FALSE = 0.95, 0.05
_BINS = 10

_Floats = NDArray[np.float64]
_Bools = NDArray[np.bool_]


class Scored(NamedTuple):
    """What one said of the cases whose truth is known, and what came."""

    probability: _Floats  #: (n,) after calibration on other episodes
    score: _Floats  #: (n,) before it
    truth: _Bools  #: (n,)
    episode: NDArray[np.intp]  #: (n,)
    left: _Floats  #: (n,) steps to the failure
    alarm: float  #: threshold of the score with a false-alarm rate of 5 % on other episodes
    calls: float  #: threshold of the probability with the best F1 there


class Measured(NamedTuple):
    """A number with its 95 % interval, by bootstrap over episodes; NaN where there is none."""

    value: float
    low: float
    high: float


def scored(score: _Floats, test: Cases, before: _Floats, calibration: Cases, steps: int) -> Scored:
    """Calibrate scores, and choose thresholds, on other episodes.

    Parameters
    ----------
    score, before : (n,) ndarray
        Of the test cases, and of those for calibration.
    test, calibration : Cases
    steps : int
        Of the horizon.
    """
    known, own = test.judged(steps), calibration.judged(steps)
    came, said = calibration.truth(steps)[own], before[own]
    calibrate = isotonic(said, came)
    return Scored(
        calibrate(score[known]),
        score[known],
        test.truth(steps)[known],
        test.episode[known],
        test.left[known],
        _quantile_above(said[~came], FALSE),
        _best_call(calibrate(said), came),
    )


def _quantile_above(scores: _Floats, share: float) -> float:
    """The lowest threshold above which no larger share of the scores lies."""
    if not len(scores):
        return -math.inf
    ordered = np.sort(scores)[::-1]
    return float(ordered[min(int(share * len(ordered)), len(ordered) - 1)])


def _best_call(probability: _Floats, truth: _Bools) -> float:
    levels = np.unique(probability)
    return float(max(levels, key=lambda level: _f1(probability >= level, truth)))


def _f1(called: _Bools, truth: _Bools) -> float:
    both = float((called & truth).sum())
    total = float(called.sum() + truth.sum())
    return 2.0 * both / total if total else math.nan


def ece(probability: _Floats, truth: _Bools) -> float:
    """Expected calibration error: mean distance of probability and share, in ten equal bins.

    Examples
    --------
    >>> round(ece(np.array([0.05, 0.05, 0.95, 0.95]), np.array([False, False, True, False])), 9)
    0.25
    """
    if not len(probability):
        return math.nan
    place = np.minimum((probability * _BINS).astype(int), _BINS - 1)
    off = np.bincount(place, probability - truth, _BINS)
    return float(np.abs(off).sum() / len(probability))


def false_at_recall(score: _Floats, truth: _Bools) -> float:
    """False-alarm rate at the highest threshold that 95 % of the failures reach.

    Examples
    --------
    >>> false_at_recall(np.array([0.1, 0.6, 0.5, 0.9]), np.array([False, False, True, True]))
    0.5
    """
    if truth.all() or not truth.any():
        return math.nan
    ordered = np.sort(score[truth])[::-1]
    threshold = ordered[math.ceil(RECALL * len(ordered)) - 1]
    return float((score[~truth] >= threshold).mean())


#: Numbers that are told with an interval, each of probabilities, scores and so on.
MEASURES: dict[str, Callable[[Scored], float]] = {
    "brier": lambda one: brier(one.probability, one.truth),
    "ece": lambda one: ece(one.probability, one.truth),
    "f1": lambda one: _f1(one.probability >= one.calls, one.truth),
    "false_95": lambda one: false_at_recall(one.score, one.truth),
}


def leads(one: Scored) -> tuple[_Floats, NDArray[np.intp]]:
    """Steps from the first alarm that stays on to the failure, of each episode that failed.

    At the threshold that had a false-alarm rate of 5 % on other episodes; 0 where none was on at
    the end. The second array says which episodes these are.
    """
    found: list[float] = []
    episodes: list[int] = []
    for episode in np.unique(one.episode[np.isfinite(one.left)]):
        rows = np.flatnonzero(one.episode == episode)
        on = one.score[rows] > one.alarm
        quiet = np.flatnonzero(~on)
        first = quiet[-1] + 1 if len(quiet) else 0
        found.append(float(one.left[rows[first]]) if first < len(rows) else 0.0)
        episodes.append(int(episode))
    return np.array(found), np.array(episodes, np.intp)


def measured(every: Sequence[Scored], episodes: int, rounds: int, seed: int) -> dict[str, Measured]:
    """All of `MEASURES`, and the median lead time in steps, with intervals over episodes.

    Parameters
    ----------
    every : sequence of Scored
        Of each learning seed, on the same episodes; the mean over them is told.
    episodes : int
        How many there are.
    rounds, seed : int
        Of the bootstrap.
    """
    parts = [_ByEpisode.of(one, episodes) for one in every]
    names = (*MEASURES, "lead")
    drawn = [_means(parts, chosen) for chosen in resampled(episodes, rounds, seed)]
    values = _means(parts, np.arange(episodes))
    ranges = {name: interval([one[name] for one in drawn]) for name in names}
    return {name: Measured(values[name], *ranges[name]) for name in names}


class _ByEpisode(NamedTuple):
    """What one said, with the rows and the lead time of each episode."""

    one: Scored
    rows: list[NDArray[np.intp]]
    lead: _Floats  #: (episodes,) NaN of those that did not fail

    @classmethod
    def of(cls, one: Scored, episodes: int) -> _ByEpisode:
        lead = np.full(episodes, math.nan)
        found, failed = leads(one)
        lead[failed] = found
        return cls(one, [np.flatnonzero(one.episode == k) for k in range(episodes)], lead)

    def measure(self, chosen: NDArray[np.intp]) -> dict[str, float]:
        rows = np.concatenate([self.rows[k] for k in chosen])
        some = _at(self.one, rows)
        found = {
            name: measure(some) if len(rows) else math.nan for name, measure in MEASURES.items()
        }
        lead = self.lead[chosen]
        lead = lead[np.isfinite(lead)]
        return found | {"lead": float(np.median(lead)) if len(lead) else math.nan}


def _means(parts: Sequence[_ByEpisode], chosen: NDArray[np.intp]) -> dict[str, float]:
    """Over learning seeds."""
    each = [part.measure(chosen) for part in parts]
    return {name: float(np.mean([one[name] for one in each])) for name in each[0]}


def _at(one: Scored, rows: NDArray[np.intp]) -> Scored:
    parts = (one.probability, one.score, one.truth, one.episode, one.left)
    return Scored._make([*(part[rows] for part in parts), one.alarm, one.calls])
