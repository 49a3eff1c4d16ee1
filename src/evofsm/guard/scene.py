"""A judge of scenes: failure is to meet one of the objects around, and nothing about it is given.

An action is as dangerous as the best that can follow it: each action, taken for good. What that
brings is forecast from remembered episodes. Four things are learnt, from all objects alike:

* *Which object is which* a step later: the one nearest to where it was expected. How places change
  is a linear model of what oneself and the object were like before and after, fitted by robust
  least squares; its prior is that by what oneself moves, all else moves back (`_fit_motion`).
* *How oneself moves*: as after the same action where it was most alike (`_own_courses`).
* *How objects go on*: as the objects did that were most alike, an analog ensemble (Delle Monache et
  al., "Probabilistic weather prediction with an analog ensemble", Monthly Weather Review 2013;
  `foresee`).
* *How close is too close*: from how close objects came in steps that ended in failure (`Contact`).
"""

from __future__ import annotations

import math
import operator
from collections.abc import Mapping, Sequence
from copy import copy
from functools import partial
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from evofsm import store
from evofsm.fsm.kernels import compiled
from evofsm.fsm.naming import Labels
from evofsm.fsm.proportions import wilson_bounds
from evofsm.fsm.sharing import Rollback
from evofsm.fsm.validation import Floats, positive, whole
from evofsm.guard.actions import Action, ActionSet, Mask
from evofsm.guard.api import Fallback, Judgement, LearningJudge, Search, SearchingJudge, Situation
from evofsm.store import COUNT, FLAG, FROM_1, MOST_COUNTED, SIZE, Kind, Numbers, Place

_Ints = NDArray[np.int64]
_Steps = tuple[Floats, Floats]  # places before and after

# Numbers of a place.
_P = 2
# Steps that are looked ahead.
_STEPS_AHEAD = 5
# Objects that are remembered, at most; the oldest episodes are forgotten.
_MOST_REMEMBERED = 40_000
# Analogs of an object, and of oneself.
_ANALOGS, _OWN_ANALOGS = 20, 3
# An analog at this squared distance counts a quarter of one that is the same.
_ANALOG_SCALE = 0.1
# Weight of a place, relative to the rest, where objects are linked; and where they are compared.
_OF_REST, _NEAR_TO = 0.1, 2.0
# Squared distance from where an object was expected beyond which it is another one.
_GATE = 0.5
# Nothing is forecast from an object that went so many times as far astray as is too close.
_ASTRAY = 2.5
# Reweightings of a robust fit; the squared residual, in medians, that counts half; the ridge.
_REWEIGHTINGS, _HALF, _RIDGE = 4, 9.0, 1e-6
# A number varies by so much of its mean square at least, so that two that never change differ.
_CONSTANT = 1e-6
# Squared residuals count as this large at least, in squared spreads.
_LEAST_SQUARE = 1e-4
# Objects that have to be seen twice before anything is learnt, times the numbers of oneself.
_ROWS = 10
# Points of a step at which a distance is taken, its two ends included.
_POINTS = 6
# Shapes of the box around an object that are tried: how much longer than wide, as powers of e.
_SHAPES = np.linspace(-3.5, 3.5, 29)
# Actions, each of which is foreseen by itself.
_MOST_ACTIONS = 1_000
# Closest steps that were survived, of which each counts.
_CLOSEST = 2000

_BOUNDED = Numbers(least=-1e31, most=1e31)
_INDEX = Numbers(least=-1.0, most=MOST_COUNTED, whole=True)
_KIND = Kind(
    "scenerisk",
    {
        "own": _BOUNDED.of("n", "o"),
        "actions": _INDEX.of("n"),
        "counts": COUNT.of("n"),
        "lost": FLAG.of("n"),
        "away": _BOUNDED.of("m", "p"),
        "other": _BOUNDED.of("m", "r"),
        "links": _INDEX.of("m"),
    },
    {
        "dt": SIZE,
        "n_actions": FROM_1._replace(most=_MOST_ACTIONS),
        "columns": FROM_1,
        "failures": COUNT,
        "fitted": COUNT,
        "relative": bool,
    },
)


