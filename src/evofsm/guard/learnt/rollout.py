"""A rollout: what comes of a situation amid a disturbance that was seen before, by the model.

An action is taken, then what a backup (b, K) says, until the horizon or failure. With features phi
of a situation and an action (`features`), weights W, and residuals r of a disturbance times its
scale eta,

    z' = z + clip(W'phi + eta r),    u = clip(b + K'(z - mean) / spread).

Its value is the least distance to failure on the way. A situation is a row: an observation, its
change, and the action before.
"""

from __future__ import annotations

import math
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from evofsm.fsm.kernels import Entry, compiled, lanes, spliced_kernel

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Flags = NDArray[np.bool_]

#: Where the effect of an action may bend, in each dimension of a box.
KNOTS = (-0.5, 0.0, 0.5)
#: Products of two variables are features where there are at most so many, as of 12 variables; and
#: so are products of actions with variables.
MAX_PRODUCTS = 80
# Variables, and features, of a model at most.
_MAX_VARIABLES, _MAX_FEATURES = 64, 256
#: What a form says of where it is above 0: that it fails there, that an episode ends by itself, or
#: that it fails where it ends, or that what begins there is fatal.
FAILS, ENDS, CRASHES, FATAL = 0, 1, 2, 3
#: The square of a gradient that is none: a form that does not change is far from 0.
FLAT = 1e-300
#: Bent forms of failure reach so much farther than they were learnt, and where it ends by itself
#: begins so much farther in [typical steps].
GROWN, SHRUNK = 2.0, 0.5
# So much of half the range of actions a backup leaves unused for each typical step of margin.
_RESERVE = 0.01
# What the distance to failure counts compared with the time survived.
_DISTANCE, _FAR = 0.05, 0.05
# Halvings between a proposal and an action that passes.
_HALVINGS = 4
#: Shares that are rounding alone, and so small that nothing of a variance is left.
ROUNDING, SMALL = 1e-9, 1e-6
#: Who takes over has to last longer than the proposal by more than that.
NO_LONGER = 1e-4


class Model(NamedTuple):
    """What is expected, as kernels see it: m variables, a numbers of an action, p features."""

    weights: Floats  #: (p, m) change of each variable for each feature
    origin: Floats  #: (m,) from which variables are counted: the first observation
    reach: Floats  #: (m,) a latest change beyond this has no sequel
    lowest: Floats  #: (m,) where variables saturate; infinite where they do not
    highest: Floats  #: (m,)
    least: Floats  #: (m,) most negative change there was that was no jump
    most: Floats  #: (m,) most positive one
    #: (r, 13) forms in one or two variables i and j: what they say, i, j, where each is counted
    #: from, in how large a unit (its inverse), and coefficients of 1, x, y, x x, x y, y y; those
    #: without squares with a gradient of 1
    forms: Floats
    #: (k, m + 2) dead ends: centre, radius in spreads, and typical steps in a spread
    dead_ends: Floats
    mean: Floats  #: (m,) of what backups take for their middle
    inverse: Floats  #: (m,) and one over their spread; 0 of what never changed
    choices: int  #: number of actions; 0 where the action is a box


class Ends(NamedTuple):
    """How rollouts ended: for each of S situations those of K disturbances, (S K,) each."""

    #: least distance to failure [typical steps]; of one that failed the steps left, negative,
    #: less 1
    value: Floats
    #: the share of the horizon that is survived, and a little for the distance to failure: the
    #: least one and, where all is survived, that at the end as well, as who comes back does better
    #: than who hovers beside failure
    worth: Floats


# -- What is expected -----------------------------------------------------------------------------


def n_features(m: int, a: int, *, box: bool) -> int:
    """Number of features: 1, z, latest change, action, action before, bends, products."""
    return 1 + 2 * m + 2 * a + (len(KNOTS) * a if box else 0) + crossed(m, a) * m + len(pairs(m)[0])


