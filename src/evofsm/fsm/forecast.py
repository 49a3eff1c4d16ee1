"""Forecasts of the state some steps ahead, each horizon learnt by itself.

A machine's matrices say what the next step brings (the paper's Section 2.3). Raised to a power they
answer for later ones as well, but poorly: each step smears a belief once more, and what a Markov
chain of states forgets, such as whether one has been braking, stays forgotten. Here every horizon
has matrices of its own, which go from the belief then straight to the belief h steps later.

How a transition is counted is the other half. The paper counts from every state that was believed
in to every state that was reached, in proportion to both; the count is as wide as two beliefs and
forecasts are wider still. Here a transition is counted by how likely it is, given both ends::

    xi_ij = tau_i P_ij gamma_j / (tau P)_j

This is the E-step of Baum and Welch (1970), taken online. It climbs the expected log score
``sum_j gamma_j log (tau P)_j``, which is concave in P, and persistence is one of the P that it
climbs over: where nothing better can be learnt, the forecast stays as good as "it stays as it is".

References
----------
L. Baum, T. Petrie, G. Soules, N. Weiss, "A maximization technique occurring in the statistical
analysis of probabilistic functions of Markov chains", Ann. Math. Stat. 41 (1970).
O. Cappe, E. Moulines, "On-line expectation-maximization algorithm for latent data models",
J. R. Stat. Soc. B 71 (2009).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, SupportsIndex

import numpy as np
from numpy.typing import ArrayLike, NDArray

from evofsm.fsm.kernels import inner_kernel, kernel, lanes
from evofsm.fsm.learnt import NO_ACTION, NOT_OPEN
from evofsm.fsm.model import FSMModel
from evofsm.fsm.validation import (
    check_action,
    check_actions,
    check_rows,
    positive,
    real_rows,
    refuse_unless_distribution,
    whole,
)

# What is believed less than this takes no part in learning.
_LEAST_BELIEF = 1e-3
# Share of where a state's transitions may lead that is spread over all states, however far.
_ANYWHERE = 1e-3
# In place of a forecast of 0, by which nothing can be divided.
_TINY = 1e-300
# The place of an action without matrices.
_NOT_OPEN = int(NOT_OPEN)


class _Learnt(NamedTuple):
    """S horizons, the matrices of s actions, n of ``capacity`` states in use."""

    n_states: NDArray[np.int64]  # (1,)
    moving: NDArray[np.float64]  # (S, 2) evidence that beliefs stay, and that they move
    counts: NDArray[np.float64]  # (S, 1 + s, capacity, capacity), first those of all actions
    totals: NDArray[np.float64]  # (S, 1 + s, capacity) of each row
    places: NDArray[np.int64]  # (q,) of each action's counts, or _NOT_OPEN
    nearby: NDArray[np.float64]  # (capacity, capacity) belief of each state's centre


class _Room(NamedTuple):
    """Room to work in; worth nothing afterwards."""

    origins: NDArray[np.int64]  # (n,)
    targets: NDArray[np.int64]  # (n,)
    weights: NDArray[np.float64]  # (2, n) of the rows of origins, see `_weight`
    gains: NDArray[np.float64]  # (2, n)


class Forecasts:
    """Forecasts of the state a number of steps ahead, learnt beside a machine.

    They share the machine's states, and look at observations through a snapshot of it: hand over
    each episode when it is over, and the machine has learnt it. States that the machine gives up
    (``max_states``) are not followed: use them beside one that keeps all.

    Parameters
    ----------
    n_actions : int
        Number of actions, as the machine's.
    steps : sequence of int
        Horizons, in steps of the machine.
    evidence : float
        How many transitions count as much as what is presumed: that an action leads where all
        actions lead together, and that a state stays, or goes to those near it.
    moved : float
        Share of transitions that are presumed to leave a state before any was seen, in (0, 1). For
        each horizon it is learnt from there on.

    Raises
    ------
    ValueError
        If ``steps`` is empty, names a horizon twice or one below 1, another number is not positive,
        or ``moved`` is 1 or more.

    Notes
    -----
    Counts never forget, and every row of every matrix is a distribution. Memory is about
    ``8 * len(steps) * (1 + actions used) * n**2`` byte for n states.

    Examples
    --------
    >>> from evofsm import EvolvingFSM, Novelty
    >>> machine = EvolvingFSM(n_actions=1, rule=Novelty(radius=0.9, spread=0.3))
    >>> forecasts = Forecasts(n_actions=1, steps=[1, 2])
    >>> laps, actions = [[float(k % 4)] for k in range(60)], [0] * 60  # 0, 1, 2, 3, 0, 1 ...
    >>> trace = machine.learn_many(laps, actions)
    >>> forecasts.learn(machine.model(), laps, actions)
    >>> machine.state, int(forecasts.predict(machine.belief, 0, steps=2).argmax())
    (3, 1)
    """

    def __init__(
        self,
        n_actions: int,
        steps: Sequence[int] = (2, 4, 8, 20),
        evidence: float = 0.3,
        moved: float = 0.003,
    ) -> None:
        self.n_actions = whole("n_actions", n_actions)
        self.steps = tuple(whole("a horizon", h) for h in steps)
        if not self.steps or len(set(self.steps)) < len(self.steps):
            raise ValueError(f"steps are {tuple(steps)}; there must be one or more, each once")
        self.evidence = positive("evidence", evidence)
        self.moved = positive("moved", moved)
        if self.moved >= 1.0:
            raise ValueError(f"moved is {moved}; it must lie below 1")
        self._learnt = _blank(len(self.steps), self.n_actions, 0, 0)
        self._learnt.moving[:] = 1.0 - self.moved, self.moved
        self._learnt.places[:] = _NOT_OPEN

    @property
    def n_states(self) -> int:
        """Number of states of the latest snapshot that was learnt through."""
        return int(self._learnt.n_states[0])

    @property
    def nbytes(self) -> int:
        """Memory that holds what was learnt [byte]."""
        return sum(array.nbytes for array in self._learnt)

    def learn(
        self,
        model: FSMModel,
        Z: ArrayLike,
        I: ArrayLike,
        episode_starts: Sequence[int] | NDArray[np.integer] = (),
    ) -> None:
        """Learn an episode, or many, from each row to those that come after it.

        Nothing is learnt from the rows of one call to those of the next.

        Parameters
        ----------
        model : FSMModel
            Snapshot of the machine that has learnt these rows, ``machine.model()``.
        Z : (T, m) array_like
            Observations, evenly spaced in time, as the machine's.
        I : (T,) array_like of int
            The action taken after each row; -1 where none is known.
        episode_starts : (E,) array_like of int
            Rows at which an episode begins; the first one does anyway.

        Raises
        ------
        TypeError, ValueError
            If observations or actions are not what the machine could have learnt, or the model has
            fewer states than those before (of another machine?). Nothing is learnt then.

        Examples
        --------
        >>> from evofsm import EvolvingFSM, Novelty
        >>> machine = EvolvingFSM(n_actions=1, rule=Novelty(radius=0.9, spread=0.1))
        >>> Z, I = [[0.0], [1.0], [0.0], [1.0]], [0, 0, 0, 0]
        >>> trace = machine.learn_many(Z, I)
        >>> forecasts = Forecasts(n_actions=1, steps=[1])
        >>> forecasts.learn(machine.model(), Z, I)
        >>> forecasts.matrix(0, steps=1).round(1)
        array([[0. , 1. ],
               [0.9, 0.1]])
        """
        beliefs = np.atleast_2d(model.recognise(real_rows("observations", Z)))
        actions = check_actions(I, len(beliefs), self.n_actions)
        starts = check_rows("episode_starts", episode_starts, len(beliefs))
        n = self._check_states(model.n_states)
        self._make_room(n, actions)
        self._learnt.n_states[0] = n
        self._learnt.nearby[:n, :n] = model.recognise(model.centers)
        room = _Room(np.empty(n, np.int64), np.empty(n, np.int64), *np.empty((2, 2, n)))
        steps = np.array(self.steps)
        _learn_rows(self._learnt, steps, self.evidence, beliefs, actions, starts, room)

    def predict(self, belief: ArrayLike, i: ArrayLike | None, steps: int) -> NDArray[np.float64]:
        """Forecast the state; nothing is changed by asking.

        Parameters
        ----------
        belief : (n,) or (T, n) array_like
            Present distribution over states, or many.
        i : int, or (T,) array_like of int, optional
            Action that is taken now; what comes after it is not told, and goes as it usually went.
            Without it, or where it is -1, all actions together answer.
        steps : int
            One of the horizons.

        Returns
        -------
        (n,) or (T, n) ndarray
            Distribution over states that many steps later. States created since nothing was
            learnt of stay as they are.

        Raises
        ------
        TypeError, ValueError
            If the belief is no distribution, has fewer states than were learnt, or there is no such
            action or horizon.

        Examples
        --------
        >>> forecasts = Forecasts(n_actions=2, steps=[1])
        >>> forecasts.predict([0.3, 0.7], 0, steps=1)  # nothing was learnt
        array([0.3, 0.7])
        """
        rows = real_rows("belief", np.atleast_2d(belief))
        refuse_unless_distribution("belief", rows)
        self._check_states(rows.shape[1])
        given = np.broadcast_to(np.asarray(NO_ACTION if i is None else i), len(rows))
        actions = check_actions(given, len(rows), self.n_actions)
        predicted = np.zeros_like(rows)
        _predict_rows(self._learnt, self._horizon(steps), self.evidence, rows, actions, predicted)
        return predicted if np.ndim(belief) == 2 else predicted[0]

    def matrix(self, i: SupportsIndex | None, steps: int) -> NDArray[np.float64]:
        """(n, n) transition probabilities over a horizon, from state (row) to state (column).

        Parameters
        ----------
        i : int, optional
            Action taken at first; None for all together.
        steps : int
            One of the horizons.

        Returns
        -------
        (n, n) ndarray
            Each row a distribution.

        Raises
        ------
        TypeError, ValueError
            If there is no such action or horizon.

        Examples
        --------
        >>> forecasts = Forecasts(n_actions=1, steps=[2])
        >>> forecasts.matrix(None, steps=2).shape  # nothing was learnt
        (0, 0)
        """
        if self.n_states == 0:
            self._horizon(steps)
            return np.empty((0, 0))
        action = None if i is None else check_action(i, self.n_actions)
        actions = None if action is None else np.full(self.n_states, action)
        return self.predict(np.eye(self.n_states), actions, steps)

    def __repr__(self) -> str:
        return (
            f"{type(self).__name__}(n_actions={self.n_actions}, steps={self.steps}, "
            f"evidence={self.evidence}, moved={self.moved})"
        )

    # -- Inside ---------------------------------------------------------------------------------

    def _horizon(self, steps: int) -> int:
        """Index of a horizon."""
        if steps not in self.steps:
            known = ", ".join(map(str, self.steps))
            raise ValueError(f"there is no horizon of {steps} steps; there are {known}")
        return self.steps.index(steps)

    def _check_states(self, n: int) -> int:
        """A number of states that can be of the same machine, later on."""
        if n < self.n_states:
            raise ValueError(
                f"there are {n} states, but {self.n_states} were learnt (of another machine?)"
            )
        return n

    def _make_room(self, n: int, actions: NDArray[np.int64]) -> None:
        """Make room for as many states, and for the actions that are used for the first time."""
        learnt = self._learnt
        used = np.unique(actions[actions != NO_ACTION])
        fresh = used[learnt.places[used] == _NOT_OPEN]
        open_, capacity = learnt.counts.shape[1] - 1, len(learnt.nearby)
        if n <= capacity and len(fresh) == 0:
            return
        if n > capacity:
            capacity = lanes(max(n, capacity + capacity // 4))
        roomier = _blank(len(self.steps), self.n_actions, capacity, open_ + len(fresh))
        for old, new in zip(learnt, roomier, strict=True):
            new[tuple(slice(length) for length in old.shape)] = old
        roomier.places[fresh] = 1 + open_ + np.arange(len(fresh))
        self._learnt = roomier


def _blank(kinds: int, n_actions: int, capacity: int, places: int) -> _Learnt:
    return _Learnt(
        n_states=np.zeros(1, np.int64),
        moving=np.zeros((kinds, 2)),
        counts=np.zeros((kinds, 1 + places, capacity, capacity)),
        totals=np.zeros((kinds, 1 + places, capacity)),
        places=np.zeros(n_actions, np.int64),
        nearby=np.zeros((capacity, capacity)),
    )


# -- Kernels --------------------------------------------------------------------------------------


@kernel
def _learn_rows(
    learnt: _Learnt,
    steps: NDArray[np.int64],
    evidence: float,
    beliefs: NDArray[np.float64],
    actions: NDArray[np.int64],
    starts: NDArray[np.bool_],
    room: _Room,
) -> None:
    begin = 0
    for row in range(len(beliefs)):
        if starts[row]:
            begin = row
        for horizon in range(len(steps)):
            before = row - steps[horizon]
            if before >= begin:
                origin, action, reached = beliefs[before], actions[before], beliefs[row]
                _learn(learnt, horizon, evidence, origin, action, reached, room)


@inner_kernel
def _elsewhere(learnt: _Learnt, i: int, j: int) -> float:
    """Where a state's transitions are presumed to lead that leave it: to those near it."""
    return float((1.0 - _ANYWHERE) * learnt.nearby[i, j] + _ANYWHERE / learnt.n_states[0])


