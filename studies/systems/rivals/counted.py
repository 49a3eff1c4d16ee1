"""A shield of states and counted matrices alone: the machine as a Markov decision process."""

from __future__ import annotations

from itertools import product

import numpy as np
from numpy.typing import NDArray

from evofsm.fsm import EvolvingFSM, Novelty
from studies.systems.rivals.rival import Executed, States
from studies.systems.system import Action, Box, Discrete, System, Vector

# A state reaches so far, in standard deviations of the first episode.
_RADIUS = 0.5
# So narrow that what is counted in a state is not spread over its neighbours, and forgotten there.
_SPREAD = 0.1
_MOST_STATES = 200
# Failure is one more state, so far away that nothing else is taken for it [standard deviations].
_AWAY = 1e3
# How far ahead it looks, in decisions, and the highest probability that it accepts.
_STEPS, _ACCEPTED = 50, 0.05
# Actions of a box that are told apart, about: as many along each axis, two of them at least.
_LEVELS = 9


class Counted:
    """Keeps the closest action under which failing soon is unlikely, by counts.

    The states are those of an `EvolvingFSM`, one of them the failure; its matrices say how likely
    it is to fail within some decisions if the action is taken now and the best ones afterwards
    (bounded reachability, as in shields of Markov decision processes: Jansen et al. 2020). The
    first episode sets the scales and is decided by nobody.

    Parameters
    ----------
    system : System
        Of which it is told the actions alone.
    """

    told = "nothing but failures"

    def __init__(self, system: System) -> None:
        self._discrete = isinstance(system.actions, Discrete)
        self._actions = _told_apart(system.actions)
        self._machine: EvolvingFSM | None = None
        self._failed_at: Vector = np.empty(0)
        self._risk: NDArray[np.float64] = np.empty((0, 0))  # (actions, states)
        self._seen: list[Vector] = []
        self._done: list[int] = []
        self._learn = True

    def begin(self) -> None:
        """Begin an episode."""
        self._seen, self._done = [], []

    def decide(self, observation: Vector, proposal: Action) -> Executed:
        """What to execute instead of a proposal."""
        wanted = np.atleast_1d(np.asarray(proposal, np.float64))
        away = np.abs(self._actions - wanted).sum(axis=1)
        action, executed = int(np.argmin(away)), proposal
        if len(self._risk):
            risk = self._risk @ self._model.recognise(observation)
            if risk[action] > _ACCEPTED:
                fine = risk <= max(_ACCEPTED, float(risk.min()))
                action = int(np.argmin(np.where(fine, away, np.inf)))
                executed = self._as_action(action)
        self._seen.append(np.array(observation))
        self._done.append(action)
        return Executed(executed)

    def _as_action(self, index: int) -> Action:
        value = self._actions[index]
        if self._discrete:
            return index
        return float(value[0]) if len(value) == 1 else value.copy()

    def end(self, failed: bool = False, observation: Vector | None = None) -> None:
        """Count the episode, and what it says of all others."""
        if not (self._learn and self._done):
            return
        machine = self._machine = self._machine or self._made()
        machine.start_episode()
        for seen, action in zip(self._seen, self._done, strict=True):
            machine.observe(seen)
            machine.act(action)
        if failed:
            machine.observe(self._failed_at)
        elif observation is not None:
            machine.observe(observation)
        self._plan()

    def freeze(self) -> None:
        """Learn nothing from now on."""
        self._learn = False

    def _made(self) -> EvolvingFSM:
        seen = np.array(self._seen)
        scales = np.maximum(seen.std(axis=0), 1e-6)
        self._failed_at = seen.mean(axis=0) + _AWAY * scales
        return EvolvingFSM(
            len(self._actions),
            rule=Novelty(_RADIUS, tuple(scales.tolist()), spread=_SPREAD),
            max_states=_MOST_STATES,
        )

    def _plan(self) -> None:
        """Probability of failing within some decisions, of each action in each state."""
        assert self._machine is not None
        self._model = self._machine.model()
        matrices = self._model.transition_matrices
        failure = int(self._model.recognise(self._failed_at).argmax())
        if not np.allclose(self._model.centers[failure], self._failed_at):
            return  # it has not failed yet
        soon = np.zeros(self._model.n_states)
        soon[failure] = 1.0
        for _ in range(_STEPS):
            risk = matrices @ soon
            risk[:, failure] = 1.0
            soon = risk.min(axis=0)
        self._risk = risk


def _told_apart(actions: Box | Discrete) -> States:
    """(k, d) actions that stand for all; of a box a grid, ends included."""
    if isinstance(actions, Discrete):
        return np.arange(actions.n_actions, dtype=np.float64)[:, None]
    each = max(2, round(_LEVELS ** (1.0 / len(actions.low))))
    ends = zip(actions.low, actions.high, strict=True)
    return np.array(list(product(*(np.linspace(low, high, each) for low, high in ends))))
