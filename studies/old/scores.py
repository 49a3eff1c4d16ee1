"""How good scores, probabilities and alarms are, with the uncertainty that episodes leave.

Rows of one episode are much alike, so whatever is uncertain here is resampled by whole episodes
(B. Efron, R. Tibshirani, "An Introduction to the Bootstrap", 1993).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from evofsm.extras import needs
from evofsm.fsm.kernels import compiled

with needs("scipy", "study", "calibrating scores"):
    from scipy.optimize import isotonic_regression
    from scipy.stats import binomtest

# Of an interval, in both directions: 95 %.
_TAILS = (0.025, 0.975)


class Interval(NamedTuple):
    """From and to, 95 %; NaN where there is none."""

    low: float
    high: float


class Share(NamedTuple):
    """So many of so many, with its 95 % interval (Clopper and Pearson 1934)."""

    held: int
    tried: int
    low: float
    high: float

    @property
    def value(self) -> float:
        """The share itself; NaN of none."""
        return self.held / self.tried if self.tried else math.nan


def share_of(verdicts: ArrayLike) -> Share:
    """Share of the true ones.

    The interval takes the draws for independent; those of a Latin hypercube are spread more evenly
    than that, so it is rather too wide than too narrow (Stein 1987).

    Parameters
    ----------
    verdicts : (n,) array_like of bool

    Examples
    --------
    >>> share = share_of([True] * 3 + [False] * 7)
    >>> share.value, round(share.low, 3), round(share.high, 3)
    (0.3, 0.067, 0.652)
    """
    values = np.asarray(verdicts, dtype=np.bool_)
    if not len(values):
        return Share(0, 0, 0.0, 1.0)
    held, tried = int(values.sum()), len(values)
    exact = binomtest(held, tried).proportion_ci(0.95, method="exact")
    return Share(held, tried, float(exact.low), float(exact.high))


class Areas(NamedTuple):
    """Under both curves; NaN where cases are too much alike."""

    auroc: float  #: see `auroc`
    auprc: float  #: see `auprc`


class Ranked:
    """Scores in falling order: both areas for many weightings, sorted once.

    Parameters
    ----------
    score : (n,) array_like
        Higher is more dangerous. Infinite scores have a rank like any others.
    truth : (n,) array_like of bool
        Whether it was dangerous.
    episode : (n,) array_like of int, optional
        Which episode each case is of, from 0; without it each is one of its own.

    Raises
    ------
    ValueError
        If they are not equally long, or a score is NaN, which has no rank.

    Examples
    --------
    >>> ranked = Ranked([0.1, 0.4, 0.4, 0.8], [False, False, True, True])
    >>> ranked.areas().auroc, round(ranked.areas().auprc, 4)
    (0.875, 0.8333)
    >>> ranked.areas([1, 0, 1, 1])  # the second case left out
    Areas(auroc=1.0, auprc=1.0)
    """

    def __init__(
        self, score: ArrayLike, truth: ArrayLike, episode: ArrayLike | None = None
    ) -> None:
        values, dangerous = np.asarray(score, dtype=np.float64), np.asarray(truth, dtype=np.bool_)
        places = np.arange(len(values)) if episode is None else np.asarray(episode, dtype=np.intp)
        if values.ndim != 1 or not values.shape == dangerous.shape == places.shape:
            raise ValueError(
                f"score has shape {values.shape}, truth {dangerous.shape} and episode "
                f"{places.shape}; each must be one row, all equally long"
            )
        if np.isnan(values).any():
            raise ValueError("score holds NaN, which has no rank")
        order = np.argsort(-values, kind="stable")
        self._truth, self._episode = dangerous[order], places[order]
        self._score = values[order]
        self._episodes = int(places.max(initial=-1)) + 1

    def areas(self, weight: ArrayLike | None = None) -> Areas:
        """Under both curves.

        Parameters
        ----------
        weight : (episodes,) array_like, optional
            How often each episode counts; once if not given.
        """
        weights = np.ones(self._episodes) if weight is None else np.asarray(weight, np.float64)
        return Areas(*_areas(self._score, self._truth, self._episode, weights))


@compiled
def _areas(
    score: NDArray[np.float64],
    truth: NDArray[np.bool_],
    episode: NDArray[np.intp],
    weight: NDArray[np.float64],
) -> tuple[float, float]:
    true = false = under_roc = under_prc = true_before = false_before = 0.0
    for i in range(len(score)):
        if truth[i]:
            true += weight[episode[i]]
        else:
            false += weight[episode[i]]
        if i + 1 < len(score) and score[i + 1] == score[i]:
            continue  # a threshold cannot tell equal scores apart
        under_roc += 0.5 * (false - false_before) * (true + true_before)
        if true > true_before:
            under_prc += (true - true_before) * true / (true + false)
        true_before, false_before = true, false
    auroc = under_roc / (true * false) if true * false > 0.0 else np.nan
    return auroc, under_prc / true if true > 0.0 else np.nan


def auroc(score: ArrayLike, truth: ArrayLike) -> float:
    """Probability that a dangerous case scores above another one, ties counting half.

    Parameters
    ----------
    score : (n,) array_like
    truth : (n,) array_like of bool

    Returns
    -------
    float
        NaN where all cases are alike.

    Examples
    --------
    >>> auroc([0.1, 0.4, 0.4, 0.8], [False, False, True, True])
    0.875
    """
    return Ranked(score, truth).areas().auroc


def auprc(score: ArrayLike, truth: ArrayLike) -> float:
    """Area under the curve of precision over recall, as average precision.

    Precision at each threshold, weighed by the recall that it adds; no line is drawn between
    thresholds, which would flatter (J. Davis, M. Goadrich, ICML 2006). A score that knows nothing
    reaches the share of dangerous cases.

    Parameters
    ----------
    score : (n,) array_like
    truth : (n,) array_like of bool

    Returns
    -------
    float
        NaN where no case is dangerous.

    Examples
    --------
    >>> auprc([0.1, 0.4, 0.6, 0.8], [False, True, False, True])
    0.8333333333333333
    """
    return Ranked(score, truth).areas().auprc


def brier(probability: ArrayLike, truth: ArrayLike) -> float:
    """Mean squared error of probabilities (G. W. Brier, Monthly Weather Review 78, 1950).

    Examples
    --------
    >>> brier([0.0, 0.5, 1.0], [False, True, True])
    0.08333333333333333
    """
    error = np.asarray(probability, dtype=np.float64) - np.asarray(truth, dtype=np.float64)
    return float((error**2).mean()) if error.size else float("nan")


class Calibration(NamedTuple):
    """Turns a score into a probability that never falls as the score rises; see `isotonic`."""

    scores: NDArray[np.float64]  #: (k,) in rising order
    probabilities: NDArray[np.float64]  #: (k,) from each of them on

    def __call__(self, score: ArrayLike) -> NDArray[np.float64]:
        """(n,) ndarray: probability of each score."""
        place = np.searchsorted(self.scores, np.asarray(score, dtype=np.float64), side="right") - 1
        return np.asarray(self.probabilities[np.maximum(place, 0)])


def isotonic(score: ArrayLike, truth: ArrayLike) -> Calibration:
    """Calibrate scores by isotonic regression (B. Zadrozny, C. Elkan, KDD 2002).

    Parameters
    ----------
    score : (n,) array_like
        Of cases that nothing is judged by later. They may be infinite.
    truth : (n,) array_like of bool

    Raises
    ------
    ValueError
        If there is no case, or a score is NaN.

    Examples
    --------
    >>> calibrate = isotonic([1.0, 2.0, 3.0, 4.0], [False, True, False, True])
    >>> calibrate([0.0, 2.5, 9.0])
    array([0. , 0.5, 1. ])
    """
    values = np.asarray(score, dtype=np.float64)
    if values.size == 0 or np.isnan(values).any():
        raise ValueError("isotonic calibration needs one score or more, none of them NaN")
    scores, which, cases = np.unique(values, return_inverse=True, return_counts=True)
    came = np.bincount(which, weights=np.asarray(truth, dtype=np.float64)) / cases
    fitted = isotonic_regression(came, weights=cases.astype(np.float64)).x
    return Calibration(scores, np.clip(fitted, 0.0, 1.0))


def bootstrap(
    function: Callable[[NDArray[np.intp]], float], episodes: int, rounds: int = 200, seed: int = 0
) -> Interval:
    """95 % interval of a number, by drawing as many episodes again and again.

    Parameters
    ----------
    function : callable
        Takes the indices of episodes, some of them several times, and returns the number, or NaN
        where there is none, which is left out.
    episodes : int
        How many there are.
    rounds : int
        How often they are drawn.
    seed : int

    Examples
    --------
    >>> lasted = np.array([3.0, 4.0, 5.0, 6.0])
    >>> low, high = bootstrap(lambda chosen: float(lasted[chosen].mean()), len(lasted))
    >>> bool(low < lasted.mean() < high)
    True
    """
    return interval([function(chosen) for chosen in resampled(episodes, rounds, seed)])


def resampled(episodes: int, rounds: int, seed: int = 0) -> Iterator[NDArray[np.intp]]:
    """Indices of as many episodes as there are, drawn with replacement, round by round."""
    rng = np.random.default_rng(seed)
    for _ in range(rounds):
        yield rng.integers(episodes, size=episodes)


def interval(values: ArrayLike) -> Interval:
    """95 % interval of bootstrap values; NaN is left out."""
    found = np.asarray(values, dtype=np.float64)
    found = found[~np.isnan(found)]
    if found.size == 0:
        return Interval(float("nan"), float("nan"))
    low, high = np.quantile(found, _TAILS)
    return Interval(float(low), float(high))
