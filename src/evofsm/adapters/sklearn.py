"""A clusterer in scikit-learn's conventions: whole arrays, or batch after batch."""

from __future__ import annotations

from typing import Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from evofsm.extras import needs
from evofsm.fsm import EvolvingFSM, StateRule, WhenFull

with needs("scikit-learn", "sklearn", "a clusterer of scikit-learn"):
    from sklearn.base import BaseEstimator, ClusterMixin
    from sklearn.utils.validation import check_is_fitted, validate_data


class EvolvingClusterer(ClusterMixin, BaseEstimator):  # type: ignore[misc] # both are untyped
    """The states of an `EvolvingFSM` as the clusters of a scikit-learn clusterer.

    Rows are observations in the order of time. Their order matters: states are created and moved
    as the rows come, and how one follows another is learnt beside them.

    Parameters
    ----------
    radius, distance_weight, learning_rate, prior_frequency, spread : float, optional
        As `EvolvingFSM` takes them; ``radius`` in the unit of the features, which all count
        alike: scale them first.
    rule : StateRule, optional
        How states are determined.
    max_states : int, optional
        Number of states at which another one is only created where one is given up.
    when_full : WhenFull, optional
        Which one is given up; its number goes to the new state. Without it the machine's own
        default, ``MERGE``: scikit-learn allows no enumeration as a default.
    belief_tolerance : float
        How far a belief may be from the exact one.

    Attributes
    ----------
    machine_ : EvolvingFSM
        With one action: ``machine_.predict(0)`` forecasts the next state, and
        ``machine_.start_episode()`` says that the next row does not follow from the last.
    labels_ : (N,) ndarray of int
        State that each row of the latest batch was recognised as when it was learnt; `predict`
        goes by the states of now.
    n_features_in_ : int
        Number m of features.
    feature_names_in_ : (m,) ndarray of str
        Their names, where the first X had names that are all strings.

    Examples
    --------
    >>> clusterer = EvolvingClusterer(radius=0.5).fit([[0.0], [0.1], [2.0], [1.0]])
    >>> clusterer.labels_, clusterer.predict([[0.2], [1.8]])
    (array([0, 0, 0, 1]), array([0, 1]))
    >>> clusterer.predict_proba([[0.5]])
    array([[0.5, 0.5]])
    """

    def __init__(
        self,
        radius: float | None = None,
        distance_weight: float = 0.85,
        learning_rate: float = 0.01,
        prior_frequency: float = 1e-3,
        spread: float | None = None,
        rule: StateRule | None = None,
        max_states: int | None = None,
        when_full: WhenFull | None = None,
        belief_tolerance: float = 0.0,
    ) -> None:
        self.radius = radius
        self.distance_weight = distance_weight
        self.learning_rate = learning_rate
        self.prior_frequency = prior_frequency
        self.spread = spread
        self.rule = rule
        self.max_states = max_states
        self.when_full = when_full
        self.belief_tolerance = belief_tolerance

    def fit(self, X: ArrayLike, y: object = None) -> Self:
        """Learn from the rows of X alone, whatever was learnt before.

        Parameters
        ----------
        X : (N, m) array_like
            Observations, in the order of time.
        y : object
            Not used.

        Returns
        -------
        EvolvingClusterer
            Itself.

        Raises
        ------
        TypeError, ValueError
            If X or a setting cannot be used.

        Examples
        --------
        >>> EvolvingClusterer(radius=0.5).fit([[0.0], [0.1], [2.0], [1.0]]).cluster_centers_
        array([[0.],
               [1.]])
        """
        return self._learn(X, anew=True)

    def partial_fit(self, X: ArrayLike, y: object = None) -> Self:
        """Go on learning, with rows that follow those learnt before.

        Parameters
        ----------
        X : (N, m) array_like
            Observations, in the order of time.
        y : object
            Not used.

        Returns
        -------
        EvolvingClusterer
            Itself.

        Raises
        ------
        TypeError, ValueError
            If X or a setting cannot be used, or X has another number of features than before.

        Examples
        --------
        >>> clusterer = EvolvingClusterer(radius=0.5).partial_fit([[0.0], [0.1]])
        >>> clusterer.partial_fit([[2.0], [1.0]]).labels_
        array([0, 1])
        """
        return self._learn(X, anew=not hasattr(self, "machine_"))

    def _learn(self, X: ArrayLike, anew: bool) -> Self:
        rows = self._checked(X, reset=anew)
        if anew:
            settings = self.get_params(deep=False).items()
            told = {name: value for name, value in settings if value is not None}
            self.machine_ = EvolvingFSM(n_actions=1, **told)
        trace = self.machine_.learn_many(rows, np.zeros(len(rows), np.int64))
        self.labels_ = trace.state
        return self

    def predict(self, X: ArrayLike) -> NDArray[np.int64]:
        """Index of the most probable state of each row; nothing is changed by asking.

        Parameters
        ----------
        X : (N, m) array_like
            Observations.

        Returns
        -------
        (N,) ndarray of int
            From 0, as rows of ``cluster_centers_``.

        Raises
        ------
        sklearn.exceptions.NotFittedError
            If nothing was learnt yet.
        TypeError, ValueError
            If X cannot be used, or has another number of features than what was learnt.

        Examples
        --------
        >>> clusterer = EvolvingClusterer(radius=0.5).fit([[0.0], [0.1], [2.0], [1.0]])
        >>> clusterer.predict([[0.2], [1.8]])
        array([0, 1])
        """
        return np.asarray(self.predict_proba(X).argmax(axis=1))

    def predict_proba(self, X: ArrayLike) -> NDArray[np.float64]:
        """Distribution over states of each row: how much it belongs to each.

        Parameters
        ----------
        X : (N, m) array_like
            Observations.

        Returns
        -------
        (N, n) ndarray
            A row sums to 1.

        Raises
        ------
        sklearn.exceptions.NotFittedError
            If nothing was learnt yet.
        TypeError, ValueError
            If X cannot be used, or has another number of features than what was learnt.

        Examples
        --------
        >>> clusterer = EvolvingClusterer(radius=0.5).fit([[0.0], [0.1], [2.0], [1.0]])
        >>> clusterer.predict_proba([[0.0], [0.5]]).round(3)
        array([[0.625, 0.375],
               [0.5  , 0.5  ]])
        """
        check_is_fitted(self)
        return self.machine_.model().recognise(self._checked(X, reset=False))

    @property
    def cluster_centers_(self) -> NDArray[np.float64]:
        """(n, m) ndarray: centres of the states."""
        return self.machine_.centers

    def _checked(self, X: ArrayLike, reset: bool) -> NDArray[np.float64]:
        # Kernels are made for arrays that may be written to; others would make them anew.
        wanted = {"dtype": np.float64, "order": "C", "force_writeable": True}
        return np.asarray(validate_data(self, X, reset=reset, **wanted))
