"""Where a disturbance begins: beyond a threshold of one variable, if it never began elsewhere.

An *event* is a transition that was not expected, at its onset. Of all events alike, n episodes had
one, and all of them lie beyond a threshold, where the system was for a share p of its time. If that
is chance, 2m thresholds being tried, its probability is at most 2m p^n.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from evofsm.guard.learnt.replay import Floats, Model, unforeseen

#: Variable (-1: none), sign and threshold beyond which something begins.
Place = tuple[int, float, float]
ANYWHERE: Place = (-1, 0.0, 0.0)

# Events that are kept, of an episode and in all.
_OF_EPISODE, _KEPT = 8, 200
# What is alike goes at least so far in the same direction; within so many steps it is one event.
_ALIKE, _APART = 0.5, 3
# Events of fewer ordinary changes are none; below this probability it is no chance.
_SMALL, _CHANCE = 0.25, 0.001


def after(
    events: Floats, z: Floats, u: Floats, found: Floats, unit: Floats, episode: int, model: Model
) -> Floats:
    """Events, and those of an episode (T + 1, m) with actions (T, a) and residuals (T - 1, m).

    Each is a row: three observations, two actions, and the number of the episode.
    """
    for t in onsets(found / unit, _OF_EPISODE, _SMALL, back=True):
        events = np.vstack([events, [*z[t : t + 3].flat, *u[t : t + 2].flat, episode]])
    if len(events) > _KEPT:
        size = np.abs(_began(events, model, u.shape[1])[0] / unit).max(1)
        events = events[np.sort(np.argsort(-size, kind="stable")[:_KEPT])]
    return events


def _began(events: Floats, model: Model, a: int) -> tuple[Floats, Floats]:
    """(k, m) what was not expected in events, as it is seen now, and where one would be."""
    m = len(model.origin)
    before, z, x = np.split(events[:, : 3 * m], 3, axis=1)
    actions = events[:, 3 * m : 3 * m + 2 * a]
    found = unforeseen(model, z, z - before, actions[:, :a], actions[:, a:], x)
    return found, x - found


def places_of(
    rests: Floats, ends: Floats, events: Floats, seen: Floats, unit: Floats, model: Model, a: int
) -> list[Place]:
    """Where residuals (K, L, m) begin, as they would have gone on to ``ends``.

    ``seen`` (n, m) are observations that say where one was.
    """
    found, to = _began(events, model, a)
    found, places, known = found / unit, [], dict[bytes, Place]()
    for rest, end in zip(rests / unit, ends, strict=True):
        t = onset(rest)
        key = rest[t].tobytes() + end[t].tobytes()
        if key not in known:
            along = found @ rest[t] >= _ALIKE * (rest[t] @ rest[t])
            known[key] = _place(to[along], events[along, -1], end[t], seen, unit)
        places.append(known[key] if rest[t].any() else ANYWHERE)
    return places


def _place(to: Floats, episodes: Floats, own: Floats, exposure: Floats, unit: Floats) -> Place:
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
        p = (1.0 + (sign * exposure[:, j] >= at).sum()) / (1.0 + len(exposure))
        if 2 * m * p**n < _CHANCE:
            found = -p, float((sign * to[:, j] - at).mean() / unit[j])
            if found > best:
                best, place = found, (j, sign, float(sign * at))
    return place


def onset(rest: Floats) -> int:
    """The first step of (L, m) with at least half the largest residual."""
    size = np.abs(rest).max(1)
    return int((size >= 0.5 * size.max()).argmax())


def onsets(found: Floats, most: int, least: float, *, back: bool = False) -> list[int]:
    """Steps of residuals (T, m) at which one of at least so much is largest, at most so many.

    If asked for those at which they began, ``back`` from there.
    """
    size, steps = np.abs(found).max(1), list[int]()
    while len(steps) < most and size.max() >= least:
        t = last = int(size.argmax())
        if back:
            alike: NDArray[np.bool_] = found @ found[t] >= _ALIKE * (found[t] @ found[t])
            while alike[last + 1 : last + 1 + _APART].any():
                last += 1
            while alike[max(0, t - _APART) : t].any():
                t = int(alike[max(0, t - _APART) : t].argmax()) + max(0, t - _APART)
        steps.append(t)
        size[max(0, t - _APART) : last + 1 + _APART] = 0.0
    return steps
