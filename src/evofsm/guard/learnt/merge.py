"""Learnt judges that drove different systems of one kind, merged into one.

Sums add up once they are counted from one origin, which is the first observation of each. Where
variables are larger by d, features phi become T phi: z_i becomes z_i + d_i, u z_i becomes
u (z_i + d_i), and z_i z_j becomes (z_i + d_i)(z_j + d_j). So the sums A of products of features,
and B of features with changes, become T A T' and T B, exactly.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import TypeVar

import numpy as np

from evofsm.guard.learnt import library
from evofsm.guard.learnt.dynamics import MOST, Dynamics
from evofsm.guard.learnt.judge import LearntRisk
from evofsm.guard.learnt.regression import Recent
from evofsm.guard.learnt.replay import Floats, Sums, n_products

_Item = TypeVar("_Item")
_ENDS = ("lowest", "highest")


def merge_judges(judges: Sequence[LearntRisk]) -> LearntRisk:
    """Merge judges that learnt apart, between episodes, into one that shares nothing with them.

    Of sequences, failures, jumps and situations the newest of all are kept; backups are those of
    the judge that learnt from most episodes, which evolve on; the margin is the largest.

    A ValueError if there is none, or actions, intervals or numbers of variables differ.
    """
    if not judges:
        raise ValueError("judges is empty; there must be at least one to merge")
    for one in judges[1:]:
        judges[0].refuse_unfit(*one.range)
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
    for name in ("n_violated", "n_scanned"):
        setattr(merged, name, sum(getattr(one, name) for one in told))
    for name in ("margin", "time_to_failure", "horizon"):
        setattr(merged, name, max(getattr(one, name) for one in told))
    merged.situations = np.vstack(_newest([list(one.situations) for one in told], library.KEPT))
    if merged.backups is not None:
        policies = merged.backups.policies[merged.backups.ranks[:2]]
        disturbances = library.choose(
            merged.dynamics, merged.situations, merged.horizon, policies, merged.disturbance_scale
        )
        merged.disturbances = disturbances
        merged.backups = merged.evolved(np.random.default_rng([merged.seed, merged.n_studied]))
    merged.start_episode(learn=False)
    return merged


def _merged(parts: Sequence[Dynamics]) -> Dynamics:
    """What dynamics learnt in all, counted from the origin of the first."""
    merged = copy.deepcopy(parts[0])
    merged.forget_episode()
    m, a, p = merged.n_variables, merged.size, len(merged.weights)
    off = np.array([part.origin - merged.origin for part in parts])
    shifts = [_moved(each, a, p) for each in off]
    of = Sums(*map(np.array, zip(*(part.sums for part in parts), strict=True)))
    observed, learnt = of.counts.T
    known = learnt * (of.scale[:, 0] > 0.0)
    mean = observed @ (off + of.mean) / observed.sum()
    pairs = list(zip(shifts, of.squares, of.products, strict=True))
    early = [rows[: int(n)] for rows, n in zip(of.early, learnt, strict=True)]
    merged.sums = of._replace(
        counts=of.counts.sum(0),
        squares=np.sum([T @ squares @ T.T for T, squares, _ in pairs], axis=0),
        products=np.sum([T @ products for T, _, products in pairs], axis=0),
        mean=mean,
        scatter=of.scatter.sum(0) + observed @ (off + of.mean - mean) ** 2,
        early=np.resize(np.concatenate(early), of.early[0].shape),
        least=of.least.min(0),
        most=of.most.max(0),
        low=of.low.min(0),
        high=of.high.max(0),
        **{name: _average(getattr(of, name), learnt) for name in ("variance", "unit", "moving")},
        **{name: _average(getattr(of, name), known) for name in ("scale", "noise")},
    )
    merged.used = np.sum([part.used for part in parts], axis=0)
    merged.missed = _average(np.array([part.missed for part in parts]), learnt)
    merged.doubt_of_lags = float(_average(np.array([one.doubt_of_lags for one in parts]), learnt))
    lowest, highest = (np.array([getattr(part, name) for part in parts]) for name in _ENDS)
    merged.lowest, merged.highest = lowest.min(0), highest.max(0)
    reached, spread = np.array([part.reached for part in parts]), merged.highest - merged.lowest
    at_lowest, at_highest = lowest - merged.lowest, merged.highest - highest
    there = np.stack([at_lowest, at_highest], 2) <= 1e-9 * np.maximum(spread, 0.0)[:, None]
    merged.reached = np.where(there, reached, 0.0).sum(0)
    total = merged.n_episodes = sum(part.n_episodes for part in parts)
    later = [total - part.n_episodes for part in parts]
    sequences = [
        [one._replace(episode=one.episode + more) for one in part.sequences]
        for part, more in zip(parts, later, strict=True)
    ]
    merged.sequences = _newest(sequences, len(parts) * merged.remembered)
    merged.drifts = sorted(
        one._replace(since=one.since + more, noticed=one.noticed + more)
        for part, more in zip(parts, later, strict=True)
        for one in part.drifts
    )
    failures = _newest([list(part.failures) for part in parts], MOST)
    merged.failures = np.array(failures).reshape(-1, m)
    merged.jumps = [
        np.array(_newest([list(part.jumps[j]) for part in parts], MOST)).reshape(-1, m + 1)
        for j in range(m)
    ]
    merged.recent, merged.latest = Recent.none(p, m, total), None
    merged.settle()
    return merged


def _average(rows: Floats, weights: Floats) -> Floats:
    return np.asarray(np.tensordot(weights, rows, 1) / max(weights.sum(), 1.0))


def _moved(d: Floats, a: int, p: int) -> Floats:
    """(p, p) what features become where variables are larger by ``d`` (m,)."""
    m = len(d)
    T = np.eye(p)
    T[1 : 1 + m, 0] = d
    k = p - n_products(m, a)
    for i in range(a):
        T[k : k + m, 1 + 2 * m + i] = d
        k += m
    for i in range(m):
        for j in range(i, m):
            T[k, 0] = d[i] * d[j]
            T[k, 1 + i] += d[j]
            T[k, 1 + j] += d[i]
            k += 1
    return T


def _newest(lists: Sequence[Sequence[_Item]], most: int) -> list[_Item]:
    """The last of all lists, evenly, up to so many; the newest last."""
    longest = max(map(len, lists))
    by_age = [one[-1 - age] for age in range(longest) for one in lists if len(one) > age]
    return by_age[:most][::-1]
