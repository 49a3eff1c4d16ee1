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

from evofsm.fsm.kernels import compiled, inner_kernel, lanes, rare_kernel

# After a change, so many times the largest change there was may be foreseen.
_FARTHER = 3.0
# So much of half the range of actions a policy leaves unused for each ordinary change of margin.
_RESERVE = 0.01
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
    anew: _Floats  #: (m,) 1 of a variable that moves otherwise than it did, -1 of others then, or 0
    mean: _Floats  #: (m,) of what policies take for their middle
    inverse: _Floats  #: (m,) and one over their spread
    close: _Floats  #: (m,) how far from where it saturates a variable may be seen that is there
    gains: _Floats  #: (m,) of `observer`
    choices: int  #: number of actions; 0 where the action is a box


class Here(NamedTuple):
    """Where one is, and how one got there."""

    z: _Floats  #: (m,) observation
    change: _Floats  #: (m,) since the one before
    action: _Floats  #: (a,) latest one


class Stretch(NamedTuple):
    """What happened for a while, as it was observed: residuals follow from it at any time.

    Unless it was observed of a system that moves otherwise now: then they are kept with it.
    """

    observations: _Floats  #: (L + 2, m), the first one step before it began
    actions: _Floats  #: (L + 1, a), the first one step before it began
    episode: int  #: in which it was seen, from 0
    unforeseen: _Floats  #: (L, m) residuals of then; (0, m) where they follow from the rest


class Disturbances(NamedTuple):
    """K stretches of what was not expected, H steps each; number 0 is none at all."""

    residuals: _Floats  #: (K, H, m)
    jump_at: _Floats  #: (K, m) step at which a variable jumps; -1: at none
    jump_to: _Floats  #: (K, m) to where, from 0
    jump_slope: _Floats  #: (K, m, m) and so much of where each variable was
    jump_from: _Floats  #: (K, m, m, 2) least and most from which such jumps were seen
    landing: _Floats  #: (K, m, 2) least and most to which such jumps led

    @classmethod
    def nothing(cls, count: int, steps: int, m: int) -> Disturbances:
        """So many that are none, of m variables."""
        none = np.zeros((count, m))
        slopes, ranges = np.zeros((count, m, m)), np.zeros((count, m, m, 2))
        still = np.zeros((count, steps, m))
        return cls(still, none - 1.0, none, slopes, ranges, np.zeros((count, m, 2)))


class Futures(NamedTuple):
    """Futures side by side, so that loops over them are vector instructions: so many are in use.

    There is room for n, which is `lanes` of those in use.
    """

    which: NDArray[np.int64]  #: (n,) number of the disturbance of each; 0 where there is none
    residuals: _Floats  #: (H, m, n) of those
    jumps: NDArray[np.bool_]  #: (H,) steps at which some of those jump
    z: _Floats  #: (m, n)
    change: _Floats  #: (m, n)
    before: _Floats  #: (a, n)
    action: _Floats  #: (a, n)
    move: _Floats  #: (m, n)
    next: _Floats  #: (m, n)
    features: _Floats  #: (p, n)
    survived: NDArray[np.int64]  #: (in use,) steps until failure
    least: _Floats  #: (in use,) least distance to it in those [ordinary changes]
    steps: NDArray[np.int64]  #: (n,) of which the first are `survived`
    near: _Floats  #: (n,) of which the first are `least`


def n_features(m: int, a: int, *, box: bool) -> int:
    """Number of features: 1, z, latest change, action, previous action, bends, products."""
    return 1 + 2 * m + 2 * a + (len(KNOTS) * a if box else 0) + n_products(m, a)


def n_products(m: int, a: int) -> int:
    """Number of products: of actions with variables, and of two variables; they come last."""
    return a * m + m * (m + 1) // 2


def lags(m: int, a: int) -> NDArray[np.int64]:
    """Indices of features that say what was just before: latest changes, and the action before."""
    return np.append(np.arange(1 + m, 1 + 2 * m), np.arange(1 + 2 * m + a, 1 + 2 * m + 2 * a))


@compiled
def futures(
    known: Consequents,
    a: int,
    which: NDArray[np.int64],
    disturbances: Disturbances | None = None,
) -> Futures:
    """Futures of a situation with ``a`` numbers of an action, one for each disturbance.

    Without disturbances they cannot advance.
    """
    m, p, n = len(known.origin), len(known.weights), lanes(len(which))
    padded = np.zeros(n, np.int64)
    padded[: len(which)] = which
    steps = 0 if disturbances is None else disturbances.residuals.shape[1]
    unforeseen, jumps = np.empty((steps, m, n)), np.zeros(steps, np.bool_)
    if disturbances is not None:
        for l in range(n):
            for t in range(steps):
                for j in range(m):
                    unforeseen[t, j, l] = disturbances.residuals[padded[l], t, j]
            for j in range(m):
                t = int(disturbances.jump_at[padded[l], j])
                if 0 <= t < steps:
                    jumps[t] = True
    z, change, move, after = np.empty((m, n)), np.empty((m, n)), np.empty((m, n)), np.empty((m, n))
    before, action, features = np.empty((a, n)), np.empty((a, n)), np.empty((p, n))
    survived, least = np.empty(n, np.int64), np.empty(n)
    ends = survived[: len(which)], least[: len(which)], survived, least
    room = z, change, before, action, move, after, features
    return Futures(padded, unforeseen, jumps, *room, *ends)


