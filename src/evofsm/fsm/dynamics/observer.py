"""An observer: where one is, from what was expected and what is seen, where sensors are noisy.

What is expected of a variable is corrected by a share of what it misses, the gain (Luenberger, "An
introduction to observers", IEEE Transactions on Automatic Control 16, 1971). A gain of 1 takes a
variable as it is seen; where sensors are exact, nothing foresees more. Below it the model smooths.
Which gain foresees most is tried on every episode, as in prediction error methods (Ljung, "System
Identification", 1999).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from evofsm.fsm.dynamics.consequents import Consequents, Futures, Here, begin_at, expect, futures
from evofsm.fsm.kernels import compiled, inner_kernel

_Floats = NDArray[np.float64]

#: Gains that are tried.
GAINS = np.array([1.0, 0.7, 0.5, 0.35, 0.25, 0.15])
# What misses by so many ordinary changes jumped, and is taken as it is seen.
_JUMP = 8.0
# Of what gains missed, what still counts an episode later; what those below 1 are said to have
# missed before any was tried; and up to how much more than the least is hardly more.
_FADES, _AT_FIRST, _HARDLY = 0.9, 0.05, 0.005


def untried(m: int) -> _Floats:
    """(m, g) what gains of m variables miss as long as none was tried: all is taken as seen.

    Examples
    --------
    >>> best_gains(untried(2))
    array([1., 1.])
    """
    missed = np.full((m, len(GAINS)), _AT_FIRST)
    missed[:, GAINS == 1.0] = 0.0
    return missed


def best_gains(missed: _Floats) -> _Floats:
    """(m,) for each variable the largest gain that misses hardly more than the best one.

    Parameters
    ----------
    missed : (m, g) ndarray
        As `tried` returns it.

    Examples
    --------
    >>> best_gains(np.array([[0.44, 0.41, 0.391, 0.388, 0.39, 0.41]]))
    array([0.5])
    """
    hardly_more = missed <= missed.min(1, keepdims=True) + _HARDLY
    found: _Floats = GAINS[hardly_more.argmax(1)]
    return found


def tried(missed: _Floats, known: Consequents, Z: _Floats, U: _Floats, unit: _Floats) -> _Floats:
    """(m, g) what gains miss, after an episode of observations (T + 1, m) and actions (T, a).

    Mean of log(1 + square) of what a variable's next observation misses [ordinary changes] of what
    was expected, of which the last episodes count most.
    """
    latest = _missed(known, Z, U, np.maximum(unit, 1e-300))
    found: _Floats = _FADES * missed + (1.0 - _FADES) * latest
    return found


@inner_kernel
def _correct(
    known: Consequents, room: Futures, seen: _Floats, gains: _Floats, unit: _Floats
) -> None:
    """Go on to where one is, by what is expected in ``room.move`` and what is ``seen`` (m,).

    With a gain of each variable in each future (m, n). What was missed is in ``room.next`` then.
    """
    z, missed = room.z, room.next
    for j in range(len(z)):
        for l in range(z.shape[1]):
            expected = min(max(z[j, l] + room.move[j, l], known.lowest[j]), known.highest[j])
            missed[j, l] = seen[j] - expected
            gain = 1.0 if abs(missed[j, l]) > _JUMP * unit[j] else gains[j, l]
            y = seen[j] + (gain - 1.0) * missed[j, l]
            room.change[j, l] = y - z[j, l]
            z[j, l] = y


@compiled
def corrected(
    known: Consequents, here: Here, action: _Floats, seen: _Floats, unit: _Floats
) -> _Floats:
    """(m,) where one is, a step after ``here`` and an action (a,), if that is ``seen`` (m,)."""
    room = futures(known, len(action), np.arange(1))
    begin_at(room, here)
    gains = np.empty(room.z.shape)
    for i in range(len(action)):
        room.action[i, :] = action[i]
    for j in range(len(seen)):
        gains[j, :] = known.gains[j]
    expect(known, room)
    _correct(known, room, seen, gains, unit)
    return room.z[:, 0].copy()


@compiled
def _missed(known: Consequents, Z: _Floats, U: _Floats, unit: _Floats) -> _Floats:
    """(m, g) what each gain of a variable misses of it, the others being taken as they are seen."""
    m, a, g = Z.shape[1], U.shape[1], len(GAINS)
    room = futures(known, a, np.arange(m * g))
    gains, found = np.ones(room.z.shape), np.zeros((m, g))
    for j in range(m):
        gains[j, j * g : (j + 1) * g] = GAINS
    begin_at(room, Here(Z[0], np.zeros(m), np.zeros(a)))
    for t in range(len(U)):
        for i in range(a):
            room.action[i, :] = U[t, i]
        expect(known, room)
        _correct(known, room, Z[t + 1], gains, unit)
        for i in range(a):
            room.before[i, :] = U[t, i]
        for j in range(m):
            for k in range(g):
                off = room.next[j, j * g + k] / unit[j]
                found[j, k] += np.log1p(off * off)
    return found / len(U)