class SceneRisk(LearningJudge, SearchingJudge):
    """Judges one of a few actions among any number of objects; given only which episodes failed.

    The risk of an action is the probability to meet an object within five decisions, if the best
    of all actions follows it for good. For decisions that are few and coarse, such as one a second;
    actions are `Choices`.

    Parameters
    ----------
    dt : float
        Time between two decisions [s].
    n_actions : int
    columns : int
        Numbers in a row of the observation, at least 4. The first is above 0.5 where the row is in
        use, two more say where something is. The first row is oneself, each other one an object. A
        row with a NaN is not in use.
    relative : bool
        Whether rows of objects are relative to oneself in all columns but the first.

    Raises
    ------
    ValueError
        If a number is out of its range.

    Notes
    -----
    Before the first failure all is kept. Failures that no object explains (a border, time) are not
    learnt, nor how objects answer to one's own action. The 90 % interval is that of a share of so
    many analogs (Wilson 1927).

    Examples
    --------
    >>> from evofsm.guard import Guard
    >>> judge = SceneRisk(1.0, 5)
    >>> guard = Guard(n_actions=5, interval=1.0, judge=judge)
    >>> ego, car = [1.0, 0.0, 4.0, 25.0, 0.0], [1.0, 30.0, 0.0, -5.0, 0.0]
    >>> guard.decide(ego + car, proposal=3).reason
    'no failure with an object in sight is known yet, so nothing is refused'
    """

    _seen: list[Seen]  # of the episode under way
    fallback = Fallback(0.0, "the first action")  #: without a usable proposal, revised like any

    def __init__(
        self, dt: float, n_actions: int, *, columns: int = 5, relative: bool = True
    ) -> None:
        self.dt = positive("dt", dt)
        self.labels = Labels(dt=self.dt)
        self.columns = whole("columns", columns)
        if self.columns < 2 + _P:
            fields = "whether it is in use, two numbers of a place, and something else"
            raise ValueError(f"columns is {columns}; a row holds {fields}, such as a speed")
        self.relative = relative
        #: What was learnt.
        self.memory = Memory(operator.index(n_actions), self.columns - 1 - _P)
        self._seen = []

    def refuse_unfit(self, actions: ActionSet) -> None:
        """Raise a ValueError if there are other actions than it was made for."""
        if (actions.low, actions.high) != (0.0, self.memory.n_actions - 1.0):
            fault = f"actions lie from {actions.low} to {actions.high}"
            raise ValueError(f"the judge was made for {self.memory.n_actions} choices, but {fault}")

    def search(
        self, situation: Situation, wanted: Action, *, tolerance: float, mask: Mask | None = None
    ) -> Search:
        """The tolerable action of those in ``mask`` that is closest in effect to ``wanted``.

        Else one of the least risky after which it lasts longest; ``wanted``, if it is among them.
        """
        forecast = self._foreseen(situation)
        if isinstance(forecast, str):
            return Search(np.array([wanted]), self._judged(np.full(1, math.nan)), 0, forecast)
        risks, proposed = forecast.risks.min(1), int(wanted)
        judgement = self._judged(risks[[proposed]])
        if risks[proposed] <= tolerance:
            text = f"risk within {_STEPS_AHEAD * self.dt:g} s is within the tolerance"
            return Search(np.array([wanted]), judgement, 0, text)
        why, after = self.why(judgement), forecast.after
        can = risks if mask is None else np.where(mask, risks, math.inf)
        good, reason = np.flatnonzero(can <= tolerance), "the closest in effect that can"
        if not len(good):
            good = np.flatnonzero(can <= can.min() + tolerance)
            shares = forecast.lasting[good].max(1)
            good = good[shares >= shares.max() - tolerance]
            reason = "nothing can, the one that lasts longest"
        best = int(good[self.memory.apart(after[good], after[proposed]).argmin()])
        if proposed in good:
            best, reason = proposed, "nothing can, nor does anything last longer"
        judgement = self._judged(risks[[proposed, best]])
        options = np.array([wanted, float(best)])
        return Search(options, judgement, int(best != proposed), f"{why}; {reason}")

    def judge(self, situation: Situation, actions: ArrayLike) -> Judgement:
        """Risk of each action; NaN as long as nothing can be said."""
        choices, forecast = np.asarray(actions, np.float64), self._foreseen(situation)
        if isinstance(forecast, str):
            return self._judged(np.full(len(choices), math.nan))
        return self._judged(forecast.risks.min(1)[choices.astype(int)])

    def why(self, judged: Judgement) -> str:
        """Why the first action that was judged is dangerous, in a few words."""
        ahead, risk = _STEPS_AHEAD * self.dt, 100.0 * judged.risk[0]
        return f"whatever follows, an object is met within {ahead:g} s: {risk:.2g} %"

    @property
    def told_by_experience(self) -> str:
        """What was learnt so far, in words."""
        if self.memory.contact is None:
            return "no failure with an object in sight is known yet, so nothing is refused"
        return f"how close is too close was learnt of {self.memory.failures} failures"

    def _foreseen(self, situation: Situation) -> Foreseen | str:
        scene = self._read(situation.observation)
        if self.memory.contact is None:
            return self.told_by_experience
        if not np.isfinite(scene.own).all():
            return "own row is not seen"
        return self.memory.foresee(scene)

    def _judged(self, risks: Floats) -> Judgement:
        bounds = [wilson_bounds(float(risk), _ANALOGS) for risk in risks]
        low, high = np.where(np.isnan(risks), math.nan, np.transpose(bounds))
        evidence = 0.0 if np.isnan(risks).any() else float(self.memory.failures)
        return Judgement(risks, low, high, np.full(len(risks), math.nan), evidence)

    def _read(self, observation: Floats) -> Seen:
        if not observation.size or observation.size % self.columns:
            raise ValueError(f"{observation.size} numbers are no rows of {self.columns}")
        rows = observation.reshape(-1, self.columns)
        ego, objects = rows[0, 1:].copy(), rows[1:]
        objects = objects[(objects[:, 0] > 0.5) & np.isfinite(objects).all(1), 1:]
        away, rest = objects[:, :_P], objects[:, _P:]
        if self.relative:
            return Seen(ego, away, rest + ego[_P:])
        return Seen(ego, away - ego[:_P], rest)

    def learn(self, observation: ArrayLike, action: Action, *, watched: bool = False) -> None:
        """Take in an observation and the action after it, whoever acts."""
        scene = self._read(np.asarray(observation, np.float64))
        if not np.isfinite(scene.own).all():  # what follows begins anew
            self._remember(failed=False)
            return
        self._seen = [*self._seen, scene._replace(action=int(action))]

    def follow(self, observation: ArrayLike, action: Action) -> None:
        """Nothing: its decisions depend on the present observation alone."""

    def start_episode(self) -> None:
        """What comes does not follow from what was."""
        self._seen = []

    def end(self, observation: Floats | None, *, failed: bool, terminated: bool = False) -> None:
        """Learn from an episode, and from its last observation if there is one."""
        if observation is not None:
            last = self._read(observation)
            if np.isfinite(last.own).all():
                self._seen = [*self._seen, last]
        self._remember(failed=failed)

    def savepoint(self) -> Rollback:
        """What takes back all that it learns from now on."""
        return partial(vars(self).update, _seen=self._seen, memory=copy(self.memory))

    def _remember(self, *, failed: bool) -> None:
        """Add what was seen to the memory, if it was more than a moment."""
        if len(self._seen) > 1:
            self.memory.add(Past.of(self._seen, self.columns - 1 - _P, failed))
        self._seen = []

    def save(self, path: Place, provenance: Mapping[str, Any] | None = None) -> None:
        """Write what is remembered to a file; all else follows from it."""
        settings = {name: getattr(self, name) for name in ("dt", "columns", "relative")}
        counts = {name: getattr(self.memory, name) for name in ("n_actions", "failures", "fitted")}
        arrays = {
            name: array.astype(np.float64) for name, array in self.memory.past._asdict().items()
        }
        store.write(path, _KIND, settings | counts, arrays, provenance)

    @classmethod
    def load(cls, path: Place) -> Self:
        """Read what `save` wrote; a ValueError if it is something else or damaged."""
        settings, arrays = store.read(path, _KIND)
        with store.explained(path):
            counts = {name: int(settings.pop(name)) for name in ("failures", "fitted")}
            judge = cls(settings.pop("dt"), settings.pop("n_actions"), **settings)
            fresh = judge.memory.past
            history = Past(*(arrays[name].astype(of.dtype) for name, of in fresh._asdict().items()))
            history.refuse_damaged(fresh, judge.memory.n_actions)
            judge.memory.restore(history, **counts)
        return judge