@inner_kernel
def _together(
    learnt: _Learnt, horizon: int, evidence: float, share: float, weight: float, i: int, j: int
) -> float:
    """Probability of a transition under all actions together, of which a share moves.

    ``weight`` is that of the row, see `_weight`.
    """
    presumed = share * _elsewhere(learnt, i, j) + (1.0 - share if i == j else 0.0)
    return float((learnt.counts[horizon, 0, i, j] + evidence * presumed) * weight)


@inner_kernel
def _under(
    learnt: _Learnt,
    horizon: int,
    evidence: float,
    place: int,
    together: float,
    weight: float,
    i: int,
    j: int,
) -> float:
    """Probability of a transition under one action, presumed to lead where all lead together."""
    return float((learnt.counts[horizon, place, i, j] + evidence * together) * weight)


@inner_kernel
def _weight(learnt: _Learnt, horizon: int, place: int, evidence: float, i: int) -> float:
    """By what counts of a row and what is presumed are multiplied to be probabilities."""
    return float(1.0 / (learnt.totals[horizon, place, i] + evidence))


@inner_kernel
def _share_moved(learnt: _Learnt, horizon: int) -> float:
    stayed, moved = learnt.moving[horizon, 0], learnt.moving[horizon, 1]
    return float(moved / (stayed + moved))