@inner_kernel
def begin_at(room: Futures, here: Here) -> None:
    """All futures begin here."""
    n = room.z.shape[1]
    for j in range(len(room.z)):
        for l in range(n):
            room.z[j, l] = here.z[j]
            room.change[j, l] = here.change[j]
    for i in range(len(room.before)):
        for l in range(n):
            room.before[i, l] = here.action[i]


@inner_kernel
def fill_features(
    room: Futures, origin: _Floats, reach: _Floats, box: bool, harder: float = 1.0
) -> None:
    """The features of situations and actions."""
    z, change, features = room.z, room.change, room.features
    action, before = room.action, room.before
    m, a, n = len(z), len(action), z.shape[1]
    for l in range(n):
        features[0, l] = 1.0
    for j in range(m):
        for l in range(n):
            features[1 + j, l] = z[j, l] - origin[j]
            features[1 + m + j, l] = change[j, l] if abs(change[j, l]) <= harder * reach[j] else 0.0
    k = 1 + 2 * m
    for i in range(a):
        for l in range(n):
            features[k + i, l] = action[i, l]
            features[k + a + i, l] = before[i, l]
    k += 2 * a
    if box:
        for i in range(a):
            for knot in KNOTS:
                for l in range(n):
                    features[k, l] = abs(action[i, l] - knot)
                k += 1
    for i in range(a):
        for j in range(m):
            for l in range(n):
                features[k, l] = action[i, l] * features[1 + j, l]
            k += 1
    for i in range(m):
        for j in range(i, m):
            for l in range(n):
                features[k, l] = features[1 + i, l] * features[1 + j, l]
            k += 1


@inner_kernel
def expect(known: Consequents, room: Futures, harder: float = 1.0) -> None:
    """The changes that are expected, into ``room.move``."""
    fill_features(room, known.origin, known.reach, known.choices == 0, harder)
    move, features, weights = room.move, room.features, known.weights
    n, p = move.shape[1], len(features)
    whole = p - p % 4
    for j in range(len(move)):
        for l in range(n):
            move[j, l] = 0.0
    for k in range(0, whole, 4):  # four at once: the sums are the same, and written less often
        for j in range(len(move)):
            u, v, w, x = weights[k, j], weights[k + 1, j], weights[k + 2, j], weights[k + 3, j]
            for l in range(n):
                y = move[j, l] + features[k, l] * u + features[k + 1, l] * v
                move[j, l] = y + features[k + 2, l] * w + features[k + 3, l] * x
    for k in range(whole, p):
        for j in range(len(move)):
            weight = weights[k, j]
            for l in range(n):
                move[j, l] += features[k, l] * weight


@inner_kernel
def follow_policy(
    known: Consequents, policy: _Floats, z: _Floats, action: _Floats, end: float = 1.0
) -> None:
    """Actions (a, n) of a linear policy, (a, 1 + m): saturated, or the largest of a few."""
    a, n = action.shape
    for i in range(a):
        for l in range(n):
            action[i, l] = policy[i, 0]
        for j in range(len(z)):
            slope, mean, inverse = policy[i, 1 + j], known.mean[j], known.inverse[j]
            for l in range(n):
                action[i, l] += slope * (z[j, l] - mean) * inverse
        if known.choices == 0:
            for l in range(n):
                action[i, l] = min(end, max(-end, action[i, l]))
    if known.choices > 0:
        for l in range(n):
            best = 0
            for i in range(1, a):
                if action[i, l] > action[best, l]:
                    best = i
            for i in range(a):
                action[i, l] = 1.0 if i == best else 0.0


