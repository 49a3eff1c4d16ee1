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

from evofsm.guard.learnt.replay import FLAT, Floats, Ints

Flags = NDArray[np.bool_]
Threshold = tuple[int, float, float]

#: Numbers of a region.
SIZE = 12
# Regions at most; a failure so near one [ordinary changes] is in it, as it is known no better.
_MOST, _BLUR = 8, 0.5
# A threshold that explains fewer failures, or a smaller share of them, may be challenged.
_FEW, _SHARE = 3, 0.25
# Survived observations of a fit; steps of Newton, and the ridge for each of them.
_NEAR, _NEWTON, _RIDGE = 400, 40, 1e-9
# Variables of which all pairs are tried, and rounds of splitting failures between two regions.
_SCREENED, _ROUNDS = 6, 3
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


def in_units(regions: Floats, unit: Floats) -> Floats:
    """Regions as they are, with variables in units (m,)."""
    new = regions.copy()
    if len(regions):
        times = regions[:, 4:6] * unit[regions[:, :2].astype(int)]
        new[:, 4:6] = regions[:, 4:6] / times
        new[:, 7:9] *= times
        new[:, 9], new[:, 11] = regions[:, 9] * times[:, 0] ** 2, regions[:, 11] * times[:, 1] ** 2
        new[:, 10] *= times[:, 0] * times[:, 1]
    return new


def without_survived(regions: Floats, survived: Floats) -> Floats:
    """Regions so small that nothing that was survived (n, m) is inside."""
    new = regions.copy()
    if len(regions) and len(survived):
        most = forms(new, survived)[0].max(1)
        size = np.abs(new[:, 6]) + np.abs(most)
        new[:, 6] -= np.where(most > 0.0, most + 1e-12 * size, 0.0)
    return new


def are_explained(failures: Floats, thresholds: Sequence[Threshold], regions: Floats) -> bool:
    """Whether each failure is beyond a threshold or in a region."""
    each = _beyond(thresholds, failures), inside(regions, failures)
    return bool(np.concatenate(each).any(0).all())


def _beyond(thresholds: Sequence[Threshold], z: Floats) -> Flags:
    """(t, n) which observations (n, m) are beyond which thresholds."""
    by = [sign * (z[:, j] - at) >= 0.0 for j, sign, at in thresholds]
    return np.array(by, bool).reshape(len(thresholds), len(z))


def inside(regions: Floats, z: Floats) -> Flags:
    """(r, n) which observations (n, m) are in which regions."""
    return distances(regions, z) <= _BLUR


# -- Which regions there are ----------------------------------------------------------------------


def explain(
    thresholds: Sequence[Threshold],
    failures: Floats,
    survived: Floats,
    unit: Floats,
    spread: Floats,
) -> tuple[list[Threshold], Floats]:
    """Thresholds that stay, and regions (r, 12) for failures that they do not explain.

    Of ``failures`` (k, m) amid what was ``survived`` (n, m). ``unit`` (m,) is what a distance of 1
    is for each variable, ``spread`` (m,) its standard deviation. As long as thresholds explain all,
    there is no region. Thresholds that explain few may go if regions explain the same failures; and
    all of them, if regions alone explain all and are fewer.
    """
    stay, k = list(thresholds), len(failures)
    by = _beyond(stay, failures)
    if by.any(0).all() or not len(survived) or not k:
        return stay, np.empty((0, SIZE))
    strong = by.sum(1) >= max(_FEW, _SHARE * k)
    left = failures[by[strong].sum(0) == 0]
    found, _ = _learnt(left, survived, unit, spread)
    if strong.any():
        alone, whole = _learnt(failures, survived, unit, spread, len(found) + int(strong.sum()))
        if whole:
            found, strong = alone, np.zeros(len(strong), bool)
    within: Flags = np.asarray(inside(found, failures).any(0))
    keep = [bool(s or not within[mine].all()) for s, mine in zip(strong, by, strict=True)]
    return [one for one, stays in zip(stay, keep, strict=True) if stays], found


