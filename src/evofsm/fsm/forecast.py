"""Forecasts of the state some steps ahead, each horizon learnt by itself.

Powers of a machine's matrices (the paper's Section 2.3) forecast later steps poorly: each one
smears a belief once more, and forgets what a chain of states forgets. Here every horizon has
matrices of its own, which go from the belief then straight to the belief h steps later, and a
transition is counted by how likely it is, given both ends::

    xi_ij = tau_i P_ij gamma_j / (tau P)_j

This is the E-step of Baum and Welch (1970), taken online (Cappe & Moulines, J. R. Stat. Soc. B 71,
2009). It climbs the expected log score ``sum_j gamma_j log (tau P)_j``, which is concave in P, and
persistence is one P of those: where nothing better can be learnt, the forecast stays as good.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from evofsm.fsm import validation as valid
from evofsm.fsm.arrays import NO_ACTION
from evofsm.fsm.model import FSMModel
from evofsm.fsm.validation import Floats, whole

# So many transitions count as much as what is presumed: that an action leads where all lead
# together, and that a state stays, or goes to those near it.
_EVIDENCE = 0.3
# Share of transitions that are presumed to leave a state before any was seen.
_MOVED = 0.003
# What is believed less than this takes no part in learning.
_LEAST_BELIEF = 1e-3
# Share of where a state's transitions may lead that is spread over all states, however far.
_ANYWHERE = 1e-3
# In place of a forecast of 0, by which nothing can be divided.
_TINY = 1e-300


class Forecasts:
    """Forecasts of the state a number of steps ahead, learnt alongside a machine.

    They look at observations through a snapshot of the machine: hand over each episode when it is
    over, and the machine has learnt it. Counts forget nothing but states that were merged.

    Parameters
    ----------
    n_actions : int
        Number of actions, as the machine's.
    steps : sequence of int
        Horizons, in steps of the machine, each once.

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

    def __init__(self, n_actions: int, steps: Sequence[int] = (2, 4, 8, 20)) -> None:
        self.n_actions = whole("n_actions", n_actions)
        self.steps = tuple(whole("a horizon", h) for h in steps)
        if not self.steps or len(set(self.steps)) < len(self.steps):
            raise ValueError(f"steps are {tuple(steps)}; there must be one or more, each once")
        #: Number of states of the latest snapshot that was learnt through.
        self.n_states = 0
        self._created: Floats = np.zeros(0)  # when the states of that snapshot were created
        # (n, n) where a state's transitions are presumed to lead that leave it: to those near it.
        self._elsewhere: Floats = np.zeros((0, 0))
        # For each horizon, evidence that beliefs stay, and that they move; and (n, n) counts, by
        # action, with those of all actions together at NO_ACTION.
        self._moving = [np.array([1.0 - _MOVED, _MOVED]) for _ in self.steps]
        self._counts: list[dict[int, Floats]] = [{} for _ in self.steps]

    def learn(self, model: FSMModel, Z: ArrayLike, I: ArrayLike) -> None:
        """Learn an episode, from each row to those that come after it.

        Parameters
        ----------
        model : FSMModel
            Of the machine that has learnt these rows.
        Z, I
            As `EvolvingFSM.learn_many` takes them.
        """
        beliefs = model.recognise(valid.real_array("observations", Z, ndim=2, copy=False))
        actions = valid.check_actions(I, len(beliefs), self.n_actions)
        self.n_states = self._check_states(model.n_states)
        remains = np.resize(self._created, self.n_states) == model.created  # else merged, or new
        remain, self._created = np.outer(remains, remains), model.created
        near = model.recognise(model.centers)
        self._elsewhere = (1.0 - _ANYWHERE) * near + _ANYWHERE / self.n_states
        states = [np.flatnonzero(belief > _LEAST_BELIEF) for belief in beliefs]
        for horizon, steps in enumerate(self.steps):
            counts = self._counts[horizon]
            for action in {NO_ACTION, *actions.tolist()} | set(counts):
                old = counts.get(action, np.zeros((0, 0)))
                counts[action] = np.pad(old, (0, self.n_states - len(old))) * remain
            for before, row in enumerate(range(steps, len(beliefs))):
                arguments = beliefs[before], states[before], beliefs[row], states[row]
                self._learn(horizon, int(actions[before]), *arguments)

    def predict(self, belief: ArrayLike, i: ArrayLike | None, steps: int) -> Floats:
        """(n,) forecast of the state, or (T, n) of many; nothing is changed by asking.

        States created since nothing was learnt of stay as they are.

        Parameters
        ----------
        belief : (n,) or (T, n) array_like
            Present distribution over states, or many.
        i : int, or (T,) array_like of int, optional
            Action that is taken now. Without it, or where it is -1, all actions together answer.
        steps : int
            One of the horizons.
        """
        rows = valid.real_array("belief", np.atleast_2d(belief), ndim=2)
        valid.refuse_unless_distribution("belief", rows)
        self._check_states(rows.shape[1])
        if steps not in self.steps:
            horizons = ", ".join(map(str, self.steps))
            raise ValueError(f"there is no horizon of {steps} steps; there are {horizons}")
        indices = np.broadcast_to(np.asarray(NO_ACTION if i is None else i), len(rows))
        actions = valid.check_actions(indices, len(rows), self.n_actions)
        forecast, n = rows.copy(), np.arange(self.n_states)
        for action in np.unique(actions).tolist():
            block = np.ix_(actions == action, n)
            forecast[block] = rows[block] @ self._matrix(self.steps.index(steps), action, n, n)
        return forecast if np.ndim(belief) == 2 else forecast[0]

    def _matrix(self, horizon: int, action: int, i: Any, j: Any) -> Floats:
        """Transition probabilities from states i to j; presumed are those of all actions."""
        block, stays = np.ix_(i, j), i[:, None] == j
        share = self._moving[horizon][1] / self._moving[horizon].sum()
        matrix = share * self._elsewhere[block] + (1.0 - share) * stays
        for counts in (self._counts[horizon].get(key) for key in {NO_ACTION: 0, action: 0}):
            if counts is not None:
                weight = 1.0 / (counts[i].sum(axis=1, keepdims=True) + _EVIDENCE)
                matrix = (counts[block] + _EVIDENCE * matrix) * weight
        return np.asarray(matrix)

    def _learn(
        self, horizon: int, action: int, origin: Floats, i: Any, reached: Floats, j: Any
    ) -> None:
        """Count one transition from states i to states j, by how likely each pair is."""
        evidence, counts = self._moving[horizon], self._counts[horizon]
        keys = {NO_ACTION: 0, action: 0}
        likely = {key: origin[i, None] * self._matrix(horizon, key, i, j) for key in keys}
        share = evidence[1] / evidence.sum()
        stay = (1.0 - share) * origin[j]
        move = share * (origin[i] @ self._elsewhere[np.ix_(i, j)])
        gain = reached[j] / np.maximum(stay + move, _TINY)
        evidence += (gain * stay).sum(), (gain * move).sum()
        for key, pairs in likely.items():
            counts[key][np.ix_(i, j)] += pairs * (reached[j] / np.maximum(pairs.sum(axis=0), _TINY))

    def _check_states(self, n: int) -> int:
        """A number of states that can be of the same machine, later on."""
        if n < self.n_states:
            before = f"{self.n_states} were learnt (of another machine?)"
            raise ValueError(f"there are {n} states, but {before}")
        return n
