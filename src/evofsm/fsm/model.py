"""A frozen snapshot of a machine: what it knew, with labels, as a file can hold it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from evofsm.fsm.actions import IntervalActions
from evofsm.fsm.explanation import Explanation, explain
from evofsm.fsm.known import Known
from evofsm.fsm.layout import Array
from evofsm.fsm.learnt import MODEL, OF_MODEL
from evofsm.fsm.naming import Labels
from evofsm.fsm.notebook import model_html
from evofsm.fsm.states.dispatch import describe_rule
from evofsm.fsm.validation import (
    check_action,
    check_state,
    positive,
    refuse_more_failures,
    refuse_unless_distribution,
)


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class FSMModel(Known):
    """States and transitions as they stood when the snapshot was taken.

    Its parts are given by name; see `Known` and `Counts` for what they are. Arrays are read-only,
    and counts that are not given are 0.

    Raises
    ------
    ValueError
        If an array has not its shape, a number is out of its range in `core.learnt`, such as NaN
        or a count below 0, a row of a transition matrix is no distribution, more decisions failed
        than were taken, ``actions``, ``names`` or ``units`` are of another number than the arrays
        say, or ``dt`` is not positive and finite.

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

    actions: IntervalActions | None = None  #: what the action indices mean
    names: tuple[str, ...] = ()  #: of the m variables
    units: tuple[str, ...] = ()  #: of the m variables
    dt: float | None = None  #: time between two observations [s]
    _kind = MODEL

    def __post_init__(self) -> None:
        m, q = self.n_variables, self.n_actions
        sizes: dict[int | str, int] = {"n": self.n_states, "m": m, "q": q}
        arrays = {}
        for name, member in OF_MODEL.items():
            shape = tuple(sizes[letter] for letter in member.shape)
            given = getattr(self, name)
            array = np.zeros(shape) if isinstance(given, Array) else np.array(given, np.float64)
            if array.shape != shape:
                raise ValueError(f"{name} has shape {array.shape}, not {shape}")
            array.setflags(write=False)
            object.__setattr__(self, name, array)
            arrays[name] = array
        MODEL.refuse_others(self._content)
        for name, array in arrays.items():
            OF_MODEL[name].refuse_others(name, array, sizes)
        refuse_more_failures(self)
        counted = self.failures, self.endings, self.failed_soon
        told = bool(self.failures_told) or any(counts.any() for counts in counted)
        object.__setattr__(self, "failures_told", told)
        if self.n_states:
            refuse_unless_distribution("a row of transition_matrices", self.transition_matrices)
        for name in ("names", "units"):
            if len(getattr(self, name)) not in (0, m):
                raise ValueError(f"{name} are {getattr(self, name)}, but there are {m} variables")
        if self.dt is not None:
            object.__setattr__(self, "dt", positive("dt", self.dt))
        if self.actions is not None and self.actions.n_actions != q:
            raise ValueError(f"actions has {self.actions.n_actions} intervals for {q} matrices")

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

    def explain(
        self,
        situation: int | ArrayLike | None = None,
        action: int | None = None,
        *,
        observation: ArrayLike | None = None,
    ) -> Explanation:
        """What experience says of a situation: where it lies, and what came of being there.

        All of it was counted, once for each episode; see `evofsm.fsm.explanation`.

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

    def submodel(self, states: Sequence[int]) -> Self:
        """The model of some of its states, in the order in which they are named.

        Rows are those of the chain where it stays among these states: what leads elsewhere is left
        out, and the rest sums to 1. A row that leads only elsewhere has equal shares.

        Parameters
        ----------
        states : sequence of int
            Indices, from 0, each once.

        Returns
        -------
        FSMModel
            With the counts of these states; steps from and to others are left out of ``changes``.

        Raises
        ------
        TypeError
            If a state is not an integer.
        ValueError
            If there is no such state, or one is named twice.

        Examples
        --------
        >>> from evofsm import EvolvingFSM
        >>> machine = EvolvingFSM(n_actions=2, radius=0.5)
        >>> trace = machine.learn_many([[0.0], [0.1], [2.0], [1.0]], [0, 0, 0, 0])
        >>> part = machine.model().submodel([1])
        >>> part.centers, part.visits, part.transition_matrices.ravel()
        (array([[1.]]), array([1.]), array([1., 1.]))
        """
        chosen = [check_state(state, self.n_states) for state in states]
        if len(set(chosen)) < len(chosen):
            raise ValueError(f"states are {chosen}; each may be named once")
        parts: dict[str, Any] = {}
        for name, member in OF_MODEL.items():
            part = getattr(self, name)
            for axis, letter in enumerate(member.shape):
                part = part.take(chosen, axis) if letter == "n" else part
            parts[name] = part
        sums = parts["transition_matrices"].sum(axis=2, keepdims=True)
        rows = np.full_like(parts["transition_matrices"], 1.0 / max(len(chosen), 1))
        np.divide(parts["transition_matrices"], sums, out=rows, where=sums > 0.0)
        parts["transition_matrices"] = rows
        parts["origin_frequency"] = parts["origin_frequency"] * sums[..., 0]
        return replace(self, **parts)

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
            "rule": describe_rule(self.rule),
            "failures_told": self.failures_told,
        }

    def _kept(self) -> dict[str, NDArray[Any]]:
        return {name: getattr(self, name) for name in OF_MODEL}

    @classmethod
    def _restored(cls, content: dict[str, Any], arrays: dict[str, NDArray[Any]]) -> Self:
        if content["actions"] is not None:
            content["actions"] = _actions(content["actions"], len(arrays["uses"]))
        for name in ("names", "units"):
            content[name] = tuple(content[name])
        values: dict[str, Any] = {**content, **arrays}
        if lacking := {entry.name for entry in fields(cls)} - set(values):
            raise ValueError(f"it lacks {', '.join(sorted(lacking))}")
        return cls(**values)


def _actions(settings: Mapping[str, Any], q: int) -> IntervalActions:
    """A set of actions from a file, of as many intervals as there are matrices."""
    if (settings["high"] - settings["low"]) > (q + 1) * settings["width"]:
        raise ValueError(f"actions has more than {q} intervals, for {q} matrices")
    return IntervalActions(**settings)
