"""What is worth remembering: tight situations, and the disturbances that would harm there."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from evofsm.fsm import Disturbances, Dynamics, Episode, Here
from evofsm.guard.learnt.search import harm

_Floats = NDArray[np.float64]

# Situations that are kept, and those on which the starts of an episode are tried.
_KEPT, _TRIED = 32, 8
# Of an episode that failed, so many of its last ones.
_BEFORE_FAILURE = 3
# Starts of an episode that are tried, and how far those are apart that are remembered.
_MOST_STARTS, _APART = 160, 3
# What is lost in so few steps, whatever one does, is no argument.
_AT_ONCE = 3
# Residuals that disturbances without memory are drawn from.
_POOL = 3000


class Situations:
    """Situations on which backups and disturbances are tried: some anywhere, some tight."""

    def __init__(self) -> None:
        self.kept: list[Here] = []
        #: Residuals, only for disturbances without memory.
        self.pool: list[_Floats] = []

    def __len__(self) -> int:
        return len(self.kept)

    def arrays(self, which: NDArray[np.int64] | None = None) -> tuple[_Floats, _Floats, _Floats]:
        """Observations, changes and actions before, (k, m), (k, m) and (k, a)."""
        some = self.kept if which is None else [self.kept[int(i)] for i in which]
        z, change, action = (np.array(column) for column in zip(*some, strict=True))
        return z, change, action

    def add(
        self,
        episode: Episode,
        tight: Sequence[bool],
        horizon: int,
        random: np.random.Generator,
    ) -> None:
        """Keep one situation of an episode, a tight one, and some before failure."""
        Z, U = episode.observations, episode.actions
        T = len(U)
        steps = list(random.integers(1, T, 1))
        tights = np.flatnonzero(tight[1:T]) + 1
        if len(tights):
            steps.append(int(random.choice(tights)))
        if episode.failed:
            back = random.integers(2, max(3, min(T, horizon)), _BEFORE_FAILURE)
            steps += list(np.maximum(1, T - 1 - back))
        for t in steps:
            one = Here(Z[t], Z[t] - Z[t - 1], U[t - 1])
            if len(self.kept) < _KEPT:
                self.kept.append(one)
            else:
                self.kept[int(random.integers(_KEPT))] = one

    def scan(
        self, dynamics: Dynamics, horizon: int, policies: _Floats, random: np.random.Generator
    ) -> None:
        """Remember those starts of the latest episode that would harm most in a few situations."""
        episode, known = dynamics.latest, dynamics.consequents
        assert episode is not None
        n, m = len(episode.residuals), dynamics.n_variables
        alone, calm = np.empty((1, len(self))), Disturbances.nothing(1, horizon, m)
        harm(known, *self.arrays(), policies, calm, 1.0, alone)
        safe = np.flatnonzero(alone[0] > 0.0)
        if not len(safe):
            return
        safe = random.permutation(safe)[:_TRIED]
        steps = np.arange(n)
        if n > _MOST_STARTS:
            steps = np.sort(random.permutation(n)[:_MOST_STARTS])
        rest = np.vstack([episode.residuals, np.zeros((horizon, m))])
        begun = Disturbances.nothing(len(steps), horizon, m)
        for row, begin in zip(begun.residuals, steps, strict=True):
            row[:] = rest[begin : begin + horizon]
        found = np.empty((len(steps), len(safe)))
        harm(known, *self.arrays(safe), policies, begun, 1.0, found)
        taken, starts = dynamics.onsets(episode.residuals), list[int]()
        for worst in found.argmin(0).tolist():
            t = int(steps[worst])
            if all(abs(t - other) > _APART for other in [*starts, *taken]):
                starts.append(t)
        dynamics.remember(starts)


def choose(
    dynamics: Dynamics,
    situations: Situations,
    horizon: int,
    policies: _Floats,
    harder: float,
    random: np.random.Generator,
) -> Disturbances:
    """Keep the most harmful stretches of all that are remembered; return what is kept."""
    if "memory" in dynamics.without:
        return _shuffled(dynamics, situations, horizon, random)
    found, K = dynamics.disturbances(horizon), dynamics.n_stretches
    n = len(dynamics.stretches)
    if n <= K:
        return found
    keep = list(range(n))
    if len(dynamics.consequents.sides) and len(situations):
        ends = np.empty((1 + n, len(situations)))
        harm(dynamics.consequents, *situations.arrays(), policies, found, harder, ends)
        ends = np.where(ends[1:] < _AT_ONCE - 1.0 - horizon, 1e9, ends[1:])
        value = np.minimum(ends, 100.0).mean(1)
        while len(keep) > K:
            worst = {keep[i] for i in ends[keep].argmin(0)}
            free = [k for k in keep if k not in worst] or keep
            keep.remove(max(free, key=lambda k: float(value[k])))
    else:
        keep = keep[-K:]
    dynamics.keep(keep)
    which = np.array([0, *(1 + k for k in keep)])
    return Disturbances(*(array[which] for array in found))


def _shuffled(
    dynamics: Dynamics, situations: Situations, horizon: int, random: np.random.Generator
) -> Disturbances:
    """As many disturbances whose steps have nothing to do with each other."""
    assert dynamics.latest is not None
    pool = np.vstack([*situations.pool, dynamics.latest.residuals])[-_POOL:]
    situations.pool = [pool]
    made = Disturbances.nothing(1 + dynamics.n_stretches, horizon, dynamics.n_variables)
    for row in made.residuals[1:]:
        row[:] = pool[random.integers(len(pool), size=len(row))]
    return made


def failing_after(
    dynamics: Dynamics, situations: Situations, policies: _Floats, disturbances: Disturbances
) -> int:
    """Steps after which it fails at the latest where it does, under the best of the policies."""
    steps = disturbances.residuals.shape[1]
    ends = np.empty((len(disturbances.residuals), len(situations)))
    harm(dynamics.consequents, *situations.arrays(), policies, disturbances, 1.0, ends)
    return int(ends[ends < 0.0].max(initial=-1.0 - steps) + 1 + steps)
