"""Dead-end states, learnt: from there episodes failed that had been certified not to.

Where a certificate was refuted one may be in a dead end whatever the model says of it. It grows by
repetition, which is what tells a wrong model from a new disturbance, and shrinks by what is
survived. Distances are in y = (z - mean) / spread, each variable in its own spread.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from evofsm.guard.learnt.replay import KEPT, Floats, Ints, Model, search
from evofsm.store import FROM_1, Numbers

# Where it failed nearer than this, an old dead end counts for one more; its largest radius, too.
_NEAR = 0.6
# How far new ones are apart, and the radius of one from where one episode failed; each doubles it.
_APART = 0.15
# So much of the way to the nearest that was survived.
_SHARE = 0.9
# One of less than so many ordinary changes is forgotten; so many there may be.
_LEAST, _MOST = 0.5, 40
# Observations that were survived: that are kept, and of an episode.
_SURVIVED, _EACH = 1500, 60
#: Of an episode that was cut off the last ones, of which it is not known that they were survived.
LAST = 10
# Steps of replays after which nothing is asked but the proposal.
_ONCE = 1.0


class DeadEnds(NamedTuple):
    """Some, and what was survived, which says how large they may be."""

    centres: Floats  #: (k, m) observations
    radii: Floats  #: (k,) in spreads
    counts: Floats  #: (k,) of episodes that had been certified and failed from there
    numbers: Floats  #: (k,) by which people know them, from 1, in the order of creation
    survived: Floats  #: (n, m) observations, the newest last
    created: int = 0  #: so many there were so far

    @classmethod
    def none(cls, m: int) -> DeadEnds:
        """None, of m variables."""
        return cls(np.empty((0, m)), np.empty(0), np.empty(0), np.empty(0), np.empty((0, m)))

    def rows(self, inverse: Floats, unit: Floats) -> Floats:
        """(k, m + 2) as kernels see them: centre, radius, ordinary changes in a spread."""
        worth = np.full(len(self.radii), 1.0 / _ordinary(inverse, unit))
        return np.column_stack([self.centres, self.radii, worth])

    def after(
        self, z: Floats, certified: Sequence[bool], unproven: int, inverse: Floats, unit: Floats
    ) -> DeadEnds:
        """What they are after an episode (T, m), without the observation that failed.

        Where it failed, ``certified`` says in which decisions it was not to; else it is empty.
        It is not known of so many last ones (``unproven``) that they were survived.
        """
        kept = z[: max(0, len(z) - unproven)]
        survived = np.vstack([self.survived, kept[:: max(1, len(kept) // _EACH)]])
        found = self._replace(survived=survived[-most_survived(len(unit)) :])
        held = np.flatnonzero(certified[: len(z) - 1])
        if len(held):
            found = found._refuted(z[held[-1] + 1 :], inverse)
        return found._settled(inverse, unit)

    def _refuted(self, failed_from: Floats, inverse: Floats) -> DeadEnds:
        """With those (k, m) from where a certified episode failed."""
        nearest = _distances(failed_from, self.centres, inverse).min(0)
        found = self._replace(counts=self.counts + (nearest < _NEAR))
        for z in failed_from:
            far = _distances(z[None], found.centres, inverse)[0]
            if far.min(initial=np.inf) >= _APART:
                about = found.counts[: len(nearest)][far[: len(nearest)] < _NEAR]
                found = found._with(z, about.max(initial=1.0))
        return found

    def _with(self, z: Floats, count: float) -> DeadEnds:
        """And one more."""
        return self._replace(
            centres=np.vstack([self.centres, z]),
            counts=np.append(self.counts, count),
            numbers=np.append(self.numbers, self.created + 1.0),
            created=self.created + 1,
        )

    def _settled(self, inverse: Floats, unit: Floats) -> DeadEnds:
        """As large as counts and what was survived make them; those that are left, by number."""
        radii = np.minimum(_NEAR, _APART * 2.0 ** (np.minimum(self.counts, 9.0) - 1.0))
        far = _distances(self.centres, self.survived, inverse)
        radii = np.minimum(radii, _SHARE * far.min(1, initial=np.inf))
        left = np.flatnonzero(radii > _LEAST * _ordinary(inverse, unit))
        left = np.sort(left[np.argsort(-self.counts[left], kind="stable")[:_MOST]])
        return self._replace(
            centres=self.centres[left],
            radii=radii[left],
            counts=self.counts[left],
            numbers=self.numbers[left],
        )

    @classmethod
    def merged(cls, parts: Sequence[DeadEnds], inverse: Floats, unit: Floats) -> DeadEnds:
        """All that several learnt; of those that are alike the first, with the counts of all."""
        each = most_survived(len(unit)) // len(parts)
        survived = np.vstack([one.survived[-each:] for one in parts])
        found = cls.none(len(unit))._replace(survived=survived)
        for one in parts:
            for z, count in zip(one.centres, one.counts, strict=True):
                far = _distances(z[None], found.centres, inverse)[0]
                if far.min(initial=np.inf) < _APART:
                    more = count * (np.arange(len(far)) == far.argmin())
                    found = found._replace(counts=found.counts + more)
                else:
                    found = found._with(z, count)
        return found._settled(inverse, unit)

    def refuse_forged(self, n_episodes: int) -> None:
        """Raise a ValueError for what nothing could have learnt in so many episodes."""
        most, numbers = most_survived(self.centres.shape[1]), self.numbers
        if len(numbers) > _MOST or len(self.survived) > most:
            raise ValueError(f"there are at most {_MOST} dead ends, amid {most} that were survived")
        if len(set(numbers)) < len(numbers) or numbers.max(initial=0.0) > self.created:
            raise ValueError(f"dead ends are not {len(numbers)} of the {self.created} there were")
        if self.counts.max(initial=0.0) > n_episodes:
            raise ValueError("from a dead end more episodes failed than there were")


#: What files hold of them.
ARRAYS: dict[str, Numbers] = {
    "centres": Numbers(("dead_ends", "m"), -1e30, 1e30),
    "radii": Numbers(("dead_ends",), 0.0, _NEAR),
    "counts": FROM_1.of("dead_ends"),
    "numbers": FROM_1.of("dead_ends"),
    "survived": Numbers(("passed", "m"), -1e30, 1e30),
}


def most_survived(m: int) -> int:
    """How many observations that were survived are kept, of m variables."""
    return _SURVIVED * 12 // max(m, 12)


def _ordinary(inverse: Floats, unit: Floats) -> float:
    """An ordinary change in spreads, as distances to failure count it."""
    return 1.25 * float(np.sqrt(np.mean((unit * inverse) ** 2))) + 1e-300


def _distances(some: Floats, others: Floats, inverse: Floats) -> Floats:
    """(k, n) of (k, m) and (n, m), in spreads."""
    return np.asarray(np.sqrt((((some[:, None] - others) * inverse) ** 2).sum(2)))


def distances_to(model: Model, z: Floats) -> Floats:
    """(k,) how far an observation is from each dead end [ordinary changes]; negative within."""
    *centres, radii, worth = model.dead_ends.T
    far = _distances(z[None], np.array(centres).T, model.inverse)[0]
    return np.asarray((far - radii) * worth)


def which_refuses(
    model: Model, situation: Floats, policies: Floats, ranks: Ints, *given: Any
) -> tuple[int, int]:
    """Which dead end refuses a proposal that would else pass, and after which backup; -1: none.

    Of several the farthest of the nearest ones that have to be left out for it to pass. What is
    ``given`` besides is what `search` takes.
    """
    order = np.argsort(distances_to(model, situation[: len(model.origin)]), kind="stable")

    def passes(count: int, backup: int) -> bool:
        """Whether the backup survives after it with so many of the nearest dead ends alone."""
        some = model._replace(dead_ends=model.dead_ends[order[:count]])
        asked: tuple[Any, ...] = (situation, policies, np.array([backup]), *given, _ONCE)
        return search(some, *asked)[0] == KEPT

    for q in ranks if len(order) else ():
        if not passes(0, q):
            continue
        low, high = 0, len(order)
        while high - low > 1:
            half = (low + high) // 2
            low, high = (half, high) if passes(half, q) else (low, half)
        return int(order[high - 1]), int(q)
    return -1, -1
