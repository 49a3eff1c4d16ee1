"""Kernels of the learnt judge: which action is survived, whatever of what is remembered begins now.

A predictive safety filter (Wabersich & Zeilinger, "A predictive safety filter for learning-based
control of constrained nonlinear dynamical systems", Automatica 2021), with a model, disturbances
and backup policies that are learnt online.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from evofsm.core import (
    Consequents,
    Disturbances,
    Here,
    Scratch,
    compiled,
    follow_policy,
    replay,
    scratch,
)

_Floats = NDArray[np.float64]
_Ints = NDArray[np.int64]

#: What a search found: the proposal passes, another action passes, or nothing does.
KEPT, CHANGED, NOTHING_PASSES = 0, 1, 2

# Halvings between a proposal and an action that passes.
_HALVINGS = 4
# Of two that last as long up to so much the first is taken.
_EQUAL = 1e-9
# What the least distance counts beside the time survived.
_DISTANCE, _FAR = 0.05, 0.05


@compiled
def _lost(
    action: _Floats,
    policy: _Floats,
    margin: float,
    known: Consequents,
    here: Here,
    disturbances: Disturbances,
    order: _Ints,
    harder: float,
    allowed: int,
    room: Scratch,
) -> tuple[int, float]:
    """Number of disturbances that are not survived by the margin, up to one more than allowed.

    And the least distance to failure under the others. Those that are not survived come first in
    ``order`` from then on: they are the quickest to refuse by.
    """
    lost, steps, left = 0, disturbances.residuals.shape[1], np.inf
    for i in range(len(order)):
        k = order[i]
        survived, least = replay(known, here, action, policy, disturbances, k, harder, margin, room)
        if survived == steps and least >= margin:
            left = min(left, least)
            continue
        lost += 1 if k > 0 else allowed + 1  # without any disturbance it has to go well
        for l in range(i, 0, -1):
            order[l] = order[l - 1]
        order[0] = k
        if lost > allowed:
            break
    return lost, left


@compiled
def search(
    known: Consequents,
    here: Here,
    proposal: _Floats,
    policies: _Floats,
    ranks: _Ints,
    disturbances: Disturbances,
    order: _Ints,
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
    room = scratch(len(here.z), a, known.weights.shape[0])
    world = (known, here, disturbances, order, harder, allowed, room)
    for q in ranks:
        lost, left = _lost(proposal, policies[q], margin, *world)
        if lost <= allowed:
            best[:] = proposal
            return KEPT, q, left
    own, middle = np.empty(a), np.empty(a)
    for q in ranks:
        follow_policy(known, policies[q], here.z, own)
        if known.choices > 0 and (own == proposal).all():
            continue  # it was refused
        lost, left = _lost(own, policies[q], margin, *world)
        if lost > allowed:
            continue
        best[:] = own
        share, refused = 1.0, 0.0
        for _ in range(_HALVINGS if known.choices == 0 else 0):
            half = 0.5 * (refused + share)
            middle[:] = proposal + half * (own - proposal)
            lost, closer = _lost(middle, policies[q], margin, *world)
            if lost <= allowed:
                share, left = half, closer
                best[:] = middle
            else:
                refused = half
        return CHANGED, q, left
    which = -1
    longest, shortest = -np.inf, np.inf
    nothing = np.empty(0)
    for q in ranks:
        total = 0.0
        for k in range(len(order)):
            total += lasting(known, here, nothing, policies[q], disturbances, k, harder, room)
        shortest = min(shortest, total)
        if total > longest + _EQUAL:
            longest, which = total, q
            follow_policy(known, policies[q], here.z, best)
    return NOTHING_PASSES, which, (longest - shortest) / (abs(longest) + 1e-12)


@compiled
def lasting(
    known: Consequents,
    here: Here,
    action: _Floats,
    policy: _Floats,
    disturbances: Disturbances,
    k: int,
    harder: float,
    room: Scratch,
) -> float:
    """Share of the horizon that is survived, and a little for the least distance to failure."""
    steps = disturbances.residuals.shape[1]
    survived, least = replay(known, here, action, policy, disturbances, k, harder, 0.0, room)
    share: float = survived / steps
    return share + _DISTANCE * min(1.0, max(-1.0, _FAR * least))


@compiled
def escapes(
    known: Consequents,
    here: Here,
    action: _Floats,
    policies: _Floats,
    ranks: _Ints,
    disturbances: Disturbances,
    found: _Floats,
) -> None:
    """For each disturbance the least distance to failure under the backup that escapes it best.

    Disturbances are taken as they were; where ``action`` is empty, the backup begins. Where none
    escapes, the steps left as it fails, negative.
    """
    room = scratch(len(here.z), policies.shape[1], known.weights.shape[0])
    steps = disturbances.residuals.shape[1]
    for k in range(len(found)):
        found[k] = -np.inf
        for q in ranks:
            t, least = replay(known, here, action, policies[q], disturbances, k, 1.0, 0.0, room)
            found[k] = max(found[k], least if t == steps else t - steps - 1.0)
            if found[k] >= 0.0:
                break


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
    """For each disturbance (row) and situation (column) how well the best of the policies ends.

    The steps left where it fails, negative, less 1; else the least distance.
    """
    a, p = before.shape[1], known.weights.shape[0]
    room, nothing = scratch(z.shape[1], a, p), np.empty(0)
    steps = disturbances.residuals.shape[1]
    for r in range(len(z)):
        here = Here(z[r], change[r], before[r])
        for k in range(len(found)):
            best = -np.inf
            for q in range(len(policies)):
                t, least = replay(
                    known, here, nothing, policies[q], disturbances, k, harder, 0.0, room
                )
                best = max(best, least if t == steps else -1.0 - (steps - t))
            found[k, r] = best


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
) -> float:
    """How well a policy ends, over all situations and the disturbances ``which``."""
    room, nothing = scratch(z.shape[1], before.shape[1], known.weights.shape[0]), np.empty(0)
    total = 0.0
    for r in range(len(z)):
        here = Here(z[r], change[r], before[r])
        for k in which:
            total += lasting(known, here, nothing, policy, disturbances, k, harder, room)
    return total / (len(z) * len(which))
