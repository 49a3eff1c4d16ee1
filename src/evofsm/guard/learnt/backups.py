"""Backup policies: what could be done from now on, constant or linear feedback that evolves."""

from __future__ import annotations

from collections.abc import Callable
from itertools import product

import numpy as np
from numpy.typing import NDArray

_Floats = NDArray[np.float64]

# Linear policies; mutants that are tried an episode, and of those how many of the best one.
_LINEAR, _MUTANTS, _OF_BEST = 3, 40, 0.8
# A mutant differs in this share of its numbers, by a size of 10 to a power between these.
_CHANGED, _SIZES = 0.6, (-1.5, 0.7)
# What a policy is worth by itself counts so much beside what it adds to the others.
_BY_ITSELF = 0.01
# By so much less a linear policy wants the next of the choices.
_PREFERRED = 1e-9
# Digits of actions and scores: what differs by rounding alone is equal, in whatever units it comes.
_ROUNDED = 9
# Boxes of more dimensions have an action along each axis, not one in each corner.
_MOST_CORNERS = 3


class Backups:
    """Constant policies, and linear ones u = sat(b + kᵀz) that evolve by mutation.

    Parameters
    ----------
    observations, actions : ndarray
        Of the first episode. From them comes an order of variables and actions, and a direction of
        each, that no one chose: so it makes no difference to what evolves in which order, unit or
        sign they come.
    choices : bool
        Whether an action is one of a few: then the largest of b + kᵀz is taken.
    evolving : bool
        Whether there are linear ones.
    """

    def __init__(
        self, observations: _Floats, actions: _Floats, *, choices: bool, evolving: bool = True
    ) -> None:
        a, m = actions.shape[1], observations.shape[1]
        off = observations - observations.mean(0)
        spread = np.sqrt((off**2).mean(0))
        pace = np.abs(np.diff(observations, axis=0)).mean(0) / np.where(spread > 0.0, spread, 1.0)
        self.variables = np.argsort(pace, kind="stable")
        self.flips = np.where((off**3).sum(0) < 0.0, -1.0, 1.0)
        if choices:
            self.actions = _order(-actions)
            self.turns = np.ones(a)
            corners = np.eye(a)
        else:
            self.actions = _order(np.abs(actions))
            self.turns = np.where(actions.sum(0) < 0.0, -1.0, 1.0)
            ends = np.vstack([-np.eye(a), np.eye(a)])
            if a <= _MOST_CORNERS:
                ends = np.array(list(product((-1.0, 1.0), repeat=a)))
            corners = np.vstack([ends, np.zeros(a)])
        constants = np.empty_like(corners)
        constants[:, self.actions] = corners
        self.n_constant = len(constants)
        self.policies = np.zeros((len(constants) + (_LINEAR if evolving else 0), a, 1 + m))
        self.policies[: len(constants), :, 0] = constants * self.turns
        if choices:  # of equals the first in that order, whatever its index
            self.policies[:, self.actions, 0] -= _PREFERRED * np.arange(a)
        #: What each adds to those before it.
        self.scores = np.full(len(self.policies), -np.inf)
        #: Of the policies, those first that add most to the ones before them.
        self.ranks = np.arange(len(self.policies))

    def evolve(self, value: Callable[[_Floats], _Floats], random: np.random.Generator) -> None:
        """Put mutants in the place of linear ones where all together are worth more then.

        ``value`` says how well a policy ends in each of some situations. Together they are worth
        what the best of them is in each situation: one that is like another adds nothing.
        """
        values = np.array([value(policy) for policy in self.policies])
        linear = np.arange(self.n_constant, len(self.policies))
        for _ in range(_MUTANTS if len(linear) else 0):
            parent = linear[values[linear].mean(1).round(_ROUNDED).argmax()]
            if random.random() >= _OF_BEST:
                parent = self.ranks[int(random.integers(len(self.policies)))]
            child = self.policies[parent] + self._mutation(random)
            reached = value(child)
            worth = [_together(np.vstack([reached, np.delete(values, q, 0)])) for q in linear]
            if max(worth) > _together(values):
                replaced = linear[int(np.argmax(worth))]
                self.policies[replaced], values[replaced] = child, reached
        self._rank(values)

    def _rank(self, values: _Floats) -> None:
        """First the one that is worth most, then whichever adds most to those before it."""
        left, best = list(range(len(values))), np.full(values.shape[1], -1.0)
        while left:
            adds = np.maximum(values[left] - best, 0.0).mean(1)
            adds = (adds + _BY_ITSELF * values[left].mean(1)).round(_ROUNDED)
            q = left.pop(int(adds.argmax()))
            self.scores[q] = adds.max()  # never more than that of the one before
            best = np.maximum(best, values[q])
        self.ranks = np.argsort(-self.scores, kind="stable")

    def _mutation(self, random: np.random.Generator) -> _Floats:
        shape = self.policies.shape[1:]
        size = 10.0 ** random.uniform(*_SIZES)
        drawn = (random.random(shape) < _CHANGED) * size * random.standard_normal(shape)
        put: _Floats = np.empty_like(drawn)
        put[np.ix_(self.actions, np.append(0, 1 + self.variables))] = drawn
        put *= np.append(1.0, self.flips) * self.turns[:, None]
        return put


def _together(values: _Floats) -> float:
    """Worth of policies in situations (q, r): the best in each, and a little of each by itself."""
    return round(float(values.max(0).mean() + _BY_ITSELF * values.mean(1).sum()), _ROUNDED)


def _order(rows: _Floats) -> NDArray[np.int64]:
    """Of columns by their mean, of equals by the first rows in which they differ."""
    exact = rows.round(_ROUNDED)
    return np.lexsort((*exact[::-1], exact.mean(0).round(_ROUNDED)))
