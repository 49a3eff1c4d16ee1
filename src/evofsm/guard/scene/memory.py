"""What is remembered of scenes, and what is forecast by it.

The forecast of an object is an analog ensemble (Delle Monache et al., "Probabilistic weather
prediction with an analog ensemble", Monthly Weather Review 2013): it goes on as the objects did
that were most like it. All objects are of one kind: what one did another may do.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from evofsm.fsm import compiled
from evofsm.guard.scene.contact import Contact, learn
from evofsm.guard.scene.seeing import Seen

_Floats = NDArray[np.float64]
_Ints = NDArray[np.int64]

# Objects of all moments that are remembered, at most; the oldest episodes are forgotten.
_MOST = 40_000
#: Analogs of an object, and of oneself.
ANALOGS, _OWN_ANALOGS = 20, 3
# A place counts so much as beside the rest where two objects are compared.
_OF_REST, _NEAR_TO = 0.1, 2.0
# Squared distance from where an object was expected beyond which it is another one.
_GATE = 0.5
# Nothing is forecast by an object that went so many times as far astray as is too close.
_ASTRAY = 2.5
# Reweightings of a robust fit; the squared residual, of the median, that counts half; the ridge.
_FITS, _HALF, _RIDGE = 4, 9.0, 1e-6
# A number varies by so much of its mean square at least, so that two that never change differ.
_CONSTANT = 1e-6
# Squared residuals are taken to be this large at least, in squared spreads.
_EXACT = 1e-4
# Objects that have to be seen twice before anything is learnt, times the numbers of oneself.
_ROWS = 10
# An analog at this squared distance counts a quarter of one that is the same.
_ALIKE = 0.1


class Episode(NamedTuple):
    """What was seen and done: T + 1 moments, M objects in all of them."""

    own: _Floats  #: (T + 1, p + q)
    actions: _Ints  #: (T + 1,); -1 at the last moment
    counts: _Ints  #: (T + 1,) number of objects
    away: _Floats  #: (M, p)
    other: _Floats  #: (M, q)
    links: _Ints  #: (M,) index of the same object a step later; -1 where it is not known
    failed: bool

    @classmethod
    def of(cls, seen: Sequence[Seen], actions: Sequence[int], failed: bool) -> Episode:
        """From what was seen at each moment; actions are one fewer."""
        # In the order in which a file holds them: sums are then the same to the last bit.
        away, other = (
            np.ascontiguousarray(np.concatenate([getattr(one, name) for one in seen]))
            for name in ("away", "other")
        )
        return cls(
            np.array([one.own for one in seen]),
            np.array([*actions, -1]),
            np.array([len(one.away) for one in seen]),
            away,
            other,
            np.full(len(away), -1),
            failed,
        )

    @property
    def ends(self) -> _Ints:
        """(T + 2,) index of the first object of each moment, and of none."""
        return np.append(0, np.cumsum(self.counts))


class _Flat(NamedTuple):
    """All episodes in one; `moment` is that of an object."""

    own: _Floats
    actions: _Ints
    away: _Floats
    other: _Floats
    links: _Ints
    moment: _Ints
    lost: NDArray[np.bool_]  #: whether failure came in the step from this moment


class Foreseen(NamedTuple):
    """What comes of each of n actions, if each action follows it for good."""

    risks: _Floats  #: (n, n) probability of failure within the horizon
    lasting: _Floats  #: (n, n) expected share of the horizon that is survived
    after: _Floats  #: (n, p + q) oneself a step later


class Memory:
    """Remembers episodes, and forecasts by them.

    Parameters
    ----------
    n_actions : int
    steps : int
        That it forecasts.
    """

    def __init__(self, n_actions: int, steps: int) -> None:
        self.n_actions, self.steps = n_actions, steps
        self.episodes: list[Episode] = []
        #: How close is too close; None before the first failure.
        self.contact: Contact | None = None
        self.failures = 0
        self._motion: _Floats | None = None
        #: Of the episodes, how many were learnt from.
        self.fitted = 0

    def add(self, episode: Episode) -> None:
        """Remember an episode; learn from it at once if it failed, else now and then."""
        self.episodes.append(episode)
        self.failures += episode.failed
        forgets = False
        while sum(len(one.away) for one in self.episodes) > _MOST and len(self.episodes) > 1:
            del self.episodes[0]
            self.fitted, forgets = max(0, self.fitted - 1), True
        new = len(self.episodes) - self.fitted
        if episode.failed or forgets or new >= max(1, len(self.episodes) // 10):
            self.fit()

    # -- Learning -------------------------------------------------------------------------------

    def fit(self) -> None:
        """Learn from all that is remembered."""
        count = len(self.episodes)
        again = self._motion is None or count & (count - 1) == 0
        first = 0 if again else self.fitted
        self._scale()
        for _ in range(3 if self._motion is None else 1):
            for k in range(first, count):
                links = self._linked(self.episodes[k])
                self.episodes[k] = self.episodes[k]._replace(links=links)
            self._move(self._flat())
            if self._motion is None:
                return
        self.fitted = count
        self._conclude()

    def restore(self, episodes: list[Episode], failures: int, fitted: int) -> None:
        """Remember these, of which the first ``fitted`` were learnt from, as they were linked."""
        self.episodes, self.failures, self.fitted = episodes[:fitted], failures, fitted
        if fitted:
            self._scale()
            self._conclude()
        self.episodes = episodes

    def _conclude(self) -> None:
        flat = self._flat()
        self._move(flat)
        self._follow_oneself(flat)
        self._meet(flat)
        self._go_on(flat)

    def _scale(self) -> None:
        away, other, own = (
            np.concatenate([getattr(one, name) for one in self.episodes])
            for name in ("away", "other", "own")
        )
        self._spreads = tuple(
            np.where((s := of.std(0)) > 0.0, s, 1.0) if len(of) else np.ones(of.shape[1])
            for of in (away, other, own)
        )

    def _linked(self, episode: Episode) -> _Ints:
        """Which object is which a step later: each is nearest to where the other is expected."""
        away, other, _ = self._spreads
        links, ends = np.full(len(episode.away), -1), episode.ends
        gate = np.inf if self._motion is None else _GATE
        for t in range(len(episode.own) - 1):
            now, then = slice(ends[t], ends[t + 1]), slice(ends[t + 1], ends[t + 2])
            if not (episode.counts[t] and episode.counts[t + 1]):
                continue
            own = episode.own[t : t + 2]
            expected = episode.away[now] + self._moved(own, episode.other[now], episode.other[now])
            off = (expected[:, None] - episode.away[then]) / away
            change = (episode.other[now][:, None] - episode.other[then]) / other
            apart = (off**2).sum(2)
            unlike = apart + _OF_REST * (change**2).sum(2)
            nearest, back = unlike.argmin(1), unlike.argmin(0)
            each = np.arange(len(nearest))
            mutual = (back[nearest] == each) & (apart[each, nearest] < gate)
            links[ends[t] + each[mutual]] = ends[t + 1] + nearest[mutual]
        return links

    def _flat(self) -> _Flat:
        parts: list[tuple[NDArray[np.generic], ...]] = []
        objects = moments = 0
        for one in self.episodes:
            lost = np.zeros(len(one.own), bool)
            lost[-2:-1] = one.failed
            links = np.where(one.links >= 0, one.links + objects, -1)
            moment = moments + np.repeat(np.arange(len(one.own)), one.counts)
            parts.append((one.own, one.actions, one.away, one.other, links, moment, lost))
            objects, moments = objects + len(one.away), moments + len(one.own)
        return _Flat(*(np.concatenate(column) for column in zip(*parts, strict=True)))

    def _move(self, flat: _Flat) -> None:
        """Fit how places change by what oneself and objects were like before and after."""
        rows = np.flatnonzero(flat.links >= 0)
        p = flat.away.shape[1]
        if len(rows) < _ROWS * flat.own.shape[1]:
            return
        now, then = flat.moment[rows], flat.links[rows]
        mine = self._terms(flat.own[now], flat.own[now + 1], p)
        x = np.hstack([mine, flat.other[rows], flat.other[then], np.ones((len(rows), 1))])
        y = flat.away[then] - flat.away[rows]
        before = _begun(x.shape[1], p)
        weights = np.ones(len(rows))
        spread = np.maximum(x.var(0), _CONSTANT * (x**2).mean(0)) + 1e-12
        ridge = _RIDGE * len(rows) * np.diag(spread)
        for _ in range(_FITS):
            weighed = x * weights[:, None]
            motion = np.linalg.solve(weighed.T @ x + ridge, weighed.T @ y + ridge @ before)
            off = (((y - x @ motion) / self._spreads[0]) ** 2).sum(1)
            middle = max(float(np.median(off)), _EXACT)
            weights = 1.0 / (1.0 + off / (_HALF * middle))
        self._motion = np.asarray(motion, np.float64)

    def _moved(self, own: _Floats, other: _Floats, later: _Floats) -> _Floats:
        """(k, p) change of relative places in a step; ``own`` is (2, p + q), before and after."""
        mine = self._terms(own[:1], own[1:], own.shape[1] - other.shape[1])
        x = np.hstack([np.repeat(mine, len(other), axis=0), other, later, np.ones((len(other), 1))])
        motion = self._motion
        if motion is None:
            motion = _begun(x.shape[1], own.shape[1] - other.shape[1])
        return np.asarray(x @ motion)

    def _terms(self, before: _Floats, after: _Floats, p: int) -> _Floats:
        """(k, p + 2 q) what of oneself moves all relative places in a step."""
        return np.hstack([after[:, :p] - before[:, :p], before[:, p:], after[:, p:]])

    def _mine(self, before: _Floats, after: _Floats, p: int) -> _Floats:
        """(k, p) how oneself moves all relative places in a step."""
        assert self._motion is not None
        terms = self._terms(before, after, p)
        return np.asarray(terms @ self._motion[: terms.shape[1]])

    def _go_on(self, flat: _Flat) -> None:
        """Where each object went from then on, oneself left out."""
        p = flat.away.shape[1]
        rows = np.flatnonzero(flat.links >= 0)
        now, then = flat.moment[rows], flat.links[rows]
        mine = self._mine(flat.own[now], flat.own[now + 1], p)
        went = np.full_like(flat.away, np.nan)
        went[rows] = flat.away[then] - flat.away[rows] - mine
        known = np.hstack([flat.other, np.ones((len(flat.other), 1))])
        steady = np.linalg.lstsq(known[rows], went[rows], rcond=None)[0]
        self._steady = steady[:-1]
        step, links = known @ steady, flat.links.copy()
        if self.contact is not None:
            off = np.abs((went[rows] - step[rows]) / self.contact.sides).max(1)
            astray = rows[off > _ASTRAY * self.contact.met]
            if 2 * len(astray) < len(rows):  # else what failed met in one point, as in cells
                links[astray], went[astray] = -1, np.nan
                rows = np.flatnonzero(links >= 0)
        total, at = np.zeros_like(flat.away), np.arange(len(flat.away))
        paths = np.empty((len(flat.away), self.steps, p))
        for h in range(self.steps):
            here = np.where((at >= 0)[:, None], went[at], np.nan)
            step = np.where(np.isnan(here), step, here)
            total = total + step
            paths[:, h] = total
            at = np.where(at >= 0, links[at], -1)
        self._objects = self._features(flat.own[flat.moment], flat.away, flat.other)[rows]
        self._paths, self._others = paths[rows], flat.other[rows]

    def _features(self, own: _Floats, away: _Floats, other: _Floats) -> _Floats:
        """(k, f) what two objects are compared by."""
        p = away.shape[1]
        far, rest, mine = self._spreads
        return np.hstack(
            [
                _NEAR_TO * away / far,
                _NEAR_TO * other / rest,
                (away + own[:, :p]) / far,
                own[:, p:] / mine[p:],
            ]
        )

    def _follow_oneself(self, flat: _Flat) -> None:
        """What each action brought oneself, from states in units of their spreads."""
        known = np.flatnonzero((flat.actions >= 0) & ~flat.lost)
        self._own = []
        for action in range(self.n_actions):
            rows = known[flat.actions[known] == action]
            before = flat.own[rows]
            self._own.append((before / self._spreads[2], flat.own[rows + 1] - before))

    def _meet(self, flat: _Flat) -> None:
        """How close is too close."""
        if not any(one.failed for one in self.episodes):
            return
        lost = flat.lost[flat.moment]
        safe = np.flatnonzero((flat.links >= 0) & ~lost)
        failed = []
        for moment in np.flatnonzero(flat.lost):
            rows = np.flatnonzero(flat.moment == moment)
            last = flat.away[flat.moment == moment + 1]
            start = flat.away[rows]
            own, other = flat.own[moment : moment + 2], flat.other[rows]
            linked = flat.links[rows]
            expected = start + self._moved(own, other, other)
            end = np.where((linked >= 0)[:, None], flat.away[linked], expected)
            if len(start) or len(last):
                failed.append((np.concatenate([start, last]), np.concatenate([end, last])))
        if failed and len(safe):
            steps = flat.away[safe], flat.away[flat.links[safe]]
            self.contact = learn(steps, failed, self._spreads[0])

    def apart(self, own: _Floats, one: _Floats) -> _Floats:
        """(k,) squared distance of states of oneself from one, each number by its spread."""
        return np.asarray((((own - one) / self._spreads[2]) ** 2).sum(1))

    # -- Forecasting ----------------------------------------------------------------------------

    def foresee(self, seen: Seen) -> Foreseen:
        """What comes of each action."""
        assert self.contact is not None
        n, p = self.n_actions, seen.away.shape[1]
        gone, weights, after = self._gone(seen.own, p)
        safe = np.ones(gone.shape[:3])
        own = np.repeat(seen.own[None], len(seen.away), axis=0)
        analogs = _nearest(self._objects, self._features(own, seen.away, seen.other), ANALOGS)
        for i, (like, share) in enumerate(zip(*analogs, strict=True)):
            faster = (seen.other[i] - self._others[like]) @ self._steady
            path = self._paths[like] + faster[:, None] * np.arange(1, self.steps + 1)[:, None]
            to = seen.away[i] + path + gone[:, :, None]
            start = np.broadcast_to(seen.away[i], (*to.shape[:3], 1, p))
            safe *= share @ (1.0 - self.contact.of(np.concatenate([start, to], axis=-2)))
        lost = ((1.0 - safe) * weights[:, :, None]).sum(0).reshape(n, n, self.steps)
        return Foreseen(lost[:, :, -1], 1.0 - lost.mean(-1), after)

    def _gone(self, own: _Floats, p: int) -> tuple[_Floats, _Floats, _Floats]:
        """How oneself moves relative places, for each action and each that follows for good.

        (r, n², H, p) for each of r courses, of which each is what once happened after the same
        actions; (r, n²) their shares; and the (n, p + q) state after each action in the first.
        """
        n, r = self.n_actions, _OWN_ANALOGS
        first, then = np.repeat(np.arange(n), n), np.tile(np.arange(n), n)
        at = np.broadcast_to(own, (r, n * n, len(own)))
        gone = np.zeros((r, n * n, self.steps, p))
        shares = np.full((r, n * n), 1.0 / r)
        total = np.zeros((r * n * n, p))
        course = np.arange(r)[:, None, None]
        for h in range(self.steps):
            to = at.copy()
            for action, (before, change) in enumerate(self._own):
                rows = np.flatnonzero((then if h else first) == action)
                if not len(before):
                    continue
                here = (at[:, rows] / self._spreads[2]).reshape(-1, len(own))
                like, share = (of.reshape(r, len(rows), -1) for of in _nearest(before, here, r))
                which = np.minimum(course, like.shape[-1] - 1)
                to[:, rows] += change[np.take_along_axis(like, which, -1)[..., 0]]
                if h == 0:
                    shares[:, rows] = np.take_along_axis(share, which, -1)[..., 0]
            flat = at.reshape(-1, len(own)), to.reshape(-1, len(own))
            total = total + self._mine(*flat, p)
            gone[:, :, h] = total.reshape(r, n * n, p)
            if h == 0:
                after = to[0, ::n]
            at = to
        return gone, shares / shares.sum(0), after


def _begun(terms: int, p: int) -> _Floats:
    """What is taken before anything is learnt: by what one moves, all places move back.

    Without it one's own moves, if they are rare, are never learnt: the right links are then far
    from where objects are expected.
    """
    motion = np.zeros((terms, p))
    motion[:p] = -np.eye(p)
    return motion


def _nearest(points: _Floats, around: _Floats, most: int) -> tuple[_Ints, _Floats]:
    """(k, most) indices of the points nearest to each of k, nearest first, and what each counts."""
    most = min(most, len(points))
    like = np.empty((len(around), most), np.int64)
    apart = np.full((len(around), most), np.inf)
    _look(points, around, like, apart)
    weight = 1.0 / (_ALIKE + apart) ** 2
    return like, weight / weight.sum(-1, keepdims=True)


@compiled
def _look(points: _Floats, around: _Floats, like: _Ints, apart: _Floats) -> None:
    """The nearest points and their squared distances; of two equally near ones the first."""
    last = apart.shape[1] - 1
    for k in range(len(around)):
        for j in range(len(points)):
            far = 0.0
            for i in range(points.shape[1]):
                off = points[j, i] - around[k, i]
                far += off * off
            at = last
            if far >= apart[k, at]:
                continue
            while at and apart[k, at - 1] > far:
                apart[k, at], like[k, at] = apart[k, at - 1], like[k, at - 1]
                at -= 1
            apart[k, at], like[k, at] = far, j