@inner_kernel
def _above(belief: NDArray[np.float64], least: float, found: NDArray[np.int64]) -> int:
    """Write which states are believed in more than that; returns how many."""
    n = 0
    for i in range(len(belief)):
        if belief[i] > least:
            found[n] = i
            n += 1
    return n


@inner_kernel
def _learn(
    learnt: _Learnt,
    horizon: int,
    evidence: float,
    origin: NDArray[np.float64],
    action: int,
    reached: NDArray[np.float64],
    room: _Room,
) -> None:
    """Count one transition, by how likely each pair of states is given both beliefs.

    ``gains`` are the ratios of what was reached to what was forecast, with which a transition of
    probability P from a state believed tau counts as ``tau P gain``.
    """
    n_origins = _above(origin, _LEAST_BELIEF, room.origins)
    n_targets = _above(reached, _LEAST_BELIEF, room.targets)
    place = learnt.places[action] if action != NO_ACTION else _NOT_OPEN
    share = _share_moved(learnt, horizon)
    for a in range(n_origins):
        i = room.origins[a]
        room.weights[0, a] = _weight(learnt, horizon, 0, evidence, i)
        if place != _NOT_OPEN:
            room.weights[1, a] = _weight(learnt, horizon, place, evidence, i)
    for b in range(n_targets):
        j = room.targets[b]
        moved = together_j = under_j = 0.0
        for a in range(n_origins):
            i = room.origins[a]
            together = _together(learnt, horizon, evidence, share, room.weights[0, a], i, j)
            moved += origin[i] * _elsewhere(learnt, i, j)
            together_j += origin[i] * together
            if place != _NOT_OPEN:
                weight = room.weights[1, a]
                under = _under(learnt, horizon, evidence, place, together, weight, i, j)
                under_j += origin[i] * under
        room.gains[0, b] = reached[j] / max(together_j, _TINY)
        room.gains[1, b] = reached[j] / max(under_j, _TINY)
        stayed, moved = (1.0 - share) * origin[j], share * moved
        either = max(stayed + moved, _TINY)
        learnt.moving[horizon, 0] += reached[j] * stayed / either
        learnt.moving[horizon, 1] += reached[j] * moved / either

    for a in range(n_origins):
        i = room.origins[a]
        total = total_under = 0.0
        for b in range(n_targets):
            j = room.targets[b]
            together = _together(learnt, horizon, evidence, share, room.weights[0, a], i, j)
            if place != _NOT_OPEN:
                weight = room.weights[1, a]
                under = _under(learnt, horizon, evidence, place, together, weight, i, j)
                counted = origin[i] * under * room.gains[1, b]
                learnt.counts[horizon, place, i, j] += counted
                total_under += counted
            counted = origin[i] * together * room.gains[0, b]
            learnt.counts[horizon, 0, i, j] += counted
            total += counted
        learnt.totals[horizon, 0, i] += total
        if place != _NOT_OPEN:
            learnt.totals[horizon, place, i] += total_under


@kernel
def _predict_rows(
    learnt: _Learnt,
    horizon: int,
    evidence: float,
    beliefs: NDArray[np.float64],
    actions: NDArray[np.int64],
    predicted: NDArray[np.float64],
) -> None:
    share = _share_moved(learnt, horizon)
    for row in range(len(beliefs)):
        place = learnt.places[actions[row]] if actions[row] != NO_ACTION else _NOT_OPEN
        for i in range(beliefs.shape[1]):
            believed = beliefs[row, i]
            if believed == 0.0:
                continue
            if i >= learnt.n_states[0]:
                predicted[row, i] += believed
                continue
            weight = _weight(learnt, horizon, 0, evidence, i)
            own = _weight(learnt, horizon, place, evidence, i) if place != _NOT_OPEN else 0.0
            for j in range(learnt.n_states[0]):
                likely = _together(learnt, horizon, evidence, share, weight, i, j)
                if place != _NOT_OPEN:
                    likely = _under(learnt, horizon, evidence, place, likely, own, i, j)
                predicted[row, j] += believed * likely
