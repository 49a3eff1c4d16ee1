"""Merge dynamics that were learnt apart: sums add up, once they are counted from one origin.

Features of an observation are counted from the first one, which is another one in each part. From
another origin they are ``T phi``, with a matrix T of the shift d of variables: z_i becomes
z_i + d_i, u z_i becomes u (z_i + d_i), and z_i z_j becomes (z_i + d_i) (z_j + d_j). So the sums of
products of features, and of those with changes, become ``T A T'`` and ``T B``, exactly.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import chain
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from evofsm.fsm.dynamics.consequents import n_products
from evofsm.fsm.dynamics.drift import Recent
from evofsm.fsm.dynamics.dynamics import MOST_KEPT, Dynamics
from evofsm.fsm.dynamics.keeping import to_bytes
from evofsm.fsm.dynamics.undoing import side_by_side

_Floats = NDArray[np.float64]
_Item = TypeVar("_Item")


def merge_dynamics(parts: Sequence[Dynamics]) -> Dynamics:
    """Merge dynamics that were learnt apart, between episodes; in any order, the same bit for bit.

    Sums add up: what came of two halves of a stream is what comes of all of it, but for what was
    forgotten between episodes, and for residuals that compared less because they were large in the
    light of one half. Ordinary changes and residuals are means by transitions. Of stretches,
    failures and jumps the newest of all parts are kept.

    Parameters
    ----------
    parts : sequence of Dynamics
        With the same settings; at least one.

    Returns
    -------
    Dynamics
        It shares nothing with the parts. What was told of failures (`told`) is that of the first
        one that was told.

    Raises
    ------
    ValueError
        If two have different settings, or numbers of variables.

    Examples
    --------
    >>> one, other = (Dynamics(n_actions=2) for _ in range(2))
    >>> for dynamics, origin in ((one, 0.0), (other, 5.0)):
    ...     for t in range(40):
    ...         dynamics.observe(np.array([origin + t % 7]))
    ...         dynamics.act(dynamics.encode(t % 2))
    ...     dynamics.end(failed=False)
    >>> merged = merge_dynamics([one, other])
    >>> merged.n_episodes, merged.lowest, merged.highest, merged.sums.counts
    (2, array([0.]), array([11.]), array([80., 78.]))
    """
    for number, part in enumerate(parts):
        if part.settings != parts[0].settings:
            raise ValueError(
                f"dynamics of machine {number} are {part.settings}, but {parts[0].settings} of "
                "machine 0; machines to merge must have the same settings"
            )
    told = next((part for part in parts if part.told is not None), None)
    whole = []
    for part in sorted(parts, key=lambda part: to_bytes(part).tobytes()):
        over = part.copy()
        over.break_off()
        if over.n_variables:
            whole.append(over)
    if not whole:
        return parts[0].copy()
    if len({part.n_variables for part in whole}) > 1:
        raise ValueError("dynamics to merge have different numbers of variables")
    merged = whole[0].copy()
    merged.latest, merged.clock = None, 0.0
    if told is not None:
        merged.told, merged.sides = told.told, list(getattr(told, "sides", ()))
    if len(whole) > 1:
        _add_up(merged, whole)
        _join(merged, whole)
        merged.settle()
    return merged


def moved(d: _Floats, a: int, p: int) -> _Floats:
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


def _add_up(merged: Dynamics, parts: Sequence[Dynamics]) -> None:
    """All numbers, into ``merged``, whose origin stays."""
    origin, p = merged.origin, len(merged.sums.squares)
    shifts = [moved(part.origin - origin, merged.size, p) for part in parts]
    observed, learnt = np.array([part.sums.counts for part in parts]).T
    means = np.array([part.origin - origin + part.sums.mean for part in parts])
    mean = observed @ means / observed.sum()
    between = observed @ (means - mean) ** 2

    def stacked(name: str) -> _Floats:
        return np.array([getattr(part.sums, name) for part in parts])

    def averaged(name: str, weights: _Floats) -> _Floats:
        averages: _Floats = weights @ stacked(name) / max(weights.sum(), 1.0)
        return averages

    known = np.array([part.sums.scale[0] > 0.0 for part in parts]) * learnt
    sums = [(T, part.sums) for T, part in zip(shifts, parts, strict=True)]
    merged.sums = side_by_side(
        merged.sums._replace(
            counts=stacked("counts").sum(0),
            squares=np.sum([T @ one.squares @ T.T for T, one in sums], axis=0),
            products=np.sum([T @ one.products for T, one in sums], axis=0),
            mean=mean,
            scatter=stacked("scatter").sum(0) + between,
            variance=averaged("variance", learnt),
            unit=averaged("unit", learnt),
            early=_early([part.sums.early for part in parts], learnt),
            least=stacked("least").min(0),
            most=stacked("most").max(0),
            scale=averaged("scale", known),
            noise=averaged("noise", known),
            low=stacked("low").min(0),
            high=stacked("high").max(0),
            moving=averaged("moving", learnt),
        )
    )
    merged.used = np.sum([part.used for part in parts], axis=0)
    weights = learnt if learnt.any() else observed
    for name in ("doubt_of_lags", "missed"):
        of_parts = [getattr(part, name) for part in parts]
        setattr(merged, name, np.average(of_parts, axis=0, weights=weights))
    merged.quiet = min(part.quiet for part in parts)
    merged.reached = np.stack(
        [
            _reached(parts, "lowest", 0, np.min),
            _reached(parts, "highest", 1, np.max),
        ],
        axis=1,
    )
    merged.lowest = np.min([part.lowest for part in parts], axis=0)
    merged.highest = np.max([part.highest for part in parts], axis=0)


def _early(changes: Sequence[_Floats], learnt: _Floats) -> _Floats:
    """The first changes of all parts, as many as there is room for."""
    first = [early[: int(n)] for early, n in zip(changes, learnt, strict=True)]
    together = np.concatenate(first)[: len(changes[0])]
    return np.pad(together, [(0, len(changes[0]) - len(together)), (0, 0)])


def _reached(parts: Sequence[Dynamics], name: str, side: int, best: Callable[..., Any]) -> _Floats:
    """(m,) episodes that reached the extreme of all parts."""
    extremes = np.array([getattr(part, name) for part in parts])
    spread = np.max([part.highest for part in parts], axis=0)
    spread = spread - np.min([part.lowest for part in parts], axis=0)
    far = np.isfinite(spread)
    close = 1e-9 * np.maximum(1.0, np.where(far, spread, 0.0))
    extreme = best(extremes, axis=0)
    off = np.abs(np.where(np.isfinite(extremes), extremes, 0.0) - np.where(far, extreme, 0.0))
    there = np.isfinite(extremes) & (off <= close)
    return np.asarray(
        sum(np.where(at, part.reached[:, side], 0.0) for at, part in zip(there, parts, strict=True))
    )


def _join(merged: Dynamics, parts: Sequence[Dynamics]) -> None:
    """All that is remembered one by one."""
    merged.n_episodes = sum(part.n_episodes for part in parts)
    merged.stretches = _newest(
        [
            [
                one._replace(episode=merged.n_episodes - part.n_episodes + one.episode)
                for one in part.stretches
            ]
            for part in parts
        ],
        merged.most_stretches,
    )
    merged.recent = Recent.nothing(*merged.weights.shape, merged.n_episodes)
    merged.drifts = sorted(
        one._replace(since=one.since + earlier, noticed=one.noticed + earlier)
        for part in parts
        for earlier in [merged.n_episodes - part.n_episodes]
        for one in part.drifts
    )
    merged.failures = _newest([part.failures for part in parts], MOST_KEPT)
    merged.jumps = [
        _newest([part.jumps[j] for part in parts], MOST_KEPT) for j in range(merged.n_variables)
    ]


def _newest(lists: Sequence[Sequence[_Item]], most: int) -> list[_Item]:
    """The last of all lists, evenly, up to so many; the newest last."""
    longest = max(map(len, lists))
    by_age = ([one[-1 - age] for one in lists if len(one) > age] for age in range(longest))
    return list(chain.from_iterable(by_age))[:most][::-1]
