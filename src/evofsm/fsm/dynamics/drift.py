"""Drift: whether the system still moves as was learnt, and what becomes of it where it does not.

What a hundred episodes taught outweighs ten, and what contradicts it counts as an outlier. So a
correction of the model is learnt beside it, from the last few episodes alone. Where that would have
foreseen, an episode ahead, what surprised the model, the doubt grows (a cumulative sum, Page,
"Continuous inspection schemes", Biometrika 1954). Once it is large enough the model is corrected,
and what was unforeseen before stays what it was.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from evofsm.fsm.dynamics.consequents import (
    Consequents,
    Stretch,
    along,
    lags,
    n_products,
    residuals,
)
from evofsm.fsm.dynamics.regression import Sums, ridge

_Floats = NDArray[np.float64]

# Of what the last episodes said since a doubt began, what still counts an episode later.
_FADES = 0.95
# What is unforeseen counts from this share of an ordinary change on; a correction has to halve it.
_MATTERS, _HALVES = 0.5, 2.0
# Doubt, as the logarithm of a likelihood ratio, from which on a model is corrected; and the number
# of episodes before which it is still being learnt.
_DOUBT = 30.0
LEARNT = 20
# What corrections are held to 0 by: as many transitions, of products more; and how many there have
# to be.
_PRIOR, _SHY, _FIRST = 0.3, 30.0, 15


class Recent(NamedTuple):
    """What the last episodes said of the model: m variables, p features."""

    squares: _Floats  #: (p, p) sum of products of features
    products: _Floats  #: (p, m) and of features with changes
    doubt: _Floats  #: (m,) that a variable still moves as was learnt
    since: _Floats  #: (m,) the episode that brought it up, from 0

    @classmethod
    def nothing(cls, p: int, m: int, episode: int) -> Recent:
        """Before anything was seen, in this episode."""
        return cls(np.zeros((p, p)), np.zeros((p, m)), np.zeros(m), np.full(m, float(episode)))

    def overthrown(self) -> list[int]:
        """Variables that do not move any more as was learnt."""
        return np.flatnonzero(self.doubt > _DOUBT).tolist()


class Drift(NamedTuple):
    """A variable moves otherwise than it did."""

    variable: int
    since: int  #: the first episode in which it did, from 0
    noticed: int  #: the last episode before it was believed


def compared(
    recent: Recent,
    known: Consequents,
    sums: Sums,
    Z: _Floats,
    U: _Floats,
    episode: int,
    young: bool,
) -> Recent:
    """Take in an episode: T + 1 observations (T + 1, m), and actions (T, a).

    Rows in which something rests at an end, or changes more than it ordinarily does, say nothing.
    """
    length = len(U) - 1
    room = along(known, Z, U, length)
    features, moves = room.features[:, :length].T, room.move[:, :length].T
    after, change = Z[2:], np.diff(Z[1:], axis=0)
    says = (after > known.lowest + known.close) & (after < known.highest - known.close)
    says &= (change >= sums.least) & (change <= sums.most)
    rows = says.all(1)
    features, change = features[rows], change[rows]
    missed = change - moves[rows]
    size = np.maximum(np.maximum(sums.scale, _MATTERS * sums.unit), 1e-300)
    left = missed - features @ correction(recent, known.weights, sums, U.shape[1])
    gained = np.log1p((missed / size) ** 2) - _HALVES * np.log1p((left / size) ** 2)
    doubt = np.maximum(recent.doubt + gained.sum(0), 0.0) * (episode >= LEARNT)
    fades = _FADES if young or doubt.any() else 0.0  # before a doubt it moved as ever
    return Recent(
        fades * recent.squares + features.T @ features,
        fades * recent.products + features.T @ change,
        doubt,
        np.where(doubt > 0.0, recent.since, float(episode)),
    )


def correction(recent: Recent, weights: _Floats, sums: Sums, a: int) -> _Floats:
    """(p, m) what is to be added to the weights of the model.

    By ridge regression, about 0, in units of each feature's own variance. Latest
    changes and the action before, of ``a`` numbers, are not asked: they would foresee that what
    disturbs goes on. Products are asked only if they have to be.
    """
    found, m, n = np.zeros_like(weights), weights.shape[1], max(1.0, float(sums.squares[0, 0]))
    if recent.squares[0, 0] < _FIRST:
        return found
    size = np.diag(sums.squares) / n
    variance = np.maximum(size - (sums.squares[0] / n) ** 2, 1e-6 * size)
    variance[0] = 1.0
    held = _PRIOR * variance
    held[len(held) - n_products(m, a) :] *= _SHY
    latest = lags(m, a)
    held[latest] = 1e12 * np.maximum(size[latest], 1e-12)
    missed = recent.products - recent.squares @ weights
    with suppress(np.linalg.LinAlgError):  # numbers of sizes that have nothing in common
        found = ridge(recent.squares, missed, held)
    return found if np.isfinite(found).all() else np.zeros_like(found)


def as_it_was(
    one: Stretch, before: Consequents, after: Consequents, moved: Sequence[int], carried: bool
) -> Stretch:
    """A stretch with what was unforeseen in it by the model of then, if it is of then.

    It is not if the new model foresees better what those variables did that moved otherwise.
    """
    if len(one.unforeseen):
        return one
    was, now = np.zeros((2, len(one.actions) - 1, one.observations.shape[1]))
    for known, missed in ((before, was), (after, now)):
        residuals(known, one.observations, one.actions, len(missed), carried, missed)
    larger = np.abs(now[:, moved]).sum(0) > np.abs(was[:, moved]).sum(0)
    return one._replace(unforeseen=was) if larger.any() else one