def _learnt(
    failures: Floats, survived: Floats, unit: Floats, spread: Floats, fewer: float = np.inf
) -> tuple[Floats, bool]:
    """Regions that explain failures, and whether these are ``fewer`` and explain all of them."""
    asked = _asked(failures, survived, spread)
    found: list[Floats] = []
    groups, whole = [np.arange(len(failures))], True
    while groups and len(found) < _MOST:
        if len(found) + len(groups) >= fewer:  # each takes a region at least
            whole = False
            break
        groups.sort(key=len, reverse=True)
        group = groups.pop(0)
        F, k = failures[group], len(group)
        every = np.ones((len(asked), k), bool)
        rows, within, score = _fitted(F, every, asked, survived, unit, spread)
        count = within.sum(1)
        best = max(range(len(asked)), key=lambda n: (count[n], score[n]))
        if count[best] == k:
            found.append(rows[best])
            continue
        if k == 1:
            whole = False
            continue
        halves = _in_two(F, asked, survived, unit, spread) if k > 2 else None
        if halves is not None and halves[0] > count[best]:
            groups += [group[halves[1]], group[~halves[1]]]
        elif count[best] >= max(2, 0.5 * k):
            found.append(rows[best])
            groups.append(group[~within[best]])
        else:
            likeliest = asked[int(score.argmax())][:2]
            mine = _split(F[:, likeliest] / spread[likeliest])
            if mine.all():
                whole = False
                continue
            groups += [group[mine], group[~mine]]
    return np.array(found).reshape(-1, SIZE), whole and not groups


def _asked(failures: Floats, survived: Floats, spread: Floats) -> Ints:
    """(c, 3) variables and kinds of forms that are tried: of many variables those that tell most.

    A variable tells failed observations from survived ones where they have another mean or spread.
    """
    moving = np.flatnonzero(spread > 0.0)
    if len(moving) > _SCREENED:
        y = (survived[:, moving].mean(0) - failures[:, moving]) / spread[moving]
        ratio = np.maximum((y**2).mean(0), 1e-12) / (
            survived[:, moving].var(0) / spread[moving] ** 2 + 1e-12
        )
        tells = 0.5 * (ratio - 1.0 - np.log(ratio))
        moving = np.sort(moving[np.argsort(-tells, kind="stable")[:_SCREENED]])
    alone = [(j, j, 0) for j in moving]
    return np.array(alone + [(i, j, kind) for i, j in combinations(moving, 2) for kind in (1, 2)])