@inner_kernel
def advance(
    known: Consequents, disturbances: Disturbances, t: int, harder: float, room: Futures
) -> None:
    """Take the actions in ``room`` there, each amid step t of its disturbance."""
    which, z, after, move = room.which, room.z, room.next, room.move
    m, n = z.shape
    expect(known, room, harder)
    for j in range(m):
        least, most = harder * known.least[j], harder * known.most[j]
        if known.anew[j] > 0.0:  # little was seen of it: no more is foreseen than there was
            for l in range(n):
                move[j, l] = min(max(move[j, l], known.least[j]), known.most[j])
        if known.anew[j] < 0.0:  # it moves as ever, but may have to go farther than it ever did
            for l in range(n):
                low = min(least, max(move[j, l], _FARTHER * known.least[j]))
                high = max(most, min(move[j, l], _FARTHER * known.most[j]))
                y = move[j, l] + harder * room.residuals[t, j, l]
                after[j, l] = z[j, l] + min(max(y, low), high)
        else:
            for l in range(n):
                move[j, l] += harder * room.residuals[t, j, l]
            for l in range(n):
                after[j, l] = z[j, l] + min(max(move[j, l], least), most)
    for j in range(m if room.jumps[t] else 0):
        for l in range(n):
            k = which[l]
            if disturbances.jump_at[k, j] == t:
                y = disturbances.jump_to[k, j]
                for i in range(m):
                    seen = disturbances.jump_from[k, j, i]
                    y += disturbances.jump_slope[k, j, i] * min(max(z[i, l], seen[0]), seen[1])
                landing = disturbances.landing[k, j]
                after[j, l] = min(max(y, landing[0]), landing[1])
    for j in range(m):
        lowest, highest = known.lowest[j], known.highest[j]
        for l in range(n):
            y = min(max(after[j, l], lowest), highest)
            room.change[j, l] = y - z[j, l]
            z[j, l] = y
    for i in range(len(room.action)):
        for l in range(n):
            room.before[i, l] = room.action[i, l]


@rare_kernel
def replay(
    known: Consequents,
    here: Here,
    first: _Floats,
    policy: _Floats,
    disturbances: Disturbances,
    harder: float,
    enough: float,
    allowed: int,
    room: Futures,
) -> int:
    """Replay disturbances side by side, into ``room``; returns how many are not survived.

    The action ``first`` is taken, then what the policy says; where ``first`` is empty, that from
    the beginning. One ends where the distance to failure falls below ``enough``, and the larger
    that is, the more of the range of actions the policy leaves unused: where full action just
    holds, no distance says how near the point of no return is. All end as soon as
    more than ``allowed`` did, or number 0 did, that is no disturbance at all; if ``allowed`` is
    negative, all go on as far as they can.
    """
    survived, least = room.steps, room.near
    count, steps, n = len(room.survived), disturbances.residuals.shape[1], len(least)
    begin_at(room, here)
    lost, end = 0, 1.0 - _RESERVE * enough
    for l in range(n):
        survived[l], least[l] = steps if l < count else -1, np.inf
    for t in range(steps):
        if t == 0 and len(first) > 0:
            for i in range(len(first)):
                room.action[i, :] = first[i]
        else:
            follow_policy(known, policy, room.z, room.action, end)
        advance(known, disturbances, t, harder, room)
        for s in range(len(known.sides)):
            side = known.sides[s]
            j, sign, threshold, worth = int(side[0]), side[1], side[2], side[3]
            for l in range(n):
                left = sign * (threshold - room.z[j, l]) * worth
                nearer = left if left < least[l] else least[l]
                least[l] = nearer if survived[l] == steps else least[l]
        fails = 0
        for l in range(n):
            fails += 1 if (survived[l] == steps) & (least[l] < enough) else 0
        if fails == 0:
            continue
        for l in range(count):
            if survived[l] == steps and least[l] < enough:
                survived[l] = t
                lost += 1
                if allowed >= 0 and room.which[l] == 0:
                    return count
        if lost == count or 0 <= allowed < lost:
            break
    return lost


@compiled
def along(known: Consequents, observations: _Floats, actions: _Floats, length: int) -> Futures:
    """Features, and moves that were expected, from each observation but the first.

    ``observations`` (length + 1 or more, m) begin one before; ``actions`` (length + 1, a) too.
    """
    m = observations.shape[1]
    room = futures(known, actions.shape[1], np.arange(length))
    for j in range(m):
        for t in range(length):
            room.z[j, t] = observations[t + 1, j]
            room.change[j, t] = observations[t + 1, j] - observations[t, j]
    for i in range(len(room.action)):
        for t in range(length):
            room.before[i, t], room.action[i, t] = actions[t, i], actions[t + 1, i]
    expect(known, room)
    return room


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
    m, room = observations.shape[1], along(known, observations, actions, length)
    for t in range(length):
        still = True
        for j in range(m):
            still = still and observations[t + 2, j] == observations[t + 1, j]
        for j in range(m):
            y, x = observations[t + 1, j] + room.move[j, t], observations[t + 2, j]
            close = known.close[j]
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
    more = (known.least, known.most, known.anew, known.mean, known.inverse)
    last = (known.close, known.gains)
    return np.concatenate([np.ravel(part) for part in (*parts, *more, *last)])


@compiled
def unpacked(packed: _Floats, m: int, choices: int) -> Consequents:
    """What was packed, without sides."""
    at = len(packed) - 11 * m
    rest = packed[at:].reshape((11, m))
    return Consequents(
        packed[:at].reshape((at // m, m)),
        rest[0],
        rest[1],
        rest[2],
        rest[3],
        rest[4],
        rest[5],
        packed[:0].reshape((0, 4)),
        rest[6],
        rest[7],
        rest[8],
        rest[9],
        rest[10],
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
