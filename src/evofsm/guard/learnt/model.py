"""How a system moves: changes by ridge regression, and what was not expected of them.

With features phi (`features`) and changes dz of all transitions,

    W = (sum phi phi' + R)^-1 sum phi dz',

where R is a weak prior in each feature's own variance. Sums of two models add up. Jumps, and what
rests at an end of a variable, are no dynamics; outliers weigh less.
"""

from __future__ import annotations

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from evofsm.guard.learnt.rollout import SMALL, Flags, Floats, Model, features, lags

# A change so many times those around it, and the typical one, is a jump; so is a row so far from
# the median of those around it, which is none.
JUMP = 8.0
# Of a variable's spread, what a typical step is at least.
FLOOR = 1e-3
# Rows from one in which a variable was seen to the next, at most, between which it is filled in.
_MAX_GAP = 5
# From so many features on BLAS would call threads, which wait where other processes are busy.
_MANY_FEATURES = 100


def typical_step(z: Floats) -> Floats:
    """(m,) how much variables of an episode change in a step, if nothing is known yet."""
    size = np.abs(np.diff(z, axis=0))
    size = size[np.isfinite(size).all(1)]
    if not len(size):
        return np.full(z.shape[1], 1e-300)
    middle = np.median(size, 0)
    spread = np.nanmedian(np.abs(z - np.nanmedian(z, 0)), 0)
    mean = np.mean(np.minimum(size, 6.0 * middle), 0)
    return np.maximum(np.maximum(1.2 * middle, mean), FLOOR * spread) + 1e-300


def jumps(change: Floats, unit: Floats) -> Flags:
    """(T, m) which changes (T, m) are far larger than those around them and the typical ones."""
    size = np.abs(change)
    before, after = np.vstack([size[:1], size[:-1]]), np.vstack([size[1:], 0.0 * size[-1:]])
    return np.asarray(size > JUMP * np.maximum(np.maximum(before, after), unit))


def are_jumps(z: Floats, unit: Floats) -> Flags:
    """(T,) which transitions, from the second of T + 2 observations on, begin or end in a jump."""
    is_jump: Flags = np.asarray(jumps(np.diff(z, axis=0), unit).any(1))
    return np.asarray(is_jump[1:] | is_jump[:-1])


def without_glitches(z: Floats, unit: Floats) -> Floats:
    """Observations (T, m), NaN where a variable jumped there and back within two rows.

    Not where that is how it moves: more than once, and else of two values; nor where most rows do.
    """
    if len(z) < 5:
        return z
    rows = np.pad(z, ((2, 2), (0, 0)), "reflect")
    around = np.median(sliding_window_view(rows, 5, axis=0), axis=2)
    moves = np.abs(np.diff(around, axis=0, prepend=around[:1]))
    pace = np.maximum(moves, np.vstack([moves[1:], moves[-1:]]))
    bad = np.abs(z - around) > JUMP * np.maximum(unit, pace)
    bad[[0, -1]] = False
    rest = np.where(bad, np.nan, z)
    between = (rest > np.fmin.reduce(rest)) & (rest < np.fmax.reduce(rest))
    bad &= between.any(0) | (bad.sum(0) < 2)
    if 2 * bad.any(1).sum() > len(z):
        return z
    return np.where(bad.any(1, keepdims=True), np.nan, z)


def filled(z: Floats, *, failed: bool) -> Floats:
    """Observations (T, m) in which a variable that was not seen in few rows lies on a line.

    Where it ``failed`` in the last row it is as it was last seen; of a row of which nothing was
    seen, a step farther.
    """
    if np.isfinite(z).all():
        return z
    rows, index, end = z.copy(), np.arange(len(z)), len(z) - 1
    if failed and len(z) > 2 and not np.isfinite(z[-1]).any():
        rows[-1] = 2.0 * z[-2] - z[-3]
    for column in rows.T:
        at = np.flatnonzero(np.isfinite(column))
        if len(at) > 1:
            after = np.searchsorted(at, index).clip(1, len(at) - 1)
            within = (index > at[0]) & (index < at[-1]) & (at[after] - at[after - 1] <= _MAX_GAP)
            column[within] = np.interp(index, at, column[at])[within]
        if failed and len(at) and 0 < end - at[-1] < _MAX_GAP:
            column[-1] = column[at[-1]]
    return rows


