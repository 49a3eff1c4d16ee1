"""A clusterer of River: one observation at a time, as a dictionary of features."""

from __future__ import annotations

import math
from collections.abc import Hashable, Mapping, Sequence
from typing import Any

import numpy as np

from evofsm.extras import needs
from evofsm.fsm.machine import EvolvingFSM
from evofsm.fsm.rules import StateRule
from evofsm.fsm.validation import Floats, number

with needs("River", "river", "a clusterer of River"):
    from river import base


class RiverClusterer(base.Clusterer):
    """The states of an `EvolvingFSM` as the clusters of a River clusterer.

    A feature that is absent, None or NaN was *not observed*: such an observation is recognised by
    the features that are there, creates and moves no state, and teaches no transition to it.

    Parameters
    ----------
    features : sequence of hashable, optional
        Names of the features that are observed; without them, those of the first observation.
    radius, learning_rate, spread, rule, max_states : optional
        As `EvolvingFSM` takes them. All features count alike: scale them first.

    Its ``machine`` has one action: ``machine.predict(0)`` forecasts the next state.

    Examples
    --------
    >>> from river import stream
    >>> clusterer = RiverClusterer(radius=0.5)
    >>> for x, _ in stream.iter_array([[0.0], [0.1], [2.0], [1.0]], feature_names=["gap"]):
    ...     clusterer.learn_one(x)
    >>> clusterer.predict_one({"gap": 0.2}), clusterer.predict_one({"gap": 1.8})
    (0, 1)
    """

    def __init__(
        self,
        features: Sequence[Hashable] | None = None,
        radius: float | None = None,
        learning_rate: float = 0.01,
        spread: float | None = None,
        rule: StateRule | None = None,
        max_states: int | None = None,
    ) -> None:
        if features is not None and not 0 < len(set(features)) == len(features):
            raise ValueError(f"features are {features}; they must be different names, at least one")
        self.features = features
        self.radius, self.learning_rate, self.spread = radius, learning_rate, spread
        self.rule, self.max_states = rule, max_states
        settings = {name: value for name, value in self._get_params().items() if name != "features"}
        self.machine = EvolvingFSM(n_actions=1, **settings)
        self._observed = () if features is None else tuple(features)

    def learn_one(self, x: Mapping[Hashable, Any]) -> None:
        """Observe; until all features were observed at once, what is incomplete is passed over."""
        if not self._observed:  # sorted, so that the order of the first does not matter either
            self._observed = tuple(sorted(x, key=str))
        if not self._observed:
            return
        z = self._vector(x)
        if self.machine.n_states or not np.isnan(z).any():
            self.machine.observe(z, partial=True)
            self.machine.act(0)  # a clusterer acts on nothing: there is one action

    @property
    def centers(self) -> dict[int, dict[Hashable, float]]:
        """The centre of each state by feature, as River's metrics of clusterers ask for them."""
        rows = enumerate(self.machine.centers.tolist())
        return {k: dict(zip(self._observed, row, strict=True)) for k, row in rows}

    def predict_one(self, x: Mapping[Hashable, Any]) -> int:
        """Index of the most probable state; 0 before anything was learnt."""
        belief = self._recognise(x)
        return int(belief.argmax()) if len(belief) else 0

    def predict_proba_one(self, x: Mapping[Hashable, Any]) -> dict[int, float]:
        """Distribution over states: how much an observation belongs to each."""
        return dict(enumerate(self._recognise(x).tolist()))

    def _recognise(self, x: Mapping[Hashable, Any]) -> Floats:
        """(n,) belief, as `learn_one` would have it, but for what that would teach."""
        if self.machine.n_states == 0:
            return np.empty(0)
        z = self._vector(x)
        if np.isnan(z).any():  # a machine learns nothing from these, but its belief changes
            return self.machine.copy().observe(z, partial=True).belief
        return self.machine.model().recognise(z)

    def _vector(self, x: Mapping[Hashable, Any]) -> Floats:
        """The features in their order, NaN for those that were not observed."""
        z = np.full(len(self._observed), np.nan)
        hint = " (river.preprocessing.OneHotEncoder makes numbers of categories)"
        for k, name in enumerate(self._observed):
            if x.get(name) is not None:
                z[k] = number(f"feature {name!r}", x[name], hint)
            if math.isinf(z[k]):
                raise ValueError(f"feature {name!r} is infinite; it must be finite")
        return z