class Seen(NamedTuple):
    """A scene at one time, of k objects in any order."""

    own: Floats  #: (p + q,) place, then all else
    away: Floats  #: (k, p) places of the objects, relative to one's own
    other: Floats  #: (k, q) all else of them, not relative
    action: int = -1  #: that followed, if any


class Past(NamedTuple):
    """N moments of one or more episodes, one after the other, and M objects in all of them."""

    own: Floats  #: (N, p + q)
    actions: _Ints  #: (N,); -1 at the last moment of an episode
    counts: _Ints  #: (N,) number of objects
    lost: NDArray[np.bool_]  #: (N,) whether failure came in the step from this moment
    away: Floats  #: (M, p)
    other: Floats  #: (M, q)
    links: _Ints  #: (M,) index of the same object a step later; -1 where it is not known

    @classmethod
    def of(cls, seen: Sequence[Seen], q: int, failed: bool = False) -> Past:
        """An episode, from what was seen at each moment; what followed the last is left out."""
        losses = np.zeros(len(seen), bool)
        losses[-2:-1] = failed
        # In the order in which a file holds them: sums are then the same to the last bit.
        ego = np.array([s.own for s in seen]).reshape(-1, _P + q)
        away, rest = (
            np.ascontiguousarray(np.concatenate([np.zeros((0, width)), *rows]))
            for width, rows in ((_P, [s.away for s in seen]), (q, [s.other for s in seen]))
        )
        choices = np.array([s.action for s in seen], np.int64)
        choices[-1:] = -1
        counts = np.array([len(s.away) for s in seen], np.int64)
        return cls(ego, choices, counts, losses, away, rest, np.full(len(away), -1))

    @property
    def ends(self) -> _Ints:
        """(e + 1,) first moment of each episode, and of none."""
        return np.append(0, np.flatnonzero(self.actions < 0) + 1)

    @property
    def objects(self) -> _Ints:
        """(N + 1,) index of the first object of each moment, and of none."""
        return np.append(0, np.cumsum(self.counts))

    @property
    def moment(self) -> _Ints:
        """(M,) the moment of each object."""
        return np.repeat(np.arange(len(self.own)), self.counts)

    def and_then(self, later: Past) -> Past:
        """These episodes, and others after them."""
        links = np.where(later.links >= 0, later.links + len(self.away), -1)
        pairs = zip(self, later._replace(links=links), strict=True)
        return Past(*(np.concatenate(arrays) for arrays in pairs))

    def between(self, first: int, last: int) -> Past:
        """Some of the episodes."""
        begin, end = self.ends[[first, last]]
        start, stop = self.objects[[begin, end]]
        cut: list[Any] = [array[begin:end] for array in self[:4]]
        part = Past(*cut, *(array[start:stop] for array in self[4:]))
        return part._replace(links=np.where(part.links >= 0, part.links - start, -1))

    def refuse_damaged(self, none: Past, n_actions: int) -> None:
        """Raise a ValueError where arrays contradict each other, or are of other rows than none."""
        has_link, last = self.links >= 0, self.actions < 0
        if [array.shape[1:] for array in self] != [array.shape[1:] for array in none]:
            raise ValueError("its rows are of other columns than it says")
        if self.counts.sum() != len(self.links) or (self.links >= len(self.links)).any():
            raise ValueError("moments and objects are not as many as counted")
        if (self.moment[self.links[has_link]] != self.moment[has_link] + 1).any():
            raise ValueError("an object is linked to another moment than the next one")
        if (self.actions >= n_actions).any() or not np.append(True, last)[-1]:
            raise ValueError("an action is none, or the last episode has no end")
        if (np.append(last[1:], False) < self.lost).any():
            raise ValueError("a failure is not at the end of an episode")


