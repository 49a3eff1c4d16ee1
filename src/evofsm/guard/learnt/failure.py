"""Where a system fails, or ends by itself: the fewest forms that hold what failed and nothing else.

A form is a row of a table. It says something of where it is above 0: that it fails there (`FAILS`),
that an episode ends by itself there (`ENDS`), that it fails if it ends there (`CRASHES`, of the
ends just before it), or that what begins there is fatal (`FATAL`). It is linear or quadratic in at
most two variables.

*Sides* of the box of what was survived are tried first, and what they leave is told by *bent*
forms: ridge logistic regressions of what failed against what was survived, made so small that what
was survived is outside. Failures that no form holds alone are dealt out between two. Of forms that
hold as many the likeliest is taken, less what its weights cost (Schwarz 1978).

What one episode alone survived takes back no failure: that takes a second witness.
"""

from __future__ import annotations

from itertools import combinations
from typing import NamedTuple

import numpy as np

from evofsm.guard.learnt.rollout import (
    CRASHES,
    ENDS,
    FAILS,
    FATAL,
    FLAT,
    GROWN,
    ROUNDING,
    SMALL,
    Flags,
    Floats,
    Ints,
)

#: Columns of a form: what it says, variables i and j, from where each is counted, the inverse of
#: its unit, coefficients of 1, x, y, x x, x y, y y; how many failures it holds.
SIZE = 14
SAYS, I, J, AT, TO, ONE, OTHER, C, B, D, P, Q, R, HELD = range(SIZE)

# Bent forms at most; a failure so near one [typical steps] is in it, as it is known no better.
_MAX_FORMS, BLUR = 8, 0.5
# A side that explains fewer failures, or a smaller share of them, may be challenged; of more sides
# than so many, one with less than half of an even share.
_FEW_FAILURES, _SHARE, _FEW_SIDES = 3, 0.25, 4
# So many failures may leave two sides undecided.
_MOST_UNDECIDED = 2
# Blurred ends are so wide [scales], unless a scale is a larger share of the spread: a variable that
# is noise alone explains no failure.
_BLURRED, _NOISY = 5.0, 0.5
# Survived observations of a fit; steps of Newton.
_FIT_ROWS, _NEWTON = 400, 40
# Fits of what explains failures with more likelihood than this each; how many survived ones that
# are wrongly inside are added.
_REFITS, _UNLIKELY, _WORST = 3, 2.0, 100
# Variables of which all pairs are tried, and how many of others; pairs of which two forms are, and
# rounds of dealing failures out between two.
_SCREENED, _COUPLED, _IN_TWO, _ROUNDS = 6, 3, 3, 3
# An ellipse may be moved inwards by so much [standard deviations].
_INWARDS = 0.1 * 1.5 ** np.arange(8)
# A rival of a threshold, and a bent form once it is grown, hold less of what was survived; that
# also a smaller share of it than of failures.
_RARE = 0.5
# Which of x, y, x x, x y, y y a form of one variable has, a line, and a form of two variables.
_KINDS = np.array([[1, 0, 1, 0, 0], [1, 1, 0, 0, 0], [1, 1, 1, 1, 1]], np.float64)


class Survived(NamedTuple):
    """What was survived, and how it is counted."""

    rows: Floats  #: (n, m) observations
    lowest: Floats  #: (2, m) ends of the box of them, and those that two episodes came to
    highest: Floats  #: (2, m)
    unit: Floats  #: (m,) what a distance of 1 is for each variable
    spread: Floats  #: (m,) their standard deviation
    ended: Floats  #: (e, m) where episodes ended without failing
    #: (m, 2) scales of what may have blurred the lowest and the highest; none where not said
    noise: Floats = np.zeros(2)


# -- What forms say -------------------------------------------------------------------------------


def forms(table: Floats, z: Floats) -> tuple[Floats, Floats]:
    """(r, n) the forms of a table (r, SIZE) at observations (n, m), and lengths of gradients."""
    i, j = table[:, [I, J]].T.astype(int)
    at, to, inv_x, inv_y, c, b, d, p, q, r = table[:, AT:HELD, None].transpose(1, 0, 2)
    x, y = (z.T[i] - at) * inv_x, (z.T[j] - to) * inv_y
    slope = (b + 2.0 * p * x + q * y) ** 2 + (d + 2.0 * r * y + q * x) ** 2
    return c + x * (b + p * x + q * y) + y * (d + r * y), np.sqrt(slope + FLAT)


