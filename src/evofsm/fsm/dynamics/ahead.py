"""Whether lags mislead a model: what it foresaw where failure was foreseen that never came.

A feature may help one step ahead and mislead over many: that what just changed goes on is never
contradicted in a replay. So where an episode went on although nothing seemed to help, the model is
held against what came: if it had foreseen more without latest changes and the previous action,
those are doubted (a cumulative sum, Page, "Continuous inspection schemes", Biometrika 1954).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from evofsm.fsm.dynamics.consequents import Consequents, Disturbances, advance, futures
from evofsm.fsm.kernels import compiled

_Floats = NDArray[np.float64]
_Ints = NDArray[np.int64]

# Steps of an episode from which it is tried how much was foreseen.
_STARTS = 12
# What an episode says of lags counts no more than this, and so much of doubt is enough.
_MOST, _ENOUGH = 1.0, 1.0


def misled_by_lags(
    asked: Consequents,
    left_out: Consequents,
    Z: _Floats,
    U: _Floats,
    starts: _Ints,
    steps: int,
    unit: _Floats,
) -> float:
    """How much more is missed with lags than without, in [-1, 1], in an episode.

    Observations (T + 1, m), actions (T, a); from each of ``starts``, of which the last is at most T
    - ``steps``.
    """
    some = starts[np.unique(np.linspace(0, len(starts) - 1, _STARTS).astype(int))]
    calm = Disturbances.nothing(len(some), steps, len(unit))
    missed, less = (missed_ahead(known, calm, Z, U, some, unit) for known in (asked, left_out))
    return min(_MOST, max(-_MOST, missed - less))


def are_misleading(doubt: float) -> bool:
    """Whether lags are left out."""
    return doubt >= _ENOUGH


@compiled
def missed_ahead(
    known: Consequents,
    calm: Disturbances,
    Z: _Floats,
    U: _Floats,
    starts: _Ints,
    unit: _Floats,
) -> float:
    """Mean of log(1 + square) of what is missed [ordinary changes], over starts and steps."""
    n, m, a, steps = len(starts), Z.shape[1], U.shape[1], calm.residuals.shape[1]
    room = futures(known, a, np.arange(n), calm)
    for l in range(room.z.shape[1]):
        t = starts[min(l, n - 1)]
        for j in range(m):
            room.z[j, l], room.change[j, l] = Z[t, j], Z[t, j] - Z[max(0, t - 1), j]
        for i in range(a):
            room.before[i, l] = U[t - 1, i] if t > 0 else 0.0
    total = 0.0
    for k in range(steps):
        for l in range(room.z.shape[1]):
            for i in range(a):
                room.action[i, l] = U[starts[min(l, n - 1)] + k, i]
        advance(known, calm, k, 1.0, room)
        for l in range(n):
            for j in range(m):
                off = (room.z[j, l] - Z[starts[l] + k + 1, j]) / max(unit[j], 1e-300)
                total += np.log1p(off * off)
    return float(total / (n * steps))
