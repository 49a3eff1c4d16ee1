"""A frozen snapshot of a machine, with the analysis that a finite Markov chain allows."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from evofsm.core.actions import IntervalActions
from evofsm.core.explanation import Explanation, Nearest, explain
from evofsm.core.kernels import kernel
from evofsm.core.naming import Labels
from evofsm.core.notebook import model_html
from evofsm.core.states.clusters import measure_distances, nearest_center
from evofsm.core.states.dispatch import describe, reach, restore, weights
from evofsm.core.states.ets import Paper
from evofsm.core.states.rule import StateRule
from evofsm.core.states.spread import recognise
from evofsm.core.transitions import Policy, marginal, propagate
from evofsm.core.validation import (
    check_action,
    check_state,
    positive,
    real_array,
    refuse_more_failures,
    refuse_unless_distribution,
    refuse_unless_told,
    refuse_unusable,
)
from evofsm.files import ranges, storage

_COUNTS = (
    "decisions",
    "failures",
    "endings",
    "episodes",
    "failed_soon",
    "joined",
    "tried",
    "failed_after",
)


def _no_counts() -> NDArray[np.float64]:
    return np.empty(0)


@dataclass(frozen=True, eq=False, repr=False)
class FSMModel:
    """States and transitions as they stood when the snapshot was taken.

    n is the number of states, m of variables, q of actions. Arrays are read-only. Centres are in
    the units of the observations; distances and potentials as if all had the same unit, or are
    those of observations divided by the rule's scales. Without counts of outcomes they are 0. An
    episode failed *soon* after it was in a state if no more than ``failure_horizon`` observations
    lay between, of ``settings``; where that is not set, if it failed at all. The episode that was
    going on when the snapshot was taken is not counted.

    Raises
    ------
    ValueError
        If an array has not its shape, a number is none that learning can leave, such as NaN or
        a count below 0 (`files.ranges`), a row of a transition matrix is no distribution, more
        decisions failed than were taken,
        ``actions``, ``names`` or ``units`` are of another number than the arrays say, or ``dt``
        is not positive and finite.

    Examples
    --------
    >>> from evofsm import EvolvingFSM
    >>> machine = EvolvingFSM(n_actions=2, radius=0.5)
    >>> trace = machine.learn_many([[0.0], [0.1], [2.0], [1.0]], [0, 0, 0, 0])
    >>> model = machine.model(names=["gap"], units=["m"])
    >>> model
    FSMModel(2 states of gap, 2 actions, 4 observations, Paper(memory=None))
    >>> model.n_states, model.visits, model.founded
    (2, array([3., 1.]), array([1., 4.]))
    """

    centers: NDArray[np.float64]  #: (n, m) observation at the centre of each state
    potentials: NDArray[np.float64]  #: (n,) density of all observations at each centre
    width: float  #: of recognition: a squared distance, as the rule makes it of the spread
    transition_matrices: NDArray[np.float64]  #: (q, n, n) from state (row) to state (column)
    origin_frequency: NDArray[np.float64]  #: (q, n) recency-weighted frequency of each row
    uses: NDArray[np.float64]  #: (q,) transitions learnt with each action
    visits: NDArray[np.float64]  #: (n,) observations in which a state was the most probable
    founded: NDArray[np.float64]  #: (n,) number of the observation that founded it, from 1
    changes: NDArray[np.float64]  #: (n, n) steps from the most probable state (row) to the next
    actions: IntervalActions | None = None  #: what the action indices mean
    names: tuple[str, ...] = ()  #: of the m variables
    units: tuple[str, ...] = ()  #: of the m variables
    dt: float | None = None  #: time between two observations [s]
    settings: Mapping[str, float] = field(default_factory=dict)  #: of the machine it is from
    decisions: NDArray[np.float64] = field(default_factory=_no_counts)  #: (q, n) transitions begun
    failures: NDArray[np.float64] = field(default_factory=_no_counts)  #: (q, n) that led to failure
    endings: NDArray[np.float64] = field(default_factory=_no_counts)  #: (n,) failures ended in it
    episodes: NDArray[np.float64] = field(default_factory=_no_counts)  #: (n,) that came to it
    #: (n,) of these, those that failed soon after they were there
    failed_soon: NDArray[np.float64] = field(default_factory=_no_counts)
    #: (n,) 1 where two states were joined, so that an episode may count twice
    joined: NDArray[np.float64] = field(default_factory=_no_counts)
    tried: NDArray[np.float64] = field(default_factory=_no_counts)  #: (q, n) episodes that did it
    #: (q, n) of these, those that failed soon after they did
    failed_after: NDArray[np.float64] = field(default_factory=_no_counts)
    rule: StateRule = field(default_factory=Paper)  #: how its machine determines states
    #: whether anybody told of failures; where not, episodes without one are not known to be safe
    failures_told: bool = False

    def __post_init__(self) -> None:
        n, m, q = self.n_states, self.n_variables, self.n_actions
        shapes = {
            "centers": (n, m),
            "potentials": (n,),
            "transition_matrices": (q, n, n),
            "origin_frequency": (q, n),
            "uses": (q,),
            "visits": (n,),
            "founded": (n,),
            "changes": (n, n),
            "decisions": (q, n),
            "failures": (q, n),
            "endings": (n,),
            "episodes": (n,),
            "failed_soon": (n,),
            "joined": (n,),
            "tried": (q, n),
            "failed_after": (q, n),
        }
        for name, shape in shapes.items():
            array = np.array(getattr(self, name), dtype=np.float64)
            if name in _COUNTS and array.shape == (0,):
                array = np.zeros(shape)
            if array.shape != shape:
                raise ValueError(f"{name} has shape {array.shape}, not {shape}")
            array.setflags(write=False)
            object.__setattr__(self, name, array)
        ranges.refuse_others("model", self._content, {name: getattr(self, name) for name in shapes})
        refuse_more_failures(self)
        counted = self.failures, self.endings, self.failed_soon
        told = bool(self.failures_told) or any(counts.any() for counts in counted)
        object.__setattr__(self, "failures_told", told)
        if n:
            refuse_unless_distribution("a row of transition_matrices", self.transition_matrices)
        for name in ("names", "units"):
            if len(getattr(self, name)) not in (0, m):
                raise ValueError(f"{name} are {getattr(self, name)}, but there are {m} variables")
        if self.dt is not None:
            object.__setattr__(self, "dt", positive("dt", self.dt))
        if self.actions is not None and self.actions.n_actions != q:
            raise ValueError(f"actions has {self.actions.n_actions} intervals for {q} matrices")

    @property
    def n_states(self) -> int:
        """Number n of states."""
        return len(self.centers)

    @property
    def n_variables(self) -> int:
        """Number m of variables in an observation."""
        return int(np.shape(self.centers)[1])

    @property
    def n_actions(self) -> int:
        """Number q of actions."""
        return len(self.uses)

    @property
    def failure_horizon(self) -> int | None:
        """Observations after which a failure no longer counted as soon; None for no limit."""
        horizon = self.settings.get("failure_horizon")
        return None if horizon is None else int(horizon)

    @property
    def labels(self) -> Labels:
        """What its numbers mean."""
        return Labels(self.actions, self.names, self.units, self.dt)

    def __repr__(self) -> str:
        variables = ", ".join(self.names) or f"{self.n_variables} variables"
        return (
            f"{type(self).__name__}({self.n_states} states of {variables}, "
            f"{self.n_actions} actions, {self.visits.sum():.0f} observations, {self.rule})"
        )

    def _repr_html_(self) -> str:
        return model_html(self)

    def __deepcopy__(self, memo: Any) -> Self:
        """Itself: nothing in it ever changes."""
        return self

    def recognise(self, z: ArrayLike) -> NDArray[np.float64]:
        """Distribution over states for one observation or many; the states stay as they are.

        The paper's Section 2.2.2, with the width that the snapshot holds.

        Parameters
        ----------
        z : (m,) or (N, m) array_like
            One observation, or one per row, in the units of the machine's.

        Returns
        -------
        (n,) or (N, n) ndarray
            Distribution over states, one per row where many were given.

        Raises
        ------
        TypeError
            If ``z`` does not hold real numbers.
        ValueError
            If ``z`` has not m variables, an entry is NaN, infinite or beyond 1e100, or the model
            has no states.

        Examples
        --------
        >>> from evofsm import EvolvingFSM
        >>> machine = EvolvingFSM(n_actions=2, radius=0.5)
        >>> trace = machine.learn_many([[0.0], [0.1], [2.0], [1.0]], [0, 0, 0, 0])
        >>> machine.model().recognise([[0.0], [0.5], [1.0]]).round(3)
        array([[0.625, 0.375], [0.5  , 0.5  ], [0.375, 0.625]])
        """
        given, rows = self._observations(z)
        belief = np.empty((len(rows), self.n_states))
        centers = np.ascontiguousarray(self.centers.T)
        distances = np.empty(self.n_states)
        scaling = weights(self.rule, self.n_variables)
        recognise_rows(centers, scaling, rows.copy(), self.width, distances, belief)
        return belief if given.ndim == 2 else belief[0]

    def propagate(
        self,
        belief: ArrayLike,
        action: int | None = None,
        horizon: int = 1,
        policy: Policy = "marginal",
    ) -> NDArray[np.float64]:
        """Distribution over states ``horizon`` steps after ``belief``.

        The forecast equations of the paper's Section 2.3.2, from any belief.

        Parameters
        ----------
        belief : (n,) array_like
            Present distribution over states.
        action : int, optional
            Index of the first step's action, from 0; without it ``policy`` rules that step too.
        horizon : int
            Number of steps, at least 1.
        policy : {"marginal", "hold", "observed"}
            Actions after the first step: each alike (the paper's k-step equation), the first
            one again, or each as often as it was used.

        Returns
        -------
        (n,) ndarray
            Distribution over states: ``belief @ P[action] @ P*^(horizon - 1)``.

        Raises
        ------
        TypeError
            If ``action`` is not an integer.
        ValueError
            If ``belief`` is no distribution over the n states, there is no such action or
            policy, ``horizon`` is no whole number of at least 1, or ``"hold"`` has no action.

        Examples
        --------
        >>> from evofsm import EvolvingFSM
        >>> machine = EvolvingFSM(n_actions=2, radius=0.5)
        >>> trace = machine.learn_many([[0.0], [0.1], [2.0], [1.0]], [0, 0, 0, 0])
        >>> model = machine.model()
        >>> model.propagate([1.0, 0.0], 0).round(3)
        array([0.771, 0.229])
        >>> model.propagate([1.0, 0.0], 0, horizon=20, policy="hold").round(3)
        array([0.686, 0.314])
        """
        start = self._belief(belief)
        if action is not None:
            action = check_action(action, self.n_actions)
        matrix_of = self.transition_matrices.__getitem__
        return propagate(start, matrix_of, self.averaged_matrix, action, horizon, policy)

    def nearest(self, z: ArrayLike) -> Nearest:
        """Which state an observation is nearest to, how far that is, and how far a state reaches.

        Parameters
        ----------
        z : (m,) array_like
            Observation, as `recognise` takes it.

        Returns
        -------
        Nearest
            Distances are those of observations divided by the rule's scales.

        Raises
        ------
        TypeError, ValueError
            As `recognise`.

        Examples
        --------
        >>> from evofsm import EvolvingFSM, Novelty
        >>> machine = EvolvingFSM(n_actions=1, rule=Novelty(radius=1.0, scales=(2.0,)))
        >>> trace = machine.learn_many([[0.0], [1.9], [4.0]], [0, 0, 0])
        >>> machine.model().nearest([9.0])
        Nearest(state=1, distance=2.5, reach=1.0)
        """
        _, rows = self._observations(z)
        if len(rows) != 1:
            raise ValueError(f"z holds {len(rows)} observations; one is asked for")
        offsets = (self.centers - rows[0]) * weights(self.rule, self.n_variables)
        distances = np.sqrt(np.square(offsets).sum(axis=1))
        state = int(distances.argmin())
        return Nearest(state, float(distances[state]), reach(self.rule, self.width))

    def explain(
        self,
        situation: int | ArrayLike | None = None,
        action: int | None = None,
        *,
        observation: ArrayLike | None = None,
    ) -> Explanation:
        """What experience says of a situation: where it lies, and what came of being there.

        All of it was counted, once for each episode; see `evofsm.core.explanation`.

        Parameters
        ----------
        situation : int or (n,) array_like, optional
            A state, or a distribution over states, of which the most probable one is explained.
        action : int, optional
            Index of an action, from 0: what came of taking it there.
        observation : (m,) array_like, optional
            What was observed, in place of a situation: it is recognised, unless it is farther
            from every state than a state reaches, and so was never seen.

        Returns
        -------
        Explanation
            Its text is a sentence or two; its fields hold the numbers.

        Raises
        ------
        TypeError
            If ``action`` or a state is not an integer.
        ValueError
            If there is no such state or action, a belief is no distribution over the states, or
            not one of ``situation`` and ``observation`` is given.

        Examples
        --------
        >>> from evofsm import EvolvingFSM
        >>> machine = EvolvingFSM(n_actions=2, radius=0.5)
        >>> Z, I = [[0.0], [0.1], [2.0], [1.0]], [0, 1, 0, 0]
        >>> trace = machine.learn_many(Z, I, episode_starts=[0, 2], failures=[3])
        >>> model = machine.model(names=["gap"], units=["m"], dt=0.1)
        >>> print(model.explain(0))
        #1: gap 0 m. 2 episodes came here (3 observations); 1 of 2 (12 to 88 %) failed later on.
        >>> print(model.explain([0.2, 0.8], action=1))
        #2: gap 1 m (belief 80 %, next #1 20 %). 1 episode came here (1 observation);
        1 of 1 (at least 26 %) failed later on; none of them is known to have tried a(2) here.
        Most often reached from #1: 1 of 1 times.
        >>> print(model.explain(observation=[30.0]))
        Never seen, as far as the states tell: 29 from the nearest, #2 (gap 1 m), where a state
        reaches 2.8.
        """
        if action is not None:
            action = check_action(action, self.n_actions)
        if (situation is None) == (observation is None):
            raise ValueError("give either a situation or an observation")
        if situation is None:
            assert observation is not None
            nearest, belief = self.nearest(observation), self.recognise(observation)
            return explain(self, np.ravel(belief), action, self.labels, nearest)
        if np.ndim(situation) == 0:
            belief = np.eye(self.n_states)[check_state(situation, self.n_states)]
        else:
            belief = self._belief(situation)
        return explain(self, belief, action, self.labels)

    @property
    def _content(self) -> dict[str, Any]:
        """All but the arrays, for JSON."""
        return {
            "width": self.width,
            "actions": None if self.actions is None else asdict(self.actions),
            "names": self.names,
            "units": self.units,
            "dt": self.dt,
            "settings": dict(self.settings),
            "rule": describe(self.rule),
            "failures_told": self.failures_told,
        }

    def _observations(self, z: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """One observation or many, as given and row by row; refused where it is none."""
        given = real_array("z", z, ndim=np.ndim(z))
        rows = np.atleast_2d(given)
        if rows.ndim != 2 or rows.shape[1] != self.n_variables:
            raise ValueError(f"z has shape {given.shape}; a row needs {self.n_variables} variables")
        refuse_unusable("z", rows)
        if self.n_states == 0:
            raise ValueError("this model has no states: its machine had observed nothing")
        return given, rows

    def _belief(self, belief: ArrayLike) -> NDArray[np.float64]:
        """Refuse what is no distribution over the states."""
        given = np.asarray(belief, dtype=np.float64)
        if given.shape != (self.n_states,):
            raise ValueError(
                f"belief has shape {given.shape}; the model has {self.n_states} states"
            )
        if self.n_states:
            refuse_unless_distribution("belief", given)
        return given

    @property
    def marginal_matrix(self) -> NDArray[np.float64]:
        """(n, n) ndarray: the paper's P*, transition probabilities if all actions are alike."""
        return self.averaged_matrix("marginal")

    def averaged_matrix(self, policy: Policy = "observed") -> NDArray[np.float64]:
        """(n, n) transition probabilities, averaged over the actions.

        Parameters
        ----------
        policy : {"observed", "marginal"}
            Each action as often as it was used, or all alike (the paper's P*, Section 2.3.2).
            Where none was used yet, both are alike.

        Returns
        -------
        (n, n) ndarray
            From state (row) to state (column); a row sums to 1.

        Raises
        ------
        ValueError
            If there is no such policy.

        Examples
        --------
        >>> from evofsm import EvolvingFSM
        >>> machine = EvolvingFSM(n_actions=2, radius=0.5)
        >>> trace = machine.learn_many([[0.0], [0.1], [2.0], [1.0]], [0, 0, 0, 0])
        >>> model = machine.model()
        >>> model.averaged_matrix("observed")[0].round(3)  # action 0 was all it saw
        array([0.771, 0.229])
        >>> model.averaged_matrix("marginal")[0].round(3)
        array([0.636, 0.364])
        """
        return marginal(self.transition_matrices, self.uses, self.n_actions, policy)

    def stationary_distribution(self, policy: Policy = "marginal") -> NDArray[np.float64]:
        """(n,) share of time that the chain would spend in each state if it ran on for ever.

        Parameters
        ----------
        policy : {"marginal", "observed"}
            How actions are weighed, as in `averaged_matrix`.

        Returns
        -------
        (n,) ndarray
            The distribution that ``averaged_matrix(policy)`` leaves as it is.

        Raises
        ------
        ValueError
            If there is no such policy, or the chain falls apart into sets of states that never
            meet, so that it has more than one such distribution.

        Examples
        --------
        >>> from evofsm import EvolvingFSM
        >>> machine = EvolvingFSM(n_actions=2, radius=0.5)
        >>> trace = machine.learn_many([[0.0], [0.1], [2.0], [1.0]], [0, 0, 0, 0])
        >>> machine.model().stationary_distribution("observed").round(3)
        array([0.686, 0.314])
        """
        n = self.n_states
        if n == 0:
            return np.empty(0)
        balance = np.vstack([self.averaged_matrix(policy).T - np.eye(n), np.ones(n)])
        solution, _, rank, _ = np.linalg.lstsq(balance, np.append(np.zeros(n), 1.0))
        if rank < n:
            raise ValueError(
                "the chain has states that never meet: no single stationary distribution"
            )
        shares = np.clip(solution, 0.0, None)
        return np.asarray(shares / shares.sum())

    def save(self, path: storage.Place, provenance: Mapping[str, Any] | None = None) -> None:
        """Write the model to a file (arrays and a JSON header, nothing that can run).

        Parameters
        ----------
        path : str, path-like or binary file
            Name of the file, used as it is; a file of that name is replaced.
        provenance : mapping, optional
            What it learnt from, for JSON; `evofsm inspect` shows it.

        Raises
        ------
        OSError
            If the folder does not exist, or the file cannot be written. A file that was there
            before is then as it was.

        Examples
        --------
        >>> import tempfile
        >>> from pathlib import Path
        >>> from evofsm import EvolvingFSM
        >>> machine = EvolvingFSM(n_actions=2, radius=0.5)
        >>> trace = machine.learn_many([[0.0], [0.1], [2.0], [1.0]], [0, 0, 0, 0])
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     machine.model(names=["gap"]).save(Path(folder) / "model.evofsm")
        ...     FSMModel.load(Path(folder) / "model.evofsm").names
        ('gap',)
        """
        names = [entry.name for entry in fields(self) if entry.name not in self._content]
        arrays = {name: getattr(self, name) for name in names}
        storage.write(path, "model", self._content, arrays, provenance)

    @classmethod
    def load(cls, path: storage.Place) -> Self:
        """Read a model that was saved.

        Parameters
        ----------
        path : str, path-like or binary file
            Name of the file.

        Returns
        -------
        FSMModel
            The model as it was saved.

        Raises
        ------
        OSError
            If there is no such file, or it may not be read.
        ValueError
            If the file is not a model's, is damaged, or of a newer version.

        Examples
        --------
        >>> import tempfile
        >>> from pathlib import Path
        >>> from evofsm import EvolvingFSM
        >>> machine = EvolvingFSM(n_actions=2, radius=0.5)
        >>> trace = machine.learn_many([[0.0], [0.1], [2.0], [1.0]], [0, 0, 0, 0])
        >>> model = machine.model()
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     model.save(Path(folder) / "model.evofsm")
        ...     again = FSMModel.load(Path(folder) / "model.evofsm")
        >>> np.array_equal(again.transition_matrices, model.transition_matrices)
        True
        """
        content, arrays = storage.read(path, "model")
        with storage.explained(path):
            if content["actions"] is not None:
                content["actions"] = _actions(content["actions"], len(arrays["uses"]))
            for name in ("names", "units"):
                content[name] = tuple(content[name])
            content["rule"] = restore(content["rule"])
            refuse_unless_told(content.setdefault("failures_told", False))
            values: dict[str, Any] = {**content, **arrays}
            if lacking := {entry.name for entry in fields(cls)} - set(values):
                raise ValueError(f"it lacks {', '.join(sorted(lacking))}")
            return cls(**values)


def _actions(settings: Mapping[str, Any], q: int) -> IntervalActions:
    """A set of actions from a file, of as many intervals as there are matrices."""
    if (settings["high"] - settings["low"]) > (q + 1) * settings["width"]:
        raise ValueError(f"actions has more than {q} intervals, for {q} matrices")
    return IntervalActions(**settings)


@kernel
def recognise_rows(
    centers: NDArray[np.float64],
    weights: NDArray[np.float64],
    rows: NDArray[np.float64],
    width: float,
    squared_distances: NDArray[np.float64],
    belief: NDArray[np.float64],
) -> None:
    """Write the belief (N, n) of each row, given centres (m, n) and 1 / scale of each variable."""
    n = len(squared_distances)
    for row in range(len(rows)):
        measure_distances(centers, weights, n, rows[row], squared_distances)
        nearest = nearest_center(squared_distances, n)
        recognise(squared_distances, n, nearest, width, 0.0, belief[row])