def distances(table: Floats, z: Floats) -> Floats:
    """(r, n) how far observations are from forms, to first order; negative inside."""
    form, slope = forms(table, z)
    return -form / slope


def are_sides(table: Floats) -> Flags:
    """(r,) which forms are thresholds of one variable."""
    return np.asarray((table[:, I] == table[:, J]) & (table[:, P] == 0.0))


def saying(table: Floats, *says: int) -> Floats:
    """The forms that say one of these."""
    return np.asarray(table[np.isin(table[:, SAYS], says)])


def inside(table: Floats, z: Floats, blur: float = BLUR) -> Flags:
    """(r, n) which observations (n, m) are in which forms, but for a ``blur`` of bent ones."""
    return distances(table, z) <= np.where(are_sides(table), 0.0, blur)[:, None]


def crashed(table: Floats, z: Floats) -> Flags:
    """(n,) which observations (n, m) are where it ends, and there where it crashes."""
    is_end = inside(saying(table, ENDS), z).any(0)
    return np.asarray(is_end & inside(saying(table, CRASHES), z, 0.0).any(0))


def counted(table: Floats, failures: Floats, survived: Survived) -> Floats:
    """Forms, with how many failures each holds: beyond what was survived, if it ends there."""
    i = table[:, I].astype(int)
    ends = np.where(table[:, B] < 0.0, survived.lowest[0, i], survived.highest[0, i])
    at_end = are_sides(table) & (table[:, AT] == ends)
    holds = inside(table, failures) & ~(at_end[:, None] & (distances(table, failures) == 0.0))
    table[:, HELD] = holds.sum(1)
    return table


def telling(table: Floats) -> list[int]:
    """Variables of forms, those of bent ones first."""
    rows = table[np.argsort(are_sides(table), kind="stable")]
    return list(dict.fromkeys(rows[:, [I, J]].astype(int).ravel().tolist()))


def prepared(table: Floats) -> Floats:
    """(r, 13) forms as kernels take them: linear ones with a gradient of 1.

    Those of two variables that say it fails are `GROWN` as bent ones are.
    """
    rows = table[:, :HELD].copy()
    flat = (rows[:, P:HELD] == 0.0).all(1)
    length = np.hypot(rows[:, B], rows[:, D])
    rows[flat, C : D + 1] /= np.where(length > 0.0, length, 1.0)[flat, None]
    rows[flat & (rows[:, I] != rows[:, J]) & (rows[:, SAYS] == FAILS), C] += GROWN
    return rows


def among(table: Floats, others: Floats) -> Flags:
    """(r,) which thresholds are of a variable and a direction of one of others."""
    return np.asarray((table[:, None, [I, B]] == others[:, [I, B]]).all(2).any(1))


def without(table: Floats, z: Floats) -> Floats:
    """Forms so small that none of some observations (n, m) is inside."""
    new, most = table.copy(), forms(table, z)[0].max(1, initial=0.0)
    new[:, C] -= np.where(most > 0.0, most + 1e-12 * (np.abs(new[:, C]) + most), 0.0)
    return new


def nearer(table: Floats, failures: Floats, share: float) -> Floats:
    """Forms nearer by a share of the way to the innermost of the failures in each."""
    new, form = table.copy(), forms(table, failures)[0]
    within = np.where(form > 0.0, form, np.inf).min(1, initial=np.inf)
    new[:, C] -= share * np.where(np.isfinite(within), within, 2.0 * GROWN)
    return new


