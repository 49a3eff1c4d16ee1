"""The consequents: what follows from where one is, what just happened, and what one does.

The other half of eTS (Angelov & Filev, "An approach to online identification of Takagi-Sugeno
fuzzy models", 2004), of which the paper uses the antecedents alone. The change of an observation
is linear in features of it; an action is what is in [-1, 1] in each of its dimensions, or a one
among zeros where it is one of a few.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from evofsm.core.kernels import compiled, inner_kernel, rare_kernel

#: Where the effect of an action may bend, in each dimension of a box.
KNOTS = np.array([-0.5, 0.0, 0.5])

_Floats = NDArray[np.float64]


class Consequents(NamedTuple):
    """What is expected, as kernels see it: m variables, a numbers of an action, p features."""

    weights: _Floats  #: (p, m) change of each variable for each feature
    origin: _Floats  #: (m,) from which variables are counted: the first observation
    reach: _Floats  #: (m,) a latest change beyond this has no sequel
    lowest: _Floats  #: (m,) where variables saturate; infinite where they do not
    highest: _Floats  #: (m,)
    least: _Floats  #: (m,) most negative ordinary change there was
    most: _Floats  #: (m,) most positive one
    sides: _Floats  #: (k, 4) failure: variable, its sign, threshold, and what a change is worth
    mean: _Floats  #: (m,) of what policies take for their middle
    inverse: _Floats  #: (m,) and one over their spread
    choices: int  #: number of actions; 0 where the action is a box


class Here(NamedTuple):
    """Where one is, and how one got there."""

    z: _Floats  #: (m,) observation
    change: _Floats  #: (m,) since the one before
    action: _Floats  #: (a,) latest one


class Disturbances(NamedTuple):
    """K stretches of what was not expected, H steps each; number 0 is none at all."""

    residuals: _Floats  #: (K, H, m)
    jump_at: _Floats  #: (K, m) step at which a variable jumps; -1: at none
    jump_to: _Floats  #: (K, m) to where, from 0
    jump_slope: _Floats  #: (K, m, m) and so much of where each variable was
    jump_from: _Floats  #: (K, m, m, 2) least and most from which such jumps were seen
    landing: _Floats  #: (K, m, 2) least and most to which such jumps led


class Scratch(NamedTuple):
    """Room to work in."""

    z: _Floats
    was: _Floats
    change: _Floats
    move: _Floats
    action: _Floats
    before: _Floats
    features: _Floats


def n_features(m: int, a: int, *, box: bool) -> int:
    """Number of features: 1, z, latest change, action, previous action, bends, products."""
    return 1 + 2 * m + 2 * a + (len(KNOTS) * a if box else 0) + n_products(m, a)


def n_products(m: int, a: int) -> int:
    """Number of products: of actions with variables, and of two variables; they come last."""
    return a * m + m * (m + 1) // 2


@compiled
def scratch(m: int, a: int, p: int) -> Scratch:
    """Room for m variables, a numbers of an action and p features."""
    z, was, change, move = np.empty(m), np.empty(m), np.empty(m), np.empty(m)
    return Scratch(z, was, change, move, np.empty(a), np.empty(a), np.empty(p))


@inner_kernel
def fill_features(
    z: _Floats,
    change: _Floats,
    action: _Floats,
    before: _Floats,
    origin: _Floats,
    reach: _Floats,
    box: bool,
    features: _Floats,
) -> None:
    """The features of a situation and an action."""
    m, a = len(z), len(action)
    features[0] = 1.0
    for j in range(m):
        features[1 + j] = z[j] - origin[j]
        features[1 + m + j] = change[j] if abs(change[j]) <= reach[j] else 0.0
    k = 1 + 2 * m
    for i in range(a):
        features[k + i] = action[i]
        features[k + a + i] = before[i]
    k += 2 * a
    if box:
        for i in range(a):
            for knot in KNOTS:
                features[k] = abs(action[i] - knot)
                k += 1
    for i in range(a):
        for j in range(m):
            features[k] = action[i] * features[1 + j]
            k += 1
    for i in range(m):
        for j in range(i, m):
            features[k] = features[1 + i] * features[1 + j]
            k += 1


@inner_kernel
def expect(
    known: Consequents,
    z: _Floats,
    change: _Floats,
    action: _Floats,
    before: _Floats,
    features: _Floats,
    move: _Floats,
) -> None:
    """The change that is expected: ``move``."""
    fill_features(
        z, change, action, before, known.origin, known.reach, known.choices == 0, features
    )
    for j in range(len(z)):
        total = 0.0
        for k in range(len(features)):
            total += features[k] * known.weights[k, j]
        move[j] = total


@inner_kernel
def follow_policy(known: Consequents, policy: _Floats, z: _Floats, action: _Floats) -> None:
    """The action of a linear policy, (a, 1 + m): saturated, or the largest of a few."""
    best, largest = 0, -np.inf
    for i in range(len(action)):
        s = policy[i, 0]
        for j in range(len(z)):
            s += policy[i, 1 + j] * (z[j] - known.mean[j]) * known.inverse[j]
        if known.choices == 0:
            action[i] = min(1.0, max(-1.0, s))
        else:
            action[i] = 0.0
            if s > largest:
                best, largest = i, s
    if known.choices > 0:
        action[best] = 1.0


@inner_kernel
def advance(
    known: Consequents,
    disturbances: Disturbances,
    k: int,
    t: int,
    harder: float,
    room: Scratch,
) -> None:
    """Take the action in ``room`` there, amid step t of disturbance k."""
    m, a = len(room.z), len(room.action)
    expect(known, room.z, room.change, room.action, room.before, room.features, room.move)
    for j in range(m):
        room.was[j] = room.z[j]
    for j in range(m):
        x = room.move[j] + harder * disturbances.residuals[k, t, j]
        x = min(max(x, harder * known.least[j]), harder * known.most[j])
        y = room.z[j] + x
        if disturbances.jump_at[k, j] == t:
            y = disturbances.jump_to[k, j]
            for i in range(m):
                seen = disturbances.jump_from[k, j, i]
                was = min(max(room.was[i], seen[0]), seen[1])
                y += disturbances.jump_slope[k, j, i] * was
            landing = disturbances.landing[k, j]
            y = min(max(y, landing[0]), landing[1])
        y = min(max(y, known.lowest[j]), known.highest[j])
        room.change[j] = y - room.z[j]
        room.z[j] = y
    for i in range(a):
        room.before[i] = room.action[i]


@rare_kernel
def replay(
    known: Consequents,
    here: Here,
    first: _Floats,
    policy: _Floats,
    disturbances: Disturbances,
    k: int,
    harder: float,
    enough: float,
    room: Scratch,
) -> tuple[int, float]:
    """Steps survived, and the least distance to failure in those [ordinary changes].

    The action ``first`` is taken, then what the policy says; where ``first`` is empty, that from
    the beginning. It ends where the distance falls below ``enough``.
    """
    m, a = len(here.z), len(room.action)
    steps = disturbances.residuals.shape[1]
    for j in range(m):
        room.z[j] = here.z[j]
        room.change[j] = here.change[j]
    for i in range(a):
        room.before[i] = here.action[i]
    least = np.inf
    for t in range(steps):
        if t == 0 and len(first) > 0:
            for i in range(a):
                room.action[i] = first[i]
        else:
            follow_policy(known, policy, room.z, room.action)
        advance(known, disturbances, k, t, harder, room)
        for s in range(len(known.sides)):
            side = known.sides[s]
            left = side[1] * (side[2] - room.z[int(side[0])]) * side[3]
            if left < least:
                least = left
        if least < enough:
            return t, least
    return steps, least


@compiled
def residuals(
    known: Consequents,
    observations: _Floats,
    actions: _Floats,
    length: int,
    carried: bool,
    found: _Floats,
) -> None:
    """What was not expected, of a stretch that begins with its second observation.

    ``observations`` (length + 2, m) begin one before; ``actions`` (length + 1, a) too. Where a
    variable is expected beyond where it saturates and stays there, its residual is censored; if
    it is ``carried``, the one before goes on, for its cause may not have ended. Where nothing moves
    at all, what was expected is the model's own error: nothing disturbs.
    """
    m, a = observations.shape[1], actions.shape[1]
    room = scratch(m, a, known.weights.shape[0])
    for t in range(length):
        for j in range(m):
            room.change[j] = observations[t + 1, j] - observations[t, j]
        expect(
            known,
            observations[t + 1],
            room.change,
            actions[t + 1],
            actions[t],
            room.features,
            room.move,
        )
        still = True
        for j in range(m):
            still = still and observations[t + 2, j] == observations[t + 1, j]
        for j in range(m):
            y, x = observations[t + 1, j] + room.move[j], observations[t + 2, j]
            close = 1e-9 / known.inverse[j]
            low, high = x <= known.lowest[j] + close, x >= known.highest[j] - close
            beyond = (y < known.lowest[j] and low) or (y > known.highest[j] and high)
            found[t, j] = 0.0 if still or beyond else x - y
            if carried and t > 0:
                if low:
                    found[t, j] = min(found[t, j], found[t - 1, j])
                elif high:
                    found[t, j] = max(found[t, j], found[t - 1, j])
    for t in range(length, len(found)):
        for j in range(m):
            found[t, j] = 0.0


def pack(known: Consequents) -> _Floats:
    """All but the sides and the number of choices, in one array."""
    parts = (known.weights, known.origin, known.reach, known.lowest, known.highest)
    return np.concatenate(
        [np.ravel(part) for part in (*parts, known.least, known.most, known.mean, known.inverse)]
    )


@compiled
def unpacked(packed: _Floats, m: int, choices: int) -> Consequents:
    """What was packed, without sides."""
    at = len(packed) - 8 * m
    return Consequents(
        packed[:at].reshape((at // m, m)),
        packed[at : at + m],
        packed[at + m : at + 2 * m],
        packed[at + 2 * m : at + 3 * m],
        packed[at + 3 * m : at + 4 * m],
        packed[at + 4 * m : at + 5 * m],
        packed[at + 5 * m : at + 6 * m],
        packed[:0].reshape((0, 4)),
        packed[at + 6 * m : at + 7 * m],
        packed[at + 7 * m :],
        choices,
    )


@compiled
def is_unforeseen(
    packed: _Floats,
    choices: int,
    before: _Floats,
    start: _Floats,
    end: _Floats,
    action_before: _Floats,
    action: _Floats,
    scale: _Floats,
    onset: float,
) -> bool:
    """Whether a residual is larger than ``onset`` times its scale (m,)."""
    m, a = len(start), len(action)
    observations, actions, found = np.empty((3, m)), np.empty((2, a)), np.empty((1, m))
    for j in range(m):
        observations[0, j], observations[1, j], observations[2, j] = before[j], start[j], end[j]
    for i in range(a):
        actions[0, i], actions[1, i] = action_before[i], action[i]
    residuals(unpacked(packed, m, choices), observations, actions, 1, False, found)
    return bool((np.abs(found[0]) > onset * scale).any())
