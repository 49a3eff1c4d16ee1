"""Backup policies: what could be done from now on, and how linear ones among them evolve.

With the share v_q(s) of the horizon that backup q survives from situation s, over some
disturbances, and a little for the distance to failure, the backups Q together are worth

    F(Q) = mean_s max_q v_q(s) + 0.01 sum_q mean_s v_q(s).

A mutant takes the place of the linear backup for which F grows most, if it grows. They are asked in
the order in which each adds most to F of those before it, the greedy order for a submodular
function (Nemhauser, Wolsey & Fisher 1978).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product
from typing import Self

import numpy as np
from numpy.typing import NDArray

from evofsm.guard.learnt.replay import Disturbances, Ends, Floats, Ints, Model, worth

# Linear policies; mutants that are tried an episode, and of those how many of the best one.
_LINEAR, _MUTANTS, _OF_BEST = 3, 40, 0.8
# A mutant differs in this share of its numbers, by a size of 10 to a power between these.
_CHANGED, _SIZES = 0.6, (-1.5, 0.7)
# What a policy is worth by itself counts so much, compared with what it adds to the others.
_BY_ITSELF = 0.01
# By so much less a linear policy wants the next of the choices.
_PREFERRED = 1e-9
# Digits of actions and scores: what differs by rounding alone is equal, in whatever units it comes.
_ROUNDED = 9
# Boxes of more dimensions have an action along each axis, not one in each corner.
_MOST_CORNERS = 3


@dataclass
class Backups:
    """Constant policies, and linear ones u = sat(b + K'z) that evolve by mutation.

    An order of variables and actions, and a direction of each, come from the first episode: so it
    makes no difference to what evolves in which order, unit or sign they come.
    """

    policies: Floats  #: (b, a, 1 + m), the constant ones first
    n_constant: int
    scores: Floats  #: (b,) what each adds to those before it
    variables: Ints  #: (m,) in their order
    flips: Floats  #: (m,) their directions, 1 or -1
    actions: Ints  #: (a,) in their order
    turns: Floats  #: (a,) their directions

    @classmethod
    def of(cls, z: Floats, u: Floats, *, choices: bool, evolving: bool = True) -> Backups:
        """Those that nothing was learnt of yet.

        Parameters
        ----------
        z, u : ndarray
            Observations and actions of the first episode.
        choices : bool
            Whether an action is one of a few: then the largest of b + K'z is taken.
        evolving : bool
            Whether there are linear ones.
        """
        a, m = u.shape[1], z.shape[1]
        off = z - z.mean(0)
        spread = np.sqrt((off**2).mean(0))
        pace = np.abs(np.diff(z, axis=0)).mean(0) / np.where(spread > 0.0, spread, 1.0)
        if choices:
            actions, turns, corners = _order(-u), np.ones(a), np.eye(a)
        else:
            actions, turns = _order(np.abs(u)), np.where(u.sum(0) < 0.0, -1.0, 1.0)
            ends = np.vstack([-np.eye(a), np.eye(a)])
            if a <= _MOST_CORNERS:
                ends = np.array(list(product((-1.0, 1.0), repeat=a)))
            corners = np.vstack([ends, np.zeros(a)])
        constants = np.empty_like(corners)
        constants[:, actions] = corners
        policies = np.zeros((len(constants) + (_LINEAR if evolving else 0), a, 1 + m))
        policies[: len(constants), :, 0] = constants * turns
        if choices:  # of equals the first in that order, whatever its index
            policies[:, actions, 0] -= _PREFERRED * np.arange(a)
        return cls(
            policies=policies,
            n_constant=len(constants),
            scores=np.full(len(policies), -np.inf),
            variables=np.argsort(pace, kind="stable"),
            flips=np.where((off**3).sum(0) < 0.0, -1.0, 1.0),
            actions=actions,
            turns=turns,
        )

    @classmethod
    def restored(
        cls, n_constant: int, m: int, a: int, arrays: dict[str, NDArray[np.float64]]
    ) -> Self:
        """Those that arrays of a file hold, of m variables and actions of a numbers.

        Raises
        ------
        ValueError
            If arrays contradict that, or each other: kernels check no index.
        """
        count, size, features = arrays["policies"].shape
        if (size, features) != (a, 1 + m):
            raise ValueError(f"backups are not of {m} variables and actions of {a} numbers")
        orders = {name: arrays[name].astype(int) for name in ("variables", "actions")}
        for name, order in orders.items():
            if sorted(order.tolist()) != list(range(len(order))):
                raise ValueError(f"{name} of the backups are in no order")
        if n_constant > count:
            raise ValueError(f"there are {count} backups, not {n_constant} constant ones")
        return cls(n_constant=n_constant, **{**arrays, **orders})

    @property
    def ranks(self) -> Ints:
        """(b,) ndarray of int: those first that add most to the ones before them."""
        return np.argsort(-self.scores, kind="stable")

    def evolved(
        self,
        model: Model,
        situations: Floats,
        disturbances: Disturbances,
        scale: float,
        random: np.random.Generator,
    ) -> Backups:
        """With mutants in the place of linear ones where all together are worth more then."""
        policies, ranks = self.policies.copy(), self.ranks
        linear = np.arange(self.n_constant, len(policies))
        ends = Ends.of(len(situations) * disturbances.residuals.shape[2])
        world = disturbances, scale, ends
        values = np.array([worth(model, situations, one, *world) for one in policies])
        for mutation in self._mutations(random) if len(linear) else ():
            parent = linear[values[linear].mean(1).round(_ROUNDED).argmax()]
            if random.random() >= _OF_BEST:
                parent = ranks[int(random.integers(len(policies)))]
            child = policies[parent] + mutation
            reached = worth(model, situations, child, *world)
            tried = np.repeat(values[None], 1 + len(linear), 0)  # as they are, and with the child
            tried[1 + np.arange(len(linear)), linear] = reached
            together = tried.max(1).mean(1) + _BY_ITSELF * tried.mean(2).sum(1)
            best = int(together.round(_ROUNDED).argmax())  # of equals the first: nothing changes
            if best:
                policies[linear[best - 1]], values[linear[best - 1]] = child, reached
        scores = np.empty(len(policies))
        left, most = list(range(len(values))), np.full(values.shape[1], -1.0)
        while left:  # first the one that is worth most, then whichever adds most
            adds = np.maximum(values[left] - most, 0.0).mean(1)
            adds = (adds + _BY_ITSELF * values[left].mean(1)).round(_ROUNDED)
            q = left.pop(int(adds.argmax()))
            scores[q] = adds.max()  # never more than that of the one before
            most = np.maximum(most, values[q])
        return replace(self, policies=policies, scores=scores)

    def _mutations(self, random: np.random.Generator) -> Floats:
        """(n, a, 1 + m) what mutants differ by."""
        shape = (_MUTANTS, *self.policies.shape[1:])
        size = 10.0 ** random.uniform(*_SIZES, _MUTANTS)[:, None, None]
        drawn = (random.random(shape) < _CHANGED) * size * random.standard_normal(shape)
        put: Floats = np.empty_like(drawn)
        put[:, self.actions[:, None], np.append(0, 1 + self.variables)] = drawn
        put *= np.append(1.0, self.flips) * self.turns[:, None]
        return put


def _order(rows: Floats) -> Ints:
    """Of columns by their mean, of equals by the first rows in which they differ."""
    exact = rows.round(_ROUNDED)
    return np.lexsort((*exact[::-1], exact.mean(0).round(_ROUNDED)))