def rivals(table: Floats, failures: Floats, survived: Survived) -> Floats:
    """Fit the smallest forms that still hold all failures, to try whether larger ones are true.

    In place of a bent form ellipses around its failures, of all (k, m). In place of a threshold
    that it *ends* there, and fails only nearer to its failures than to what ended; where nothing
    ended there, only beyond the innermost failure in another variable in which that is rare among
    what was survived; and so where a form says that it crashes, as few endings tell little.
    """
    rows: list[Floats] = []
    fails, ends, crashes = (saying(table, says) for says in (FAILS, ENDS, CRASHES))
    for row, is_side, holds in zip(fails, are_sides(fails), inside(fails, failures), strict=True):
        if not holds.any() or not len(survived.rows):
            rows.append(row)
        else:
            rows += (_as_failed if is_side else _ellipses)(row, failures[holds], survived)
    at_end = crashed(table, failures)
    if at_end.any() and len(survived.rows):
        rare = _rare(failures[at_end], survived, *ends[:, I].astype(int).tolist())
        crashes = rare if len(rare) else crashes
    # What crashes is told of the ends just before it: others come behind.
    return np.array([*rows, *ends, *crashes, *saying(table, FATAL)]).reshape(-1, SIZE)


def _ellipses(row: Floats, held: Floats, survived: Survived) -> list[Floats]:
    """The smallest one around failures that a form holds, without what was survived.

    Where that lies among them it is the nearest circle, in standard deviations, that lies inwards
    of them; or else each half of them has its own.
    """
    pair = row[[I, J]].astype(int)
    unit, centre, inverse = survived.unit[pair], held[:, pair].mean(0), row[ONE:C]
    X, Y = (centre - row[AT:ONE]) * inverse
    slope = np.array([row[B] + 2 * row[P] * X + row[Q] * Y, row[D] + 2 * row[R] * Y + row[Q] * X])
    wide = survived.spread[pair] / unit
    inwards = slope * inverse * unit * wide
    inwards *= wide / (np.linalg.norm(inwards) + 1e-300)
    x, y = ((rows[:, pair] - centre) / unit for rows in (held, survived.rows))
    around = np.linalg.inv(2.0 * x.T @ x / len(x) + np.eye(2))
    for off in (0.0, *_INWARDS):
        shape = np.diag(wide**-2.0) if off else around
        far, away = (
            np.einsum("ni,ij,nj->n", v, shape, v) for v in (x - off * inwards, y - off * inwards)
        )
        most, least = float(far.max()), float(away.min())
        size = min(1.1 * most if off else max(1.0, 1.1 * most), 0.99 * least)
        if size >= most:
            new = row.copy()
            new[AT:ONE], new[ONE:C] = centre + off * inwards * unit, 1.0 / unit
            new[C:HELD] = size, 0.0, 0.0, -shape[0, 0], -2.0 * shape[0, 1], -shape[1, 1]
            return [new]
    first = _split(x / wide)
    if first.all():
        return [row]
    return [form for half in (first, ~first) for form in _ellipses(row, held[half], survived)]


def _as_failed(row: Floats, held: Floats, survived: Survived) -> list[Floats]:
    """That it ends beyond a threshold, and fails only as it did; or the threshold as it is."""
    end, endings = row.copy(), survived.ended[inside(row[None], survived.ended)[0]]
    end[SAYS] = ENDS
    if len(endings):
        crashes = nearer(crashing(held, endings, survived, int(row[I])), held, 0.5)
    else:
        crashes = _rare(held, survived, int(row[I]))
    return [end, *crashes] if len(crashes) else [row]


def _rare(held: Floats, survived: Survived, *at: int) -> Floats:
    """That it crashes as far out as the innermost failure, in each variable where that is rare.

    To one side, or on both sides of the median of what was survived; but of variables ``at``.
    """
    unit, rows, m = survived.unit, survived.rows, len(survived.unit)
    low, high, centre = held.min(0) - BLUR * unit, held.max(0) + BLUR * unit, np.median(rows, 0)
    off = (np.abs(held - centre).min(0) - BLUR * unit).clip(0.0)
    share = np.array([rows >= low, rows <= high, np.abs(rows - centre) >= off]).mean(1)
    share[:, (survived.spread == 0.0) | np.isin(np.arange(m), at)] = np.inf
    table = np.empty((0, SIZE))
    for j in np.flatnonzero(share.min(0) < _RARE).tolist():
        sides = (
            _of_one(CRASHES, j, low[j], unit[j], b=1.0),
            _of_one(CRASHES, j, high[j], unit[j], b=-1.0),
            _of_one(CRASHES, j, centre[j], unit[j], c=-((off[j] / unit[j]) ** 2), p=1.0),
        )
        table = np.vstack([table, sides[share[:, j].argmin()]])
    table[:, HELD] = len(held)
    return table


