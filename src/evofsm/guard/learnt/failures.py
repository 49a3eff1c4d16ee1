"""How a threshold is learnt: where a system fails, from where it did.

Thresholds are sides of the box of all that was survived, the fewest that explain the failures; of
two that explain the first ones alike, both hold until another failure tells them apart. Where noise
blurs the ends of the box, a failure may lie within it: then the threshold is where the innermost of
such failures was seen.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

_Floats = NDArray[np.float64]

# How far from what was survived failure is looked for, halvings between the two, and how far in.
_RADII, _HALVINGS, _DEEP = tuple(0.1 * 1.3**k for k in range(20)), 40, 0.05
# So many failures may leave two sides undecided.
_FIRST = 2
# Beyond an end is what is so many ordinary changes beyond; blurred ends are so wide.
_BEYOND, _BLUR = 1e-12, 5.0


def explain_failures(
    failures: _Floats,
    lowest: _Floats,
    highest: _Floats,
    unit: _Floats,
    blur: _Floats,
    least: float = 0.0,
) -> list[tuple[int, float, float]]:
    """Thresholds as (variable, sign, where): a variable beyond its threshold is failure.

    Of ``failures`` (k, m), observations in which episodes failed, amid all that was survived from
    ``lowest`` to ``highest`` (m,). ``unit`` (m,) is the ordinary change of each variable. A failure
    within five times ``blur`` (m, 2) of the lowest or the highest may have been beyond it, as noise
    blurs them; 0 where a variable saturates. Sides that some are beyond by ``least`` come first.
    """
    m = len(unit)
    if not len(failures) or not np.isfinite(lowest).all():  # or nothing was survived yet
        return []
    ends = np.concatenate([lowest, highest])
    far = np.hstack([lowest - failures, failures - highest])
    with np.errstate(over="ignore"):  # of a variable that never changed it is far enough
        beyond = far / np.tile(unit, 2)
    perhaps = far > -_BLUR * blur.T.ravel()
    left = np.ones(len(failures), bool)
    found: dict[int, float] = {}
    for clear in (max(least, _BEYOND), _BEYOND):
        while (explained := (beyond > clear) & left[:, None]).any():
            tied, best = _most_telling(explained, perhaps, beyond)
            left &= ~(beyond[:, best] > _BEYOND)
            undecided = len(failures) <= _FIRST and len(tied) == 2
            for k in tied if undecided else [best]:
                found[k] = float(ends[k])
    while (explained := perhaps & left[:, None]).any():
        _, best = _most_telling(explained, perhaps, beyond)
        left &= ~explained[:, best]
        among = failures[explained[:, best], best % m]
        found[best] = float(among.max() if best < m else among.min())  # the innermost
    return [(k % m, -1.0 if k < m else 1.0, at) for k, at in found.items()]


def _most_telling(
    explained: NDArray[np.bool_], perhaps: NDArray[np.bool_], beyond: _Floats
) -> tuple[list[int], int]:
    """Ends that explain most failures, and of them the one that may explain most, and by most."""
    votes = explained.sum(0)
    tied = np.flatnonzero(votes == votes.max()).tolist()
    best, most = tied[0], (-1.0, 0.0)
    for k in tied:
        tells = float(perhaps[:, k].sum()), float(np.median(beyond[explained[:, k], k]))
        if tells > most:
            best, most = k, tells
    return tied, best


def ask(
    failed: Callable[[_Floats], bool], survived: _Floats, towards: _Floats
) -> tuple[_Floats, _Floats]:
    """Observations that a function says are failures, each at the edge of them, and others.

    Looked for from some that were ``survived`` (n, m) in the directions ``towards`` (r, m).
    """
    lost, kept = [], []
    starts = survived[np.linspace(0, len(survived) - 1, len(towards)).astype(int)]
    for z, off in zip(starts, towards, strict=True):
        near = 0.0
        for far in _RADII:
            if failed(z + far * off):
                for _ in range(_HALVINGS):
                    half = 0.5 * (near + far)
                    near, far = (near, half) if failed(z + half * off) else (half, far)
                deep = far + _DEEP
                lost.append(z + (deep if failed(z + deep * off) else far) * off)
                kept.append(z + near * off)
                break
            kept.append(z + far * off)
            near = far
    m = survived.shape[1]
    return np.array(lost).reshape(-1, m), np.array(kept).reshape(-1, m)
