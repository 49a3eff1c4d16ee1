"""How close is too close: learnt from how close objects came in steps that ended in failure."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

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

    def of(self, start: _Floats, end: _Floats) -> _Floats:
        """Probability of failure in steps between places, (..., p) each."""
        come = closest(start, end, self.sides)
        return np.asarray(np.interp(come, self.closeness, self.risk, right=0.0))


def closest(start: _Floats, end: _Floats, sides: _Floats) -> _Floats:
    """How close it comes between two places: the least max |x_i| / side_i on the line."""
    least = np.full(np.broadcast(start, end).shape[:-1], np.inf)
    for share in np.linspace(0.0, 1.0, _POINTS):
        at = np.abs(start + share * (end - start)) / sides
        np.minimum(least, at.max(-1), out=least)
    return least


def learn(
    survived: tuple[_Floats, _Floats], failed: list[tuple[_Floats, _Floats]], spread: _Floats
) -> Contact:
    """From steps of objects that were survived, and from those of all objects at each failure.

    The shape of the box is the one by which the fewest survived steps came closer than the failed
    ones. The probability at closeness c is F / (F + S): failures that happened at c or farther
    away, and steps that were survived at c or closer. So it falls with the distance, whatever else.

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
    failures = len(met) - np.searchsorted(met, at, "left")
    survivals = np.searchsorted(near, at, "right")
    risk = failures / np.maximum(failures + survivals, 1)
    return Contact(sides, np.append(0.0, at), np.append(1.0, risk))