def _of_one(
    says: int, j: int, at: float, unit: float, *, c: float = 0.0, b: float = 0.0, p: float = 0.0
) -> list[float]:
    """A form of one variable, by its coefficients of 1, x and x x; it holds no failure yet."""
    return [says, j, j, at, at, 1.0 / unit, 1.0 / unit, c, b, 0.0, p, 0.0, 0.0, 0.0]


def boxed(known: Survived, rows: Floats) -> Survived:
    """Others (n, m) that forms are to leave outside, in the same units."""
    low, high = (np.array([end] * 2) for end in (rows.min(0), rows.max(0)))
    return known._replace(rows=rows, lowest=low, highest=high, noise=0.0 * known.noise)


def crashing(failed: Floats, ended: Floats, survived: Survived, *at: int) -> Floats:
    """How it fails where it ends: by variables other than those ``at`` which it ends, if it can."""
    alike = failed.copy()
    alike[:, at] = ended[:, at].mean(0)
    end_box = boxed(survived, ended)
    table = explain(CRASHES, alike, end_box)
    if inside(table, alike, 0.0).any(0).all():
        return table
    return explain(CRASHES, failed, end_box)


# -- Which forms there are ------------------------------------------------------------------------


def explain(says: int, failures: Floats, survived: Survived) -> Floats:
    """Fit the fewest forms (r, SIZE) that hold what failed, or ended (k, m), as it ``says``.

    What was survived is outside. Sides (`sides_of`) that explain few may go if bent forms, blurred
    by `BLUR`, explain the same failures; and all, if bent forms alone explain all and are fewer.
    """
    stay = sides_of(says, failures, survived)
    by, k = inside(stay, failures), len(failures)
    if by.any(0).all() or not len(survived.rows) or not k:
        return stay
    share = _SHARE if len(stay) <= _FEW_SIDES else 0.5 / len(stay)
    strong = by.sum(1) >= max(_FEW_FAILURES, share * k)
    bent, _ = _bent(says, failures[by[strong].sum(0) == 0], survived, k)
    if strong.any():
        alone, whole = _bent(says, failures, survived, k, len(bent) + int(strong.sum()))
        if whole:
            bent, strong = alone, np.zeros(len(strong), bool)
    within: Flags = np.asarray(inside(bent, failures).any(0))
    keep = [bool(s or not within[holds].all()) for s, holds in zip(strong, by, strict=True)]
    table = counted(np.concatenate([stay[keep], bent]), failures, survived)
    by = inside(table, failures)
    if says == FAILS and 2 * by.any(0).sum() < k:  # most are by chance
        table = table[by.sum(1) > 1]
    return table


def sides_of(says: int, failures: Floats, survived: Survived) -> Floats:
    """The fewest ends of the box of what was survived that explain failures.

    Where it crashes those come first that some failures are beyond by a typical step. Of two that
    explain the first ones alike both hold until another failure tells them apart. A failure within
    five scales of a blurred end may have been beyond it: then the side is where the innermost of
    such failures was seen.
    """
    m, unit, noise = len(survived.unit), survived.unit, survived.noise
    if not len(failures) or not np.isfinite(survived.lowest[0]).all():
        return np.empty((0, SIZE))
    ends = np.concatenate([survived.lowest[0], survived.highest[0]])
    far, again = (
        np.hstack([low - failures, failures - high])
        for low, high in zip(survived.lowest, survived.highest, strict=True)
    )
    with np.errstate(over="ignore"):  # of a variable that never changed it is far enough
        beyond = far / np.tile(unit, 2)
    wide = _BLURRED * np.where(noise < _NOISY * survived.spread[:, None], noise, 0.0)
    perhaps = (far > -wide.T.ravel()) | ((again > 0.0) & np.isfinite(again))
    is_open = np.ones(len(failures), bool)
    thresholds: dict[int, float] = {}
    for clear in (1.0 if says == CRASHES else ROUNDING, ROUNDING):
        while (is_explained := (beyond > clear) & is_open[:, None]).any():
            ties, best = _most_telling(is_explained, perhaps, beyond)
            is_open &= ~(beyond[:, best] > ROUNDING)
            is_undecided = len(failures) <= _MOST_UNDECIDED and len(ties) == 2
            for k in ties if is_undecided else [best]:
                thresholds[k] = float(ends[k])
    while (is_explained := perhaps & is_open[:, None]).any():
        _, best = _most_telling(is_explained, perhaps, beyond)
        is_open &= ~is_explained[:, best]
        among = failures[is_explained[:, best], best % m]
        thresholds[best] = float(among.max() if best < m else among.min())  # the innermost
    rows = [
        _of_one(says, k % m, at, unit[k % m], b=-1.0 if k < m else 1.0)
        for k, at in thresholds.items()
    ]
    return counted(np.array(rows).reshape(-1, SIZE), failures, survived)