class Contact(NamedTuple):
    """The probability of failure in a step, by how close an object comes in it.

    At closeness c it is (F + 1) / (F + 1 + S): F failures that happened at c or farther away, one
    more that might, and S steps that were survived at c or closer. So it falls with the distance,
    and is high where little was survived although nothing failed.
    """

    sides: Floats  #: (p,) half sides of the box in which closeness is counted
    closeness: Floats  #: (n,) rising; 1 is at the side of the box
    risk: Floats  #: (n,) probability of failure, falling
    met: float  #: median closeness of what failed

    @classmethod
    def learn(cls, survived: _Steps, failed: list[_Steps], spread: Floats) -> Contact:
        """From steps, (s, p) places before and after, of objects survived and at each failure.

        The closest object in a failure was met. Of the shapes of a box of this ``spread``, that is
        taken by which the fewest survived steps came closer than the failed ones.
        """
        candidates = []
        for power in _SHAPES:
            sides = spread * np.exp(0.5 * power * np.array([1.0, -1.0]))
            near = np.sort(_closest(*survived, sides))
            met = np.sort([_closest(*steps, sides).min() for steps in failed])
            candidates.append((np.log1p(np.searchsorted(near, met)).sum(), sides, near, met))
        _, sides, near, met = min(candidates, key=operator.itemgetter(0))
        at = np.unique(np.concatenate([met, near[:_CLOSEST]]))
        failures = 1 + len(met) - np.searchsorted(met, at, "left")
        risk = failures / (failures + np.searchsorted(near, at, "right"))
        return cls(sides, np.append(0.0, at), np.append(1.0, risk), float(np.median(met)))

    def of(self, path: Floats) -> Floats:
        """(..., n) probability of failure by each step of paths, (..., n + 1, p) places."""
        come = _closest(path[..., :-1, :], path[..., 1:, :], self.sides)
        # What is not known of how close is too close is not drawn anew in each step.
        so_far = np.minimum.accumulate(come, axis=-1)
        return np.asarray(np.interp(so_far, self.closeness, self.risk))


