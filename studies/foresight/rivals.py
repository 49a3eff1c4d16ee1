"""Who foresees beside ours: logistic regression, nearest neighbours, and extrapolation."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from evofsm.extras import needs
from studies.foresight.data import Cases
from studies.old.scores import isotonic

with needs("scipy", "study", "nearest neighbours"):
    from scipy.spatial import KDTree
    from scipy.special import expit

#: Neighbours that are asked.
NEIGHBOURS = 25
# Of the logistic regression: penalty of each standardised weight, iterations, and the largest step.
_RIDGE, _ITERATIONS = 1e-2, 25
# Extrapolation looks so far [steps].
_FARTHEST = 200

_Floats = NDArray[np.float64]


class Logistic:
    """Logistic regression on observation, change, action and the products of all of them.

    Fitted by iteratively reweighted least squares with a small ridge.

    Parameters
    ----------
    train : Cases
    truth : (n,) ndarray of bool
    """

    def __init__(self, train: Cases, truth: NDArray[np.bool_]) -> None:
        raw = _products(_inputs(train))
        self._mean, self._scale = raw.mean(axis=0), _spread(raw)
        X = self._features(raw)
        penalty = _RIDGE * np.eye(X.shape[1])
        penalty[0, 0] = 1e-9
        self.weights = np.zeros(X.shape[1])
        y = truth.astype(np.float64)
        for _ in range(_ITERATIONS):
            p = expit(X @ self.weights)
            w = np.maximum(p * (1.0 - p), 1e-6)
            gradient = X.T @ (y - p) - penalty @ self.weights
            step = np.linalg.solve((X.T * w) @ X + penalty, gradient)
            size = np.abs(step).max()
            self.weights += step * min(1.0, 5.0 / max(size, 1e-12))
            if size < 1e-6:
                break

    def __call__(self, some: Cases) -> _Floats:
        """(n,) probability."""
        return np.asarray(expit(self._features(_products(_inputs(some))) @ self.weights))

    def _features(self, raw: _Floats) -> _Floats:
        return np.column_stack([np.ones(len(raw)), (raw - self._mean) / self._scale])


class Neighbours:
    """The share of the nearest training steps that failed in time, calibrated by Venn and Abers.

    Observation, change and action are standardised. The calibrated probability is that of an
    inductive Venn-Abers predictor (Vovk & Petej 2014), which is conformal prediction's way to
    probabilities: isotonic regression twice, with the case taken for a failure and for none.
    """

    def __init__(
        self, train: Cases, truth: NDArray[np.bool_], on: Cases, came: NDArray[np.bool_]
    ) -> None:
        raw = _inputs(train)
        self._mean, self._scale = raw.mean(axis=0), _spread(raw)
        self._tree, self._truth = KDTree((raw - self._mean) / self._scale), truth
        score = self.share(on)
        levels = np.arange(NEIGHBOURS + 1) / NEIGHBOURS
        self._probabilities = np.array([venn_abers(score, came, level) for level in levels])

    def share(self, some: Cases) -> _Floats:
        """(n,) of the neighbours that failed in time."""
        count = min(NEIGHBOURS, len(self._truth))
        _, near = self._tree.query((_inputs(some) - self._mean) / self._scale, count)
        return np.asarray(self._truth[np.reshape(near, (-1, count))].mean(axis=1))

    def __call__(self, some: Cases) -> _Floats:
        """(n,) probability."""
        return np.asarray(self._probabilities[np.rint(self.share(some) * NEIGHBOURS).astype(int)])


def venn_abers(score: _Floats, came: NDArray[np.bool_], at: float) -> float:
    """Probability of an inductive Venn-Abers predictor at a score, from calibration cases.

    Examples
    --------
    >>> scores, came = np.array([0.0, 0.0, 1.0, 1.0]), np.array([False, False, True, True])
    >>> round(venn_abers(scores, came, 0.0), 3), round(venn_abers(scores, came, 1.0), 3)
    (0.25, 0.75)
    """
    low, high = (
        float(isotonic(np.append(score, at), np.append(came, said))(at)) for said in (False, True)
    )
    return high / (1.0 - low + high)


class Taylor:
    """Time until the state, extrapolated by backward differences, is beyond where it fails.

    As Henzinger et al. (arXiv 2412.16564) extrapolate what is seen of a black box. Where it fails
    is given to it: the boundaries that ours found in the failures, since no task tells them.

    Parameters
    ----------
    sides : (k, 4) ndarray
        Variable, sign and threshold of each boundary; what else they hold is not used.
    order : int
        1: at the latest pace. 2: at the latest pace and its latest change.
    """

    def __init__(self, sides: _Floats, order: int) -> None:
        self.sides, self.order = sides, order

    def steps(self, some: Cases) -> _Floats:
        """(n,) steps to the first boundary; infinite where it is not reached in 200."""
        s = np.arange(1.0, _FARTHEST + 1.0)
        first = np.full(len(some.z), np.inf)
        for variable, sign, threshold, *_ in self.sides:
            j = int(variable)
            path = some.z[:, j, None] + s * some.change[:, j, None]
            if self.order > 1:
                bend = some.change[:, j] - some.earlier[:, j]
                path += 0.5 * s * (s + 1.0) * bend[:, None]
            beyond = sign * (path - threshold) >= 0.0
            reached = np.where(beyond.any(axis=1), s[beyond.argmax(axis=1)], np.inf)
            first = np.minimum(first, reached)
        return first

    def __call__(self, some: Cases) -> _Floats:
        """(n,) score: minus the steps."""
        return -self.steps(some)


def _inputs(some: Cases) -> _Floats:
    """(n, 2 m + a) what everyone may know; the last of several choices follows from the others."""
    return np.column_stack([some.z, some.change, some.action])


def _products(raw: _Floats) -> _Floats:
    i, j = np.triu_indices(raw.shape[1])
    return np.column_stack([raw, raw[:, i] * raw[:, j]])


def _spread(raw: _Floats) -> _Floats:
    spread = raw.std(axis=0)
    return np.where(spread > 1e-12, spread, 1.0)