def _most_telling(explained: Flags, perhaps: Flags, beyond: Floats) -> tuple[list[int], int]:
    """Ends that explain most failures, and of them the one that may explain most, and by most."""
    votes = explained.sum(0)
    ties = np.flatnonzero(votes == votes.max()).tolist()
    return ties, max(
        ties, key=lambda k: (perhaps[:, k].sum(), float(np.median(beyond[explained[:, k], k])), -k)
    )


def _bent(
    says: int, failures: Floats, survived: Survived, n_failures: int, fewer: float = np.inf
) -> tuple[Floats, bool]:
    """Bent forms that explain failures, and whether these are ``fewer`` and explain all of them.

    One that says it fails holds, grown, a smaller share of what was survived than of ``n_failures``
    in all: one amid what was survived, as of a sensor that was stuck, says nothing.
    """
    candidates, n = _candidates(failures, survived), len(survived.rows)
    sample = survived.rows[np.linspace(0, n - 1, min(n, _FIT_ROWS)).astype(int)]
    bent_rows: list[Floats] = []
    groups, whole = [np.arange(len(failures))], True
    while groups and len(candidates) and len(bent_rows) < _MAX_FORMS:  # or nothing ever moved
        if len(bent_rows) + len(groups) >= fewer:  # each takes a form at least
            whole = False
            break
        groups.sort(key=len, reverse=True)
        group = groups.pop(0)
        F = failures[group]
        rows, within, score = _fitted(F, candidates, survived)
        if says == FAILS:  # grown, it would refuse more of what was survived than of failures
            share = (distances(rows, sample) < GROWN).mean(1)
            within[share > np.minimum(_RARE, within.sum(1) / n_failures)] = False
        count = within.sum(1)
        best = max(range(len(candidates)), key=lambda n: (count[n], score[n]))
        if 2 < len(group) and count[best] < len(group):
            by_two, first = _in_two(F, candidates, score, survived)
            if by_two > count[best]:
                groups += [group[first], group[~first]]
                continue
        if count[best] >= min(max(2, 0.5 * len(group)), len(group)):
            bent_rows.append(rows[best])
            groups += [group[~within[best]]] if count[best] < len(group) else []
            continue
        likeliest = candidates[int(score.argmax())][:2]
        first = _split(F[:, likeliest] / survived.spread[likeliest])
        whole &= not first.all()
        groups += [] if first.all() else [group[first], group[~first]]
    table = np.array(bent_rows).reshape(-1, SIZE)
    table[:, SAYS] = says
    return table, whole and not groups


def _in_two(F: Floats, asked: Ints, score: Floats, survived: Survived) -> tuple[int, Flags]:
    """How many failures two forms of the likeliest pairs of variables explain, and which half."""
    best_split = 0, np.ones(len(F), bool)
    pairs = np.flatnonzero(asked[:, 2] == 2)
    for n in pairs[np.argsort(-score[pairs], kind="stable")[:_IN_TWO]]:
        first = _split(F[:, asked[n, :2]] / survived.spread[asked[n, :2]])
        for _ in range(_ROUNDS):
            if first.all() or not first.any():
                break
            fits = [_fitted(F[half], asked[[n]], survived) for half in (first, ~first)]
            far = np.concatenate([distances(rows, F) for rows, _, _ in fits])
            count = int((far.min(0) <= BLUR).sum())
            best_split = (count, first) if count > best_split[0] else best_split
            if (first == (far[0] <= far[1])).all():
                break
            first = far[0] <= far[1]
    return best_split


