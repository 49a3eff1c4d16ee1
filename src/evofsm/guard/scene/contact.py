"""How close is too close: learnt from how close objects came in steps that ended in failure."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from evofsm.fsm import compiled

_Floats = NDArray[np.float64]

# Points of a step at which the distance is taken, its two ends included.
_POINTS = 6
# Shapes of the box around an object that are tried: how much longer than wide, as powers of e.
_SHAPES = np.linspace(-3.5, 3.5, 29)
# Closest steps that were survived, of which each counts.
_CLOSEST = 2000


class Contact(NamedTuple):
    """The probability of failure in a step, by how close an object comes in it."""

    sides: _Floats  #: (p,) half sides of the box in which closeness is counted
    closeness: _Floats  #: (n,) rising; 1 is at the side of the box
    risk: _Floats  #: (n,) probability of failure, falling
    met: float  #: median closeness of what failed

    def of(self, path: _Floats) -> _Floats:
        """Probability of failure by each step of paths, (..., n + 1, p) places: (..., n).

        It is that of the closest step so far: what is not known of how close is too close is not
        drawn anew in each step.
        """
        come = closest(path[..., :-1, :], path[..., 1:, :], self.sides)
        so_far = np.minimum.accumulate(come, axis=-1)
        return np.asarray(np.interp(so_far, self.closeness, self.risk))


def closest(start: _Floats, end: _Floats, sides: _Floats) -> _Floats:
    """How close it comes between two places: the least of ``max(abs(x) / sides)`` on the line."""
    start, end = np.broadcast_arrays(start, end)
    least = np.empty(start.shape[:-1])
    first, last = (np.ascontiguousarray(of).reshape(-1, len(sides)) for of in (start, end))
    _closest(first, last, sides, least.reshape(-1))
    return least


@compiled
def _closest(start: _Floats, end: _Floats, sides: _Floats, least: _Floats) -> None:
    for k in range(len(least)):
        least[k] = np.inf
        for point in range(_POINTS):
            share = point / (_POINTS - 1)
            far = 0.0
            for i in range(len(sides)):
                at = start[k, i] + share * (end[k, i] - start[k, i])
                far = max(far, abs(at) / sides[i])
            least[k] = min(least[k], far)


def learn(
    survived: tuple[_Floats, _Floats], failed: list[tuple[_Floats, _Floats]], spread: _Floats
) -> Contact:
    """From steps of objects that were survived, and from those of all objects at each failure.

    The shape of the box is the one by which the fewest survived steps came closer than the failed
    ones. The probability at closeness c is (F + 1) / (F + 1 + S): failures that happened at c or
    farther away, one more that might, and steps that were survived at c or closer. So it falls with
    the distance, and where little was survived it is high although nothing failed.

    Parameters
    ----------
    survived : ((s, p) array, (s, p) array)
        Places at the beginning and at the end of a step.
    failed : list of the same
        One for each failure; whichever object came closest is taken to be the one.
    spread : (p,) array
        Of places, to begin with.
    """
    best: tuple[float, _Floats, _Floats, _Floats] | None = None
    for power in _SHAPES if len(spread) == 2 else (0.0,):
        turned = np.exp(0.5 * power * np.array([1.0, -1.0])) if len(spread) == 2 else 1.0
        sides = spread * turned
        near = np.sort(closest(*survived, sides))
        met = np.sort([closest(*steps, sides).min() for steps in failed])
        score = float(np.log1p(np.searchsorted(near, met)).sum())
        if best is None or score < best[0]:
            best = score, sides, near, met
    assert best is not None
    _, sides, near, met = best
    at = np.unique(np.concatenate([met, near[:_CLOSEST]]))
    failures = 1 + len(met) - np.searchsorted(met, at, "left")
    risk = failures / (failures + np.searchsorted(near, at, "right"))
    return Contact(sides, np.append(0.0, at), np.append(1.0, risk), float(np.median(met)))
