"""A replay: what comes of a situation amid a disturbance that was seen before, by the learnt model.

An action is taken, then what a backup policy (b, K) says, until the horizon or failure. With the
features phi of a situation and an action (`features`), the weights W, and the residuals r of a
disturbance times its scale eta,

    z' = z + sat(W'phi + eta r),    u = sat(b + K'(z - mean) / spread).

Each variable's change is linear in the features, as the consequents of eTS are (Angelov & Filev
2004).
"""

from __future__ import annotations

import math
from functools import cache
from operator import itemgetter
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from evofsm.fsm.kernels import Entry, compiled, lanes, spliced_kernel

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

#: Where the effect of an action may bend, in each dimension of a box.
KNOTS = (-0.5, 0.0, 0.5)
#: Products of two variables are features only where there are at most so many, as of 12 variables;
#: and so are products of actions with variables.
MOST_PRODUCTS = 80
# Variables, and features, of which a model is learnt at most.
_MOST_VARIABLES, _MOST_FEATURES = 64, 256

# After a change, so many times the largest change there was may be foreseen.
_FARTHER = 3.0
# So much of half the range of actions a policy leaves unused for each ordinary change of margin.
_RESERVE = 0.01
# What the distance to failure counts compared with the time survived.
_DISTANCE, _FAR = 0.05, 0.05
# Halvings between a proposal and an action that passes.
_HALVINGS = 4
# Of two backups that last as long up to so much the first is taken.
_EQUAL = 1e-9
# A change so many times those around it, and the ordinary one, is a jump; so many more of the first
# ones, of which it is not known what is ordinary.
JUMP, _FIRST_JUMP, _FIRST = 8.0, 32.0, 8.0
# The ordinary change is the median of so many, then a mean; of what is larger, so much counts.
EARLY, CLIP, _SLOWEST = 200, 6.0, 5000.0
#: What changes in more than this share of transitions may have saturated where it rests.
MOVING = 0.5
#: Residuals of so many scales are the onset of a disturbance.
ONSET = 4.0
# Residuals beyond so many of their scale weigh less.
_OUTLIER = 4.0
#: The square of a gradient that is none: a form that does not change is far from 0.
FLAT = 1e-300
#: So much larger than they were learnt to be regions are taken, and smaller where endings are
#: [ordinary changes].
GROWN, SHRUNK = 1.0, 0.5


class Model(NamedTuple):
    """What is expected, as kernels see it: m variables, a numbers of an action, p features."""

    weights: Floats  #: (p, m) change of each variable for each feature
    origin: Floats  #: (m,) from which variables are counted: the first observation
    reach: Floats  #: (m,) a latest change beyond this has no sequel
    lowest: Floats  #: (m,) where variables saturate; infinite where they do not
    highest: Floats  #: (m,)
    least: Floats  #: (m,) most negative ordinary change there was
    most: Floats  #: (m,) most positive one
    #: (k, 4) failure: variable, sign, threshold, and ordinary changes in a unit of the variable
    thresholds: Floats
    #: (r, 12) failure in one or two variables i and j: i, j, where each is counted from, in how
    #: large a unit (its inverse), and a quadratic form in those, above 0 where it fails:
    #: 1, x, y, x x, x y, y y
    regions: Floats
    endings: Floats  #: (e, 12) where it ends by itself, as regions are
    crashes: Floats  #: (c, 12) where it fails if it ends, as regions are
    #: (k, m + 2) dead ends: centre, radius in spreads, and ordinary changes in a spread
    dead_ends: Floats
    drifted: Floats  #: (m,) 1 of a variable that moves otherwise than it did, -1 of others then
    mean: Floats  #: (m,) of what policies take for their middle
    inverse: Floats  #: (m,) and one over their spread
    choices: int  #: number of actions; 0 where the action is a box


