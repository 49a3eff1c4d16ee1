"""Where a system fails that is no threshold: quadratic regions in at most two variables.

A region is learnt from observations that failed and that were survived, by ridge logistic
regression with linear or quadratic features, and then made so small that nothing that was survived
is inside. Failures that no single region explains are split. Which variables and features explain
most failures, and of those that explain as many which do by the largest likelihood less what their
number of weights costs (Schwarz 1978), is chosen.

A region is a row of 12 numbers: variables i and j, from where each is counted, the inverse of its
unit, and the form ``c + b x + d y + p x x + q x y + r y y`` in those, above 0 inside. Where it is
of one variable, j is i and all that has y is 0.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from evofsm.guard.learnt.replay import FLAT, GROWN, Floats, Ints

Flags = NDArray[np.bool_]
Threshold = tuple[int, float, float]

#: Numbers of a region.
SIZE = 12
# Regions at most; a failure so near one [ordinary changes] is in it, as it is known no better.
_MOST, _BLUR = 8, 0.5
# A threshold that explains fewer failures, or a smaller share of them, may be challenged.
_FEW, _SHARE = 3, 0.25
# What explains fewer failures may be doubted.
_DOUBTED = 6
# Survived observations of a fit; steps of Newton, and the ridge for each of them.
_NEAR, _NEWTON, _RIDGE = 400, 40, 1e-9
# Fits of what explains failures with more likelihood than this each; how many survived ones that
# are wrongly inside are added.
_FITS, _UNLIKELY, _WORST = 3, 2.0, 100
# Variables of which all pairs are tried; pairs of which two forms are, and rounds of dealing
# failures out between two.
_SCREENED, _IN_TWO, _ROUNDS = 6, 3, 3
# Which of x, y, x x, x y, y y a form of one variable has, a line, and a form of two variables.
_KINDS = np.array([[1, 0, 1, 0, 0], [1, 1, 0, 0, 0], [1, 1, 1, 1, 1]], np.float64)


# -- What regions say -----------------------------------------------------------------------------


def forms(regions: Floats, z: Floats) -> tuple[Floats, Floats]:
    """(r, n) the forms of regions at observations (n, m), and the lengths of their gradients."""
    i, j = regions[:, :2].T.astype(int)
    at, to, one, other, c, b, d, p, q, r = regions[:, 2:, None].transpose(1, 0, 2)
    x, y = (z.T[i] - at) * one, (z.T[j] - to) * other
    slope = (b + 2.0 * p * x + q * y) ** 2 + (d + 2.0 * r * y + q * x) ** 2
    return c + x * (b + p * x + q * y) + y * (d + r * y), np.sqrt(slope + FLAT)


def distances(regions: Floats, z: Floats) -> Floats:
    """(r, n) how far observations are from regions, to first order; negative inside."""
    form, slope = forms(regions, z)
    return -form / slope


def without_survived(regions: Floats, survived: Floats) -> Floats:
    """Regions so small that nothing that was survived (n, m) is inside."""
    new, most = regions.copy(), forms(regions, survived)[0].max(1, initial=0.0)
    new[:, 6] -= np.where(most > 0.0, most + 1e-12 * (np.abs(new[:, 6]) + most), 0.0)
    return new


def halfway(regions: Floats, failures: Floats) -> Floats:
    """Regions half as far from the innermost of the failures in each as they reached beyond."""
    new, form = regions.copy(), forms(regions, failures)[0]
    within = np.where(form > 0.0, form, np.inf).min(1, initial=np.inf)
    new[:, 6] -= 0.5 * np.where(np.isfinite(within), within, 2.0 * GROWN)
    return new


def of_thresholds(found: Sequence[Threshold], unit: Floats) -> Floats:
    """Regions (t, 12) beyond thresholds; ``unit`` (m,) is what a distance of 1 is."""
    rows = [
        [j, j, at, at, 1.0 / unit[j], 1.0 / unit[j], 0.0, sign, 0.0, 0.0, 0.0, 0.0]
        for j, sign, at in found
    ]
    return np.array(rows, np.float64).reshape(-1, SIZE)


def explained(
    failures: Floats, thresholds: Sequence[Threshold], regions: Floats, blur: float = _BLUR
) -> Flags:
    """(k,) which observations are beyond a threshold or in a region."""
    each = _beyond(thresholds, failures), distances(regions, failures) < blur
    return np.asarray(np.concatenate(each).any(0))


def _beyond(thresholds: Sequence[Threshold], z: Floats) -> Flags:
    """(t, n) which observations (n, m) are beyond which thresholds."""
    by = [sign * (z[:, j] - at) >= 0.0 for j, sign, at in thresholds]
    return np.array(by, bool).reshape(len(thresholds), len(z))


def inside(regions: Floats, z: Floats) -> Flags:
    """(r, n) which observations (n, m) are in which regions."""
    return distances(regions, z) <= _BLUR


# -- Which regions there are ----------------------------------------------------------------------


def explain(
    found: Sequence[Threshold], failures: Floats, survived: Floats, unit: Floats, spread: Floats
) -> tuple[list[Threshold], Floats]:
    """Thresholds that stay, and regions (r, 12) for failures that these do not explain.

    Of ``failures`` (k, m) amid what was ``survived`` (n, m). ``unit`` (m,) is what a distance of 1
    is for each variable, ``spread`` (m,) its standard deviation. As long as thresholds explain all,
    there is no region. Thresholds that explain few may go if regions explain the same failures; and
    all of them, if regions alone explain all and are fewer.
    """
    stay, k = list(found), len(failures)
    by = _beyond(stay, failures)
    if by.any(0).all() or not len(survived) or not k:
        return stay, np.empty((0, SIZE))
    strong = by.sum(1) >= max(_FEW, _SHARE * k)
    left = failures[by[strong].sum(0) == 0]
    there, _ = _learnt(left, survived, unit, spread)
    if strong.any():
        alone, whole = _learnt(failures, survived, unit, spread, len(there) + int(strong.sum()))
        if whole:
            there, strong = alone, np.zeros(len(strong), bool)
    within: Flags = np.asarray(inside(there, failures).any(0))
    keep = [bool(s or not within[mine].all()) for s, mine in zip(strong, by, strict=True)]
    return [one for one, stays in zip(stay, keep, strict=True) if stays], there


def are_weak(
    thresholds: Sequence[Threshold], regions: Floats, failures: Floats
) -> tuple[Flags, Flags]:
    """(t,) and (r,) which thresholds and regions hardly any failure tells.

    As long as there is no region, of thresholds those that explain nothing that another does not.
    """
    by = _beyond(thresholds, failures)
    alone = (by & (by.sum(0) < 2)).any(1) & (len(regions) == 0)
    few = (by.sum(1) < _DOUBTED) & ~alone
    return np.asarray(few), np.asarray(inside(regions, failures).sum(1) < _DOUBTED)


def _learnt(
    failures: Floats, survived: Floats, unit: Floats, spread: Floats, fewer: float = np.inf
) -> tuple[Floats, bool]:
    """Regions that explain failures, and whether these are ``fewer`` and explain all of them."""
    asked = _asked(failures, survived, spread)
    found: list[Floats] = []
    groups, whole = [np.arange(len(failures))], True
    while groups and len(asked) and len(found) < _MOST:  # or nothing ever moved
        if len(found) + len(groups) >= fewer:  # each takes a region at least
            whole = False
            break
        groups.sort(key=len, reverse=True)
        group = groups.pop(0)
        F = failures[group]
        rows, within, score = _fitted(F, asked, survived, unit, spread)
        count = within.sum(1)
        best = max(range(len(asked)), key=lambda n: (count[n], score[n]))
        if 2 < len(group) and count[best] < len(group):
            both, mine = _in_two(F, asked, score, survived, unit, spread)
            if both > count[best]:
                groups += [group[mine], group[~mine]]
                continue
        if count[best] >= min(max(2, 0.5 * len(group)), len(group)):
            found.append(rows[best])
            groups += [group[~within[best]]] if count[best] < len(group) else []
            continue
        likeliest = asked[int(score.argmax())][:2]
        mine = _split(F[:, likeliest] / spread[likeliest])
        whole &= not mine.all()
        groups += [] if mine.all() else [group[mine], group[~mine]]
    return np.array(found).reshape(-1, SIZE), whole and not groups


def _in_two(
    F: Floats, asked: Ints, score: Floats, survived: Floats, unit: Floats, spread: Floats
) -> tuple[int, Flags]:
    """How many failures two forms of the likeliest pairs of variables explain, and which half."""
    found = 0, np.ones(len(F), bool)
    pairs = np.flatnonzero(asked[:, 2] == 2)
    for n in pairs[np.argsort(-score[pairs], kind="stable")[:_IN_TWO]]:
        mine = _split(F[:, asked[n, :2]] / spread[asked[n, :2]])
        for _ in range(_ROUNDS):
            if mine.all() or not mine.any():
                break
            each = [_fitted(F[half], asked[[n]], survived, unit, spread) for half in (mine, ~mine)]
            far = np.concatenate([distances(rows, F) for rows, _, _ in each])
            explained = int((far.min(0) <= _BLUR).sum())
            found = (explained, mine) if explained > found[0] else found
            if (mine == (far[0] <= far[1])).all():
                break
            mine = far[0] <= far[1]
    return found


def _asked(failures: Floats, survived: Floats, spread: Floats) -> Ints:
    """(c, 3) variables and kinds of forms that are tried: of many variables those that tell most.

    A variable tells failed observations from survived ones where they have another mean or spread.
    """
    moving = np.flatnonzero(spread > 0.0)
    if len(moving) > _SCREENED:
        seen = survived[:, moving]
        square = ((failures[:, moving] - seen.mean(0)) ** 2).mean(0) / spread[moving] ** 2
        ratio = np.maximum(square, 1e-12) / (seen.var(0) / spread[moving] ** 2 + 1e-12)
        tells = 0.5 * (ratio - 1.0 - np.log(ratio))
        moving = np.sort(moving[np.argsort(-tells, kind="stable")[:_SCREENED]])
    alone = [(j, j, 0) for j in moving]
    both = [(i, j, kind) for i, j in combinations(moving, 2) for kind in (1, 2)]
    return np.array(alone + both, np.int64).reshape(-1, 3)


def _split(x: Floats) -> Flags:
    """Rows in two, from the pair that is farthest apart: which are with the first of them."""
    far = ((x[:, None] - x[None]) ** 2).sum(2)
    a, b = x[list(np.unravel_index(int(far.argmax()), far.shape))]
    mine = np.ones(len(x), bool)
    for _ in range(5):
        mine = ((x - a) ** 2).sum(1) <= ((x - b) ** 2).sum(1)
        if mine.all() or not mine.any():
            return np.ones(len(x), bool)
        a, b = x[mine].mean(0), x[~mine].mean(0)
    return mine


# -- One region -----------------------------------------------------------------------------------


def _fitted(
    F: Floats, asked: Ints, survived: Floats, unit: Floats, spread: Floats
) -> tuple[Floats, Flags, Floats]:
    """(c, 12) the forms that are asked of failures (k, m); which are inside; and scores."""
    scale, those = spread[asked[:, :2]], F[:, asked[:, :2]].transpose(1, 0, 2)
    at, k = those.mean(1), len(F)
    near: dict[tuple[int, int], Ints] = {}
    for i, j, _ in asked.tolist():
        if (i, j) not in near:
            near[i, j] = _near(survived[:, [i, j]], F[:, [i, j]], spread[[i, j]])
    which = np.array([near[i, j] for i, j, _ in asked.tolist()])
    rows, likelihood = np.zeros((len(asked), SIZE)), np.zeros(len(asked))
    again = np.arange(len(asked))
    for _ in range(_FITS):  # with what the fit before has wrongly inside
        asked_now, scale_now, at_now = asked[again], scale[again], at[again]
        seen = survived[which[..., None], asked_now[:, None, :2]]
        x = np.concatenate([those[again], seen], 1) - at_now[:, None]
        u, v = (x / scale_now[:, None]).transpose(2, 0, 1)
        phi = np.stack([u, v, u * u, u * v, v * v], 2) * _KINDS[asked_now[:, 2]][:, None]
        y = np.append(np.ones(k), np.zeros(which.shape[1]))
        w, likelihood[again] = _logistic(phi, y)
        times = unit[asked_now[:, :2]] / scale_now
        found = np.zeros((len(again), SIZE))
        found[:, :2], found[:, 2:4] = asked_now[:, :2], at_now
        found[:, 4:6] = 1.0 / unit[asked_now[:, :2]]
        found[:, 6], found[:, 7:9] = w[:, 5], w[:, :2] * times
        found[:, 9], found[:, 11] = w[:, 2] * times[:, 0] ** 2, w[:, 4] * times[:, 1] ** 2
        found[:, 10] = w[:, 3] * times[:, 0] * times[:, 1]
        form = forms(found, survived)[0]
        most = form.max(1)  # as large as it may be with none of them inside
        wrong = (most > 0.0) & (likelihood[again] > -_UNLIKELY * k)
        found[:, 6] -= most + 1e-12 * (np.abs(found[:, 6]) + np.abs(most))
        rows[again] = found
        again, form, which = again[wrong], form[wrong], which[wrong]
        if not len(again) or len(survived) <= _NEAR:
            break
        which = np.hstack([which, np.argpartition(-form, _WORST, 1)[:, :_WORST]])
    within = inside(rows, F)
    within[2 * (within & (distances(rows, F) < 0.0)).sum(1) < within.sum(1)] = False
    score = likelihood - 0.5 * _KINDS[asked[:, 2]].sum(1) * np.log(k + 1.0)
    return rows, within, score


def _near(survived: Floats, F: Floats, scale: Floats) -> Ints:
    """Of what was survived as much nearest to each failure as to others, and as much evenly."""
    n, half = len(survived), _NEAR // 2
    if n <= _NEAR:
        return np.arange(n)
    each = -(-half // len(F))
    x, y = ((survived[:, k] - F[:, [k]]) / scale[k] for k in (0, 1))
    far = x * x + y * y
    near = np.argpartition(far, each, 1)[:, :each].ravel()[:half]
    return np.append(near, np.linspace(0, n - 1, _NEAR - half).astype(int))


def _logistic(phi: Floats, y: Floats) -> tuple[Floats, Floats]:
    """(c, p + 1) weights of c ridge logistic regressions, the constant last, and likelihoods.

    Of features ``phi`` (c, n, p), standardised, by Newton's method. The ridge is so small that what
    can be told apart is, and only keeps weights finite.
    """
    (count, n, p), mean, size = phi.shape, phi.mean(1), phi.std(1)
    size = np.where(size > 0.0, size, 1.0)
    X = np.concatenate([(phi - mean[:, None]) / size[:, None], np.ones((count, n, 1))], 2)
    hold = np.full((count, p + 1), _RIDGE * n)
    hold[:, :p][~(phi != 0.0).any(1)] = 1.0  # features that it has not
    w, to = np.zeros((count, p + 1)), np.where(y > 0.0, -1.0, 1.0)

    def cost(which: Ints, w: Floats) -> Floats:
        t = np.einsum("cnp,cp->cn", X[which], w) * to
        lost = np.maximum(t, 0.0) + np.log1p(np.exp(-np.abs(t)))
        return np.asarray(lost.sum(1) + 0.5 * (hold[which] * w**2).sum(1))

    going, now = np.arange(count), cost(np.arange(count), w)
    for _ in range(_NEWTON):
        A = X[going]
        q = 0.5 * (1.0 + np.tanh(0.5 * np.einsum("cnp,cp->cn", A, w[going])))
        down = np.einsum("cnp,cn->cp", A, q - y) + hold[going] * w[going]
        curved = (A * np.maximum(q * (1.0 - q), 1e-12)[..., None]).transpose(0, 2, 1) @ A
        curved += hold[going][:, :, None] * np.eye(p + 1)
        step = np.linalg.solve(curved, down[..., None])[..., 0]
        rate = np.ones(len(going))
        for _ in range(10):
            new = cost(going, w[going] - rate[:, None] * step)
            worse = new > now[going] - 1e-12
            if not worse.any():
                break
            rate[worse] *= 0.5
        w[going] -= np.where(worse, 0.0, rate)[:, None] * step
        was = now[going]
        now[going] = np.where(worse, was, new)
        going = going[~worse & (was - new >= 1e-4 * new + 1e-9)]
        if not len(going):
            break
    likelihood = -(now - 0.5 * (hold * w**2).sum(1))
    found = w[:, :p] / size
    return np.column_stack([found, w[:, p] - (found * mean).sum(1)]), likelihood