def solve(
    squares: Floats, products: Floats, noisy: Floats, a: int, prior: tuple[float, float, float]
) -> Floats:
    """(p, m) weights: ridge regression, about 0, in units of each feature's own variance.

    Bends, products and, last of all, latest changes are asked only if they have to be, else the
    first episodes say that one's own throttle speeds others up.

    Given are sums of products of features (p, p), and of features with changes (p, m); the share of
    each variable's changes that is noise (m,): the less, the less evidence its weights need; how
    many numbers an action has; and ``prior``, ``shy`` and ``lags`` of `LearntSettings`.
    """
    n, size, m = max(1.0, float(squares[0, 0])), np.diag(squares), len(noisy)
    variance = np.maximum(size - squares[0] ** 2 / n, SMALL * size)
    variance[0] = 0.0
    is_plain = np.zeros(len(size), bool)
    is_plain[: 1 + m] = is_plain[1 + 2 * m : 1 + 2 * m + a] = True
    times = np.ones(len(size))
    times[lags(m, a)] = min(prior[2], 1e15)  # infinite where they are left out
    weights = np.empty_like(products)
    for j, share in enumerate(noisy):
        penalty = np.where(is_plain, 1e-6 + share * prior[0] / n, 30e-6 + share * prior[1] / n)
        weights[:, [j]] = ridge(squares, products[:, [j]], penalty * times * variance)
    return weights


def ridge(squares: Floats, products: Floats, held: Floats) -> Floats:
    """(p, k) weights that are held to 0 by ``held`` (p,), as by so many squares more."""
    size = np.diag(squares)
    scale = 1.0 / np.sqrt(np.where(size > 0.0, size + held, 1.0))
    matrix = scale[:, None] * (squares + np.diag(held)) * scale
    matrix[np.diag_indices_from(matrix)] += 1e-10  # features that did not vary yet explain alike
    return np.asarray(scale[:, None] * _solved(matrix, scale[:, None] * products))


def _solved(squares: Floats, products: Floats) -> Floats:
    """Of a positive definite matrix, halved until its parts are too small for threads."""
    if len(squares) < _MANY_FEATURES:
        return np.asarray(np.linalg.solve(squares, products))
    n, columns = len(squares) // 2, products.reshape(len(products), -1)
    upper = _solved(squares[:n, :n], np.hstack([squares[:n, n:], columns[:n]]))
    rest = np.hstack([squares[n:, n:], columns[n:]])
    rest = rest - np.einsum("ij,jk->ik", squares[n:, :n], upper)
    n_lower = len(squares) - n
    below = _solved(rest[:, :n_lower], rest[:, n_lower:])
    above = upper[:, n_lower:] - np.einsum("ij,jk->ik", upper[:, :n_lower], below)
    return np.vstack([above, below]).reshape(products.shape)


def rows_of(model: Model, z: Floats, u: Floats) -> tuple[Floats, Floats, Flags]:
    """Features (T, p) and changes (T, m) from the second of T + 2 observations on, and which count.

    A row counts where its observation and those before and after were seen.
    """
    is_finite: Flags = np.asarray(np.isfinite(z).all(1))
    is_seen = is_finite[:-2] & is_finite[1:-1] & is_finite[2:]
    z = np.where(np.isfinite(z), z, model.origin)
    phi = features(model, z[1:-1], np.diff(z[:-1], axis=0), u[:-1], u[1:])
    return phi, np.diff(z[1:], axis=0), is_seen


def disturbed(model: Model, z: Floats, u: Floats, unit: Floats) -> Floats:
    """(T, 2m) residuals from the second of T + 2 observations on, under actions u, and landings.

    A residual is 0 where something was not seen, nothing moved, a variable jumped, or is expected
    beyond where it saturates and stays there: how far it would have gone is not known. A landing is
    where a variable jumped to unexpectedly, else inf.
    """
    phi, change, is_seen = rows_of(model, z, u)
    move, after = phi @ model.weights, z[2:]
    to = z[1:-1] + move
    is_held = ((to < model.lowest) & (after <= model.lowest)) | (
        (to > model.highest) & (after >= model.highest)
    )
    no_rest = ~is_seen | (change == 0.0).all(1) | are_jumps(z, unit)
    is_jump = jumps(np.diff(z, axis=0), unit)[1:] & is_seen[:, None]
    is_jump &= np.abs(change - move) > 0.5 * np.abs(change)
    rest = np.where(is_held | no_rest[:, None], 0.0, after - to)
    return np.hstack([rest, np.where(is_jump, after, np.inf)])


def undisturbed(steps: int, m: int, count: int) -> Floats:
    """(T, 2m, K) no residuals, no landings."""
    calm = np.zeros((steps, 2 * m, count))
    calm[:, m:] = np.inf
    return calm


def trimmed(found: Floats) -> Floats:
    """(H, m, K) residuals where no variable lands anywhere, else also landings, (H, 2m, K)."""
    m = found.shape[1] // 2
    return found if np.isfinite(found[:, m:]).any() else np.ascontiguousarray(found[:, :m])
