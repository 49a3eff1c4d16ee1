"""Kernels of the learnt judge: which action is survived, whatever of what is remembered begins now.

A predictive safety filter (Wabersich & Zeilinger, "A predictive safety filter for learning-based
control of constrained nonlinear dynamical systems", Automatica 2021), with a model, disturbances
and backup policies that are learnt online.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from evofsm.fsm import (
    Consequents,
    Disturbances,
    Futures,
    Here,
    compiled,
    follow_policy,
    futures,
    replay,
)

_Floats = NDArray[np.float64]
_Ints = NDArray[np.int64]

#: What a search found: the proposal passes, another action passes, or nothing does.
KEPT, CHANGED, NOTHING_PASSES = 0, 1, 2

# Halvings between a proposal and an action that passes.
_HALVINGS = 4
# Of two that last as long up to so much the first is taken.
_EQUAL = 1e-9
# What the distance counts beside the time survived.
_DISTANCE, _FAR = 0.05, 0.05


@compiled
def _lost(
    action: _Floats,
    policy: _Floats,
    margin: float,
    known: Consequents,
    here: Here,
    disturbances: Disturbances,
    harder: float,
    allowed: int,
    room: Futures,
) -> tuple[bool, float]:
    """Whether more than allowed are not survived by the margin, or not even that nothing happens.

    And the least distance to failure under the others.
    """
    lost = replay(known, here, action, policy, disturbances, harder, margin, allowed, room)
    left = np.inf
    for x in room.least:
        if x >= margin:
            left = min(left, x)
    return lost > allowed, left


@compiled
def search(
    known: Consequents,
    here: Here,
    proposal: _Floats,
    policies: _Floats,
    ranks: _Ints,
    disturbances: Disturbances,
    harder: float,
    margin: float,
    allowed: int,
    best: _Floats,
) -> tuple[int, int, float]:
    """Find ``best`` (a,), the closest action to the proposal that passes; how, by which backup.

    The last number is the least distance to failure that is then left [ordinary changes]; where
    nothing passes, how far apart the backups are: near 0 all are alike.
    """
    a = len(proposal)
    room = futures(known, a, np.arange(len(disturbances.residuals)), disturbances)
    world = (known, here, disturbances, harder, allowed, room)
    for q in ranks:
        is_lost, left = _lost(proposal, policies[q], margin, *world)
        if not is_lost:
            best[:] = proposal
            return KEPT, q, left
    own, middle, z = np.empty(a), np.empty(a), here.z.reshape((len(here.z), 1))
    for q in ranks:
        follow_policy(known, policies[q], z, own.reshape((a, 1)))
        if known.choices > 0 and (own == proposal).all():
            continue  # it was refused
        is_lost, left = _lost(own, policies[q], margin, *world)
        if is_lost:
            continue
        best[:] = own
        share, refused = 1.0, 0.0
        for _ in range(_HALVINGS if known.choices == 0 else 0):
            half = 0.5 * (refused + share)
            middle[:] = proposal + half * (own - proposal)
            is_lost, closer = _lost(middle, policies[q], margin, *world)
            if is_lost:
                refused = half
            else:
                share, left = half, closer
                best[:] = middle
        return CHANGED, q, left
    which = -1
    longest, shortest = -np.inf, np.inf
    for q in ranks:
        total = _lasting(known, here, policies[q], disturbances, harder, room)
        shortest = min(shortest, total)
        if total > longest + _EQUAL:
            longest, which = total, q
            follow_policy(known, policies[q], z, best.reshape((a, 1)))
    return NOTHING_PASSES, which, (longest - shortest) / (abs(longest) + 1e-12)


@compiled
def _lasting(
    known: Consequents,
    here: Here,
    policy: _Floats,
    disturbances: Disturbances,
    harder: float,
    room: Futures,
) -> float:
    """Shares of the horizon that are survived, and a little for the distances to failure, summed.

    The least distance, and, where all of the horizon is survived, that at its end as well: who
    comes back does better than who hovers beside failure.
    """
    replay(known, here, np.empty(0), policy, disturbances, harder, 0.0, -1, room)
    steps, total = disturbances.residuals.shape[1], 0.0
    for l in range(len(room.least)):
        left = room.least[l]
        if room.survived[l] == steps:
            end = np.inf
            for side in known.sides:
                end = min(end, side[1] * (side[2] - room.z[int(side[0]), l]) * side[3])
            left = 0.5 * (left + end)
        total += room.survived[l] / steps + _DISTANCE * min(1.0, max(-1.0, _FAR * left))
    return total


@compiled
def ends(
    known: Consequents,
    here: Here,
    action: _Floats,
    policies: _Floats,
    disturbances: Disturbances,
    harder: float,
    enough: float,
    found: _Floats,
) -> None:
    """For each disturbance how well it ends under the best of the policies, into ``found``.

    The least distance to failure; where none escapes, the steps left as it fails, negative, less 1.
    The first policy after which it is ``enough`` will do. Where ``action`` is empty, the policy
    begins.
    """
    every, steps = np.arange(len(found)), disturbances.residuals.shape[1]
    found[:] = -np.inf
    for policy in policies:
        room = futures(known, policies.shape[1], every[found < enough], disturbances)
        replay(known, here, action, policy, disturbances, harder, 0.0, -1, room)
        for l in range(len(room.least)):
            t, k = room.survived[l], room.which[l]
            found[k] = max(found[k], room.least[l] if t == steps else t - steps - 1.0)


@compiled
def outcomes(
    known: Consequents,
    here: Here,
    actions: _Floats,
    policies: _Floats,
    ranks: _Ints,
    disturbances: Disturbances,
    found: _Floats,
) -> None:
    """What comes of each action (k, a) if the best policy follows, into ``found`` (3, k).

    How many disturbances are lost, infinite if it fails without any; the least distance to failure
    under the worst of them, as `ends` has it; and the steps after which it fails at the latest.
    """
    steps, asked = disturbances.residuals.shape[1], policies[ranks]
    each = np.empty(len(disturbances.residuals))
    for i in range(len(actions)):
        ends(known, here, actions[i], asked, disturbances, 1.0, 0.0, each)
        lost, worst, took = 0.0, np.inf, 0.0
        for x in each:
            worst = min(worst, x)
            if x < 0.0:
                lost += 1.0
                took = max(took, x + 1.0 + steps)
        found[0, i] = np.inf if each[0] < 0.0 else lost
        found[1, i], found[2, i] = worst, took


@compiled
def harm(
    known: Consequents,
    z: _Floats,
    change: _Floats,
    before: _Floats,
    policies: _Floats,
    disturbances: Disturbances,
    harder: float,
    found: _Floats,
) -> None:
    """`ends` of each disturbance (row) in each situation (column), if a policy begins."""
    nothing, column = np.empty(0), np.empty(len(found))
    for r in range(len(z)):
        here = Here(z[r], change[r], before[r])
        ends(known, here, nothing, policies, disturbances, harder, np.inf, column)
        found[:, r] = column


@compiled
def worth(
    known: Consequents,
    z: _Floats,
    change: _Floats,
    before: _Floats,
    policy: _Floats,
    disturbances: Disturbances,
    which: _Ints,
    harder: float,
) -> _Floats:
    """How well a policy ends in each situation, over the disturbances ``which``."""
    room, found = futures(known, before.shape[1], which, disturbances), np.empty(len(z))
    for r in range(len(z)):
        here = Here(z[r], change[r], before[r])
        found[r] = _lasting(known, here, policy, disturbances, harder, room) / len(which)
    return found