def refuse_too_many(m: int, a: int, *, box: bool) -> None:
    """Raise a ValueError for more variables, or numbers of an action, than can be learnt of."""
    most = min(_MAX_VARIABLES, (_MAX_FEATURES - n_features(0, a, box=box)) // 2)
    if most < 1:
        kind, numbers = ("components", 2 + len(KNOTS)) if box else ("actions", 2)
        most = (_MAX_FEATURES - n_features(1, 0, box=box)) // numbers
        raise ValueError(f"a learnt judge takes at most {most} {kind}, not {a}: group them")
    if m > most:
        fault = f"with actions of {a} numbers a judge learns of at most {most}"
        hint = "choose those on which failure depends, as with observe= of RevisedActions"
        raise ValueError(f"observation has {m} variables; {fault}: {hint}")


def lags(m: int, a: int) -> Ints:
    """Indices of features that say what was just before: latest changes, and the action before."""
    return np.append(np.arange(1 + m, 1 + 2 * m), np.arange(1 + 2 * m + a, 1 + 2 * m + 2 * a))


@cache
def pairs(m: int) -> tuple[Ints, Ints]:
    """Of which variables products are features."""
    return np.triu_indices(m if m * (m + 1) // 2 <= MAX_PRODUCTS else 0)


def crossed(m: int, a: int) -> int:
    """Of how many numbers of an action products with variables are features."""
    return a if a * m <= MAX_PRODUCTS else 0


def features(model: Model, z: Floats, change: Floats, before: Floats, action: Floats) -> Floats:
    """(T, p) features of situations and actions: ``[1, z, dz, u, u before, |u - knot|, u z, z z]``.

    ``z`` and ``change`` (T, m), ``before`` and ``action`` (T, a).
    """
    off, m = z - model.origin, z.shape[1]
    lag = np.where(np.abs(change) <= model.reach, change, 0.0)
    parts = [np.ones((len(z), 1)), off, lag, action, before]
    if not model.choices:
        parts.append(np.abs(action[:, :, None] - KNOTS).reshape(len(z), -1))
    acts = action[:, : crossed(m, action.shape[1]), None]
    parts.append((acts * off[:, None]).reshape(len(z), -1))
    i, j = pairs(m)
    return np.concatenate([*parts, off[:, i] * off[:, j]], axis=1)


def expected(model: Model, situation: Floats, action: Floats) -> Floats:
    """(m,) the observation that is expected a step after a situation (2m + a,) and an action."""
    z, change, before = np.split(situation[None], np.cumsum([len(model.origin)] * 2), axis=1)
    phi = features(model, z, change, before, action[None])[0]
    move = sum(row * weights for row, weights in zip(phi, model.weights, strict=True))
    after = z[0] + np.minimum(np.maximum(move, model.least), model.most)
    return np.asarray(np.minimum(np.maximum(after, model.lowest), model.highest))


@spliced_kernel
def _fill_features(
    model: Model,
    z: Floats,
    change: Floats,
    before: Floats,
    action: Floats,
    scale: float,
    found: Floats,
) -> None:
    """`features` of n situations and actions side by side, into ``found`` (p, n)."""
    (m, n), a = z.shape, len(action)
    for l in range(n):
        found[0, l] = 1.0
    for j in range(m):
        origin, reach = model.origin[j], scale * model.reach[j]
        for l in range(n):
            found[1 + j, l] = z[j, l] - origin
            found[1 + m + j, l] = change[j, l] if abs(change[j, l]) <= reach else 0.0
    k = 1 + 2 * m
    for i in range(a):
        for l in range(n):
            found[k + i, l] = action[i, l]
            found[k + a + i, l] = before[i, l]
    k += 2 * a
    if model.choices == 0:
        for i in range(a):
            for knot in KNOTS:
                for l in range(n):
                    found[k, l] = abs(action[i, l] - knot)
                k += 1
    for i in range(a if a * m <= MAX_PRODUCTS else 0):
        for j in range(m):
            for l in range(n):
                found[k, l] = action[i, l] * found[1 + j, l]
            k += 1
    for i in range(m if m * (m + 1) // 2 <= MAX_PRODUCTS else 0):
        for j in range(i, m):
            for l in range(n):
                found[k, l] = found[1 + i, l] * found[1 + j, l]
            k += 1


@spliced_kernel
def _expect(weights: Floats, found: Floats, move: Floats) -> None:
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


@spliced_kernel
def _follow(model: Model, policy: Floats, z: Floats, end: float, action: Floats) -> None:
    """Actions (a, n) of a backup (a, 1 + m): saturated at ``end``, or the largest of few."""
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
def _measure(
    model: Model, z: Floats, aside: Floats, square: Floats, last: Floats, far: Floats, over: Floats
) -> None:
    """The distance of each of n observations (m, n) to the nearest failure, into ``far`` (n,).

    And to where it ends by itself, into ``over``: there it also fails if it crashes, as said by the
    forms that follow those of the end. Distances to bent forms are of first order; their boundary
    touches what was survived in one place and lies beyond the truth elsewhere, so they are `GROWN`.
    Dead ends of (k, n) that are set ``aside`` are infinitely far. ``square`` and ``last`` (n,) are
    overwritten.
    """
    n = len(far)
    for l in range(n):
        far[l] = over[l] = last[l] = np.inf
    for s in range(len(model.forms)):
        says, i, j = model.forms[s, 0], int(model.forms[s, 1]), int(model.forms[s, 2])
        at, to, inv_x, inv_y = model.forms[s, 3:7]
        c, b, d, p, q, r = model.forms[s, 7:13]
        if p == 0.0 and q == 0.0 and r == 0.0:
            for l in range(n):
                square[l] = -(c + b * (z[i, l] - at) * inv_x + d * (z[j, l] - to) * inv_y)
        else:
            grown = GROWN if says == FAILS else 0.0
            for l in range(n):
                x, y = (z[i, l] - at) * inv_x, (z[j, l] - to) * inv_y
                form = c + x * (b + p * x + q * y) + y * (d + r * y)
                u, v = b + 2.0 * p * x + q * y, d + 2.0 * r * y + q * x
                square[l] = -form / np.sqrt(u * u + v * v + FLAT) - grown
        if says == ENDS:
            is_first = s == 0 or model.forms[s - 1, 0] != ENDS
            for l in range(n):
                last[l] = square[l] if is_first or square[l] < last[l] else last[l]
                over[l] = square[l] if square[l] < over[l] else over[l]
        else:
            if says == CRASHES:
                for l in range(n):
                    square[l] = max(last[l] - GROWN, square[l])
            for l in range(n):
                far[l] = square[l] if square[l] < far[l] else far[l]
    for s in range(len(model.dead_ends)):
        _from_centre(model, s, z, square)
        radius, worth, nearer = model.dead_ends[s, -2], model.dead_ends[s, -1], 0
        for l in range(n):  # most are farther away than what is nearest: a root less
            within = max(far[l] / worth + radius, 0.0)
            nearer += 1 if square[l] <= within * within * (1.0 + ROUNDING) else 0
        for l in range(n if nearer > 0 else 0):
            distance = (np.sqrt(square[l]) - radius) * worth + aside[s, l]
            far[l] = distance if distance < far[l] else far[l]


# -- A rollout ------------------------------------------------------------------------------------


@compiled
def _rollout(
    model: Model,
    situations: Floats,
    plan: Floats,
    policy: Floats,
    residuals: Floats,
    scale: float,
    enough: float,
    allowed: int,
    ends: Ends,
) -> tuple[int, float, int]:
    """`rollout` into ``ends``; how many are not survived, the least distance of others, and steps.

    All end as soon as more than ``allowed`` did, or number 0 did, that is no disturbance at all; if
    all are allowed, each goes on as far as it can, and dead ends in which it begins do not count:
    who is there has to leave.

    Rollouts lie side by side, so that loops over them (``l``) are vector instructions. No slice is
    assigned: that takes a second of compiling each.
    """
    m, (a, _), p = len(model.origin), policy.shape, len(model.weights)
    steps, rows, n_disturbances = residuals.shape
    count = len(situations) * n_disturbances
    n = lanes(count)
    z, change, move = np.empty((m, n)), np.empty((m, n)), np.empty((m, n))
    before, action, phi = np.empty((a, n)), np.empty((a, n)), np.empty((p, n))
    column, lifetime = np.empty(n, np.int64), np.empty(n, np.int64)
    near, far, square = np.empty(n), np.empty(n), np.empty(n)
    over, last = np.empty(n), np.empty(n)
    aside = np.empty((len(model.dead_ends), n))
    for l in range(n):
        start = l // n_disturbances if l < count else 0
        for j in range(m):
            z[j, l], change[j, l] = situations[start, j], situations[start, m + j]
        for i in range(a):
            before[i, l] = situations[start, 2 * m + i]
        near[l], lifetime[l] = np.inf, steps if l < count else -1
        column[l] = l % n_disturbances if l < count else 0
    for s in range(len(aside)):
        _from_centre(model, s, z, square)
        radius = model.dead_ends[s, -2]
        for l in range(n):
            within = (square[l] < radius * radius) & (allowed >= count)
            aside[s, l] = np.inf if within else 0.0
    n_failures, n_endings, end, n_steps = 0, 0, 1.0 - _RESERVE * enough, 0
    for t in range(steps):
        n_steps += 1
        if t < len(plan):
            for i in range(a):
                for l in range(n):
                    action[i, l] = plan[t, i]
        else:
            _follow(model, policy, z, end, action)
        _fill_features(model, z, change, before, action, scale, phi)
        _expect(model.weights, phi, move)
        for j in range(m):
            low, high = scale * model.least[j], scale * model.most[j]
            lowest, highest = model.lowest[j], model.highest[j]
            for l in range(n):
                y = move[j, l] + scale * residuals[t, j, column[l]]
                y = min(max(z[j, l] + min(max(y, low), high), lowest), highest)
                if rows > m:  # it jumps
                    to = residuals[t, m + j, column[l]]
                    y = to if to < np.inf else y
                change[j, l] = y - z[j, l]
                z[j, l] = y
        for i in range(a):
            for l in range(n):
                before[i, l] = action[i, l]
        _measure(model, z, aside, square, last, far, over)
        fails = 0
        for l in range(n):
            nearer = far[l] if far[l] < near[l] else near[l]
            near[l] = nearer if lifetime[l] == steps else near[l]
        for l in range(n):
            fails += 1 if (lifetime[l] == steps) & (near[l] < enough) else 0
        if fails > 0:
            for l in range(count):
                if lifetime[l] == steps and near[l] < enough:
                    lifetime[l] = t
                    n_failures += 1
                    if allowed < count and column[l] == 0:
                        n_failures = count
            if n_failures >= count or n_failures > allowed:
                break
        for l in range(count):  # what fails at once has failed
            if lifetime[l] == steps and over[l] <= -SHRUNK:
                lifetime[l] = steps + 1
                n_endings += 1
        if n_endings > 0 and n_failures + n_endings >= count:
            break
    slack = np.inf
    for l in range(count):
        share, distance = min(lifetime[l], steps) / steps, near[l]
        if near[l] >= enough:
            slack = min(slack, near[l])
        ends.value[l] = near[l] if lifetime[l] >= steps else lifetime[l] - steps - 1.0
        if lifetime[l] == steps:
            distance = 0.5 * (near[l] + far[l])  # those in the end
        ends.worth[l] = share + _DISTANCE * min(1.0, max(-1.0, _FAR * distance))
    return n_failures, slack, n_steps


_enter = Entry(_rollout)


def rollout(
    model: Model,
    situations: Floats,
    policy: Floats,
    residuals: Floats,
    scale: float = 1.0,
    plan: Floats | None = None,
) -> Ends:
    """Roll out each of K disturbances from each of S situations (S, 2m + a).

    After a plan (T, a) a backup is followed, the policy (a, 1 + m). Disturbances, number 0 of which
    is none at all, have residuals (H, m, K), or (H, 2m, K), where the rest is where variables land
    that jump, else inf; they are taken to be ``scale`` times as hard as they were. A rollout ends
    where it fails or, survived, where the system ends by itself.
    """
    count = len(situations) * residuals.shape[2]
    ends = Ends(np.empty(count), np.empty(count))
    plan = np.empty((0, len(policy))) if plan is None else plan
    _enter.call(model, situations, plan, policy, residuals, scale, 0.0, count, ends)
    return ends


def value_of(
    model: Model,
    situations: Floats,
    policies: Floats,
    residuals: Floats,
    scale: float = 1.0,
    plan: Floats | None = None,
    enough: float = math.inf,
) -> Floats:
    """(S, K) how each disturbance ends from each situation under the best of some backups.

    As `Ends.value` has it; once all are ``enough`` no other backup is asked.
    """
    ends = np.full(len(situations) * residuals.shape[2], -np.inf)
    for policy in policies:
        np.maximum(ends, rollout(model, situations, policy, residuals, scale, plan).value, out=ends)
        if ends.min() >= enough:
            break
    return ends.reshape(len(situations), -1)


# -- What decides ---------------------------------------------------------------------------------

#: What a search finds: the proposal passes, another action passes, none did in time, or none does.
KEPT, CHANGED, CUT_SHORT, NOTHING_PASSES = 0, 1, 2, 3


def search(
    model: Model,
    situation: Floats,
    policies: Floats,
    ranks: Ints,
    residuals: Floats,
    scale: float,
    proposal: Floats,
    margin: float,
    allowed: int,
    most: float = math.inf,
    *,
    lasting: bool = True,
    longer: float = NO_LONGER,
) -> tuple[int, Floats, int, float]:
    """Find an action near the proposal after which a backup survives by the margin.

    The proposal itself if one does; else what the first of ``ranks`` does that survives, and from
    there as near to the proposal as halvings come. All disturbances have to be survived but
    ``allowed``, and that none begins. Where no action passes it is that of the backup that lasts
    longest, if that is asked (``lasting``), or the proposal if none lasts ``longer`` than after it.
    ``situation`` is (2m + a,), proposal and action are (a,). After ``most`` steps of rollouts it is
    cut short, with the action of the first of ``ranks``.

    Returns what was found, the action, after which backup it passes, and the least distance to
    failure that is then left; where nothing passes, how far apart backups are, near 0 if all last
    as long.
    """
    m, choices, total = len(model.origin), model.choices, 0
    rows, count = situation[None], residuals.shape[2]
    ends = Ends(np.empty(count), np.empty(count))

    def after(action: Floats, backup: int) -> tuple[bool, float]:
        """Whether the backup survives after the action, and by how much."""
        nonlocal total
        amid = residuals, scale, margin, allowed, ends
        n_failures, slack, n_steps = _enter.call(model, rows, action[None], policies[backup], *amid)
        total += n_steps
        return n_failures <= allowed, slack

    for q in ranks:
        if total >= most:
            break
        passes, slack = after(proposal, q)
        if passes:
            return KEPT, proposal, q, slack
    for q in ranks:
        fallback = action_of(model, policies[q], situation[:m])
        if total >= most:
            first = action_of(model, policies[ranks[0]], situation[:m])
            return CUT_SHORT, first, ranks[0], math.inf
        if (fallback == proposal).all():
            continue  # it was refused
        passes, slack = after(fallback, q)
        if not passes:
            continue
        action, off, refused_share, share = fallback, fallback - proposal, 0.0, 1.0
        for _ in range(0 if choices else _HALVINGS):
            half = 0.5 * (refused_share + share)
            closer = proposal + half * off
            passes, distance = after(closer, q)
            if passes:
                action, share, slack = closer, half, distance
            else:
                refused_share = half
        return CHANGED, action, q, slack
    if not lasting:
        return NOTHING_PASSES, proposal, ranks[0], math.inf
    best, longest, shortest, proposal_worth = ranks[0], -np.inf, np.inf, -np.inf
    for q in ranks:
        inputs = model, rows, policies[q], residuals, scale
        lasts = _mean(rollout(*inputs).worth)
        shortest = min(shortest, lasts)
        if lasts > longest + ROUNDING:
            best, longest = q, lasts
        proposal_worth = max(proposal_worth, _mean(rollout(*inputs, proposal[None]).worth))
    apart = (longest - shortest) / (abs(longest) + 1e-12)
    if proposal_worth >= longest - longer:
        return NOTHING_PASSES, proposal, best, apart
    return NOTHING_PASSES, action_of(model, policies[best], situation[:m]), best, apart


def _mean(values: Floats) -> float:
    """The mean, added up in their order, as the C does."""
    return float(np.cumsum(values)[-1]) / values.size


def action_of(model: Model, policy: Floats, z: Floats) -> Floats:
    """(a,) what a backup (a, 1 + m) does at an observation."""
    action, off = policy[:, 0], (z - model.mean).tolist()
    for slope, distance, inverse in zip(policy.T[1:], off, model.inverse.tolist(), strict=True):
        action = action + slope * distance * inverse
    if model.choices:
        return np.asarray(np.eye(len(action))[action.argmax()])
    return np.minimum(np.maximum(action, -1.0), 1.0)
