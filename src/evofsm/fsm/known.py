"""What a machine knows, and its snapshot: every array and every question to them once.

A machine reads them from its buffer, as it is at the moment; a model has arrays of its own.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, Literal, NamedTuple, Self, SupportsIndex, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from evofsm import store
from evofsm.fsm import chains
from evofsm.fsm.kernels import kernel
from evofsm.fsm.layout import Floats
from evofsm.fsm.learnt import Clusters, Counts, Transitions
from evofsm.fsm.rates import OnsetRates, shrunk_rates
from evofsm.fsm.states.clusters import measure_distances, nearest_center
from evofsm.fsm.states.dispatch import reach, restore_rule, weights
from evofsm.fsm.states.paper import Paper
from evofsm.fsm.states.rule import StateRule
from evofsm.fsm.states.spread import recognise
from evofsm.fsm.validation import (
    check_action,
    check_state,
    positive,
    real_array,
    refuse_unless_distribution,
    refuse_unless_told,
    refuse_unusable,
    whole,
)
from evofsm.store import Kind, Place

#: Which actions are taken: each alike, the first one again, or each as often as it was used.
Policy = Literal["marginal", "hold", "observed"]


class Nearest(NamedTuple):
    """The state that an observation is nearest to, in the scales of the rule."""

    state: int  #: its index
    distance: float  #: from its centre
    reach: float  #: how far from a centre an observation still belongs to the state

    @property
    def is_beyond(self) -> bool:
        """Whether no state reaches as far as the observation."""
        return self.distance > self.reach


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class Known(Counts):
    """The states, the transitions and the counts, and what can be asked of them.

    n is the number of states, m of variables, q of actions. Centres are in the units of the
    observations; distances and potentials as if all had the same unit, or are those of
    observations divided by the rule's scales. Rows of a matrix are "from", columns "to".

    Examples
    --------
    >>> from evofsm import EvolvingFSM
    >>> machine = EvolvingFSM(n_actions=2, radius=0.5)
    >>> trace = machine.learn_many([[0.0], [0.1], [2.0], [1.0]], [0, 0, 0, 0])
    >>> machine.n_states, machine.centers.ravel(), machine.uses
    (2, array([0., 1.]), array([3., 0.]))
    """

    centers: Floats  #: (n, m) the observation at the centre of each state
    potentials: Floats = Clusters.potentials  #: (n,) density of all observations at each centre
    width: float  #: of recognition: a squared distance, as the rule makes it of the spread
    #: (q, n, n) for each action, probabilities from state (row) to state (column); 1 / n where it
    #: was never used
    transition_matrices: Floats
    origin_frequency: Floats  #: (q, n) the paper's F_o, recency-weighted frequency of each row
    uses: Floats = Transitions.uses  #: (q,) transitions learnt with each action
    rule: StateRule = field(default_factory=Paper)  #: how states are determined
    #: whether anybody told of failures; where not, episodes without one are not known to be safe
    failures_told: bool = False
    settings: Mapping[str, Any] = field(default_factory=dict)  #: of the machine, by name
    #: how the system moves, what disturbs it and where it fails; None where nobody asked for that

    @property
    def n_states(self) -> int:
        """Number n of states."""
        return len(self.centers)

    @property
    def n_variables(self) -> int:
        """Number m of variables in an observation; of a machine 0 before the first."""
        return int(np.shape(self.centers)[1])

    @property
    def n_actions(self) -> int:
        """Number q of actions."""
        return len(self.uses)

    @property
    def failure_horizon(self) -> int | None:
        """Observations after which a failure no longer counts as soon; None for no limit."""
        horizon = self.settings.get("failure_horizon")
        return None if horizon is None else int(horizon)

    @property
    def joint_frequency(self) -> NDArray[np.float64]:
        """(q, n, n) ndarray: the paper's F, recency-weighted frequencies of transitions."""
        return np.asarray(self.origin_frequency[:, :, None] * self.transition_matrices)

    @property
    def marginal_matrix(self) -> NDArray[np.float64]:
        """(n, n) ndarray: the paper's P*, transition probabilities if all actions are alike."""
        return self.averaged_matrix("marginal")

    # -- Where it is ----------------------------------------------------------------------------

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

    # -- What comes next --------------------------------------------------------------------------

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
        return self._ahead(self._belief(belief), action, horizon, policy)

    def _ahead(
        self,
        there: NDArray[np.float64],
        action: SupportsIndex | None,
        horizon: int,
        policy: Policy,
    ) -> NDArray[np.float64]:
        """`propagate`, of a belief that is known to be one."""
        if policy not in get_args(Policy):
            known = ", ".join(get_args(Policy))
            raise ValueError(f"policy is {policy!r}; it must be one of {known}")
        steps = whole("horizon", horizon)
        if action is None and policy == "hold":
            raise ValueError("policy 'hold' needs the action that is held")
        if action is not None:
            first = self._matrix(self._index(action))
            there, steps = there @ first, steps - 1
        if steps:
            holds = action is not None and policy == "hold"
            then = first if holds else self.averaged_matrix(policy)
            there = there @ np.linalg.matrix_power(then, steps)
        return there

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
        if policy not in ("marginal", "observed"):
            raise ValueError(f"policy is {policy!r}; an average is 'marginal' or 'observed'")
        matrices, uses = self._matrices()
        if policy == "observed" and uses.sum() > 0.0:
            return np.asarray(np.tensordot(uses / uses.sum(), matrices, axes=1))
        unused = (self.n_actions - len(matrices)) / max(self.n_states, 1)
        return np.asarray((matrices.sum(axis=0) + unused) / self.n_actions)

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
        return chains.stationary(self.averaged_matrix(policy))

    def committor_forward(
        self,
        failure: Sequence[int] | None = None,
        before: Sequence[int] = (),
        action: SupportsIndex | None = None,
        policy: Policy = "observed",
    ) -> NDArray[np.float64]:
        """Probability to fail before the episode ends, from each state: 1 is a dead end.

        An observation in state i, of the ``visits[i]`` that there were, was the last of an episode
        that failed (``endings[i]``), the last of one that did not, or was followed by another
        (the sum of ``changes[i]``). With these shares f_i, s_i and c_i, ::

            q_i = f_i + c_i sum_j P_ij q_j,        q_i = 0 in the states ``before``

        Parameters
        ----------
        failure : sequence of int, optional
            States that count as failure in place of failures that were counted: q is 1 there, and
            an episode that ended elsewhere did not fail.
        before : sequence of int
            States that are safe: whoever gets there first has not failed.
        action : int, optional
            Index of the action that is taken in every state, from 0.
        policy : {"observed", "marginal"}
            Without an action, how actions are weighed, as in `averaged_matrix`.

        Returns
        -------
        (n,) ndarray
            The least solution: 0 where no failure can be reached.

        Raises
        ------
        TypeError
            If an action or a state is not an integer.
        ValueError
            If there is no such action, state or policy.

        Examples
        --------
        >>> from evofsm import EvolvingFSM, Novelty
        >>> machine = EvolvingFSM(n_actions=1, rule=Novelty(radius=1.0, spread=0.01))
        >>> Z = [[0.0], [2.0], [4.0], [0.0], [2.0], [0.0]]  # it failed at 4, and ended at 0
        >>> trace = machine.learn_many(Z, [0] * 6, episode_starts=[0, 3], failures=[2])
        >>> machine.model().committor_forward().round(2)
        array([0.5 , 0.75, 1.  ])
        """
        P = self.averaged_matrix(policy) if action is None else self._matrix(self._index(action))
        fails, ends = self._last_shares()
        if failure is not None:
            fails, ends = self._marked(failure).astype(np.float64), fails + ends
        safe = self._marked(before)
        fails = np.where(safe, 0.0, fails)
        goes_on = np.where(safe, 0.0, np.clip(1.0 - fails - ends, 0.0, 1.0))
        return chains.committor(goes_on[:, None] * P, fails)

    def _last_shares(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """(n,) shares of the observations in each state that ended in failure, or without one.

        Incomplete observations are no visits, and may lead to more changes than there were.
        """
        followed = self.changes.sum(axis=1)
        cases = np.maximum(self.visits, followed + self.endings)
        cases = np.where(cases > 0.0, cases, 1.0)
        ended = np.maximum(self.visits - followed - self.endings, 0.0)
        return self.endings / cases, ended / cases

    def mfpt(
        self,
        targets: Sequence[int],
        action: SupportsIndex | None = None,
        policy: Policy = "observed",
    ) -> NDArray[np.float64]:
        """Mean first passage time: observations until one of the targets, from each state.

        ``m_i = 1 + sum_j P_ij m_j``, and 0 in a target; the chain runs on without an end.

        Parameters
        ----------
        targets : sequence of int
            States, from 0.
        action : int, optional
            Index of the action that is taken in every state, from 0.
        policy : {"observed", "marginal"}
            Without an action, how actions are weighed, as in `averaged_matrix`.

        Returns
        -------
        (n,) ndarray
            Observations; infinity where it is not certain that a target is reached.

        Raises
        ------
        TypeError
            If an action or a state is not an integer.
        ValueError
            If there is no such action, state or policy.

        Examples
        --------
        >>> from evofsm import EvolvingFSM
        >>> machine = EvolvingFSM(n_actions=2, radius=0.5)
        >>> trace = machine.learn_many([[0.0], [0.1], [2.0], [1.0]], [0, 0, 0, 0])
        >>> machine.model().mfpt([1]).round(2)  # 1 / 0.229
        array([4.37, 0.  ])
        """
        P = self.averaged_matrix(policy) if action is None else self._matrix(self._index(action))
        return chains.passage_times(P, self._marked(targets))

    def simulate(
        self,
        n: int,
        start: SupportsIndex | None = None,
        policy: Policy = "marginal",
        seed: int | np.random.Generator | None = None,
    ) -> NDArray[np.int64]:
        """A run of the chain of states, drawn at random.

        Parameters
        ----------
        n : int
            Number of states, at least 1.
        start : int, optional
            The first one, from 0; without it, it is drawn from `stationary_distribution`.
        policy : {"marginal", "observed"}
            How actions are weighed, as in `averaged_matrix`.
        seed : int or Generator, optional
            The same gives the same run.

        Returns
        -------
        (n,) ndarray of int
            Indices of states.

        Raises
        ------
        TypeError
            If ``start`` is not an integer.
        ValueError
            If there is no such state or policy, or ``n`` is no whole number of at least 1.

        Examples
        --------
        >>> from evofsm import EvolvingFSM
        >>> machine = EvolvingFSM(n_actions=2, radius=0.5)
        >>> trace = machine.learn_many([[0.0], [0.1], [2.0], [1.0]], [0, 0, 0, 0])
        >>> run = machine.model().simulate(10000, start=0, policy="observed", seed=1)
        >>> np.bincount(run) / len(run)  # near `stationary_distribution`: 0.686, 0.314
        array([0.6804, 0.3196])
        """
        rng, steps, P = np.random.default_rng(seed), whole("n", n), self.averaged_matrix(policy)
        if start is None:
            first = int(rng.choice(self.n_states, p=chains.stationary(P)))
        else:
            first = check_state(start, self.n_states)
        return chains.path(P, first, steps, rng)

    # -- What was not expected --------------------------------------------------------------------

    def onset_rates(self, dt: float | None = None) -> OnsetRates:
        """How often something unexpected began in each state, shrunk towards the rate of all.

        Whoever has a model of how the system moves says so (`EvolvingFSM.onset`). The more was
        observed in a state, the more its own count says: see `evofsm.fsm.rates`.

        Parameters
        ----------
        dt : float, optional
            Time between two observations [s]; without it rates are per observation.

        Returns
        -------
        OnsetRates
            (n,) rates with 90 % intervals, and that of all states together.

        Raises
        ------
        ValueError
            If ``dt`` is not positive.

        Notes
        -----
        Exposure is all observations in a state.

        Examples
        --------
        >>> from evofsm import EvolvingFSM
        >>> machine = EvolvingFSM(n_actions=2, radius=0.5)
        >>> trace = machine.learn_many([[0.0], [0.1], [2.0], [1.0]], [0, 0, 0, 0])
        >>> machine.onset()
        >>> machine.onset_rates().rate.round(2)
        array([0.25, 0.25])
        """
        step = 1.0 if dt is None else positive("dt", dt)
        return shrunk_rates(self.onsets, self.visits * step)

    # -- Keeping it -----------------------------------------------------------------------------

    def save(self, path: Place, provenance: Mapping[str, Any] | None = None) -> None:
        """Write it to a file (arrays and a JSON header, nothing that can run).

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
        ...     machine.save(Path(folder) / "machine.evofsm")
        ...     again = EvolvingFSM.load(Path(folder) / "machine.evofsm")
        >>> again.observe([1.1]).surprise == machine.observe([1.1]).surprise
        True
        """
        store.write(path, self._kind, self._content, self._kept(), provenance)

    @classmethod
    def load(cls, path: Place) -> Self:
        """Read it from a file; a machine goes on bit for bit as if it had never been stopped.

        Parameters
        ----------
        path : str, path-like or binary file
            Name of the file.

        Returns
        -------
        EvolvingFSM or FSMModel
            As it was saved; a machine in the middle of its episode.

        Raises
        ------
        OSError
            If there is no such file, or it may not be read.
        ValueError
            If the file holds something else, is damaged, or of a newer version.

        Examples
        --------
        >>> import tempfile
        >>> from pathlib import Path
        >>> from evofsm import EvolvingFSM, FSMModel
        >>> model = EvolvingFSM(n_actions=2).model()
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     model.save(Path(folder) / "model.evofsm")
        ...     FSMModel.load(Path(folder) / "model.evofsm").n_actions
        2
        """
        content, arrays = store.read(path, cls._kind)
        with store.explained(path):
            refuse_unless_told(content.setdefault("failures_told", False))
            return cls._restored({**content, "rule": restore_rule(content["rule"])}, arrays)

    # -- Inside ---------------------------------------------------------------------------------

    _kind: ClassVar[Kind]

    @property
    def _content(self) -> dict[str, Any]:
        """All but the arrays, for JSON."""
        raise NotImplementedError

    def _kept(self) -> dict[str, NDArray[Any]]:
        """The arrays of a file."""
        raise NotImplementedError

    @classmethod
    def _restored(cls, content: dict[str, Any], arrays: dict[str, NDArray[Any]]) -> Self:
        """What was kept so."""
        raise NotImplementedError

    def _matrix(self, i: int) -> NDArray[np.float64]:
        """(n, n) transition probabilities under an action."""
        return np.asarray(self.transition_matrices[i])

    def _matrices(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """(s, n, n) and (s,): the matrices of all actions that were used, and their uses."""
        return self.transition_matrices, self.uses

    def _index(self, action: SupportsIndex) -> int:
        return check_action(action, self.n_actions)

    def _marked(self, states: Sequence[int]) -> NDArray[np.bool_]:
        """Whether each state is one of these."""
        marked = np.zeros(self.n_states, np.bool_)
        marked[[check_state(state, self.n_states) for state in states]] = True
        return marked

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
