"""A clusterer in scikit-learn's conventions: whole arrays, or batch after batch."""

from __future__ import annotations

from typing import Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from evofsm.extras import needs
from evofsm.fsm.machine import EvolvingFSM
from evofsm.fsm.rules import StateRule
from evofsm.fsm.validation import Floats

with needs("scikit-learn", "sklearn", "a clusterer of scikit-learn"):
    from sklearn.base import BaseEstimator, ClusterMixin
    from sklearn.utils.validation import check_is_fitted, validate_data


class EvolvingClusterer(ClusterMixin, BaseEstimator):  # type: ignore[misc] # both are untyped
    """The states of an `EvolvingFSM` as the clusters of a scikit-learn clusterer.

    Rows are observations in the order of time, which matters.

    Parameters
    ----------
    radius, learning_rate, spread, rule, max_states : optional
        As `EvolvingFSM` takes them. All features count alike: scale them first.

    Attributes
    ----------
    machine_ : EvolvingFSM
        With one action: ``machine_.predict(0)`` forecasts the next state.
    labels_ : (N,) ndarray of int
        State that each row of the latest batch was recognised as when it was learnt; `predict`
        goes by the states of now.

    Examples
    --------
    >>> clusterer = EvolvingClusterer(radius=0.5).fit([[0.0], [0.1], [2.0], [1.0]])
    >>> clusterer.labels_, clusterer.predict([[0.2], [1.8]])
    (array([0, 0, 0, 1]), array([0, 1]))
    >>> clusterer.predict_proba([[0.5]])
    array([[0.5, 0.5]])
    >>> clusterer.partial_fit([[2.0], [1.1]]).cluster_centers_
    array([[0.],
           [1.]])
    """

    def __init__(
        self,
        radius: float | None = None,
        learning_rate: float = 0.01,
        spread: float | None = None,
        rule: StateRule | None = None,
        max_states: int | None = None,
    ) -> None:
        self.radius, self.learning_rate, self.spread = radius, learning_rate, spread
        self.rule, self.max_states = rule, max_states

    def fit(self, X: ArrayLike, y: object = None) -> Self:
        """Learn from the rows of X (N, m), in the order of time, whatever was learnt before."""
        return self._learn(X, anew=True)

    def partial_fit(self, X: ArrayLike, y: object = None) -> Self:
        """Go on learning, with rows (N, m) that follow those learnt before."""
        return self._learn(X, anew=not hasattr(self, "machine_"))

    def predict(self, X: ArrayLike) -> NDArray[np.int64]:
        """(N,) index of the most probable state of each row; nothing is changed by asking."""
        return np.asarray(self.predict_proba(X).argmax(axis=1))

    def predict_proba(self, X: ArrayLike) -> Floats:
        """(N, n) distribution over states of each row: how much it belongs to each."""
        check_is_fitted(self)
        return self.machine_.model().recognise(self._checked(X, reset=False))

    @property
    def cluster_centers_(self) -> Floats:
        """(n, m) ndarray: centres of the states."""
        return self.machine_.centers

    def _learn(self, X: ArrayLike, anew: bool) -> Self:
        rows = self._checked(X, reset=anew)
        if anew:
            settings = self.get_params(deep=False).items()
            arguments = {name: value for name, value in settings if value is not None}
            self.machine_ = EvolvingFSM(n_actions=1, **arguments)
        self.labels_ = self.machine_.learn_many(rows, np.zeros(len(rows), np.int64)).state
        return self

    def _checked(self, X: ArrayLike, reset: bool) -> Floats:
        # Kernels are made for arrays that may be written to; others would make them anew.
        requirements = {"dtype": np.float64, "order": "C", "force_writeable": True}
        return np.asarray(validate_data(self, X, reset=reset, **requirements))
