"""A judge that learns nothing, and the commonest of them: keep what a backup policy can save."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from studies.systems.system import Action, Box, Discrete, Vector

#: (k, m) states, and (k, d) or (k,) actions.
States = NDArray[np.float64]
# Actions of a box that are tried, in each of so many dimensions.
_TRIED = {1: 41, 2: 9}


class Executed(NamedTuple):
    """What a rival decided."""

    executed: Action


class Rival(ABC):
    """A judge that is told what it knows, and learns nothing."""

    told: str  #: in a few words

    def begin(self) -> None:  # noqa: B027
        """Begin an episode."""

    def decide(self, observation: Vector, proposal: Action) -> Executed:
        """What to execute instead of a proposal."""
        return Executed(self.action(observation, proposal))

    def end(  # noqa: B027
        self, failed: bool = False, observation: Vector | None = None
    ) -> None:
        """Nothing to learn."""

    def freeze(self) -> None:  # noqa: B027
        """Nothing to freeze."""

    @abstractmethod
    def action(self, observation: Vector, proposal: Action) -> Action:
        """The action to execute."""


class Unrevised(Rival):
    """Executes what is proposed."""

    told = "nothing"

    def action(self, observation: Vector, proposal: Action) -> Action:
        """The proposal."""
        return proposal


class BackupShield(Rival):
    """Executes the closest action after which a backup policy does not fail for a while.

    Where there is none, the action is taken after which the failure comes last. This is a
    predictive safety filter (Wabersich and Zeilinger 2021) with a single backup and no disturbance.

    Parameters
    ----------
    actions : Box or Discrete
    told : str
        What all that follows knows.
    move : callable
        From (k, m) states and k actions to the next states.
    fails : callable
        From (k, m) states to whether each has failed.
    backup : callable
        From (k, m) states to k actions.
    steps : int
        That the backup has to last.
    """

    def __init__(
        self,
        actions: Box | Discrete,
        told: str,
        *,
        move: Callable[[States, States], States],
        fails: Callable[[States], NDArray[np.bool_]],
        backup: Callable[[States], States],
        steps: int,
    ) -> None:
        self.told = told
        self._move, self._fails, self._backup = move, fails, backup
        self._steps = steps
        self._actions, self._tried = actions, tried(actions)

    def action(self, observation: Vector, proposal: Action) -> Action:
        """The proposal, or the closest action after which the backup lasts."""
        if self._lasts(observation, np.array([proposal], np.float64))[0] == self._steps:
            return proposal
        lasts = self._lasts(observation, self._tried)
        away = np.abs(self._tried - proposal).reshape(len(self._tried), -1).sum(axis=1)
        best = int(np.lexsort((away, -lasts))[0])
        return as_action(self._tried[best], self._actions)

    def _lasts(self, state: Vector, first: States) -> NDArray[np.int64]:
        """(k,) steps that are survived after each action."""
        states = self._move(np.repeat(state[None], len(first), axis=0), first)
        lasts = np.zeros(len(first), np.int64)
        alive = ~self._fails(states)
        for _ in range(self._steps):
            lasts += alive
            if not alive.any() or lasts.max() == self._steps:
                break
            states = self._move(states, self._backup(states))
            alive &= ~self._fails(states)
        return lasts


def tried(actions: Box | Discrete) -> States:
    """(k,) or (k, d) actions that stand for all."""
    if isinstance(actions, Discrete):
        return np.arange(actions.n_actions, dtype=np.float64)
    each = _TRIED[len(actions.low)]
    axes = [
        np.linspace(low, high, each) for low, high in zip(actions.low, actions.high, strict=True)
    ]
    return axes[0] if len(axes) == 1 else np.array(list(product(*axes)))


def as_action(value: States, actions: Box | Discrete) -> Action:
    """One of those that were tried, as it is executed."""
    if isinstance(actions, Discrete):
        return int(value)
    return float(value) if np.ndim(value) == 0 else value
