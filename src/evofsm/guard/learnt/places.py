"""Where a disturbance begins: beyond a threshold of one variable, if it never began elsewhere.

An *event* is a transition that was not expected, at its onset. Of all events alike, n episodes had
one, and all of them lie beyond a threshold, where the system was for a share p of its time. If that
is chance, 2m thresholds being tried, its probability is at most 2m p^n.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from evofsm.guard.learnt.replay import Floats, Model, unforeseen

#: Variable (-1: none), sign and threshold beyond which something begins.
Place = tuple[int, float, float]
ANYWHERE: Place = (-1, 0.0, 0.0)

# Events that are kept, of an episode and in all; observations that say where one was.
_OF_EPISODE, _KEPT, _EXPOSURE = 8, 200, 1024
# What is alike goes at least so far in the same direction; within so many steps it is one event.
_ALIKE, _APART = 0.5, 3
# Events of fewer ordinary changes are none; below this probability it is no chance.
_SMALL, _CHANCE = 0.25, 0.001


class Places(NamedTuple):
    """Where something unforeseen began, and where one was."""

    events: Floats  #: (k, 3m + 2a + 1) three observations, two actions, and the episode
    exposure: Floats  #: (n, m) observations, evenly drawn of all that were survived
    exposed: int  #: number of all of them

    @classmethod
    def none(cls, m: int, a: int) -> Self:
        """Before anything was seen."""
        return cls(np.empty((0, 3 * m + 2 * a + 1)), np.empty((0, m)), 0)

    def after(
        self, z: Floats, u: Floats, found: Floats, unit: Floats, episode: int, model: Model
    ) -> Places:
        """With those of an episode (T + 1, m) and (T, a) with its residuals (T - 1, m)."""
        rows = []
        for t in onsets(found / unit):
            rows.append(np.concatenate([*z[t : t + 3], *u[t : t + 2], [float(episode)]]))
        events = np.vstack([self.events, *rows])
        if len(events) > _KEPT:
            size = np.abs(self._replace(events=events).began(model, len(u[0]))[0] / unit).max(1)
            events = events[np.sort(np.argsort(-size, kind="stable")[:_KEPT])]
        exposed = self.exposed + len(z)
        every = _every(exposed)  # of all that were survived, counted from the first
        more = z[-self.exposed % every :: every]
        kept = self.exposure[:: every // _every(self.exposed)]
        return Places(events, np.vstack([kept, more]), exposed)

    def fit(self, m: int, a: int) -> bool:
        """Whether they are of m variables and actions of a numbers."""
        sizes = self.events.shape[1], self.exposure.shape[1], len(self.exposure)
        return sizes == (3 * m + 2 * a + 1, m, -(-self.exposed // _every(self.exposed)))

    @classmethod
    def merged(cls, parts: Sequence[Self], later: Sequence[int]) -> Self:
        """Of systems of one kind; episodes of each come so many ``later``."""
        exposed = sum(part.exposed for part in parts)
        finest = max(_every(part.exposed) for part in parts)
        seen = [part.exposure[:: finest // _every(part.exposed)] for part in parts]
        rows = np.vstack(seen)
        need = -(-exposed // _every(exposed))
        even = (np.arange(need) * len(rows)) // max(need, 1)
        events = [part.events.copy() for part in parts]
        for one, offset in zip(events, later, strict=True):
            one[:, -1] += offset
        return cls(np.vstack(events), rows[even], exposed)

    def began(self, model: Model, a: int) -> tuple[Floats, Floats]:
        """(k, m) what was not expected in events, as it is seen now, and where one would be."""
        m = len(model.origin)
        before, z, x = np.split(self.events[:, : 3 * m], 3, axis=1)
        actions = self.events[:, 3 * m : 3 * m + 2 * a]
        found = unforeseen(model, z, z - before, actions[:, :a], actions[:, a:], x)
        return found, x - found

    def of(
        self, sequences: Floats, ends: Floats, unit: Floats, model: Model, a: int
    ) -> list[Place]:
        """Where sequences of residuals (K, L, m) begin, as they would have gone on to ``ends``."""
        found, to = self.began(model, a)
        found, places, known = found / unit, [], dict[bytes, Place]()
        for rest, end in zip(sequences / unit, ends, strict=True):
            t = onset(rest)
            key = rest[t].tobytes() + end[t].tobytes()
            if key not in known:
                along = found @ rest[t] >= _ALIKE * (rest[t] @ rest[t])
                known[key] = self._place(to[along], self.events[along, -1], end[t], unit)
            places.append(known[key] if rest[t].any() else ANYWHERE)
        return places

    def _place(self, to: Floats, episodes: Floats, own: Floats, unit: Floats) -> Place:
        """Of thresholds that all are beyond that beyond which one was most rarely.

        Of two that are as rare it is that beyond which they are farthest.
        """
        m, n = len(own), len(np.unique(episodes))
        best, place = (-1.0, 0.0), ANYWHERE
        if not n:
            return place
        least = np.array([(-to).min(0), to.min(0)])
        for j, side in np.argwhere((np.array([-own, own]) >= least).T).tolist():
            sign, at = (-1.0, 1.0)[side], least[side, j]
            p = (1.0 + (sign * self.exposure[:, j] >= at).sum()) / (1.0 + len(self.exposure))
            if 2 * m * p**n < _CHANCE:
                found = -p, float((sign * to[:, j] - at).mean() / unit[j])
                if found > best:
                    best, place = found, (j, sign, float(sign * at))
        return place


def _every(exposed: int) -> int:
    """Of so many observations one in how many is kept: a power of two."""
    return 1 << max(0, -(-exposed // _EXPOSURE) - 1).bit_length()


def onset(rest: Floats) -> int:
    """The first step of (L, m) with at least half the largest residual."""
    size = np.abs(rest).max(1)
    return int((size >= 0.5 * size.max()).argmax())


def onsets(found: Floats) -> list[int]:
    """Steps at which something begins in an episode, of residuals (T, m) [ordinary changes]."""
    size, steps = np.abs(found).max(1), list[int]()
    while len(steps) < _OF_EPISODE and size.max() >= _SMALL:
        t = last = int(size.argmax())
        alike: NDArray[np.bool_] = found @ found[t] >= _ALIKE * (found[t] @ found[t])
        while alike[last + 1 : last + 1 + _APART].any():
            last += 1
        while alike[max(0, t - _APART) : t].any():  # where it began, not where it is worst
            t = int(alike[max(0, t - _APART) : t].argmax()) + max(0, t - _APART)
        steps.append(t)
        size[max(0, t - _APART) : last + 1 + _APART] = 0.0
    return steps