def _candidates(failures: Floats, survived: Survived) -> Ints:
    """(c, 3) variables and kinds of forms that are tried: of many variables those that tell most.

    A variable tells failed observations from survived ones where they have another mean or spread;
    of pairs those are tried, too, that tell most beyond what their variables do.
    """
    variables = np.flatnonzero(survived.spread > 0.0)
    pairs = [*combinations(variables.tolist(), 2)]
    if len(variables) > _SCREENED:
        x, y = (z[:, variables] / survived.spread[variables] for z in (failures, survived.rows))
        alone, more = _tells(x, y)
        couples = [pairs[n] for n in np.argsort(-more, kind="stable")[:_COUPLED]]
        variables = np.sort(variables[np.argsort(-alone, kind="stable")[:_SCREENED]])
        pairs = [*dict.fromkeys([*combinations(variables.tolist(), 2), *couples])]
    bent = [(i, j, kind) for i, j in pairs for kind in (1, 2)]
    return np.array([*((j, j, 0) for j in variables), *bent], np.int64).reshape(-1, 3)


def _tells(failures: Floats, survived: Floats) -> tuple[Floats, Floats]:
    """(m,) what each variable tells, and what each pair of them does beyond that.

    Twice the divergences of normal distributions of failures (k, m), about the mean of what was
    survived, from those of that; for pairs it counts as one failure more.
    """
    scale = np.sqrt(survived.var(0) + 1e-12)
    x, y = ((z - survived.mean(0)) / scale for z in (failures, survived))
    square, R = np.maximum((x * x).mean(0), 1e-12), y.T @ y / len(y)
    S = (x.T @ x + R) / (len(x) + 1.0)
    i, j = np.triu_indices(len(scale), 1)
    joint, free = S[i, i] + S[j, j], np.maximum(1.0 - R[i, j] ** 2, SMALL)
    remainder = np.maximum(1.0 - S[i, j] ** 2 / (S[i, i] * S[j, j]), SMALL)
    more = (joint - 2.0 * R[i, j] * S[i, j]) / free - joint - np.log(remainder / free)
    return square - 1.0 - np.log(square), more


def _split(x: Floats) -> Flags:
    """Rows in two, from the pair that is farthest apart: which are with the first of them."""
    far = ((x[:, None] - x[None]) ** 2).sum(2)
    a, b = x[list(np.unravel_index(int(far.argmax()), far.shape))]
    first = np.ones(len(x), bool)
    for _ in range(5):
        first = ((x - a) ** 2).sum(1) <= ((x - b) ** 2).sum(1)
        if first.all() or not first.any():
            return np.ones(len(x), bool)
        a, b = x[first].mean(0), x[~first].mean(0)
    return first


# -- One bent form --------------------------------------------------------------------------------


def _fitted(F: Floats, asked: Ints, survived: Survived) -> tuple[Floats, Flags, Floats]:
    """(c, SIZE) the forms that are asked of failures (k, m); which are inside; and scores."""
    rows, k = survived.rows, len(F)
    pairs, kinds = asked[:, :2], _KINDS[asked[:, 2]]
    unit, scale = survived.unit[pairs], survived.spread[pairs]
    points = F[:, pairs].transpose(1, 0, 2)
    at = points.mean(1)
    different, of_them = np.unique(pairs, axis=0, return_inverse=True)
    near = [_near(rows[:, pair], F[:, pair], survived.spread[pair]) for pair in different]
    index = np.array(near)[of_them.ravel()]
    table, likelihood = np.zeros((len(asked), SIZE)), np.zeros(len(asked))
    again = np.arange(len(asked))
    for _ in range(_REFITS):  # with what the fit before has wrongly inside
        neighbours = rows[index[..., None], pairs[again][:, None]]
        x = np.concatenate([points[again], neighbours], 1) - at[again][:, None]
        u, v = (x / scale[again][:, None]).transpose(2, 0, 1)
        phi = np.stack([u, v, u * u, u * v, v * v], 2) * kinds[again][:, None]
        w, likelihood[again] = _logistic(phi, np.append(np.ones(k), np.zeros(index.shape[1])))
        s, t = (unit / scale)[again].T
        fits = np.zeros((len(again), SIZE))
        fits[:, I:AT], fits[:, AT:ONE], fits[:, ONE:C] = pairs[again], at[again], 1.0 / unit[again]
        fits[:, C], fits[:, B], fits[:, D] = w[:, 5], w[:, 0] * s, w[:, 1] * t
        fits[:, P], fits[:, Q], fits[:, R] = w[:, 2] * s**2, w[:, 3] * s * t, w[:, 4] * t**2
        form = forms(fits, rows)[0]
        most = form.max(1)  # as large as it may be with none of them inside
        wrong = (most > 0.0) & (likelihood[again] > -_UNLIKELY * k)
        fits[:, C] -= most + 1e-12 * (np.abs(fits[:, C]) + np.abs(most))
        table[again] = fits
        again, form, index = again[wrong], form[wrong], index[wrong]
        if not len(again) or len(rows) <= _FIT_ROWS:
            break
        index = np.hstack([index, np.argpartition(-form, _WORST, 1)[:, :_WORST]])
    within = inside(table, F)
    within[2 * (within & (distances(table, F) < 0.0)).sum(1) < within.sum(1)] = False
    score = likelihood - 0.5 * kinds.sum(1) * np.log(k + 1.0)
    return table, within, score