def _closest(start: Floats, end: Floats, sides: Floats) -> Floats:
    """How close it comes between two places: the least of ``max(abs(x) / sides)`` on the line."""
    least = np.empty(start.shape[:-1])
    first, last = (np.ascontiguousarray(of).reshape(-1, len(sides)) for of in (start, end))
    _closest_on_lines(first, last, sides, least.reshape(-1))
    return least


@compiled
def _closest_on_lines(start: Floats, end: Floats, sides: Floats, least: Floats) -> None:
    for k in range(len(least)):
        least[k] = np.inf
        for point in range(_POINTS):
            share = point / (_POINTS - 1)
            far = 0.0
            for i in range(len(sides)):
                at = start[k, i] + share * (end[k, i] - start[k, i])
                far = max(far, abs(at) / sides[i])
            least[k] = min(least[k], far)


class Foreseen(NamedTuple):
    """What comes of each of n actions, if each action follows it for good."""

    risks: Floats  #: (n, n) probability of failure within the horizon
    lasting: Floats  #: (n, n) expected share of the horizon that is survived
    after: Floats  #: (n, p + q) oneself a step later


class Memory:
    """Remembers episodes, and forecasts from them."""

    def __init__(self, n_actions: int, q: int) -> None:
        self.n_actions = n_actions
        #: All episodes that are remembered.
        self.past = Past.of([], q)
        #: How close is too close; None before the first failure.
        self.contact: Contact | None = None
        self.failures = 0
        #: How many of the episodes were learnt from.
        self.fitted = 0
        self._motion: Floats | None = None

    def add(self, episode: Past) -> None:
        """Remember an episode; learn from it at once if it failed, else now and then."""
        failed, history = bool(episode.lost.any()), self.past.and_then(episode)
        starts = history.objects[history.ends]  # of each episode, as objects
        surplus = min(int((len(history.away) - starts > _MOST_REMEMBERED).sum()), len(starts) - 2)
        history = history.between(surplus, len(starts) - 1)
        self.fitted = max(0, self.fitted - surplus)
        self.failures += failed
        count = len(history.ends) - 1
        fits = failed or surplus > 0 or count - self.fitted >= max(1, count // 10)
        self.past = self._fit(history) if fits else history

    def restore(self, past: Past, failures: int, fitted: int) -> None:
        """Remember these, of which the first ``fitted`` were learnt from, as they were linked."""
        self.past, self.failures, self.fitted = past, failures, fitted
        if fitted:
            episodes = past.between(0, fitted)
            self._fit_spreads(episodes)
            self._fit_motion(episodes)
            if self._motion is None:
                raise ValueError(f"{fitted} episodes were learnt from, but no object is seen twice")
            self._conclude(episodes)

    def _fit(self, past: Past) -> Past:
        """Link objects, and learn from all that is remembered."""
        count = len(past.ends) - 1
        again = self._motion is None or count & (count - 1) == 0
        history, first = past, 0 if again else int(past.ends[self.fitted])
        self._fit_spreads(history)
        for _ in range(3 if self._motion is None else 1):
            history = self._linked(history, first)
            self._fit_motion(history)
            if self._motion is None:
                return history
        self.fitted = count
        self._conclude(history)
        return history

    def _conclude(self, past: Past) -> None:
        self._fit_oneself(past)
        self._fit_contact(past)
        self._fit_objects(past)

    def _fit_spreads(self, past: Past) -> None:
        self._spreads = tuple(
            np.where((s := of.std(0)) > 0.0, s, 1.0) if len(of) else np.ones(of.shape[1])
            for of in (past.away, past.other, past.own)
        )

    def _linked(self, past: Past, first: int) -> Past:
        """Which object is which a step later: each is nearest to where the other is expected."""
        away, rest, _ = self._spreads
        links, ends = past.links.copy(), past.objects
        links[ends[first] :] = -1
        gate = np.inf if self._motion is None else _GATE
        for t in range(first, len(past.own) - 1):
            if past.actions[t] < 0 or not (past.counts[t] and past.counts[t + 1]):
                continue
            now, then = slice(ends[t], ends[t + 1]), slice(ends[t + 1], ends[t + 2])
            places = past.away[now] + self._moved(past.own[t : t + 2], past.other[now])
            off = (places[:, None] - past.away[then]) / away
            change = (past.other[now][:, None] - past.other[then]) / rest
            apart = (off**2).sum(2)
            unlike = apart + _OF_REST * (change**2).sum(2)
            nearest, back = unlike.argmin(1), unlike.argmin(0)
            index = np.arange(len(nearest))
            mutual = (back[nearest] == index) & (apart[index, nearest] < gate)
            links[ends[t] + index[mutual]] = ends[t + 1] + nearest[mutual]
        return past._replace(links=links)

    def _fit_motion(self, past: Past) -> None:
        """How places change, by what oneself and objects were like before and after."""
        rows, moment = np.flatnonzero(past.links >= 0), past.moment
        if len(rows) < _ROWS * past.own.shape[1]:
            return
        now, then = moment[rows], past.links[rows]
        ego = _terms(past.own[now], past.own[now + 1])
        x = np.hstack([ego, past.other[rows], past.other[then], np.ones((len(rows), 1))])
        y = past.away[then] - past.away[rows]
        prior = _first_motion(x.shape[1])
        weights = np.ones(len(rows))
        spread = np.maximum(x.var(0), _CONSTANT * (x**2).mean(0)) + 1e-12
        ridge = _RIDGE * len(rows) * np.diag(spread)
        for _ in range(_REWEIGHTINGS):
            weighted_x = x * weights[:, None]
            motion = np.linalg.solve(weighted_x.T @ x + ridge, weighted_x.T @ y + ridge @ prior)
            off = (((y - x @ motion) / self._spreads[0]) ** 2).sum(1)
            middle = max(float(np.median(off)), _LEAST_SQUARE)
            weights = 1.0 / (1.0 + off / (_HALF * middle))
        self._motion = np.asarray(motion, np.float64)

    def _moved(self, own: Floats, other: Floats) -> Floats:
        """(k, p) expected change of relative places in a step; ``own`` is before and after it."""
        ego = np.repeat(_terms(own[:1], own[1:]), len(other), axis=0)
        x = np.hstack([ego, other, other, np.ones((len(other), 1))])
        motion = _first_motion(x.shape[1]) if self._motion is None else self._motion
        return np.asarray(x @ motion)

    def _mine(self, before: Floats, after: Floats) -> Floats:
        """(k, p) how oneself moves all relative places in a step."""
        assert self._motion is not None
        terms = _terms(before, after)
        return np.asarray(terms @ self._motion[: terms.shape[1]])

    def _fit_oneself(self, past: Past) -> None:
        """What each action brought oneself, from states in units of their spreads."""
        moments = np.flatnonzero((past.actions >= 0) & ~past.lost)
        self._own = []
        for action in range(self.n_actions):
            rows = moments[past.actions[moments] == action]
            before = past.own[rows]
            self._own.append((before / self._spreads[2], past.own[rows + 1] - before))

    def _fit_contact(self, past: Past) -> None:
        """How close is too close."""
        safe = np.flatnonzero((past.links >= 0) & ~past.lost[past.moment])
        failures, ends = [], past.objects
        for t in np.flatnonzero(past.lost):
            rows = slice(ends[t], ends[t + 1])
            last = past.away[ends[t + 1] : ends[t + 2]]
            start, links = past.away[rows], past.links[rows]
            places = start + self._moved(past.own[t : t + 2], past.other[rows])
            end = np.where((links >= 0)[:, None], past.away[links], places)
            if len(start) or len(last):
                failures.append((np.concatenate([start, last]), np.concatenate([end, last])))
        if failures and len(safe):
            steps = past.away[safe], past.away[past.links[safe]]
            self.contact = Contact.learn(steps, failures, self._spreads[0])

    def _fit_objects(self, past: Past) -> None:
        """Where each object went from then on, oneself left out."""
        rows, moment = np.flatnonzero(past.links >= 0), past.moment
        now, then = moment[rows], past.links[rows]
        own_moves = self._mine(past.own[now], past.own[now + 1])
        moves = np.full_like(past.away, np.nan)
        moves[rows] = past.away[then] - past.away[rows] - own_moves
        terms = np.hstack([past.other, np.ones((len(past.other), 1))])
        steady = np.linalg.lstsq(terms[rows], moves[rows], rcond=None)[0]
        self._steady = steady[:-1]
        step, links = terms @ steady, past.links.copy()
        if self.contact is not None:
            off = np.abs((moves[rows] - step[rows]) / self.contact.sides).max(1)
            astray = rows[off > _ASTRAY * self.contact.met]
            if 2 * len(astray) < len(rows):  # else what failed met in one point, as in cells
                links[astray], moves[astray] = -1, np.nan
                rows = np.flatnonzero(links >= 0)
        at, steps = np.arange(len(past.away)), np.empty((len(past.away), _STEPS_AHEAD, _P))
        for h in range(_STEPS_AHEAD):
            here = np.where((at >= 0)[:, None], moves[at], np.nan)
            steps[:, h] = step = np.where(np.isnan(here), step, here)
            at = np.where(at >= 0, links[at], -1)
        self._objects = self._features(past.own[moment], past.away, past.other)[rows]
        self._paths, self._others = np.cumsum(steps, 1)[rows], past.other[rows]

    def _features(self, own: Floats, away: Floats, other: Floats) -> Floats:
        far, rest, ego = self._spreads
        near = _NEAR_TO * away / far, _NEAR_TO * other / rest
        return np.hstack([*near, (away + own[:, :_P]) / far, own[:, _P:] / ego[_P:]])

    def apart(self, own: Floats, one: Floats) -> Floats:
        """(k,) squared distance of states of oneself from one, each number by its spread."""
        return np.asarray((((own - one) / self._spreads[2]) ** 2).sum(1))

    def foresee(self, seen: Seen) -> Foreseen:
        """What comes of each action."""
        assert self.contact is not None
        n = self.n_actions
        moves, weights, after = self._own_courses(seen.own)
        safe = np.ones(moves.shape[:3])
        ego = np.repeat(seen.own[None], len(seen.away), axis=0)
        analogs = _nearest(self._objects, self._features(ego, seen.away, seen.other), _ANALOGS)
        for i, (like, share) in enumerate(zip(*analogs, strict=True)):
            faster = (seen.other[i] - self._others[like]) @ self._steady
            path = self._paths[like] + faster[:, None] * np.arange(1, _STEPS_AHEAD + 1)[:, None]
            to = seen.away[i] + path + moves[:, :, None]
            safe *= share @ (1.0 - self.contact.of(np.insert(to, 0, seen.away[i], axis=-2)))
        losses = ((1.0 - safe) * weights[:, :, None]).sum(0).reshape(n, n, _STEPS_AHEAD)
        return Foreseen(losses[:, :, -1], 1.0 - losses.mean(-1), after)

    def _own_courses(self, own: Floats) -> tuple[Floats, Floats, Floats]:
        """How r courses move relative places, by action and by that which follows for good.

        (r, n², H, p) moves, (r, n²) shares, and the (n, p + q) states a step later in the first.
        """
        n, r = self.n_actions, _OWN_ANALOGS
        first, then = np.repeat(np.arange(n), n), np.tile(np.arange(n), n)
        at = np.broadcast_to(own, (r, n * n, len(own)))
        moves = np.zeros((r, n * n, _STEPS_AHEAD, _P))
        shares = np.full((r, n * n), 1.0 / r)
        for h in range(_STEPS_AHEAD):
            to = at.copy()
            for action, (before, change) in enumerate(self._own):
                rows = np.flatnonzero((then if h else first) == action)
                if not len(before):
                    continue
                here = (at[:, rows] / self._spreads[2]).reshape(-1, len(own))
                like, share = (of.reshape(r, len(rows), -1) for of in _nearest(before, here, r))
                own_analog = np.arange(r), slice(None), np.arange(r).clip(max=like.shape[-1] - 1)
                to[:, rows] += change[like[own_analog]]
                if h == 0:
                    shares[:, rows] = share[own_analog]
            own_moves = self._mine(at.reshape(-1, len(own)), to.reshape(-1, len(own)))
            moves[:, :, h] = own_moves.reshape(r, n * n, _P)
            if h == 0:
                after = to[0, ::n]
            at = to
        return np.cumsum(moves, 2), shares / shares.sum(0), after


def _terms(before: Floats, after: Floats) -> Floats:
    """(k, p + 2 q) what of oneself moves all relative places in a step."""
    return np.hstack([after[:, :_P] - before[:, :_P], before[:, _P:], after[:, _P:]])


def _first_motion(terms: int) -> Floats:
    """The prior of how places change, without which rare moves of one's own are never learnt."""
    motion = np.zeros((terms, _P))
    motion[:_P] = -np.eye(_P)
    return motion


def _nearest(points: Floats, around: Floats, most: int) -> tuple[_Ints, Floats]:
    """(k, most) indices of the points nearest to each of k, nearest first, and their weights."""
    most = min(most, len(points))
    like = np.empty((len(around), most), np.int64)
    apart = np.full((len(around), most), np.inf)
    _nearest_into(points, around, like, apart)
    weight = 1.0 / (_ANALOG_SCALE + apart) ** 2
    return like, weight / weight.sum(-1, keepdims=True)


@compiled
def _nearest_into(points: Floats, around: Floats, like: _Ints, apart: Floats) -> None:
    """The nearest points and their squared distances; of two equally near ones the first."""
    for k in range(len(around)):
        for j in range(len(points)):
            far = 0.0
            for i in range(points.shape[1]):
                off = points[j, i] - around[k, i]
                far += off * off
            at = apart.shape[1] - 1
            if far >= apart[k, at]:
                continue
            while at and apart[k, at - 1] > far:
                apart[k, at], like[k, at] = apart[k, at - 1], like[k, at - 1]
                at -= 1
            apart[k, at], like[k, at] = far, j