class Disturbances(NamedTuple):
    """K sequences of what was not expected, H steps each; number 0 is none at all."""

    residuals: Floats  #: (H, m, K)
    jump_at: Floats  #: (K, m) step at which a variable jumps; -1: at none
    jump_to: Floats  #: (K, m) to where, from 0
    jump_slope: Floats  #: (K, m, m) and so much of where each variable was
    jump_from: Floats  #: (K, m, m, 2) least and most from which such jumps were seen
    landing: Floats  #: (K, m, 2) least and most to which such jumps led
    #: (K, 5) where it begins: variable (-1: anywhere), sign and threshold; at which step, and with
    #: which it is over
    place: Floats

    @classmethod
    def none(cls, count: int, steps: int, m: int) -> Disturbances:
        """So many that are none, of m variables."""
        still = np.zeros((count, m))
        slopes, ranges = np.zeros((count, m, m)), np.zeros((count, m, m, 2))
        residuals, place = np.zeros((steps, m, count)), np.zeros((count, 5))
        place[:, 0] = -1.0
        return cls(residuals, still - 1.0, still, slopes, ranges, np.zeros((count, m, 2)), place)

    def of(self, which: Ints) -> Disturbances:
        """Some of them."""
        residuals = np.ascontiguousarray(self.residuals[:, :, which])
        return Disturbances(residuals, *map(itemgetter(which), self[1:]))


class Ends(NamedTuple):
    """How replays ended: for each of S situations those of K disturbances, (S K,) each."""

    #: least distance to failure [ordinary changes]; of one that failed the steps left, negative,
    #: less 1
    value: Floats
    #: the share of the horizon that is survived, and a little for the distance to failure: the
    #: least one and, where all is survived, that at the end as well, as who comes back does better
    #: than who hovers beside failure
    worth: Floats


# -- What is expected -----------------------------------------------------------------------------


def n_features(m: int, a: int, *, box: bool) -> int:
    """Number of features: 1, z, latest change, action, previous action, bends, products."""
    return 1 + 2 * m + 2 * a + (len(KNOTS) * a if box else 0) + n_products(m, a)


def n_products(m: int, a: int) -> int:
    """Number of products: of actions with variables, and of two variables; they come last."""
    return crossed(m, a) * m + len(pairs(m)[0])