def _near(survived: Floats, F: Floats, scale: Floats) -> Ints:
    """Of what was survived as much nearest to each failure as to others, and as much evenly."""
    n, half = len(survived), _FIT_ROWS // 2
    if n <= _FIT_ROWS:
        return np.arange(n)
    quota = -(-half // len(F))
    x, y = ((survived[:, k] - F[:, [k]]) / scale[k] for k in (0, 1))
    far = x * x + y * y
    near = np.argpartition(far, quota, 1)[:, :quota].ravel()[:half]
    return np.append(near, np.linspace(0, n - 1, _FIT_ROWS - half).astype(int))


def _logistic(phi: Floats, y: Floats) -> tuple[Floats, Floats]:
    """(c, p + 1) weights of c ridge logistic regressions, the constant last, and likelihoods.

    Of features ``phi`` (c, n, p), standardised, by Newton's method. The ridge is so small that what
    can be told apart is, and only keeps weights finite.
    """
    (count, n, p), mean, size = phi.shape, phi.mean(1), phi.std(1)
    size = np.where(size > 0.0, size, 1.0)
    X = np.concatenate([(phi - mean[:, None]) / size[:, None], np.ones((count, n, 1))], 2)
    hold = np.full((count, p + 1), ROUNDING * n)
    hold[:, :p][~(phi != 0.0).any(1)] = 1.0  # features that it has not
    w, to = np.zeros((count, p + 1)), np.where(y > 0.0, -1.0, 1.0)

    def tried(index: Ints, A: Floats, w: Floats) -> tuple[Floats, Floats]:
        """What weights cost, and what each row adds up to."""
        t = np.einsum("cnp,cp->cn", A, w)
        loss = np.maximum(t * to, 0.0) + np.log1p(np.exp(-np.abs(t)))
        return np.asarray(loss.sum(1) + 0.5 * (hold[index] * w**2).sum(1)), t

    open_fits, A = np.arange(count), X
    now, t = tried(open_fits, A, w)
    for _ in range(_NEWTON):
        q = 0.5 * (1.0 + np.tanh(0.5 * t))
        down = np.einsum("cnp,cn->cp", A, q - y) + hold[open_fits] * w[open_fits]
        hessian = (A * np.maximum(q * (1.0 - q), 1e-12)[..., None]).transpose(0, 2, 1) @ A
        hessian += hold[open_fits][:, :, None] * np.eye(p + 1)
        step = np.linalg.solve(hessian, down[..., None])[..., 0]
        rate = np.ones(len(open_fits))
        for _ in range(10):
            new, t = tried(open_fits, A, w[open_fits] - rate[:, None] * step)
            worse = new > now[open_fits] - 1e-12
            if not worse.any():
                break
            rate[worse] *= 0.5
        w[open_fits] -= np.where(worse, 0.0, rate)[:, None] * step
        was = now[open_fits]
        now[open_fits] = np.where(worse, was, new)
        on = ~worse & (was - new >= 1e-4 * new + 1e-9)
        open_fits, A, t = open_fits[on], A[on], t[on]
        if not len(open_fits):
            break
    likelihood = -(now - 0.5 * (hold * w**2).sum(1))
    weights = w[:, :p] / size
    return np.column_stack([weights, w[:, p] - (weights * mean).sum(1)]), likelihood
