"""Learnt judges that drove different systems of one kind, merged into one.

Sums add up once they are counted from one origin, which is the first observation of each. Where
variables are larger by d, features phi become T phi: z_i becomes z_i + d_i, u z_i becomes
u (z_i + d_i), and z_i z_j becomes (z_i + d_i)(z_j + d_j). So the sums A of products of features,
and B of features with changes, become T A T' and T B, exactly.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import Any

import numpy as np

from evofsm.guard.harm import Harm
from evofsm.guard.learnt.backups import evolved
from evofsm.guard.learnt.danger import dead_ends, explained, fails
from evofsm.guard.learnt.judge import LearntRisk
from evofsm.guard.learnt.learn import chosen, coarser, disturbance_scale, kept, worst
from evofsm.guard.learnt.rollout import Floats, crossed, pairs
from evofsm.guard.learnt.state import Episode, State, model_of, residuals_of

# Numbers of which the largest counts.
_MAXIMA = "margin", "time_to_failure", "believed", "too_short", "misled"


def merge_judges(judges: Sequence[LearntRisk]) -> LearntRisk:
    """Merge judges that learnt apart, between episodes, into one that shares nothing with them.

    Of disturbances, failures, jumps and situations the newest of each are kept; backups are those
    of the judge that learnt from most episodes, which evolve on; the margin is the largest. Whether
    they do harm is said anew, of how all their latest episodes ended.

    Parameters
    ----------
    judges : sequence of LearntRisk
        Of guards of the same system, each with its own share of the episodes.

    Raises
    ------
    ValueError
        If there is none, or actions, intervals or numbers of variables differ.

    Examples
    --------
    >>> from evofsm.guard import Guard, merge_judges
    >>> guards = [Guard(n_actions=2, interval=0.1) for _ in range(2)]
    >>> for guard in guards:
    ...     for z in range(12):
    ...         revision = guard.decide([z], 0)
    ...     guard.end(failed=False)
    >>> judge = merge_judges([guard.judge for guard in guards])
    >>> print(judge.remembered)
    6 disturbances remembered from 2.4 s
    >>> guard = Guard(n_actions=2, interval=0.1, judge=judge)
    """
    if not judges:
        raise ValueError("judges is empty; there must be at least one to merge")
    for judge in judges[1:]:
        if not judge.choices:
            judges[0].refuse_unfit(judge.low, judge.high)
    if len({(judge.dt, judge.choices) for judge in judges}) > 1:
        raise ValueError("judges to merge must be of the same actions and interval")
    told = [judge for judge in judges if judge.n_variables]
    if len({judge.n_variables for judge in told}) > 1:
        raise ValueError("judges to merge must have observed the same variables")
    merged = copy.deepcopy(max(told or judges, key=lambda judge: judge.state.n_episodes))
    merged.start_episode(learn=False)
    if len(told) > 1:
        merged.state = merge([judge.state for judge in told], merged)
        merged.harm = Harm.merged([judge.harm for judge in told])
        merged.remake()
    return merged


def merge(parts: Sequence[State], judge: LearntRisk) -> State:
    """Merge what was learnt apart of systems of one kind, as a judge that learns on from there."""
    settings = judge.settings

    def of(name: str) -> Floats:
        return np.array([getattr(part, name) for part in parts])

    def rows(name: str, most: int = 0) -> Floats:
        share = max(min(most, 1), most // len(parts))
        return np.concatenate([getattr(part, name)[-share:] for part in parts])[-most:]

    stride = max(part.stride for part in parts)
    while any(part.stride < stride for part in parts):
        parts = [part if part.stride == stride else coarser(part, settings) for part in parts]
    first, latest = parts[0], max(parts, key=lambda part: (len(part.linear) > 0, part.n_episodes))
    (p, m), a, n_episodes = first.products.shape, len(first.used), int(of("n_episodes").sum())
    T = np.array([_moved(d, a, p) for d in of("origin") - first.origin])
    moves = of("n_moves")
    lowest, highest = np.sort(rows("lowest"), 0), -np.sort(-rows("highest"), 0)
    ends = np.stack([of("lowest")[:, 0], of("highest")[:, 0]], 2)
    shared = np.isclose(ends, np.stack([lowest[0], highest[0]], 1), 1e-9, 0.0)
    after = n_episodes - of("n_episodes")  # the latest episode of each is the latest of all
    every = max(1, -(-len(rows("survived")) // settings.max_survived))
    drifts = [part.drifts + np.array([0, k, k]) for part, k in zip(parts, after, strict=True)]
    fields: dict[str, Any] = {
        **{name: int(of(name).sum()) for name in ("n_failed", "n_scanned", "n_seen", "n_moves")},
        **{name: float(of(name).max()) for name in _MAXIMA},
        **{name: _average(of(name), moves) for name in ("unit", "power")},
        **{name: _average(of(name), moves * of("scale").any(1)) for name in ("scale", "noise")},
        **{name: rows(name, settings.max_failures) for name in ("failures", "brinks", "ended")},
        **{name: rows(name) for name in ("centres", "radii", "counts", "fatal")},
        **{name: rows(name) for name in ("windows", "lengths")},
        **{name: getattr(latest, name) for name in ("policies", "linear")},
        "n_episodes": n_episodes,
        "origin": first.origin,
        "squares": (T @ of("squares") @ T.transpose(0, 2, 1)).sum(0),
        "products": (T @ of("products")).sum(0),
        "least": of("least").min(0),
        "most": of("most").max(0),
        "since": np.full(m, float(n_episodes)),
        "drifts": np.concatenate(drifts),
        "lowest": lowest[:2],
        "highest": highest[:2],
        "reached": np.where(shared, of("reached"), 0.0).sum(0),
        "seen_in": np.concatenate([part.seen_in + k for part, k in zip(parts, after, strict=True)]),
        "survived": rows("survived")[::every],
        "proven": rows("proven")[::every],
        "situations": rows("situations", settings.n_situations),
        "used": of("used").sum(0),
        **{name: int(of(name).max()) for name in ("horizon", "wrong", "stride")},
    }
    merged = State.none(m, a, first.choices, settings, None)._replace(**fields)
    no_rows = merged.survived[:0]
    nothing = Episode(no_rows, no_rows, False, False, no_rows, no_rows, no_rows, 0.0)
    if judge.failed is None:
        merged = explained(merged, settings, failed=True, bends="regions" not in judge.without)
    else:
        merged = fails(merged, no_rows, nothing, settings, judge.without, judge.failed)
    merged = merged._replace(held=int(min(0, of("held").max())))  # doubted is what all doubt
    merged = dead_ends(merged, model_of(merged, settings), no_rows, nothing, no_rows)
    if not len(merged.situations):
        return merged
    known, scale = model_of(merged, settings), disturbance_scale(merged, settings)
    rest, random = residuals_of(merged, known, merged.horizon), np.random.default_rng(judge.seed)
    harmful = worst(known, merged.situations, merged.policies[:2], rest, scale)
    keep = chosen(harmful, settings.n_disturbances)
    merged = kept(merged, keep)
    if "backups" in judge.without:
        return merged
    amid = np.ascontiguousarray(rest[:, :, [0, *(1 + k for k in keep)]])
    given = known, merged.situations, amid, scale, settings, random
    policies, linear = evolved(merged.policies, merged.linear, *given)
    return merged._replace(policies=policies, linear=linear)


def _average(rows: Floats, weights: Floats) -> Floats:
    return np.asarray(np.tensordot(weights, rows, 1) / max(weights.sum(), 1.0))


def _moved(d: Floats, a: int, p: int) -> Floats:
    """(p, p) what features become where variables are larger by ``d`` (m,)."""
    m, T = len(d), np.eye(p)
    T[1 : 1 + m, 0] = d
    products = T[p - crossed(m, a) * m - len(pairs(m)[0]) :]
    for k in range(crossed(m, a)):
        products[k * m : (k + 1) * m, 1 + 2 * m + k] = d
    for row, i, j in zip(products[crossed(m, a) * m :], *pairs(m), strict=True):
        row[0] = d[i] * d[j]
        row[1 + i] += d[j]
        row[1 + j] += d[i]
    return T
