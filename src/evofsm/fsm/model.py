"""A frozen snapshot of a machine, and every question that can be asked of what was learnt."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from functools import cached_property
from typing import Any, Self, SupportsIndex

import numpy as np
from numpy.typing import ArrayLike

from evofsm import store
from evofsm.fsm import validation as valid
from evofsm.fsm.actions import IntervalActions
from evofsm.fsm.arrays import MODEL, OF_MODEL
from evofsm.fsm.clusters import recognise_rows
from evofsm.fsm.explanation import Explanation, Nearest, explain
from evofsm.fsm.kernels import lanes
from evofsm.fsm.naming import Labels, in_a_line
from evofsm.fsm.rules import Paper, StateRule, describe_rule, reach, restore_rule, weights_of
from evofsm.fsm.validation import Floats
from evofsm.store import Place


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class FSMModel:
    """States and transitions as they stood when the snapshot was taken.

    `EvolvingFSM.model` takes it. n is the number of states, m of variables, q of actions. Distances
    and potentials are those of observations divided by the rule's scales. Rows of a matrix are
    "from", columns "to". Arrays are read-only.

    Counts never forget. An episode is counted once for each state it came to, and each action it
    took there, for its observations are no independent evidence; the one that is going on is not
    shown yet. It failed *soon* after it was in a state if that was at most ``failure_horizon``
    observations later; without that, if it failed at all.

    Examples
    --------
    >>> from evofsm import EvolvingFSM
    >>> machine = EvolvingFSM(n_actions=2, radius=0.5)
    >>> trace = machine.learn_many([[0.0], [0.1], [2.0], [1.0]], [0, 0, 0, 0], failures=[3])
    >>> model = machine.model(names=["gap"], units=["m"])
    >>> model.visits, model.endings, model.episodes, model.failed_soon
    (array([3., 1.]), array([0., 1.]), array([1., 1.]), array([1., 1.]))
    >>> model
    FSMModel(2 states of gap, 2 actions, 4 observations, Paper())
    >>> model.recognise([[0.0], [0.5]]).round(3)
    array([[0.625, 0.375],
           [0.5  , 0.5  ]])
    >>> model.propagate([1.0, 0.0], 0, horizon=20).round(3)
    array([0.578, 0.422])
    """

    centers: Floats  #: (n, m) the observation at the centre of each state
    potentials: Floats  #: (n,) density of all observations at each centre
    width: float  #: of recognition: a squared distance, as the rule makes it of the spread
    #: (q, n, n) probabilities from state (row) to state (column); 1 / n for an action never used
    transition_matrices: Floats
    origin_frequency: Floats  #: (q, n) the paper's F_o, recency-weighted frequency of each row
    uses: Floats  #: (q,) transitions learnt with each action
    rule: StateRule = field(default_factory=Paper)  #: how states are determined
    #: whether anybody told of failures; where not, episodes without one are not known to be safe
    failures_told: bool = False
    settings: Mapping[str, Any] = field(default_factory=dict)  #: of the machine, by name
    actions: IntervalActions | None = None  #: what the action indices mean
    names: tuple[str, ...] = ()  #: of the m variables
    units: tuple[str, ...] = ()  #: of the m variables
    dt: float | None = None  #: time between two observations [s]
    visits: Floats  #: (n,) observations in which each state was the most probable
    created: Floats  #: (n,) number of the observation that created each state, from 1
    changes: Floats  #: (n, n) steps from the most probable state to the next (column)
    decisions: Floats  #: (q, n) transitions that began in each state, by belief
    failures: Floats  #: (q, n) those of `decisions` that led straight into failure
    endings: Floats  #: (n,) failures whose last observation was recognised as each state
    episodes: Floats  #: (n,) episodes that came to each state
    failed_soon: Floats  #: (n,) those of `episodes` that failed soon after they were there
    joined: Floats  #: (n,) 1 where states were joined, so that an episode may count twice
    tried: Floats  #: (q, n) episodes that took each action in each state
    failed_after: Floats  #: (q, n) those of `tried` that failed soon after they did

    def __post_init__(self) -> None:
        for name in OF_MODEL:
            getattr(self, name).setflags(write=False)
        MODEL.refuse_others(self._content)
        m, q = self.n_variables, self.n_actions
        for name in ("names", "units"):
            if len(getattr(self, name)) not in (0, m):
                raise ValueError(f"{name} are {getattr(self, name)}, but there are {m} variables")
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
    def labels(self) -> Labels:
        """What its numbers mean."""
        return Labels(self.actions, self.names, self.units, self.dt)

    @property
    def joint_frequency(self) -> Floats:
        """(q, n, n) the paper's F, recency-weighted frequencies of transitions."""
        return np.asarray(self.origin_frequency[:, :, None] * self.transition_matrices)

    @property
    def marginal_matrix(self) -> Floats:
        """(n, n) the paper's P*, transition probabilities if all actions are alike."""
        return np.asarray(self.transition_matrices.mean(axis=0))

    def recognise(self, z: ArrayLike) -> Floats:
        """(n,) belief of an observation (m,), or (N, n) of many: the paper's Section 2.2.2."""
        belief = believed(*self._places, self._rows(z), self.width)
        return belief if np.ndim(z) == 2 else belief[0]

    def nearest(self, z: ArrayLike) -> Nearest:
        """Which state an observation (m,) is nearest to, and how far a state reaches."""
        rows = self._rows(z)
        if len(rows) != 1:
            raise ValueError(f"z holds {len(rows)} observations; one is asked for")
        offsets = (self.centers - rows[0]) * weights_of(self.rule, self.n_variables)
        distances = np.sqrt(np.square(offsets).sum(axis=1))
        state = int(distances.argmin())
        return Nearest(state, float(distances[state]), reach(self.rule, self.settings, self.width))

    def propagate(
        self, belief: ArrayLike, action: SupportsIndex | None = None, horizon: int = 1
    ) -> Floats:
        """(n,) distribution over states some steps later: the paper's Section 2.3.2.

        Parameters
        ----------
        belief : (n,) array_like
            Present distribution over states.
        action : int, optional
            Index of the first step's action, from 0; without it all count alike there, too.
        horizon : int
            Number of steps, at least 1.
        """
        there, steps = self._belief(belief), valid.whole("horizon", horizon)
        if action is not None:
            there = there @ self.transition_matrices[valid.check_action(action, self.n_actions)]
            steps -= 1
        return np.asarray(there @ np.linalg.matrix_power(self.marginal_matrix, steps))

    @property
    def averaged_matrix(self) -> Floats:
        """(n, n) transition probabilities, each action counted as often as it was taken there.

        Where none was, it is `marginal_matrix`.
        """
        weights = np.where(self.decisions.any(axis=0), self.decisions, 1.0)
        weights /= weights.sum(axis=0)
        return np.asarray(np.einsum("qi,qij->ij", weights, self.transition_matrices))

    def explain(
        self,
        situation: int | ArrayLike | None = None,
        action: SupportsIndex | None = None,
        *,
        observation: ArrayLike | None = None,
    ) -> Explanation:
        """What experience says of a situation: where it lies, and what came of being there.

        Parameters
        ----------
        situation : int or (n,) array_like, optional
            A state, or a distribution over states.
        action : int, optional
            What came of taking it there.
        observation : (m,) array_like, optional
            What was observed, in place of a situation.

        Examples
        --------
        >>> from evofsm import EvolvingFSM
        >>> machine = EvolvingFSM(n_actions=2, radius=0.5)
        >>> Z, I = [[0.0], [0.1], [2.0], [1.0]], [0, 1, 0, 0]
        >>> trace = machine.learn_many(Z, I, episode_starts=[0, 2], failures=[3])
        >>> model = machine.model(names=["gap"], units=["m"], dt=0.1)
        >>> print(model.explain([0.2, 0.8], action=1))
        #2: gap 1 m (belief 80 %, next #1 20 %). 1 episode came here (1 observation);
        1 of 1 (at least 5 %) failed later on; none of them is known to have tried a(2) here.
        Most often reached from #1: 1 of 1 times.
        >>> print(model.explain(observation=[30.0]))
        Never seen, as far as the states tell: 29 from the nearest, #2 (gap 1 m), where a state
        reaches 2.8.
        """
        index = None if action is None else valid.check_action(action, self.n_actions)
        if (situation is None) == (observation is None):
            raise ValueError("give either a situation or an observation")
        nearest = None if observation is None else self.nearest(observation)
        if observation is not None:
            belief = np.ravel(self.recognise(observation))
        elif np.ndim(situation) == 0:  # type: ignore[arg-type] # it is given
            state = valid.check_index("state", situation, self.n_states, valid.state_name)
            belief = np.eye(self.n_states)[state]
        else:
            belief = self._belief(situation)
        return explain(self, belief, index, self.labels, nearest)

    def __repr__(self) -> str:
        variables = in_a_line(", ".join(self.names)) or f"{self.n_variables} variables"
        return (
            f"{type(self).__name__}({self.n_states} states of {variables}, "
            f"{self.n_actions} actions, {self.visits.sum():.0f} observations, {self.rule})"
        )

    def __deepcopy__(self, memo: Any) -> Self:
        """Itself: nothing in it ever changes."""
        return self

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        self.__post_init__()  # arrays that were pickled can be written to

    def save(self, path: Place, provenance: Mapping[str, Any] | None = None) -> None:
        """Write it to a file.

        Parameters
        ----------
        path, provenance
            As `EvolvingFSM.save` takes them.
        """
        if type(self.actions) not in (IntervalActions, type(None)):
            name = type(self.actions).__name__
            raise ValueError(f"actions are {name}, which a file would hold as IntervalActions")
        arrays = {name: getattr(self, name) for name in OF_MODEL}
        store.write(path, MODEL, self._content, arrays, provenance)

    @classmethod
    def load(cls, path: Place) -> Self:
        """Read it from a file, as `EvolvingFSM.load` does."""
        content, arrays = store.read(path, MODEL)
        with store.explained(path):
            if (actions := content.get("actions")) is not None:
                content["actions"] = IntervalActions(**actions)
            content |= {name: tuple(content[name]) for name in ("names", "units")}
            content["rule"] = restore_rule(content["rule"])
            return cls(**content | arrays)

    @property
    def _content(self) -> dict[str, Any]:
        return {name: getattr(self, name) for name in ("width", "dt", "failures_told")} | {
            **{name: list(getattr(self, name)) for name in ("names", "units")},
            "actions": None if self.actions is None else asdict(self.actions),
            "rule": describe_rule(self.rule),
            "settings": dict(self.settings),
        }

    @cached_property
    def _places(self) -> tuple[Floats, Floats]:
        """Centres (m, n), as kernels take them, and 1 / scale of each variable."""
        return np.array(self.centers.T, order="C"), weights_of(self.rule, self.n_variables)

    def _rows(self, z: ArrayLike) -> Floats:
        """(N, m) of one observation or many; refused where it is none."""
        array = valid.real_array("z", z, ndim=np.ndim(z))
        if array.ndim not in (1, 2) or array.shape[-1] != self.n_variables:
            raise ValueError(f"z has shape {array.shape}; a row needs {self.n_variables} variables")
        valid.refuse_unusable("z", array)
        if self.n_states == 0:
            raise ValueError("this model has no states: its machine had observed nothing")
        return np.atleast_2d(array)

    def _belief(self, belief: Any) -> Floats:
        array, n = np.asarray(belief, dtype=np.float64), self.n_states
        if array.shape != (n,):
            raise ValueError(f"belief has shape {array.shape}; the model has {n} states")
        if n:
            valid.refuse_unless_distribution("belief", array)
        return array


def believed(centers: Floats, weights: Floats, rows: Floats, width: float) -> Floats:
    """(N, n) beliefs of rows (N, m), given centres (m, n) and 1 / scale of each variable."""
    n = centers.shape[1]
    belief = np.empty((len(rows), lanes(n)))
    arguments = np.ascontiguousarray(centers), weights, np.ascontiguousarray(rows)
    recognise_rows(*arguments, float(width), n, belief)
    return belief[:, :n].copy()