def _in_two(
    F: Floats, asked: Ints, survived: Floats, unit: Floats, spread: Floats
) -> tuple[int, Flags] | None:
    """Two forms of the same variables that together explain most: how many, and which half."""
    pairs = asked[asked[:, 2] == 2]
    mine = np.array([_split(F[:, one] / spread[one]) for one in pairs[:, :2]]).reshape(-1, len(F))
    best: tuple[int, float, Flags] | None = None
    for _ in range(_ROUNDS):
        two = mine.any(1) & ~mine.all(1)
        pairs, mine = pairs[two], mine[two]
        if not len(pairs):
            break
        each = np.concatenate([mine, ~mine]), np.concatenate([pairs, pairs])
        rows, _, score = _fitted(F, *each, survived, unit, spread)
        far = distances(rows, F).reshape(2, len(pairs), -1)
        explained, together = (far.min(0) <= _BLUR).sum(1), score.reshape(2, -1).sum(0)
        for n in range(len(pairs)):
            if best is None or (explained[n], together[n]) > best[:2]:
                best = int(explained[n]), float(together[n]), mine[n]
        new = far[0] <= far[1]
        changed = (new != mine).any(1)
        pairs, mine = pairs[changed], new[changed]
    return None if best is None else (best[0], best[2])


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
    F: Floats, mine: Flags, asked: Ints, survived: Floats, unit: Floats, spread: Floats
) -> tuple[Floats, Flags, Floats]:
    """(c, 12) the forms that are asked of failures ``mine`` (c, k); which are inside; scores."""
    (count, k), n = mine.shape, min(_NEAR, len(survived))
    one, other = asked[:, 0], asked[:, 1]
    scale = spread[asked[:, :2]]
    at = np.stack([(mine * F.T[which]).sum(1) for which in (one, other)], 1) / mine.sum(1)[:, None]
    seen = np.empty((count, n, 2))
    known: dict[tuple[object, ...], Ints] = {}
    for c, (i, j, _) in enumerate(asked.tolist()):
        key = i, j, mine[c].tobytes()
        if key not in known:
            known[key] = _near(survived[:, [i, j]], F[mine[c]][:, [i, j]], scale[c])
        seen[c] = survived[known[key]][:, [i, j]]
    x = (np.concatenate([F[:, asked[:, :2]].transpose(1, 0, 2), seen], 1) - at[:, None]) / scale[
        :, None
    ]
    u, v = x[..., 0], x[..., 1]
    phi = np.stack([u, v, u * u, u * v, v * v], 2) * _KINDS[asked[:, 2]][:, None]
    y = np.append(np.ones(k), np.zeros(n))
    weight = np.concatenate([mine.astype(float), np.ones((count, n))], 1)
    w, likelihood = _logistic(phi, y, weight)
    times = unit[asked[:, :2]] / scale
    rows = np.empty((count, SIZE))
    rows[:, :2], rows[:, 2:4], rows[:, 4:6] = asked[:, :2], at, 1.0 / unit[asked[:, :2]]
    rows[:, 6], rows[:, 7:9] = w[:, 5], w[:, :2] * times
    rows[:, 9], rows[:, 11] = w[:, 2] * times[:, 0] ** 2, w[:, 4] * times[:, 1] ** 2
    rows[:, 10] = w[:, 3] * times[:, 0] * times[:, 1]
    most = forms(rows, survived)[0].max(1)  # as large as it may be with none of them inside
    rows[:, 6] -= most + 1e-12 * (np.abs(rows[:, 6]) + np.abs(most))
    within = inside(rows, F) & mine
    within[2 * (within & (distances(rows, F) < 0.0)).sum(1) < within.sum(1)] = False
    score = likelihood - 0.5 * _KINDS[asked[:, 2]].sum(1) * np.log(mine.sum(1) + 1.0)
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


def _logistic(phi: Floats, y: Floats, weight: Floats) -> tuple[Floats, Floats]:
    """(c, p + 1) weights of c ridge logistic regressions, the constant last, and likelihoods.

    Of features ``phi`` (c, n, p), standardised, and ``weight`` (c, n), by Newton's method. The
    ridge is so small that what can be told apart is, and only keeps weights finite.
    """
    (count, n, p), total = phi.shape, weight.sum(1)
    mean = np.einsum("cn,cnp->cp", weight, phi) / total[:, None]
    off = phi - mean[:, None]
    size = np.sqrt(np.einsum("cn,cnp->cp", weight, off**2) / total[:, None])
    size = np.where(size > 0.0, size, 1.0)
    X = np.concatenate([off / size[:, None], np.ones((count, n, 1))], 2)
    hold = np.full((count, p + 1), _RIDGE) * total[:, None]
    hold[:, :p][~(phi != 0.0).any(1)] = 1.0  # features that it has not
    w, to = np.zeros((count, p + 1)), np.where(y > 0.0, -1.0, 1.0)

    def cost(which: Ints, w: Floats) -> Floats:
        t = np.einsum("cnp,cp->cn", X[which], w) * to
        lost = np.maximum(t, 0.0) + np.log1p(np.exp(-np.abs(t)))
        return np.asarray((weight[which] * lost).sum(1) + 0.5 * (hold[which] * w**2).sum(1))

    going, now = np.arange(count), cost(np.arange(count), w)
    for _ in range(_NEWTON):
        A, g = X[going], weight[going]
        q = 0.5 * (1.0 + np.tanh(0.5 * np.einsum("cnp,cp->cn", A, w[going])))
        down = np.einsum("cnp,cn->cp", A, g * (q - y)) + hold[going] * w[going]
        curved = (A * (g * np.maximum(q * (1.0 - q), 1e-12))[..., None]).transpose(0, 2, 1) @ A
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