def refuse_too_many(m: int, a: int, *, box: bool) -> None:
    """Raise a ValueError for more variables than can be learnt of."""
    most = min(_MOST_VARIABLES, (_MOST_FEATURES - n_features(0, a, box=box)) // 2)
    if m > most:
        raise ValueError(
            f"observation has {m} variables; with actions of {a} numbers a judge learns of at most "
            f"{max(most, 0)}: choose those on which failure depends, as with observe= of "
            "RevisedActions"
        )


def lags(m: int, a: int) -> Ints:
    """Indices of features that say what was just before: latest changes, and the action before."""
    return np.append(np.arange(1 + m, 1 + 2 * m), np.arange(1 + 2 * m + a, 1 + 2 * m + 2 * a))


def features(model: Model, z: Floats, change: Floats, before: Floats, action: Floats) -> Floats:
    """(T, p) features of situations and actions: ``[1, z, dz, u, u before, |u - knot|, u z, z z]``.

    ``z`` and ``change`` (T, m), ``before`` and ``action`` (T, a).
    """
    off, m = z - model.origin, z.shape[1]
    lagged = np.where(np.abs(change) <= model.reach, change, 0.0)
    parts = [np.ones((len(z), 1)), off, lagged, action, before]
    if not model.choices:
        parts.append(np.abs(action[:, :, None] - KNOTS).reshape(len(z), -1))
    acts = action[:, : crossed(m, action.shape[1]), None]
    parts.append((acts * off[:, None]).reshape(len(z), -1))
    one, other = pairs(m)
    return np.concatenate([*parts, off[:, one] * off[:, other]], axis=1)


@cache
def pairs(m: int) -> tuple[Ints, Ints]:
    """Of which variables products are features."""
    return np.triu_indices(m if m * (m + 1) // 2 <= MOST_PRODUCTS else 0)


def crossed(m: int, a: int) -> int:
    """Of how many numbers of an action products with variables are features."""
    return a if a * m <= MOST_PRODUCTS else 0


def residuals(
    model: Model, close: Floats, observations: Floats, actions: Floats, *, carried: bool = False
) -> Floats:
    """(L, m) what was not expected from the second of L + 2 observations on, under L + 1 actions.

    Where a variable is expected beyond where it saturates and stays there (but for ``close``), its
    residual is censored; if it is ``carried``, the one before goes on, for its cause may not have
    ended. Where nothing moves at all, what was expected is the model's own error.
    """
    z, x, change = observations[1:-1], observations[2:], np.diff(observations[:-1], axis=0)
    found = unforeseen(model, z, change, actions[:-1], actions[1:], x, close)
    if carried:
        low, high = x <= model.lowest + close, x >= model.highest - close
        for t in np.flatnonzero((low | high)[1:].any(1)) + 1:
            ends = np.where(low[t], np.minimum(found[t], found[t - 1]), found[t])
            found[t] = np.where(high[t] & ~low[t], np.maximum(found[t], found[t - 1]), ends)
    return found


def unforeseen(
    model: Model,
    z: Floats,
    change: Floats,
    before: Floats,
    action: Floats,
    x: Floats,
    close: Floats | float = 0.0,
) -> Floats:
    """(T, m) what was not expected of transitions from ``z`` to ``x``, as `residuals` has it."""
    expected = z + features(model, z, change, before, action) @ model.weights
    low, high = x <= model.lowest + close, x >= model.highest - close
    beyond = ((expected < model.lowest) & low) | ((expected > model.highest) & high)
    return np.where(beyond | (x == z).all(1, keepdims=True), 0.0, x - expected)


def limited(model: Model, move: Floats) -> Floats:
    """Changes (n, m), of which no larger ones are foreseen than there were, as in replays."""
    least, most, farther = model.least, model.most, model.drifted < 0.0
    low = np.where(farther, np.minimum(least, np.maximum(move, _FARTHER * least)), least)
    high = np.where(farther, np.maximum(most, np.minimum(move, _FARTHER * most)), most)
    return np.minimum(np.maximum(move, low), high)


@spliced_kernel
def fill_features(
    z: Floats,
    change: Floats,
    before: Floats,
    action: Floats,
    origin: Floats,
    reach: Floats,
    harder: float,
    box: bool,
    found: Floats,
) -> None:
    """`features` of n situations and actions side by side, into ``found`` (p, n)."""
    (m, n), a = z.shape, len(action)
    for l in range(n):
        found[0, l] = 1.0
    for j in range(m):
        for l in range(n):
            found[1 + j, l] = z[j, l] - origin[j]
            found[1 + m + j, l] = change[j, l] if abs(change[j, l]) <= harder * reach[j] else 0.0
    k = 1 + 2 * m
    for i in range(a):
        for l in range(n):
            found[k + i, l] = action[i, l]
            found[k + a + i, l] = before[i, l]
    k += 2 * a
    if box:
        for i in range(a):
            for knot in KNOTS:
                for l in range(n):
                    found[k, l] = abs(action[i, l] - knot)
                k += 1
    for i in range(a if a * m <= MOST_PRODUCTS else 0):
        for j in range(m):
            for l in range(n):
                found[k, l] = action[i, l] * found[1 + j, l]
            k += 1
    for i in range(m if m * (m + 1) // 2 <= MOST_PRODUCTS else 0):
        for j in range(i, m):
            for l in range(n):
                found[k, l] = found[1 + i, l] * found[1 + j, l]
            k += 1


@spliced_kernel
def expect(weights: Floats, found: Floats, move: Floats) -> None:
    """The changes (m, n) that are expected of features (p, n), into ``move``."""
    (p, n), m = found.shape, len(move)
    for j in range(m):
        for l in range(n):
            move[j, l] = 0.0
    fours = p - p % 4
    for k in range(0, fours, 4):  # four at once: the sums are the same, and written less often
        for j in range(m):
            u, v, w, x = weights[k, j], weights[k + 1, j], weights[k + 2, j], weights[k + 3, j]
            for l in range(n):
                y = move[j, l] + found[k, l] * u + found[k + 1, l] * v
                move[j, l] = y + found[k + 2, l] * w + found[k + 3, l] * x
    for k in range(fours, p):
        for j in range(m):
            weight = weights[k, j]
            for l in range(n):
                move[j, l] += found[k, l] * weight


# -- Learning a transition ------------------------------------------------------------------------


class Sums(NamedTuple):
    """What is learnt with every transition, in place: m variables, p features."""

    counts: Floats  #: (2,) observations, and transitions
    squares: Floats  #: (p, p) sum of products of features
    products: Floats  #: (p, m) and of features with changes
    mean: Floats  #: (m,) of observations, from the origin
    scatter: Floats  #: (m,) sum of squared distances to the mean
    variance: Floats  #: (m,) mean square of a change
    unit: Floats  #: (m,) ordinary change
    early: Floats  #: (200, m) the first changes
    least: Floats  #: (m,) most negative change that was no jump
    most: Floats  #: (m,) most positive one
    scale: Floats  #: (m,) of residuals; 0 as long as it is not known
    noise: Floats  #: (m,) their mean square; 0 as long as it is not known
    low: Floats  #: (m,) least observation
    high: Floats  #: (m,) greatest one
    moving: Floats  #: (m,) share of transitions in which it changed, but for rests at an extreme

    @classmethod
    def none(cls, first: Floats, p: int) -> Sums:
        """Of nothing but a first observation."""
        m = len(first)
        rows = {"squares": (p, p), "products": (p, m), "early": (EARLY, m), "counts": (2,)}
        arrays = {name: np.zeros(rows.get(name, (m,))) for name in cls._fields}
        return cls(**arrays | {"low": first.copy(), "high": first.copy()})


@spliced_kernel
def _is_beyond(expected: float, seen: float, low: float, high: float, close: float) -> bool:
    """Whether it is expected beyond where it saturates, and stays there."""
    return (expected < low and seen <= low + close) or (expected > high and seen >= high - close)


@compiled
def learn_transition(
    sums: Sums, model: Model, close: Floats, z: Floats, u: Floats, i: int, jumped: Floats
) -> bool:
    """Learn the transition i -> i + 1 of observations z (T, m) and actions u (T, a), in ``sums``.

    ``close`` (m,) says how far from where it saturates a variable may be seen that is there.
    ``jumped`` (m,) gets 1 where a variable jumped. Returns whether something of the next transition
    was not expected.
    """
    (p, m), a, n, first = model.weights.shape, u.shape[1], sums.counts[1], i == 0
    at, change, move = np.empty((m, 2)), np.empty((m, 2)), np.empty((m, 2))
    action, latest, found = np.empty((a, 2)), np.empty((a, 2)), np.empty((p, 2))
    for t in range(i, i + 2):
        for j in range(m):
            at[j, t - i], change[j, t - i] = z[t, j], z[t, j] - z[max(t - 1, 0), j]
        for k in range(a):
            action[k, t - i], latest[k, t - i] = u[t, k], u[max(t - 1, 0), k]
    fill_features(
        at, change, latest, action, model.origin, model.reach, 1.0, model.choices == 0, found
    )
    for r in range(2):
        for j in range(m):
            move[j, r] = 0.0
            for k in range(p):
                move[j, r] += found[k, r] * model.weights[k, j]
    known, jump, moved, surprised = sums.scale[0] > 0.0, False, False, False
    for j in range(m):
        if first or not known:
            move[j, 0] = 0.0
        now, after = z[i + 1, j] - z[i, j], z[i + 2, j] - z[i + 1, j]
        before = change[j, 0]
        sums.variance[j] += (now * now - sums.variance[j]) / (n + 1.0)
        around = max(abs(before), abs(after), sums.unit[j])
        stands_out = abs(now) > (JUMP if n > _FIRST else _FIRST_JUMP) * around
        if n > 0.0 and stands_out and abs(now - move[j, 0]) > 0.5 * abs(now):
            jumped[j], jump = 1.0, True
    weight, worst = 1.0, 0.0
    for j in range(m):
        x, y = z[i + 2, j], z[i + 1, j] + move[j, 1]
        moved |= x != z[i + 1, j]
        beyond = _is_beyond(y, x, model.lowest[j], model.highest[j], close[j])
        surprised |= known and not beyond and abs(x - y) > ONSET * sums.scale[j]
    for j in range(m):
        x, now = z[i + 1, j], z[i + 1, j] - z[i, j]
        y, low, high = z[i, j] + move[j, 0], model.lowest[j], model.highest[j]
        if jumped[j] == 0.0:
            sums.least[j], sums.most[j] = min(sums.least[j], now), max(sums.most[j], now)
        if n >= EARLY:
            floor = 1e-3 * np.sqrt(sums.scatter[j] / max(1.0, sums.counts[0]))
            grown = (min(abs(now), CLIP * sums.unit[j]) - sums.unit[j]) / min(n, _SLOWEST)
            sums.unit[j] = max(sums.unit[j] + grown, floor)
        sums.low[j], sums.high[j] = min(sums.low[j], x, z[i, j]), max(sums.high[j], x, z[i, j])
        if now == 0.0 and (x == sums.low[j] or x == sums.high[j]) and sums.moving[j] > MOVING:
            if not ((x == low and y > x) or (x == high and y < x)):
                weight = 0.0  # it may have come to its end: what it would have done is not known
        else:
            sums.moving[j] += ((now != 0.0) - sums.moving[j]) / min(n + 1.0, _SLOWEST)
        if known:
            if _is_beyond(y, x, low, high, close[j]):
                weight = 0.0  # it cannot be known how far it would have gone
            else:
                worst = max(worst, abs(x - y) / sums.scale[j])
    sums.counts[1] += 1.0
    if first or jump:
        return surprised and moved
    weight *= min(1.0, _OUTLIER / max(worst, 1e-12)) ** 2
    for j in range(m):  # lags, as far as they have a sequel by now
        reach = 1.5 * max(abs(sums.least[j]), abs(sums.most[j]))
        found[1 + m + j, 0] = change[j, 0] if abs(change[j, 0]) <= reach else 0.0
    for k in range(p):
        f = weight * found[k, 0]
        if f != 0.0:
            for r in range(p):
                sums.squares[k, r] += f * found[r, 0]
            for j in range(m):
                sums.products[k, j] += f * (z[i + 1, j] - z[i, j])
    return surprised and moved


# -- Replays --------------------------------------------------------------------------------------


@spliced_kernel
def _follow_policy(model: Model, policy: Floats, z: Floats, end: float, action: Floats) -> None:
    """Actions (a, n) of a linear policy (a, 1 + m): saturated at ``end``, or the largest of few."""
    (a, n), m, choices = action.shape, policy.shape[1] - 1, model.choices
    for i in range(a):
        for l in range(n):
            action[i, l] = policy[i, 0]
        for j in range(m):
            slope, mean, inverse = policy[i, 1 + j], model.mean[j], model.inverse[j]
            for l in range(n):
                action[i, l] += slope * (z[j, l] - mean) * inverse
        if choices == 0:
            for l in range(n):
                action[i, l] = min(end, max(-end, action[i, l]))
    if choices > 0:
        for l in range(n):
            best = 0
            for i in range(1, a):
                if action[i, l] > action[best, l]:
                    best = i
            for i in range(a):
                action[i, l] = 1.0 if i == best else 0.0


@spliced_kernel
def _from_centre(model: Model, s: int, z: Floats, square: Floats) -> None:
    """Squared distances of n observations (m, n) from the centre of a dead end, in spreads."""
    m, n = z.shape
    for l in range(n):
        square[l] = 0.0
    for j in range(m):
        centre, inverse = model.dead_ends[s, j], model.inverse[j]
        for l in range(n):
            x = (z[j, l] - centre) * inverse
            square[l] += x * x


@spliced_kernel
def _to_region(regions: Floats, s: int, z: Floats, far: Floats) -> None:
    """Distances of n observations (m, n) to a region: its form over the length of its gradient."""
    i, j = int(regions[s, 0]), int(regions[s, 1])
    at, to, one, other = regions[s, 2], regions[s, 3], regions[s, 4], regions[s, 5]
    c, b, d = regions[s, 6], regions[s, 7], regions[s, 8]
    p, q, r = regions[s, 9], regions[s, 10], regions[s, 11]
    for l in range(len(far)):
        x, y = (z[i, l] - at) * one, (z[j, l] - to) * other
        form = c + x * (b + p * x + q * y) + y * (d + r * y)
        u, v = b + 2.0 * p * x + q * y, d + 2.0 * r * y + q * x
        far[l] = -form / np.sqrt(u * u + v * v + FLAT)


@spliced_kernel
def _distances(
    model: Model, z: Floats, aside: Floats, square: Floats, far: Floats, over: Floats
) -> None:
    """The distance of each of n observations (m, n) to the nearest failure, into ``far`` (n,).

    And to where it ends by itself, into ``over`` (n,): there it also fails if it crashes. Distances
    to regions are of first order; a boundary that touches what was survived in one place lies
    beyond the truth elsewhere, so they are `GROWN`. To dead ends as well, but for those of (k, n)
    that are set ``aside``, infinitely far. ``square`` (n,) is overwritten.
    """
    n = len(far)
    for l in range(n):
        far[l] = over[l] = np.inf
    for s in range(len(model.endings)):
        _to_region(model.endings, s, z, square)
        for l in range(n):
            over[l] = square[l] if square[l] < over[l] else over[l]
    for s in range(len(model.crashes)):
        _to_region(model.crashes, s, z, square)
        for l in range(n):
            left = max(over[l] - GROWN, square[l])
            far[l] = left if left < far[l] else far[l]
    for s in range(len(model.thresholds)):
        j, sign = int(model.thresholds[s, 0]), model.thresholds[s, 1]
        threshold, worth = model.thresholds[s, 2], model.thresholds[s, 3]
        for l in range(n):
            left = sign * (threshold - z[j, l]) * worth
            far[l] = left if left < far[l] else far[l]
    for s in range(len(model.regions)):
        _to_region(model.regions, s, z, square)
        for l in range(n):
            left = square[l] - GROWN
            far[l] = left if left < far[l] else far[l]
    for s in range(len(model.dead_ends)):
        _from_centre(model, s, z, square)
        radius, worth = model.dead_ends[s, -2], model.dead_ends[s, -1]
        for l in range(n):
            left = (np.sqrt(square[l]) - radius) * worth + aside[s, l]
            far[l] = left if left < far[l] else far[l]


@spliced_kernel
def _wait(place: Floats, which: Ints, z: Floats, move: Floats, clock: Ints, at: Ints) -> None:
    """Steps of disturbances to play now, into ``at``, of those that begin only somewhere; -1: none.

    Each waits at its onset until it is there, and begins again when it is there again.
    """
    for l in range(len(which)):
        k = which[l]
        if place[k, 0] >= 0.0:
            i = int(place[k, 0])
            begins, over = int(place[k, 3]), int(place[k, 4])
            there = place[k, 1] * (z[i, l] + move[i, l] - place[k, 2]) >= 0.0
            if clock[l] >= over and there:
                clock[l] = begins
            plays = clock[l] < over and (clock[l] != begins or there)
            at[l] = clock[l] if plays else -1
            clock[l] += 1 if plays else 0


@compiled
def _replay(
    model: Model,
    situations: Floats,
    plan: Floats,
    policy: Floats,
    disturbances: Disturbances,
    harder: float,
    enough: float,
    allowed: int,
    ends: Ends,
) -> tuple[int, float, int]:
    """`replay` into ``ends``; how many are not survived, the least distance of others, and steps.

    All end as soon as more than ``allowed`` did, or number 0 did, that is no disturbance at all; if
    all are allowed, each goes on as far as it can, and dead ends in which it begins do not count:
    who is there has to leave.

    Replays lie side by side, so that loops over them (``l``) are vector instructions. No slice is
    assigned: that takes a second of compiling each.
    """
    m, (a, _), p = len(model.origin), policy.shape, len(model.weights)
    steps, _, each = disturbances.residuals.shape
    count = len(situations) * each
    n = lanes(count)
    z, change, move, after = np.empty((m, n)), np.empty((m, n)), np.empty((m, n)), np.empty((m, n))
    before, action, found = np.empty((a, n)), np.empty((a, n)), np.empty((p, n))
    which, survived = np.empty(n, np.int64), np.empty(n, np.int64)
    near, far, square, over = np.empty(n), np.empty(n), np.empty(n), np.empty(n)
    at, clock, rest = np.empty(n, np.int64), np.zeros(n, np.int64), np.empty((m, n))
    aside = np.empty((len(model.dead_ends), n))
    jumps, placed = False, False
    for l in range(n):
        start = l // each if l < count else 0
        for j in range(m):
            z[j, l], change[j, l] = situations[start, j], situations[start, m + j]
        for i in range(a):
            before[i, l] = situations[start, 2 * m + i]
        near[l], survived[l] = np.inf, steps if l < count else -1
        which[l] = l % each if l < count else 0
        for j in range(m):
            jumps |= disturbances.jump_at[which[l], j] >= 0.0
        placed |= disturbances.place[which[l], 0] >= 0.0
    for s in range(len(aside)):
        _from_centre(model, s, z, square)
        radius = model.dead_ends[s, -2]
        for l in range(n):
            within = (square[l] < radius * radius) & (allowed >= count)
            aside[s, l] = np.inf if within else 0.0
    lost, ended, end, took = 0, 0, 1.0 - _RESERVE * enough, 0
    for t in range(steps):
        took += 1
        if t < len(plan):
            for i in range(a):
                for l in range(n):
                    action[i, l] = plan[t, i]
        else:
            _follow_policy(model, policy, z, end, action)
        fill_features(
            z, change, before, action, model.origin, model.reach, harder, model.choices == 0, found
        )
        expect(model.weights, found, move)
        for l in range(n):
            at[l] = t
        if placed:
            _wait(disturbances.place, which, z, move, clock, at)
        for j in range(m):
            for l in range(n):
                rest[j, l] = disturbances.residuals[at[l], j, which[l]] if at[l] >= 0 else 0.0
        for j in range(m):
            least, most = model.least[j], model.most[j]
            if model.drifted[j] > 0.0:  # little was seen of it: no more is foreseen than there was
                for l in range(n):
                    move[j, l] = min(max(move[j, l], least), most)
            if model.drifted[j] < 0.0:  # it moves as ever, but may have to go farther than it did
                for l in range(n):
                    low = min(harder * least, max(move[j, l], _FARTHER * least))
                    high = max(harder * most, min(move[j, l], _FARTHER * most))
                    y = move[j, l] + harder * rest[j, l]
                    after[j, l] = z[j, l] + min(max(y, low), high)
            else:
                for l in range(n):
                    y = move[j, l] + harder * rest[j, l]
                    after[j, l] = z[j, l] + min(max(y, harder * least), harder * most)
        if jumps:
            for l in range(count):
                k = which[l]
                for j in range(m):
                    if disturbances.jump_at[k, j] >= 0.0 and disturbances.jump_at[k, j] == at[l]:
                        y = disturbances.jump_to[k, j]
                        for i in range(m):
                            low = disturbances.jump_from[k, j, i, 0]
                            high = disturbances.jump_from[k, j, i, 1]
                            y += disturbances.jump_slope[k, j, i] * min(max(z[i, l], low), high)
                        low, high = disturbances.landing[k, j, 0], disturbances.landing[k, j, 1]
                        after[j, l] = min(max(y, low), high)
        for j in range(m):
            lowest, highest = model.lowest[j], model.highest[j]
            for l in range(n):
                y = min(max(after[j, l], lowest), highest)
                change[j, l] = y - z[j, l]
                z[j, l] = y
        for i in range(a):
            for l in range(n):
                before[i, l] = action[i, l]
        _distances(model, z, aside, square, far, over)
        fails = 0
        for l in range(n):
            nearer = far[l] if far[l] < near[l] else near[l]
            near[l] = nearer if survived[l] == steps else near[l]
        for l in range(n):
            fails += 1 if (survived[l] == steps) & (near[l] < enough) else 0
        if fails > 0:
            for l in range(count):
                if survived[l] == steps and near[l] < enough:
                    survived[l] = t
                    lost += 1
                    if allowed < count and which[l] == 0:
                        lost = count
            if lost >= count or lost > allowed:
                break
        if len(model.endings) > 0:  # what fails at once has failed
            for l in range(count):
                if survived[l] == steps and over[l] <= -SHRUNK:
                    survived[l] = steps + 1
                    ended += 1
            if ended > 0 and lost + ended >= count:
                break
    left = np.inf
    for l in range(count):
        share, distance = min(survived[l], steps) / steps, near[l]
        if near[l] >= enough:
            left = min(left, near[l])
        ends.value[l] = near[l] if survived[l] >= steps else survived[l] - steps - 1.0
        if survived[l] == steps:
            distance = 0.5 * (near[l] + far[l])  # those in the end
        ends.worth[l] = share + _DISTANCE * min(1.0, max(-1.0, _FAR * distance))
    return lost, left, took


_enter = Entry(_replay)


def replay(
    model: Model,
    situations: Floats,
    plan: Floats,
    policy: Floats,
    disturbances: Disturbances,
    harder: float = 1.0,
    enough: float = 0.0,
) -> Ends:
    """Replay each of K disturbances in each of S situations.

    A situation is an observation, its change, and the action before (2m + a). First the actions of
    the ``plan`` (T, a) are taken, if it has any, then what the ``policy`` (a, 1 + m) says. A replay
    ends where the distance to failure falls below ``enough``, or, survived, where the system ends
    by itself. The larger ``enough`` is, the more of the range of actions the policy leaves unused:
    where full action just holds, no distance says how near the point of no return is.
    """
    count = len(situations) * disturbances.residuals.shape[2]
    ends = Ends(np.empty(count), np.empty(count))
    _enter.call(model, situations, plan, policy, disturbances, harder, enough, count, ends)
    return ends


# -- What decides ---------------------------------------------------------------------------------

#: What a search finds: the proposal passes, another action passes, none did in time, or none does.
KEPT, CHANGED, CUT_SHORT, NOTHING_PASSES = 0, 1, 2, 3


def search(
    model: Model,
    situation: Floats,
    policies: Floats,
    ranks: Ints,
    disturbances: Disturbances,
    scale: float,
    proposal: Floats,
    margin: float,
    allowed: int,
    most: float = math.inf,
    *,
    lasting: bool = True,
) -> tuple[int, Floats, int, float]:
    """Find the action closest to a proposal after which a backup survives by the margin.

    The proposal itself if one does; else what the first of ``ranks`` does that survives, and from
    there as near to the proposal as halvings come. All disturbances have to be survived but
    ``allowed``, and that none begins. Where no action passes it is that of the backup that lasts
    longest, if that is asked (``lasting``). ``situation`` is (2m + a,), proposal and action are
    (a,). After ``most`` steps of replays it is cut short, with the action of the first of
    ``ranks``.

    Returns what was found, the action, after which backup it passes, and the least distance to
    failure that is then left; where nothing passes, how far apart backups are, near 0 if all last
    as long.
    """
    m, a, choices = len(model.origin), len(proposal), model.choices
    count, plan, here = disturbances.residuals.shape[2], np.empty((1, a)), situation[None]
    ends = Ends(np.empty(count), np.empty(count))
    given, done = (disturbances, scale, margin, allowed, ends), 0

    def survives(action: Floats, backup: int) -> tuple[bool, float]:
        """Whether the backup survives after the action, and by how much."""
        nonlocal done
        plan[0] = action
        lost, left, took = _enter.call(model, here, plan, policies[backup], *given)
        done += took
        return lost <= allowed and left >= margin, left

    for q in ranks:
        if done >= most:
            break
        passes, left = survives(proposal, q)
        if passes:
            return KEPT, proposal, q, left
    for q in ranks:
        own = _action_of(model, policies[q], situation[:m])
        if done >= most:
            first = _action_of(model, policies[ranks[0]], situation[:m])
            return CUT_SHORT, first, ranks[0], math.inf
        if (own == proposal).all():
            continue  # it was refused
        passes, left = survives(own, q)
        if not passes:
            continue
        action, off, refused, share = own, own - proposal, 0.0, 1.0
        for _ in range(0 if choices else _HALVINGS):
            half = 0.5 * (refused + share)
            closer = proposal + half * off
            passes, distance = survives(closer, q)
            if passes:
                action, share, left = closer, half, distance
            else:
                refused = half
        return CHANGED, action, q, left
    if not lasting:
        return NOTHING_PASSES, proposal, ranks[0], math.inf
    which, longest, shortest, nothing = ranks[0], -np.inf, np.inf, np.empty((0, a))
    for q in ranks:
        lasts = float(replay(model, here, nothing, policies[q], disturbances, scale).worth.mean())
        shortest = min(shortest, lasts)
        if lasts > longest + _EQUAL:
            which, longest = q, lasts
    apart = (longest - shortest) / (abs(longest) + 1e-12)
    return NOTHING_PASSES, _action_of(model, policies[which], situation[:m]), which, apart


def _action_of(model: Model, policy: Floats, z: Floats) -> Floats:
    """(a,) what a linear policy (a, 1 + m) does at an observation."""
    action, off = policy[:, 0], (z - model.mean).tolist()
    for slope, distance, inverse in zip(policy.T[1:], off, model.inverse.tolist(), strict=True):
        action = action + slope * distance * inverse
    if model.choices:
        return np.asarray(np.eye(len(action))[action.argmax()])
    return np.minimum(np.maximum(action, -1.0), 1.0)
