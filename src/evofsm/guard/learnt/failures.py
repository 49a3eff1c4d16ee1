"""How a threshold is learnt: where a system fails, from where it did.

Thresholds are sides of the box of all that was survived, the fewest that explain the failures; of
two that explain the first ones alike, both hold until another failure tells them apart. Where noise
blurs the ends of the box, a failure may lie within it: then the threshold is where the innermost of
such failures was seen.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

_Floats = NDArray[np.float64]

# How far from a safe observation a failure is looked for, in halvings and doublings.
_FARTHEST, _HALVINGS = 40, 60
# So many failures may leave two sides undecided.
_FIRST = 2
# Beyond an end is what is so many ordinary changes beyond; blurred ends are so wide.
_BEYOND, _BLUR = 1e-12, 5.0
# States in which a function is compared with its thresholds, and how far beyond them.
_COMPARED, _AROUND = 256, 0.25


def explain_failures(
    failures: _Floats, lowest: _Floats, highest: _Floats, unit: _Floats, blur: _Floats
) -> list[tuple[int, float, float]]:
    """Thresholds as (variable, sign, where): a variable beyond its threshold is failure.

    Of ``failures`` (k, m), observations in which episodes failed, amid all that was survived from
    ``lowest`` to ``highest`` (m,). ``unit`` (m,) is the ordinary change of each variable. A failure
    within five times ``blur`` (m, 2) of the lowest or the highest may have been beyond it, as noise
    blurs them; 0 where a variable saturates.
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
    while (explained := (beyond > _BEYOND) & left[:, None]).any():
        tied, best = _most_telling(explained, perhaps, beyond)
        left &= ~explained[:, best]
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


def probe(
    failed: Callable[[_Floats], bool], safe: _Floats, unit: _Floats
) -> list[tuple[int, float, float]]:
    """Thresholds of a failure set that is a function, along each variable from ``safe``."""
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


def difference(
    failed: Callable[[_Floats], bool],
    thresholds: Sequence[tuple[int, float, float]],
    lowest: _Floats,
    highest: _Floats,
) -> float:
    """Share of the states around in which a function says otherwise than its thresholds.

    Around is what was survived, from ``lowest`` to ``highest`` (m,), and some way past thresholds.
    """
    low, high = lowest.copy(), highest.copy()
    for j, sign, at in thresholds:
        past = at + sign * _AROUND * max(abs(at - lowest[j]), abs(at - highest[j]))
        low[j], high[j] = min(low[j], past), max(high[j], past)
    if not np.isfinite(high - low).all():  # nothing was survived yet
        return 0.0
    z = np.random.default_rng(0).uniform(low, high, (_COMPARED, len(low)))
    beyond = np.any([sign * (z[:, j] - at) > 0.0 for j, sign, at in thresholds], 0)
    return float(np.mean([bool(failed(one)) for one in z] != beyond))
