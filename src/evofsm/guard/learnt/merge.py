"""Learnt judges that drove different systems of one kind, merged into one.

Sums add up once they are counted from one origin, which is the first observation of each. Where
variables are larger by d, features phi become T phi: z_i becomes z_i + d_i, u z_i becomes
u (z_i + d_i), and z_i z_j becomes (z_i + d_i)(z_j + d_j). So the sums A of products of features,
and B of features with changes, become T A T' and T B, exactly.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence

import numpy as np

from evofsm.guard.harm import Harm
from evofsm.guard.learnt import library
from evofsm.guard.learnt.dead_ends import DeadEnds
from evofsm.guard.learnt.dynamics import MOST, MOST_SURVIVED, Dynamics
from evofsm.guard.learnt.judge import LearntRisk
from evofsm.guard.learnt.regression import Drift, Recent
from evofsm.guard.learnt.replay import Floats, Sums, crossed, n_products, pairs


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
    what 2.4 s brought
    >>> guard = Guard(n_actions=2, interval=0.1, judge=judge)
    """
    if not judges:
        raise ValueError("judges is empty; there must be at least one to merge")
    for one in judges[1:]:
        if not one.dynamics.choices:
            judges[0].refuse_unfit(one.dynamics.low, one.dynamics.high)
    if len({(one.dt, one.dynamics.choices) for one in judges}) > 1:
        raise ValueError("judges to merge must be of the same actions and interval")
    told = [one for one in judges if one.dynamics.n_variables]
    if len({one.dynamics.n_variables for one in told}) > 1:
        raise ValueError("judges to merge must have observed the same variables")
    merged = copy.deepcopy(max(told or judges, key=lambda one: one.dynamics.n_episodes))
    merged.start_episode(learn=False)
    if len(told) < 2:
        return merged
    merged.dynamics = _merged([one.dynamics for one in told])
    merged.n_studied = merged.dynamics.n_episodes
    for name in ("n_violated", "n_failed", "n_scanned"):
        setattr(merged, name, sum(getattr(one, name) for one in told))
    for name in ("margin", "time_to_failure", "horizon"):
        setattr(merged, name, max(getattr(one, name) for one in told))
    merged.harm = Harm.merged([one.harm for one in told])
    if merged.backups is not None:
        each = library.fewer(library.KEPT, merged.dynamics.n_variables) // len(told)
        seen = [one.situations[-each:] for one in told if len(one.situations)]
        merged.situations = np.vstack(seen)
        policies = merged.backups.policies[merged.backups.ranks[:2]]
        situations, scale = merged.situations, merged.disturbance_scale
        chosen = library.choose(merged.dynamics, situations, merged.horizon, policies, scale)
        merged.disturbances = library.at_once(chosen)
        random = np.random.default_rng([merged.seed, merged.n_studied])
        merged.backups = library.at_once(merged.evolved(random))
    merged.start_episode(learn=False)
    return merged


def _merged(parts: Sequence[Dynamics]) -> Dynamics:
    """What dynamics learnt in all, counted from the origin of the first."""
    merged = copy.deepcopy(parts[0])
    merged.forget_episode()
    m, a, p, each = merged.n_variables, merged.size, len(merged.weights), MOST // len(parts)

    def of(name: str) -> Floats:
        return np.array([getattr(part, name) for part in parts])

    off = of("origin") - merged.origin
    sums = Sums(*map(np.array, zip(*(part.sums for part in parts), strict=True)))
    T = np.array([_moved(d, a, p) for d in off])
    observed, learnt = sums.counts.T
    known = learnt * (sums.scale[:, 0] > 0.0)
    mean = observed @ (off + sums.mean) / observed.sum()
    early = [rows[: int(n)] for rows, n in zip(sums.early, learnt, strict=True)]
    merged.sums = sums._replace(
        counts=sums.counts.sum(0),
        squares=(T @ sums.squares @ T.transpose(0, 2, 1)).sum(0),
        products=(T @ sums.products).sum(0),
        mean=mean,
        scatter=sums.scatter.sum(0) + observed @ (off + sums.mean - mean) ** 2,
        early=np.resize(np.concatenate(early), sums.early[0].shape),
        **{name: getattr(sums, name).min(0) for name in ("least", "low")},
        **{name: getattr(sums, name).max(0) for name in ("most", "high")},
        **{name: _average(getattr(sums, name), learnt) for name in ("variance", "unit", "moving")},
        **{name: _average(getattr(sums, name), known) for name in ("scale", "noise")},
    )
    merged.used = of("used").sum(0)
    merged.missed = _average(of("missed"), learnt)
    merged.doubt_of_lags = float(_average(of("doubt_of_lags"), learnt))
    lowest, highest = of("lowest"), of("highest")
    merged.lowest, merged.highest = lowest.min(0), highest.max(0)
    there = np.stack([lowest, highest], 2), np.stack([merged.lowest, merged.highest], 1)
    merged.reached = np.where(np.isclose(*there, 1e-9, 0.0), of("reached"), 0.0).sum(0)
    merged.n_episodes, merged.sequences, drifts = int(of("n_episodes").sum()), [], []
    events = []
    for part in parts:  # the latest episode of each is the latest of all
        later, newest = merged.n_episodes - part.n_episodes, part.sequences[-merged.remembered :]
        merged.sequences += [one._replace(episode=one.episode + later) for one in newest]
        events.append(part.events + later * (np.arange(part.events.shape[1]) == 3 * m + 2 * a))
        drifts += [Drift(j, since + later, noticed + later) for j, since, noticed in part.drifts]
    merged.drifts = sorted(drifts)
    for name in ("failures", "brinks", "ended"):
        setattr(merged, name, np.concatenate([getattr(part, name)[-each:] for part in parts]))
    survived = np.concatenate([part.survived for part in parts])
    merged.survived = survived[:: -(-len(survived) // MOST_SURVIVED) or 1]
    jumps = zip(*(part.jumps for part in parts), strict=True)
    merged.jumps = [np.concatenate([rows[-each:] for rows in seen]) for seen in jumps]
    merged.events = np.concatenate(events)
    merged.recent, merged.latest = Recent.none(p, m, merged.n_episodes), None
    merged.settle(failed=True)
    known = merged.model.inverse, merged.sums.unit
    merged.dead_ends = DeadEnds.merged([part.dead_ends for part in parts], *known)
    merged.rebuild()
    return merged


def _average(rows: Floats, weights: Floats) -> Floats:
    return np.asarray(np.tensordot(weights, rows, 1) / max(weights.sum(), 1.0))


def _moved(d: Floats, a: int, p: int) -> Floats:
    """(p, p) what features become where variables are larger by ``d`` (m,)."""
    m, T = len(d), np.eye(p)
    T[1 : 1 + m, 0] = d
    products = T[p - n_products(m, a) :]
    for k in range(crossed(m, a)):
        products[k * m : (k + 1) * m, 1 + 2 * m + k] = d
    for row, i, j in zip(products[crossed(m, a) * m :], *pairs(m), strict=True):
        row[0] = d[i] * d[j]
        row[1 + i] += d[j]
        row[1 + j] += d[i]
    return T
