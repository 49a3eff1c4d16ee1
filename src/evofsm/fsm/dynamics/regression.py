"""How consequents are learnt: sums that every transition adds to, and that are solved now and then.

Sums of two machines add up. A transition is learnt when the one after it is known, for only then
does it show whether it was a jump: one that is far larger than what came before, what came after
and what is ordinary. Jumps are no dynamics: they enter neither sums, nor units, nor limits.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba.extending import register_jitable
from numpy.typing import NDArray

from evofsm.fsm.dynamics.consequents import (
    Consequents,
    expect,
    fill_features,
    futures,
    lags,
    unpacked,
)
from evofsm.fsm.kernels import compiled

_Floats = NDArray[np.float64]

# A change so many times those around it, and the ordinary one, is a jump; so many more of the first
# ones, of which it is not known what is ordinary.
_JUMP, _FIRST_JUMP, _FIRST = 8.0, 32.0, 8.0
# The ordinary change is the median of so many, then a mean; of what is larger, so much counts.
_EARLY, _CLIP, _SLOWEST = 200, 6.0, 5000.0
# What changes in more than this share of transitions may have saturated where it rests.
MOVING = 0.5
# Residuals beyond so many of their scale weigh less.
_OUTLIER = 4.0
# Of the variance of a feature: what every weight is held to 0 by; so many times that holds those
# that are asked only if they have to be, and the latest changes among them still more.
_RIDGE, _SHY, _LAGS = 1e-6, 30.0, 10.0
# The same over the number of transitions, if all is noise; the least share of that.
_PRIOR, _SHY_PRIOR, _CLEAREST = 0.01, 20.0, 1e-3
# The least variance of a feature, and what all weights are held to 0 by, of its mean square: far
# more than rounding, so that features that did not vary yet always share what they explain alike.
_LEAST, _ALL_ALIKE = 1e-6, 1e-10


class Sums(NamedTuple):
    """What is learnt with every transition: m variables, p features."""

    counts: _Floats  #: (2,) observations, and transitions
    squares: _Floats  #: (p, p) sum of products of features
    products: _Floats  #: (p, m) and of features with changes
    mean: _Floats  #: (m,) of observations, from the origin
    scatter: _Floats  #: (m,) sum of squared distances to the mean
    variance: _Floats  #: (m,) mean square of a change
    unit: _Floats  #: (m,) ordinary change
    early: _Floats  #: (200, m) the first changes
    least: _Floats  #: (m,) most negative change that was no jump
    most: _Floats  #: (m,) most positive one
    scale: _Floats  #: (m,) of residuals; 0 as long as it is not known
    noise: _Floats  #: (m,) their mean square; 0 as long as it is not known
    low: _Floats  #: (m,) least observation
    high: _Floats  #: (m,) greatest one
    moving: _Floats  #: (m,) share of transitions in which it changed, but for rests at an extreme


@compiled
def take_in(counts: _Floats, mean: _Floats, scatter: _Floats, z: _Floats, origin: _Floats) -> None:
    """Count an observation, in arrays of `Sums`."""
    counts[0] += 1.0
    for j in range(len(z)):
        off = z[j] - origin[j] - mean[j]
        mean[j] += off / counts[0]
        scatter[j] += off * (z[j] - origin[j] - mean[j])


@compiled
def _sums_in(flat: _Floats, m: int, p: int) -> Sums:
    """The sums that stand side by side in one array."""
    products, mean = 2 + p * p, 2 + p * p + p * m
    early = mean + 4 * m
    least = early + _EARLY * m
    return Sums(
        flat[:2],
        flat[2:products].reshape((p, p)),
        flat[products:mean].reshape((p, m)),
        flat[mean : mean + m],
        flat[mean + m : mean + 2 * m],
        flat[mean + 2 * m : mean + 3 * m],
        flat[mean + 3 * m : early],
        flat[early:least].reshape((_EARLY, m)),
        flat[least : least + m],
        flat[least + m : least + 2 * m],
        flat[least + 2 * m : least + 3 * m],
        flat[least + 3 * m : least + 4 * m],
        flat[least + 4 * m : least + 5 * m],
        flat[least + 5 * m : least + 6 * m],
        flat[least + 6 * m : least + 7 * m],
    )


@compiled
def learn_latest(
    flat: _Floats,
    packed: _Floats,
    choices: int,
    before: _Floats,
    start: _Floats,
    end: _Floats,
    after: _Floats,
    action_before: _Floats,
    action: _Floats,
    first: bool,
    last: bool,
    jumped: _Floats,
) -> bool:
    """`learn_transition` for few arrays: each costs as much on the way in as all that is computed.

    ``flat`` holds `Sums` side by side, ``packed`` is what `pack` returns.
    """
    m, a = len(start), len(action)
    known = unpacked(packed, m, choices)
    sums = _sums_in(flat, m, known.weights.shape[0])
    observations, actions = np.empty((4, m)), np.empty((2, a))
    for j in range(m):
        observations[0, j], observations[1, j] = before[j], start[j]
        observations[2, j], observations[3, j] = end[j], after[j]
    for i in range(a):
        actions[0, i], actions[1, i] = action_before[i], action[i]
    return learn_transition(sums, known, observations, actions, first, last, jumped)


@compiled
def count_ends(used: _Floats, action: _Floats, lowest: float, by: float) -> None:
    """Add to ``used`` (a, 2) where a number of an action is near an end of its range."""
    for i in range(len(action)):
        used[i, 0] += by * (action[i] < lowest)
        used[i, 1] += by * (action[i] > 0.6)


@register_jitable
def _stands_out(change: Any, before: Any, after: Any, unit: Any, times: float) -> Any:
    """Whether changes are so many times those around them, and the ordinary ones."""
    around = np.maximum(np.abs(before), np.abs(after))
    return np.abs(change) > times * np.maximum(around, unit)


@compiled
def learn_transition(
    sums: Sums,
    known: Consequents,
    observations: _Floats,
    actions: _Floats,
    first: bool,
    last: bool,
    jumped: _Floats,
) -> bool:
    """Learn the transition from the second to the third of four observations; whether it jumped.

    ``observations`` (4, m): one before (none if ``first``), from, to, and one after (none if
    ``last``). ``actions`` (2, a): before, and between. ``jumped`` (m,) gets 1 where a variable
    jumped.
    """
    m, a = observations.shape[1], actions.shape[1]
    box = known.choices == 0
    room = futures(known, a, np.arange(1))
    n = sums.counts[1]
    jump = False
    z, change, features = observations[1], room.change[:, 0], room.features[:, 0]
    move, moved = np.zeros(m), np.empty(m)
    room.before[:, 0], room.action[:, 0], room.z[:, 0] = actions[0], actions[1], z
    for j in range(m):
        change[j] = 0.0 if first else observations[1, j] - observations[0, j]
    if sums.scale[0] > 0.0 and not first:
        expect(known, room)
        move[:] = room.move[:, 0]
    for j in range(m):
        now = observations[2, j] - observations[1, j]
        after = 0.0 if last else observations[3, j] - observations[2, j]
        moved[j] = now
        sums.variance[j] += (now * now - sums.variance[j]) / (n + 1.0)
        unforeseen = abs(now - move[j]) > 0.5 * abs(now)
        times = _JUMP if n > _FIRST else _FIRST_JUMP
        alone = _stands_out(now, change[j], after, sums.unit[j], times)
        jumped[j] = 1.0 if n > 0.0 and alone and unforeseen else 0.0
        jump = jump or jumped[j] > 0.0
    for j in range(m):
        now = abs(moved[j])
        floor = 1e-3 * np.sqrt(sums.scatter[j] / max(1.0, sums.counts[0]))
        ordinary = 0.0 if jumped[j] > 0.0 else moved[j]
        sums.least[j] = min(sums.least[j], ordinary)
        sums.most[j] = max(sums.most[j], ordinary)
        if n < _EARLY:
            known_now = int(n) + 1
            sums.early[known_now - 1, j] = now
            unit = max(1.2 * np.median(sums.early[:known_now, j]), floor)
            if n >= 20.0:
                total = 0.0
                for i in range(known_now):
                    total += min(sums.early[i, j], _CLIP * unit)
                unit = max(unit, total / known_now)
            sums.unit[j] = unit
        else:
            grown = (min(now, _CLIP * sums.unit[j]) - sums.unit[j]) / min(n, _SLOWEST)
            sums.unit[j] = max(sums.unit[j] + grown, floor)
    sums.counts[1] += 1.0
    weight = 1.0
    for j in range(m):
        x, now = observations[2, j], moved[j]
        sums.low[j] = min(sums.low[j], x, observations[1, j])
        sums.high[j] = max(sums.high[j], x, observations[1, j])
        if now == 0.0 and (x == sums.low[j] or x == sums.high[j]) and sums.moving[j] > MOVING:
            y = z[j] + move[j]
            stayed = (x == known.lowest[j] and y > x) or (x == known.highest[j] and y < x)
            if not stayed:
                weight = 0.0  # it may have come to its end: what it would have done is not known
        else:
            sums.moving[j] += ((now != 0.0) - sums.moving[j]) / min(n + 1.0, _SLOWEST)
    if first or jump:
        return jump
    if sums.scale[0] > 0.0:
        worst = 0.0
        for j in range(m):
            y, x, close = z[j] + move[j], observations[2, j], known.close[j]
            low = y < known.lowest[j] and x <= known.lowest[j] + close
            if low or (y > known.highest[j] and x >= known.highest[j] - close):
                weight = 0.0  # it cannot be known how far it would have gone
            else:
                worst = max(worst, abs(x - y) / sums.scale[j])
        weight *= min(1.0, _OUTLIER / max(worst, 1e-12)) ** 2
    for j in range(m):
        move[j] = 1.5 * max(abs(sums.least[j]), abs(sums.most[j]))
    fill_features(room, known.origin, move, box)
    for k in range(len(features)):
        f = weight * features[k]
        if f != 0.0:
            for i in range(len(features)):
                sums.squares[k, i] += f * features[i]
            for j in range(m):
                sums.products[k, j] += f * moved[j]
    return jump


def have_jumped(change: _Floats, unit: _Floats) -> NDArray[np.bool_]:
    """(T, m) which changes (T, m) are far larger than those around them and the ordinary ones."""
    before, after = np.vstack([change[:1], change[:-1]]), np.vstack([change[1:], 0.0 * change[-1:]])
    jumped: NDArray[np.bool_] = _stands_out(change, before, after, unit, _JUMP)
    return jumped


def solve(sums: Sums, m: int, a: int, without: _Floats) -> _Floats:
    """(p, m) weights: ridge regression, about 0, in units of each feature's own variance.

    What is true for all times is found soonest if bends, products and, last of all, latest changes
    are asked only if they have to be; else the first episodes say that one's own throttle speeds
    others up. The less of a variable's changes is noise, the less evidence its weights need.
    ``without`` (p,) is 1 for features that are left out.
    """
    squares, n = sums.squares, max(1.0, float(sums.squares[0, 0]))
    variance = np.diag(squares) - squares[0] ** 2 / n
    size = np.diag(squares)
    variance = np.where(variance > _LEAST * size, variance, _LEAST * size)
    variance[0] = 0.0
    shy = np.ones(len(size), bool)
    shy[: 1 + m] = shy[1 + 2 * m : 1 + 2 * m + a] = False
    times = np.ones(len(size))
    times[lags(m, a)] = _LAGS
    left_out = np.where(without > 0.0, 1e12 * np.maximum(size, 1.0), 0.0)
    known = sums.noise > 0.0
    noisy = np.where(known, sums.noise / np.where(known, sums.variance, 1.0), 1.0)
    weights = np.empty_like(sums.products)
    for j, share in enumerate(noisy.clip(_CLEAREST, 1.0).tolist()):
        prior = np.where(shy, _SHY * _RIDGE + share * _SHY_PRIOR / n, _RIDGE + share * _PRIOR / n)
        held = prior * times * variance + left_out
        weights[:, j] = ridge(squares, sums.products[:, j], held)
    return weights


def ridge(squares: _Floats, products: _Floats, held: _Floats) -> _Floats:
    """(p,) or (p, k) weights that are held to 0 by ``held`` (p,), as by so many squares more."""
    size = np.diag(squares)
    scale = 1.0 / np.sqrt(np.where(size > 0.0, size + held, 1.0))
    scaled = scale[:, None] * (squares + np.diag(held)) * scale
    scaled[np.diag_indices_from(scaled)] += _ALL_ALIKE
    found: _Floats = (scale * np.linalg.solve(scaled, (scale * products.T).T).T).T
    return found
