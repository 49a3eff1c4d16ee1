"""Where a system fails, from where it did: sides of the box of all that was survived.

The fewest sides that explain the failures; of two that explain the first ones alike, both hold
until another failure tells them apart.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

_Floats = NDArray[np.float64]

# How far from a safe observation a failure is looked for, in halvings and doublings.
_FARTHEST, _HALVINGS = 40, 60
# So many failures may leave two sides undecided.
_FIRST = 2


def explain_failures(
    failures: _Floats, lowest: _Floats, highest: _Floats, unit: _Floats
) -> list[tuple[int, float, float]]:
    """Sides as (variable, sign, threshold): a variable beyond its threshold is failure.

    Parameters
    ----------
    failures : (k, m) ndarray
        Last observations of episodes that failed.
    lowest, highest : (m,) ndarray
        Of all observations that were survived.
    unit : (m,) ndarray
        Ordinary change of each variable.

    Examples
    --------
    >>> low, high = np.array([1.0, 0.0]), np.array([9.0, 5.0])
    >>> explain_failures(np.array([[-0.5, 3.0], [-0.1, 6.0]]), low, high, np.ones(2))
    [(0, -1.0, 1.0)]
    """
    m = len(unit)
    if not len(failures):
        return []
    with np.errstate(over="ignore"):  # of a variable that never changed it is far enough
        beyond = np.hstack([lowest - failures, failures - highest]) / np.tile(unit, 2)
    left = np.ones(len(failures), bool)
    found: list[int] = []
    while (explained := (beyond > 1e-12) & left[:, None]).any():
        votes = explained.sum(0)
        tied = np.flatnonzero(votes == votes.max())
        depth = [float(np.median(beyond[explained[:, k], k])) for k in tied]
        best = int(tied[int(np.argmax(depth))])
        left &= ~explained[:, best]
        undecided = len(failures) <= _FIRST and len(tied) == 2
        found += [int(k) for k in tied] if undecided else [best]
    return [
        (k % m, -1.0 if k < m else 1.0, float(lowest[k % m] if k < m else highest[k % m]))
        for k in found
    ]


def probe(
    failed: Callable[[_Floats], bool], safe: _Floats, unit: _Floats
) -> list[tuple[int, float, float]]:
    """Sides of a failure set that was told as a function, along each variable from ``safe``.

    Examples
    --------
    >>> [(j, sign, at)] = probe(lambda z: z[0] <= 0.0, np.array([5.0, 1.0]), np.ones(2))
    >>> j, sign, round(at, 9)
    (0, -1.0, 0.0)
    """
    found: list[tuple[int, float, float]] = []
    for j in range(len(safe)):
        for sign in (-1.0, 1.0):
            z, far = safe.copy(), unit[j]
            for _ in range(_FARTHEST):
                z[j] = safe[j] + sign * far
                if failed(z):
                    break
                far *= 2.0
            else:
                continue
            near = 0.0
            for _ in range(_HALVINGS):
                half = 0.5 * (near + far)
                z[j] = safe[j] + sign * half
                near, far = (near, half) if failed(z) else (half, far)
            found.append((j, sign, float(safe[j] + sign * near)))
    return found
