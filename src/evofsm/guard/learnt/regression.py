"""How the model is learnt, and doubted: sums to which every transition adds, solved now and then.

With features phi (`evofsm.guard.learnt.replay.features`) and changes dz of all transitions,

    W = (sum phi phi' + R)^-1 sum phi dz',

where R is a weak prior in each feature's own variance (`solve`). Sums of two models add up. A
transition is learnt when the one after it is known, for only then does it show whether it was a
jump: one that is far larger than what came before, what came after and what is ordinary. Jumps are
no dynamics: they enter neither sums, nor units, nor limits.

Once an episode it is asked whether the model still holds, whether its lags mislead, and whether
sensors are noisy. Doubts are cumulative sums of log likelihood ratios (Page, "Continuous inspection
schemes", Biometrika 1954): they grow with every episode that another model would have foreseen
better, and count from a threshold on.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from evofsm.guard.learnt.replay import (
    CLIP,
    JUMP,
    Floats,
    Ints,
    Model,
    Sums,
    features,
    lags,
    limited,
    n_products,
    pairs,
)

# From more on, large ones count in the ordinary change.
_MEAN = 20
# Of the variance of a feature: what every weight is held to 0 by; so many times that holds those
# that are asked only if they have to be, and the latest changes among them still more.
_RIDGE, _SHY, _LAGS = 1e-6, 30.0, 10.0
# The same over the number of transitions, if all is noise; the least share of that.
_PRIOR, _SHY_PRIOR, _CLEAREST = 0.01, 20.0, 1e-3
# The least variance of a feature, and what all weights are held to 0 by, of its mean square: far
# more than rounding, so that features that did not vary yet always share what they explain alike.
_LEAST, _ALL_ALIKE = 1e-6, 1e-10
# From so many features on BLAS would call threads for a matrix, which wait for a second where other
# processes are busy; from so many on, and of many variables, those are solved for together whose
# noise is as large to a third.
_LARGE, _THIRD = 100, 3.0
# From so many products on it would for features of all rows, too, and for so many rows it does not.
_THREADS, _ROWS = 7e5, 16


def early_unit(sums: Sums, n: int) -> Floats:
    """(m,) the ordinary change as long as only n changes are known: mostly their median."""
    known, spread = sums.early[:n], np.sqrt(sums.scatter / max(1.0, sums.counts[0]))
    unit = np.maximum(1.2 * np.median(known, 0), 1e-3 * spread)
    if n > _MEAN:
        unit = np.maximum(unit, np.minimum(known, CLIP * unit).sum(0) / n)
    return np.asarray(unit)


def jumps(change: Floats, unit: Floats) -> NDArray[np.bool_]:
    """(T, m) which changes (T, m) are far larger than those around them and the ordinary ones."""
    size = np.abs(change)
    before, after = np.vstack([size[:1], size[:-1]]), np.vstack([size[1:], 0.0 * size[-1:]])
    return np.asarray(size > JUMP * np.maximum(np.maximum(before, after), unit))


def solve(sums: Sums, a: int, without: Floats) -> Floats:
    """(p, m) weights: ridge regression, about 0, in units of each feature's own variance.

    What is true for all times is found soonest if bends, products and, last of all, latest changes
    are asked only if they have to be; else the first episodes say that one's own throttle speeds
    others up. The less of a variable's changes is noise, the less evidence its weights need.
    ``without`` (p,) is 1 for features that are left out, of actions of ``a`` numbers.
    """
    squares, n, m = sums.squares, max(1.0, float(sums.squares[0, 0])), len(sums.mean)
    size = np.diag(squares)
    variance = np.maximum(size - squares[0] ** 2 / n, _LEAST * size)
    variance[0] = 0.0
    shy = np.ones(len(size), bool)
    shy[: 1 + m] = shy[1 + 2 * m : 1 + 2 * m + a] = False
    times = np.ones(len(size))
    times[lags(m, a)] = _LAGS
    left_out = np.where(without > 0.0, 1e12 * np.maximum(size, 1.0), 0.0)
    known = sums.noise > 0.0
    noisy = np.where(known, sums.noise / np.where(known, sums.variance, 1.0), 1.0)
    weights, shares = np.empty_like(sums.products), noisy.clip(_CLEAREST, 1.0)
    groups: Sequence[Any] = range(m)
    if len(size) >= _LARGE or not len(pairs(m)[0]):
        shares = _THIRD ** np.round(np.log(shares) / np.log(_THIRD))
        groups = [np.flatnonzero(shares == share) for share in np.unique(shares)]
    for j in groups:
        share = shares[j].max()
        prior = np.where(shy, _SHY * _RIDGE + share * _SHY_PRIOR / n, _RIDGE + share * _PRIOR / n)
        held = prior * times * variance + left_out
        weights[:, j] = ridge(squares, sums.products[:, j], held)
    return weights


def ridge(squares: Floats, products: Floats, held: Floats) -> Floats:
    """(p,) or (p, k) weights that are held to 0 by ``held`` (p,), as by so many squares more."""
    size = np.diag(squares)
    scale = 1.0 / np.sqrt(np.where(size > 0.0, size + held, 1.0))
    scaled = scale[:, None] * (squares + np.diag(held)) * scale
    scaled[np.diag_indices_from(scaled)] += _ALL_ALIKE
    found: Floats = (scale * _solved(scaled, (scale * products.T).T).T).T
    return found


def _solved(squares: Floats, products: Floats) -> Floats:
    """Of a positive definite matrix, halved until its parts are too small for threads."""
    if len(squares) < _LARGE:
        return np.asarray(np.linalg.solve(squares, products))
    n, columns = len(squares) // 2, products.reshape(len(products), -1)
    upper = _solved(squares[:n, :n], np.hstack([squares[:n, n:], columns[:n]]))
    rest = np.hstack([squares[n:, n:], columns[n:]])
    rest = rest - np.einsum("ij,jk->ik", squares[n:, :n], upper)
    left = len(squares) - n
    below = _solved(rest[:, :left], rest[:, left:])
    above = upper[:, left:] - np.einsum("ij,jk->ik", upper[:, :left], below)
    return np.vstack([above, below]).reshape(products.shape)


# -- Drift: whether the system still moves as was learnt ------------------------------------------
#
# A correction of the model is learnt alongside, from the last few episodes alone. Where that would
# have foreseen, an episode ahead, what surprised the model, the doubt grows:
#
#     d = max(0, d + sum ln(1 + r^2 / s^2) - 2 ln(1 + r'^2 / s^2)),
#
# of residuals r of the model and r' of the corrected one.

# Of what the last episodes said since a doubt began, what still counts an episode later.
_FADES = 0.95
# What is unforeseen counts from this share of an ordinary change on; a correction has to halve it.
_MATTERS, _HALVES = 0.5, 2.0
# Doubt from which on a model is corrected; and the number of episodes before which it is still
# being learnt.
DOUBT = 30.0
LEARNT = 20
# What corrections are held to 0 by: as many transitions, of products more; and how many there have
# to be.
_HELD, _HELD_MORE, _ENOUGH_ROWS = 0.3, 30.0, 15


class Recent(NamedTuple):
    """What the last episodes said of the model: m variables, p features."""

    squares: Floats  #: (p, p) sum of products of features
    products: Floats  #: (p, m) and of features with changes
    doubt: Floats  #: (m,) that a variable still moves as was learnt
    since: Floats  #: (m,) the episode that brought it up, from 0

    @classmethod
    def none(cls, p: int, m: int, episode: int) -> Recent:
        """Before anything was seen, in this episode."""
        return cls(np.zeros((p, p)), np.zeros((p, m)), np.zeros(m), np.full(m, float(episode)))


class Drift(NamedTuple):
    """A variable moves otherwise than it did."""

    variable: int
    since: int  #: the first episode in which it did, from 0
    noticed: int  #: the last episode before it was believed


def compared(
    recent: Recent,
    model: Model,
    sums: Sums,
    close: Floats,
    elsewhere: NDArray[np.bool_],
    z: Floats,
    u: Floats,
    episode: int,
    young: bool,
) -> Recent:
    """Take in an episode; rows at an end, or that change more than ordinarily, say nothing.

    Neither do those that are ``elsewhere`` (T,), where something else begins.
    """
    found = features(model, z[1:-1], np.diff(z[:-1], axis=0), u[:-1], u[1:])
    move = found @ model.weights
    after, change = z[2:], np.diff(z[1:], axis=0)
    says = (after > model.lowest + close) & (after < model.highest - close)
    says &= (change >= sums.least) & (change <= sums.most)
    rows = says.all(1) & ~elsewhere
    found, change = found[rows], change[rows]
    missed = change - move[rows]
    size = np.maximum(np.maximum(sums.scale, _MATTERS * sums.unit), 1e-300)
    left = missed - found @ correction(recent, model.weights, sums, u.shape[1])
    gained = np.log1p((missed / size) ** 2) - _HALVES * np.log1p((left / size) ** 2)
    doubt = np.maximum(recent.doubt + gained.sum(0), 0.0) * (episode >= LEARNT)
    fades = _FADES if young or doubt.any() else 0.0  # before a doubt it moved as ever
    return Recent(
        fades * recent.squares + _of_rows(found, found),
        fades * recent.products + _of_rows(found, change),
        doubt,
        np.where(doubt > 0.0, recent.since, float(episode)),
    )


def _of_rows(found: Floats, other: Floats) -> Floats:
    """(p, k) products of features (T, p) with (T, k), some rows at once where BLAS has threads."""
    if found.size * found.shape[1] < _THREADS:
        return found.T @ other
    few = range(0, len(found), _ROWS)
    return np.asarray(sum(found[i : i + _ROWS].T @ other[i : i + _ROWS] for i in few))


def correction(recent: Recent, weights: Floats, sums: Sums, a: int) -> Floats:
    """(p, m) what is to be added to the weights of the model, by ridge regression about 0.

    Lags are not asked: they would foresee that what disturbs goes on.
    """
    found, m, n = np.zeros_like(weights), weights.shape[1], max(1.0, float(sums.squares[0, 0]))
    if recent.squares[0, 0] < _ENOUGH_ROWS:
        return found
    size = np.diag(sums.squares) / n
    variance = np.maximum(size - (sums.squares[0] / n) ** 2, 1e-6 * size)
    variance[0] = 1.0
    held = _HELD * variance
    held[len(held) - n_products(m, a) :] *= _HELD_MORE
    latest = lags(m, a)
    held[latest] = 1e12 * np.maximum(size[latest], 1e-12)
    missed = recent.products - recent.squares @ weights
    with suppress(np.linalg.LinAlgError):  # numbers of sizes that have nothing in common
        found = ridge(recent.squares, missed, held)
    return found if np.isfinite(found).all() else np.zeros_like(found)


# -- Lags: whether latest changes, and the action before, foresee more than one step --------------
#
# A feature may help one step ahead and mislead over many. So where an episode went on although
# nothing seemed to help, it is asked whether more had been foreseen without lags.

# Steps of an episode from which it is tried how much was foreseen.
_STARTS = 12
# What an episode says of lags counts no more than this, and so much of doubt is enough.
_MOST, _ENOUGH = 1.0, 1.0


def misled_by_lags(
    models: Sequence[Model], z: Floats, u: Floats, starts: Ints, steps: int, unit: Floats
) -> float:
    """How much more is missed with lags than without, the two ``models``, in [-1, 1]."""
    some = starts[np.unique(np.linspace(0, len(starts) - 1, _STARTS).astype(int))]
    missed, less = (_missed_ahead(model, z, u, some, steps, unit) for model in models)
    return min(_MOST, max(-_MOST, missed - less))


def are_misleading(doubt: float) -> bool:
    """Whether lags are left out."""
    return doubt >= _ENOUGH


def _missed_ahead(
    model: Model, z: Floats, u: Floats, starts: Ints, steps: int, unit: Floats
) -> float:
    """Mean of ln(1 + square) of what is missed [ordinary changes], over starts and steps."""
    at, before = z[starts], np.where(starts[:, None] > 0, u[starts - 1], 0.0)
    change = at - z[np.maximum(starts - 1, 0)]
    total = 0.0
    for k in range(steps):
        action = u[starts + k]
        move = features(model, at, change, before, action) @ model.weights
        after = np.clip(at + limited(model, move), model.lowest, model.highest)
        at, change, before = after, after - at, action
        off = (at - z[starts + k + 1]) / np.maximum(unit, 1e-300)
        total += float(np.log1p(off * off).sum())
    return total / (len(starts) * steps)


# -- The observer: where one is, if sensors are noisy ---------------------------------------------
#
# What is expected of a variable is corrected by a share of what it misses, the gain (Luenberger,
# "An introduction to observers", IEEE Transactions on Automatic Control 16, 1971). A gain of 1
# takes a variable as it is seen; below it the model smooths. Which gain foresees most is tried on
# every episode, as in prediction error methods (Ljung, "System Identification", 1999).

#: Gains that are tried.
GAINS = np.array([1.0, 0.7, 0.5, 0.35, 0.25, 0.15])
# Of what gains missed, what still counts an episode later; what those below 1 are said to have
# missed before any was tried; and up to how much more than the least is hardly more.
_GAINS_FADE, _AT_FIRST, _HARDLY = 0.9, 0.05, 0.005


def untried(m: int) -> Floats:
    """(m, g) what gains of m variables miss as long as none was tried: all is taken as seen."""
    missed = np.full((m, len(GAINS)), _AT_FIRST)
    missed[:, GAINS == 1.0] = 0.0
    return missed


def best_gains(missed: Floats) -> Floats:
    """(m,) for each variable the largest gain that misses hardly more than the best one."""
    hardly_more = missed <= missed.min(1, keepdims=True) + _HARDLY
    return np.asarray(GAINS[hardly_more.argmax(1)])


def tried(missed: Floats, model: Model, z: Floats, u: Floats, unit: Floats) -> Floats:
    """(m, g) what gains miss after one more episode: the mean of ln(1 + square), in units.

    Of what is expected of a variable, the others being taken as they are seen.
    """
    unit = np.maximum(unit, 1e-300)[:, None]
    calm, slope, curve, lag = _of_itself(model, z, u)
    low, high = (model.lowest - model.origin)[:, None], (model.highest - model.origin)[:, None]
    reach, off = model.reach[:, None], np.repeat((z[0] - model.origin)[:, None], len(GAINS), 1)
    change, found = np.zeros_like(off), np.zeros_like(off)
    for t in range(len(u)):
        sequel = np.where(np.abs(change) <= reach, lag * change, 0.0)
        move = calm[t, :, None] + (slope[t, :, None] + curve * off) * off + sequel
        seen = (z[t + 1] - model.origin)[:, None]
        off_by = seen - np.minimum(np.maximum(off + move, low), high)
        gain = np.where(np.abs(off_by) > JUMP * unit, 1.0, GAINS)
        after = seen + (gain - 1.0) * off_by
        change, off = after - off, after
        found += np.log1p((off_by / unit) ** 2)
    return _GAINS_FADE * missed + (1.0 - _GAINS_FADE) * found / len(u)


def _of_itself(model: Model, z: Floats, u: Floats) -> tuple[Floats, Floats, Floats, Floats]:
    """How each variable's expected change depends on that variable, the others being as seen.

    It is calm + slope x + curve x^2 + lag dx, of its distance x to the origin and latest change dx.
    """
    m = z.shape[1]
    change = np.diff(z[:-1], axis=0, prepend=z[:1])
    before = np.vstack([np.zeros_like(u[:1]), u[:-1]])
    parts, spread = np.empty((3, len(u), m)), 1.0 / model.inverse
    for j in range(m):
        for part, at in zip(parts, (0.0, spread[j], -spread[j]), strict=True):
            seen, moved = z[:-1].copy(), change.copy()
            seen[:, j], moved[:, j] = model.origin[j] + at, 0.0
            part[:, j] = features(model, seen, moved, before, u) @ model.weights[:, j]
    calm, above, below = parts
    lag = np.diag(model.weights[1 + m : 1 + 2 * m])[:, None]
    curve = ((0.5 * (above[:1] + below[:1]) - calm[:1]) / spread**2).T
    return calm, 0.5 * (above - below) / spread, curve, lag


def corrected(
    model: Model, gains: Floats, situation: Floats, action: Floats, seen: Floats, unit: Floats
) -> Floats:
    """(m,) where one is, a step after a situation and an action (a,), if that is ``seen`` (m,)."""
    m = len(seen)
    z, change, before = (part[None] for part in np.split(situation, [m, 2 * m]))
    expected = (z + features(model, z, change, before, action[None]) @ model.weights)[0]
    missed = seen - np.minimum(np.maximum(expected, model.lowest), model.highest)
    gains = np.where(np.abs(missed) > JUMP * unit, 1.0, gains)
    return np.asarray(seen + (gains - 1.0) * missed)
