"""How a system moves, what disturbs it and where it fails: learnt online, told only what failed."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from evofsm.fsm.validation import real_array, refuse_unusable, whole
from evofsm.guard.learnt import dead_ends, places, regions, regression
from evofsm.guard.learnt.dead_ends import DeadEnds
from evofsm.guard.learnt.failures import ask, explain_failures
from evofsm.guard.learnt.places import ANYWHERE, Place, onset
from evofsm.guard.learnt.regression import Drift, Recent
from evofsm.guard.learnt.replay import (
    EARLY,
    GROWN,
    MOVING,
    ONSET,
    Disturbances,
    Floats,
    Ints,
    Model,
    Sums,
    features,
    lags,
    learn_transition,
    n_features,
    n_products,
    pairs,
    refuse_too_many,
    replay,
    residuals,
)
from evofsm.store import COUNT, SHARE, Numbers

#: Parts that can be left out, to see what each is worth.
DYNAMICS_PARTS: tuple[str, ...] = (
    *("stretches", "products", "lags", "doubt", "jumps", "carried", "regions", "places", "rivals"),
)

# Observations before anything is expected: an episode may fail after so few.
_FIRST = 8
# Of what was learnt so far, what still counts an episode later.
_KEPT = 0.999
# Weights are solved for after every so many observations, more often among the first ones once they
# could be, and in the end only between episodes.
_SELDOM, _OFTEN, _FIRST_ONES, _NEVER = 20, 5, 300, 1500
# Onsets of sequences in an episode, at most; after so many steps without a surprise another counts.
_ONSETS, _APART = 3, 3
# A sequence has at least so many steps.
_SHORTEST = 4
# An episode that goes on for so many steps is studied, and goes on; with the last of them, as the
# last transition is learnt next. Of all of them so many tell how noisy sensors are: a decision
# waits.
_LONGEST, _LAST, _LATEST = 1024, 3, 256
# An episode of fewer steps says nothing of sizes, gains and drift; one of fewer than two nothing.
_STUDIED, _LEAST = 5, 2
# An extreme is a saturation if it was reached, by moving, in so many episodes, or if a variable
# rested there although it was expected to go on.
_REACHED = 2
# Failures, and jumps of each variable, that are remembered.
MOST = 200
# Directions in which failure is looked for where it is given as a function.
_RAYS = 64
# After so many episodes in which more than this share was refused and none failed, what hardly any
# failure tells is doubted; sooner where some failure is known to be no threshold.
_PATIENCE, _REFUSED, _SOONER, _LESS = 8, 0.75, 4, 0.33
# So many endings tell where there are any; observations so near the last one [ordinary changes]
# cannot be told from it.
_ENDED, _SAME = 2, 0.5
#: Survived observations that are remembered, as many as fill some hundred kilobytes.
MOST_SURVIVED = 8000
# Choices that actions are told apart by, each of which has features of its own.
_MOST_CHOICES = 1_000
# Jumps that would have shown no dependence, for each variable.
_JUMP_PRIOR = 3.0
# Of one that is where it saturates, a noisy sensor may say that it is so many residuals from there.
_CLOSE = 3.0
# So many times the sequences that are kept there may be until somebody chooses.
_SPARE = 4
# Sequences that are kept of many variables: with none at all they fill a cache line.
_REMEMBERED_OF_MANY = 7


class Episode(NamedTuple):
    """An episode that is over, without the transition that failed."""

    observations: Floats  #: (T + 1, m)
    actions: Floats  #: (T, a)
    residuals: Floats  #: (T - 1, m) what was not expected, from the second observation on
    failed: bool
    terminated: bool  #: whether it ended by itself, without failing


class DisturbanceSequence(NamedTuple):
    """What happened for a while, as observed; residuals follow, unless it moves otherwise now."""

    observations: Floats  #: (L + 2, m), the first one step before it began
    actions: Floats  #: (L + 1, a), the first one step before it began
    episode: int  #: in which it was seen, from 0
    unforeseen: Floats  #: (L, m) residuals of then; (0, m) where they follow from the rest
    place: Place = ANYWHERE  #: where alone it begins


class Dynamics:
    """Learns how a system moves under actions, what disturbs it for a while, and where it fails.

    Actions are in a range from ``low`` to ``high``, (d,) each, or ``n_actions`` told apart by their
    index. A disturbance sequence has at most ``horizon`` steps; so many are ``remembered`` where
    somebody chooses among them (`keep`), of those that nobody has chosen yet the newest, four times
    as many. Parts of `DYNAMICS_PARTS` may be left out (``without``).

    Each variable's change is linear in the observation, its latest change, the action, the one
    before, bends of the action and products of variables and actions, learnt by sums
    (`regression`). Where a system fails is known only after it failed there once, or where it is
    given; nothing here says that something is safe.

    What is in lists, and all arrays but those of ``sums``, never change in place.
    """

    sums: Sums
    model: Model  #: what is expected, as kernels see it

    def __init__(
        self,
        low: ArrayLike | None = None,
        high: ArrayLike | None = None,
        *,
        n_actions: int | None = None,
        horizon: int = 48,
        remembered: int = 16,
        without: Sequence[str] = (),
    ) -> None:
        self.choices = 0 if n_actions is None else whole("n_actions", n_actions)
        if self.choices > _MOST_CHOICES:
            raise ValueError(
                f"n_actions is {n_actions}; a learnt judge takes at most {_MOST_CHOICES:,} actions"
            )
        self.low, self.high = _range(low, high, is_none=n_actions is not None)
        self._middle, self._half = 0.5 * (self.low + self.high), 0.5 * (self.high - self.low)
        self.size = self.choices or len(self.low)
        self.horizon = whole("horizon", horizon)
        self.remembered = whole("remembered", remembered)
        self.without = frozenset(without)
        self._carried = "carried" not in self.without
        self.n_variables = 0
        #: Whether an observation is a failure, where that is given.
        self.failed: Callable[[Floats], bool] | None = None
        self.sequences: list[DisturbanceSequence] = []
        self.thresholds: list[tuple[int, float, float]] = []  #: variable, sign, and where it fails
        self.drifts: list[Drift] = []  #: variables that move otherwise than they did, by time
        self.n_episodes = 0
        #: The episode that was studied last, if it was long enough.
        self.latest: Episode | None = None
        #: (a, 2) how often each number of an action was near an end of its range.
        self.used = np.zeros((self.size, 2))
        #: Share of the states around in which a given function says otherwise than what is known.
        self.differs = 0.0
        self.quiet = 0  #: observations since one that was not expected
        #: For how many episodes little passed; below 0 while it is tried what else may be true.
        self.held = 0
        self.ready, self.doubt_of_lags = False, 0.0
        self.is_noisy = False  #: whether some variables are not taken as they are seen
        self.forget_episode()

    # -- Actions --------------------------------------------------------------------------------

    def encode(self, action: Any) -> Floats:
        """(a,) an action in [-1, 1], or a one among zeros."""
        if self.choices:
            chosen = np.zeros(self.choices)
            chosen[int(action)] = 1.0
            return chosen
        return np.asarray((np.asarray(action, np.float64) - self._middle) / self._half)

    def decode(self, inner: Floats) -> Floats:
        """(d,) the action itself; the index of a choice."""
        if self.choices:
            return np.array([float(inner.argmax())])
        found = self._middle + self._half * inner
        return np.minimum(np.maximum(found, self.low), self.high)

    # -- An episode -----------------------------------------------------------------------------

    def forget_episode(self) -> None:
        """Nothing is under way; nothing more is learnt of what was."""
        self.n_under_way = 0  #: observations of this episode that are not studied yet
        self.has_acted = False  #: whether it is known what was done after the latest of them
        self._z, self._u = np.empty((0, self.n_variables)), np.empty((0, self.size))
        self._surprised = False  # whether something in it was not expected

    def _begin(self, z: Floats) -> None:
        """Make room for what is learnt; variables are counted from the first observation on."""
        m, a = len(z), self.size
        refuse_too_many(m, a, box=not self.choices)
        p = n_features(m, a, box=not self.choices)
        if not len(pairs(m)[0]):
            self.remembered = min(self.remembered, _REMEMBERED_OF_MANY)
        self.n_variables, self.origin = m, z.copy()
        self.sums, self.weights = Sums.none(z, p), np.zeros((p, m))
        #: (m,) of all that was survived, and (m, 2) in how many episodes those ends were reached.
        self.lowest, self.highest = np.full(m, np.inf), np.full(m, -np.inf)
        self.reached = np.zeros((m, 2))
        self.failures = np.empty((0, m))  #: (k, m) observations in which episodes failed
        self.brinks = np.empty((0, m))  #: (., m) and the last ones before
        #: (n, m) what was survived, and what is between two such observations
        self.survived = np.empty((0, m))
        self.regions = np.empty((0, regions.SIZE))  #: (r, 12) where it fails beyond no threshold
        self.ended = np.empty((0, m))  #: (k, m) observations in which it ended without failing
        #: (e, 12) where it ends by itself, and (c, 12) where it fails if it does.
        self.endings = self.crashes = np.empty((0, regions.SIZE))
        self.jumps = [np.empty((0, m + 1)) for _ in range(m)]  #: from where, and to where
        self.dead_ends = DeadEnds.none(m)  #: from where certified episodes failed
        self.recent = Recent.none(p, m, self.n_episodes)  #: what the last episodes say of the model
        self.missed = regression.untried(m)  #: by gains of the observer
        #: (k, 3m + 2a + 1) where something unforeseen began, as `places.after` has it
        self.events = np.empty((0, 3 * m + 2 * self.size + 1))
        self.rebuild()
        self.forget_episode()

    def observe(self, z: Floats) -> bool:
        """Take in an observation (m,), all finite; whether something unexpected began with it."""
        if not self.n_variables:
            self._begin(z)
        if self.n_under_way >= _LONGEST:
            self._study(failed=False)
            last = slice(self.n_under_way - _LAST, self.n_under_way)
            self._z, self._u, self.n_under_way = self._z[last].copy(), self._u[last].copy(), _LAST
        n, sums = self.n_under_way, self.sums
        if n == len(self._z):
            room = max(64, n)
            self._z = np.vstack([self._z, np.empty((room, self.n_variables))])
            self._u = np.vstack([self._u, np.empty((room, self.size))])
        self._z[n], self.n_under_way, self.has_acted = z, n + 1, False
        sums.counts[0] += 1.0  # mean and scatter as Welford (1962) has them
        off = z - self.origin - sums.mean
        sums.mean[:] += off / sums.counts[0]
        sums.scatter[:] += off * (z - self.origin - sums.mean)
        self._surprised = False
        if n > 1:
            self._learn(n - 1)
        seen = float(sums.counts[0])
        every = _OFTEN if self.ready and seen < _FIRST_ONES else _SELDOM
        if seen % every == 0 and (seen < _NEVER or not self.ready):
            self._solve()
        return self._begins()

    def _begins(self) -> bool:
        """Whether the latest change is the first for a while that was not expected."""
        self.quiet += 1
        if not self._surprised:
            return False
        was_quiet, self.quiet = self.quiet > _APART, 0
        return was_quiet

    def act(self, action: Floats) -> None:
        """What was done after the latest observation, encoded; a second one replaces the first."""
        last = self.n_under_way - 1
        if self.has_acted:
            self.used, self._u = self.used - self._ends(self._u[last]), self._u.copy()
        self.used = self.used + self._ends(action)
        self._u[last], self.has_acted = action, True

    def _ends(self, action: Floats) -> Floats:
        """(a, 2) which numbers of an action are near an end of their range."""
        lowest = -1.0 if self.choices else -0.6
        return np.array([action < lowest, action > 0.6]).T

    def end(self, *, failed: bool, terminated: bool = False) -> None:
        """The episode is over, or what comes does not follow from what was (it was cut off)."""
        if self.n_under_way > 2 or (failed and self.n_under_way):
            self._study(failed=failed, terminated=terminated and not failed)
        self.forget_episode()

    # -- The model ------------------------------------------------------------------------------

    def _learn(self, i: int) -> None:
        """Learn the transition to observation i, now that the one after it is known."""
        sums, z, jumped = self.sums, self._z, np.zeros(self.n_variables)
        n = int(sums.counts[1])
        args = sums, self.model, self.close, z, self._u, i - 1, jumped
        self._surprised = bool(learn_transition(*args))
        if n < EARLY:
            sums.early[n] = np.abs(z[i] - z[i - 1])
            sums.unit[:] = regression.early_unit(sums, n + 1)
        if i > 1 and jumped.any():
            for j in np.flatnonzero(jumped):
                jump = np.append(z[i - 1], z[i, j])
                more = np.vstack([self.jumps[j][1 - MOST :], jump])
                self.jumps = [more if k == j else one for k, one in enumerate(self.jumps)]

    def _solve(self) -> None:
        if self.sums.counts[0] < _FIRST:
            return
        with suppress(np.linalg.LinAlgError):  # numbers of sizes that have nothing in common
            misleading = regression.are_misleading(self.doubt_of_lags)
            weights = self._solved("lags" in self.without or misleading)
            if np.isfinite(weights).all():
                self.weights, self.ready = weights, True
        self.rebuild()

    def _solved(self, without_lags: bool) -> Floats:
        m, a, p = self.n_variables, self.size, len(self.weights)
        left_out = np.zeros(p)
        if "products" in self.without:
            left_out[p - n_products(m, a) :] = 1.0
        if without_lags:
            left_out[lags(m, a)] = 1.0
        return regression.solve(self.sums, a, left_out)

    def rebuild(self) -> None:
        """Make the model of weights and sums."""
        sums = self.sums
        variance = sums.scatter / max(1.0, sums.counts[0] - 1.0)
        worth = 1.0 / (1.25 * sums.unit + 1e-300)
        inverse = 1.0 / np.sqrt(np.where(variance > 0.0, variance, 1.0))
        thresholds = [[j, sign, at, worth[j]] for j, sign, at in self.thresholds]
        lowest = np.where(self.reached[:, 0] >= _REACHED, self.lowest, -np.inf)
        highest = np.where(self.reached[:, 1] >= _REACHED, self.highest, np.inf)
        for j, sign, _ in self.thresholds:  # one does not saturate where one fails
            (lowest if sign < 0.0 else highest)[j] = sign * np.inf
        drifted = np.full(self.n_variables, -1.0 if self.drifts else 0.0)
        drifted[[one.variable for one in self.drifts]] = 1.0
        self.model = Model(
            weights=self.weights,
            origin=self.origin,
            reach=1.5 * np.maximum(np.abs(sums.least), np.abs(sums.most)),
            lowest=lowest,
            highest=highest,
            least=sums.least.copy(),
            most=sums.most.copy(),
            thresholds=np.array(thresholds, np.float64).reshape(-1, 4),
            regions=self.regions,
            endings=self.endings,
            crashes=self.crashes,
            dead_ends=self.dead_ends.rows(inverse, sums.unit),
            drifted=drifted,
            mean=self.origin + sums.mean,
            inverse=inverse,
            choices=self.choices,
        )
        #: What is expected while it is tried which explanation of failure is true.
        self.daring = self.model
        if len(self.crashes):
            halfway = regions.halfway(self.crashes, self.failures)
            self.daring = self.model._replace(crashes=halfway)
        if self.held < 0:
            weak, few = regions.are_weak(self.thresholds, self.regions, self.failures)
            self.daring = self.daring._replace(
                thresholds=self.model.thresholds[~weak], regions=self.model.regions[~few]
            )
        #: (m,) gains of the observer, and how far from where it saturates one that is there is seen
        self.gains = regression.best_gains(self.missed)
        self.is_noisy = bool((self.gains < 1.0).any())
        self.close = np.where(self.gains < 1.0, _CLOSE * np.sqrt(sums.noise), 1e-9 / inverse)

    def corrected(self, situation: Floats, action: Floats, seen: Floats) -> Floats:
        """(m,) where one is, a step after a situation and an action; ``seen`` if none is noisy."""
        if not self.is_noisy:
            return seen
        return regression.corrected(self.model, self.gains, situation, action, seen, self.sums.unit)

    def refute(self, starts: Ints, steps: int) -> None:
        """Compare the model with what came where it had foreseen failure that never came.

        From ``starts`` (k,) of the latest episode it went on for so many steps.
        """
        assert self.latest is not None
        z, u = self.latest.observations, self.latest.actions
        starts = starts[starts <= len(u) - steps]
        if not len(starts) or "doubt" in self.without:
            return
        was = regression.are_misleading(self.doubt_of_lags)
        with suppress(np.linalg.LinAlgError):
            asked = [self.model._replace(weights=self._solved(each)) for each in (False, True)]
            worse = regression.misled_by_lags(asked, z, u, starts, steps, self.sums.unit)
            if self.latest.failed:
                worse = max(0.0, worse)
            self.doubt_of_lags = max(0.0, self.doubt_of_lags + worse)
        if regression.are_misleading(self.doubt_of_lags) != was:
            self._solve()

    # -- A whole episode ------------------------------------------------------------------------

    def _study(self, *, failed: bool, terminated: bool = False) -> None:
        """Learn from an episode as a whole."""
        z, u = self._z[: self.n_under_way].copy(), self._u[: self.n_under_way].copy()
        safe = z[:-1] if failed else z
        self._extend(safe)
        went_on = safe
        if terminated:
            far = (np.abs(safe - safe[-1]) > _SAME * self._sizes[0]).any(1)
            went_on = safe[: int(np.flatnonzero(far).max(initial=-1)) + 1]
            self.ended = np.vstack([self.ended[1 - MOST :], safe[-1]])
        self._survive(went_on)
        if failed:
            self.failures = np.vstack([self.failures[1 - MOST :], z[-1]])
            self.brinks = np.vstack([self.brinks[1 - MOST :], safe[-1:]])
        if len(safe) <= _STUDIED and self.sums.scale[0] > 0.0:
            self._learn_fully(safe, u)
        self.endings = regions.without_survived(self.endings, went_on)
        self.settle(failed=failed, waits=len(z) == _LONGEST)
        self.sums.squares[:] *= _KEPT
        self.sums.products[:] *= _KEPT
        self.latest = None
        T = len(safe) - 1
        known, long = self.sums.scale[0] > 0.0, T >= _STUDIED
        if self.ready and (long or (known and T >= _LEAST)):
            if known and long:
                self._follow_drift(safe, u[:T])
                first = T - _LATEST if len(z) == _LONGEST else 0
                late = safe[first:], u[first:T], self.sums.unit
                self.missed = regression.tried(self.missed, self.model, *late)
                self.rebuild()
            found = residuals(self.model, self.close, safe, u[:T])
            if long:
                self._saturate(found, safe)
                self._rescale(found, safe)
            self.latest = Episode(safe, u[:T], found, failed, terminated)
            self.rebuild()
            if "places" not in self.without:
                seen = safe, u[:T], found, self._ordinary
                self.events = places.after(self.events, *seen, self.n_episodes, self.model)
            if "stretches" not in self.without:
                self.remember(self.onsets(found))
        self.n_episodes += 1

    def _learn_fully(self, z: Floats, u: Floats) -> None:
        """Learn the transitions of an episode that is over at once as no outliers.

        It is one's own actions that end it, of which the model is wrong: else for ever.
        """
        if len(z) > _LEAST:
            change, T = np.diff(z, axis=0), len(z) - 1
            rows = features(self.model, z[1:-1], change[:-1], u[: T - 1], u[1:T])
            self.sums.squares[:] += rows.T @ rows
            self.sums.products[:] += rows.T @ change[1:]

    def settle(self, *, failed: bool = False, waits: bool = False) -> None:
        """Make of all sums what is known: weights, and where it fails, if it ``failed`` anew.

        Where a decision ``waits``, regions only shrink.
        """
        self._solve()
        before, crashed = [one[:2] for one in self.thresholds], self._crashed
        count = len(self.regions)
        if len(self.ended) >= _ENDED and not waits:
            self._find_endings()
        crashes = self._crashed
        if self.failed is None:
            sums, failures = self.sums, self.failures[~crashes]
            blur = np.where(self.reached < _REACHED, sums.scale[:, None], 0.0)
            unit = np.maximum(sums.unit, 1e-300)
            found = explain_failures(failures, self.lowest, self.highest, unit, blur)
            self.thresholds = stay = found
            if "regions" not in self.without:
                survived = np.concatenate([self.survived, self.brinks, self.ended])
                self.regions = regions.without_survived(self.regions, survived)
                if count:
                    self.thresholds = stay = [one for one in found if one[:2] in before]
                known = waits or regions.explained(failures, stay, self.regions).all()
                if failed or not known or (crashed != crashes).any():
                    given = failures, survived, *self._sizes
                    self.thresholds, self.regions = regions.explain(found, *given)
        elif not waits:
            self._ask(self.failed)
        now = [one[:2] for one in self.thresholds], len(self.regions)
        if failed or now != (before, count):  # one of two explanations is refuted
            self.held = 0
        self.rebuild()

    def _find_endings(self) -> None:
        """Where it ends by itself: nowhere where it went on, nor where it failed like that."""
        rows, ended = self.endings, self.ended
        went_on = np.concatenate([self.survived, self.brinks])
        rows = regions.without_survived(rows, went_on)
        if len(went_on) and not regions.inside(rows, ended).any(0).all():
            rows = self._told_apart(ended, went_on)
        rows = rows[regions.inside(rows, ended).sum(1) >= _ENDED]
        failed = self.failures[regions.inside(rows, self.failures).any(0)]
        self.crashes = self._told_apart(failed, ended, GROWN)
        unlike = failed[~regions.explained(failed, (), self.crashes, 0.0)]
        self.endings = regions.without_survived(rows, unlike)

    @property
    def _crashed(self) -> NDArray[np.bool_]:
        """(k,) which failures are where it ends, and explained by how it does."""
        ends = regions.explained(self.failures, (), self.endings)
        return np.asarray(ends & regions.explained(self.failures, (), self.crashes, 0.0))

    def _told_apart(self, some: Floats, others: Floats, least: float = 0.0) -> Floats:
        """Regions (r, 12) of some observations in which no others are; thresholds where they do.

        Thresholds first that some are beyond by ``least`` ordinary changes.
        """
        unit, spread = self._sizes
        given = some, others.min(0), others.max(0), unit
        found = explain_failures(*given, 0.0 * self.reached, least)
        sides, rows = regions.explain(found, some, others, unit, spread)
        return np.concatenate([regions.of_thresholds(sides, unit), rows])

    @property
    def _sizes(self) -> tuple[Floats, Floats]:
        """(m,) what a distance of 1 is for each variable, and its standard deviation."""
        spread = np.sqrt(self.sums.scatter / max(1.0, self.sums.counts[0] - 1.0))
        return 1.25 * np.maximum(self.sums.unit, 1e-3 * spread + 1e-300), spread

    def challenge(self, refused: int) -> None:
        """Doubt what hardly any failure tells, if it refuses nearly all for long.

        Of the latest episode so many were ``refused``. While learning, what is doubted is left out
        then, until it or what is left is refuted.
        """
        assert self.latest is not None
        if "rivals" in self.without or self.failed is not None or self.held < 0:
            return
        known = len(self.regions) > 0
        most, patience = (_LESS, _SOONER) if known else (_REFUSED, _PATIENCE)
        little = refused > most * len(self.latest.actions) and not self.latest.failed
        self.held = self.held + 1 if little else 0
        if self.held >= patience:
            self.held = -1
            self.rebuild()

    @property
    def telling(self) -> list[int]:
        """The variables by which it fails, those of regions first."""
        of_regions = self.regions[:, :2].astype(int).ravel().tolist()
        return list(dict.fromkeys([*of_regions, *(j for j, _, _ in self.thresholds)]))

    @property
    def fails(self) -> bool:
        """Whether it is known of anything that it is failure."""
        known = self.n_variables > 0 and len(self.regions) + len(self.crashes) > 0
        return bool(self.thresholds) or known

    def _survive(self, safe: Floats) -> None:
        """Remember what was survived; where that is too much, every second one."""
        if not len(safe):
            return
        change = np.diff(safe, axis=0)
        jumped = regression.jumps(change, self.sums.unit).any(1)
        between = (safe[:-1] + 0.5 * change)[~jumped]
        new = np.concatenate([safe, between])
        if self.failed is not None:
            new = new[[not self.failed(z) for z in new]]
        survived = np.concatenate([self.survived, new])
        while len(survived) > MOST_SURVIVED:
            survived = survived[::2]
        self.survived = survived

    def _ask(self, failed: Callable[[Floats], bool]) -> None:
        """Explain what a function says around what was survived, unless that is explained."""
        (unit, spread), survived = self._sizes, self.survived
        if not len(survived) or not spread.any():
            return
        pace = np.abs(np.diff(survived, axis=0)).mean(0) / np.where(spread > 0.0, spread, np.inf)
        drawn = np.random.default_rng(self.n_episodes).normal(size=(_RAYS, self.n_variables))
        towards = np.empty_like(drawn)
        towards[:, np.argsort(pace, kind="stable")] = drawn
        flips = np.where(((survived - survived.mean(0)) ** 3).sum(0) < 0.0, -1.0, 1.0)
        lost, kept = ask(failed, survived, towards * flips * spread)
        around = np.concatenate([kept, survived])

        def differs() -> float:
            wrong = ~regions.explained(lost, self.thresholds, self.regions)
            inside = regions.explained(kept, self.thresholds, self.regions, 0.0)
            return float(np.concatenate([wrong, inside]).mean()) if len(lost) else 0.0

        if len(lost) and differs() > 0.0:
            ends = around.min(0), around.max(0)
            found = explain_failures(lost, *ends, unit, np.zeros((len(unit), 2)))
            if "regions" in self.without:
                self.thresholds = found
            else:
                self.thresholds, self.regions = regions.explain(found, lost, around, unit, spread)
        self.differs = differs()

    def _extend(self, safe: Floats) -> None:
        """How far variables went, and in how many episodes they came to those ends by moving."""
        if not len(safe):
            return
        low, high = safe.min(0), safe.max(0)
        close = 1e-9 * (high - low)
        new = np.column_stack([low < self.lowest - close, high > self.highest + close])
        self.lowest = np.where(new[:, 0], low, self.lowest)
        self.highest = np.where(new[:, 1], high, self.highest)
        moving = np.abs(np.diff(safe, axis=0)) > close  # it arrived there, and did not start there
        at_lowest = ((safe[1:] <= self.lowest + close) & moving).any(0)
        at_highest = ((safe[1:] >= self.highest - close) & moving).any(0)
        self.reached = np.where(new, 0.0, self.reached) + np.column_stack([at_lowest, at_highest])

    def _follow_drift(self, z: Floats, u: Floats) -> None:
        """Correct the model of what moves otherwise; what was unforeseen before stays so."""
        sums, before, close, young = self.sums, self.model, self.close, self._young
        known = self.recent, before, sums, close, self.elsewhere(z)
        self.recent = recent = regression.compared(*known, z, u, self.n_episodes, bool(young))
        begun = np.flatnonzero(recent.doubt > regression.DOUBT).tolist()
        self.drifts = self.drifts + [Drift(j, int(recent.since[j]), self.n_episodes) for j in begun]
        moved = sorted({*begun, *young})
        if not moved:
            return
        change = np.diff(z, axis=0)
        change[regression.jumps(change, sums.unit)] = 0.0
        sums.least[begun], sums.most[begun] = change.min(0)[begun], change.max(0)[begun]
        self.weights = self.weights.copy()
        more = regression.correction(recent, before.weights, sums, self.size)
        self.weights[:, moved] += more[:, moved]
        sums.products[:, moved] = sums.squares @ self.weights[:, moved]
        self._solve()
        self.sequences = [self._as_it_was(one, before, close, moved) for one in self.sequences]
        doubt, since = recent.doubt.copy(), recent.since.copy()
        doubt[moved], since[moved] = 0.0, float(self.n_episodes)
        self.recent = recent._replace(doubt=doubt, since=since)

    def _as_it_was(
        self, one: DisturbanceSequence, before: Model, close: Floats, moved: list[int]
    ) -> DisturbanceSequence:
        """A sequence with what was unforeseen by the model of then, if that foresaw it better."""
        if len(one.unforeseen):
            return one
        seen, carried = (one.observations, one.actions), self._carried
        was = residuals(before, close, *seen, carried=carried)
        now = residuals(self.model, self.close, *seen, carried=carried)
        larger = np.abs(now[:, moved]).sum(0) > np.abs(was[:, moved]).sum(0)
        return one._replace(unforeseen=was) if larger.any() else one

    @property
    def _young(self) -> list[int]:
        """Variables of which the model was corrected a short while ago."""
        n = self.n_episodes
        return [one.variable for one in self.drifts if n - one.noticed < regression.LEARNT]

    def _saturate(self, found: Floats, safe: Floats) -> None:
        """Know ends by variables that rested there although they were expected to go on."""
        rests, far = safe[1:-1] == safe[2:], ONSET * self.sums.scale
        at_lowest = (rests & (safe[2:] == self.lowest) & (found > far)).any(0)
        at_highest = (rests & (safe[2:] == self.highest) & (found < -far)).any(0)
        held = np.column_stack([at_lowest, at_highest])
        held[(self.sums.moving <= MOVING) | (self.sums.scale[0] == 0.0)] = False
        if held.any():
            self.reached = np.where(held, np.maximum(self.reached, _REACHED), self.reached)
            self.rebuild()

    def elsewhere(self, z: Floats) -> NDArray[np.bool_]:
        """(T - 1,) which transitions of T + 1 observations lie where something begins."""
        found = np.zeros(len(z) - 2, bool)
        for j, sign, at in {one.place for one in self.sequences}:
            if j >= 0:
                inside = sign * (z[:, j] - at) >= 0.0
                found |= inside[1:-1] | inside[2:]
        return found

    def _rescale(self, found: Floats, safe: Floats) -> None:
        """How large residuals are, but for those of variables that rest at an extreme."""
        sums, size = self.sums, np.abs(found)
        at_end = (safe[2:] == sums.low) | (safe[2:] == sums.high)
        size[(safe[1:-1] == safe[2:]) & at_end & (sums.moving > MOVING)] = 0.0
        if (here := ~self.elsewhere(safe)).sum() < _STUDIED:
            return
        size = size[here]
        scale, square = 1.4826 * np.median(size, 0), (size**2).mean(0)
        known = sums.scale[0] > 0.0
        new = 0.8 * sums.scale + 0.2 * scale if known else scale
        if young := self._young:  # what is learnt anew is no outlier
            jumped = regression.jumps(np.diff(safe[1:], axis=0), sums.unit)[here]
            ordinary = np.where(jumped, 0.0, size**2).mean(0)
            new[young] = np.maximum(new, np.sqrt(ordinary))[young]
        sums.scale[:] = np.maximum(new, 1e-3 * np.sqrt(sums.variance) + 1e-300)
        sums.noise[:] = 0.8 * sums.noise + 0.2 * square if known else square

    # -- Disturbances ---------------------------------------------------------------------------

    def onsets(self, found: Floats) -> list[int]:
        """Steps of an episode at which something large began, of what was not expected (T, m)."""
        if not self.sums.scale[0] > 0.0:  # what is ordinary is not known yet
            return []
        return places.onsets(found / self.sums.scale, _ONSETS, ONSET)

    def remember(self, starts: Sequence[int]) -> None:
        """Keep the sequences of the latest episode that begin at these steps of its residuals."""
        assert self.latest is not None
        z, u = self.latest.observations, self.latest.actions
        more = []
        for t in starts:
            steps = min(self.horizon, len(u) - 1 - t)
            if steps >= _SHORTEST:
                observed, done = z[t : t + steps + 2].copy(), u[t : t + steps + 1].copy()
                nothing = np.empty((0, self.n_variables))
                more.append(DisturbanceSequence(observed, done, self.n_episodes, nothing))
        self.sequences = [*self.sequences, *more][-_SPARE * self.remembered :]

    def keep(self, which: Sequence[int], found: Disturbances) -> None:
        """Forget all sequences but these, by their numbers from 0; they begin as is ``found``."""
        rows = found.place[1:, :3].tolist()
        self.sequences = [
            self.sequences[k]._replace(place=(int(rows[k][0]), *rows[k][1:])) for k in which
        ]

    def where(self, found: Disturbances, ends: Floats) -> Floats:
        """(K, 5) as `Disturbances.place` has it, of what began on the way to ``ends`` (K, L, m)."""
        place, rest = found.place.copy(), found.residuals.transpose(2, 0, 1)
        place[:, 0] = -1.0
        if "places" in self.without or not len(self.events):
            return place
        seen = self.events, self.survived, self._ordinary
        where = places.places_of(rest, ends, *seen, self.model, self.size)
        for k, one in enumerate(where):
            place[k] = *one, *self._span(rest[k])
        return place

    @property
    def _ordinary(self) -> Floats:
        """(m,) the ordinary change; infinite of a variable that never changed."""
        unit = self.sums.unit
        return np.where(unit > 0.0, unit, np.inf)

    def _span(self, rest: Floats) -> tuple[int, int]:
        """At which step of residuals (L, m) something begins, and with which it is over."""
        return onset(rest / self._ordinary), int(np.flatnonzero(rest.any(1)).max(initial=-1)) + 1

    def disturbances(self, steps: int) -> Disturbances:
        """Residuals of what is remembered, as they are seen now; number 0 is none at all."""
        found = Disturbances.none(1 + len(self.sequences), steps, self.n_variables)
        for k, one in enumerate(self.sequences, 1):
            L = min(len(one.actions) - 1, steps)
            missed = one.unforeseen[:L]
            if not len(missed):
                rows = one.observations[: L + 2], one.actions[: L + 1]
                missed = residuals(self.model, self.close, *rows, carried=self._carried)
            found.residuals[:L, :, k] = missed
            if one.place[0] >= 0:
                found.place[k] = *one.place, *self._span(found.residuals[:, :, k])
        for j, seen in enumerate(self.jumps if "jumps" not in self.without else ()):
            if len(seen):
                for k, one in enumerate(self.sequences, 1):
                    self._find_jump(found, k, j, one.observations)
        return found

    def fails_after(self, situation: Floats, plan: Floats, disturbances: Disturbances) -> Floats:
        """(K,) steps after which a plan (T, a) fails amid each disturbance; infinite: it lasts."""
        policy = np.zeros((plan.shape[1], 1 + self.n_variables))
        ends = replay(self.model, situation[None], plan, policy, disturbances)
        return np.where(ends.value >= 0.0, np.inf, ends.value + len(plan) + 2.0)

    def _find_jump(self, found: Disturbances, k: int, j: int, z: Floats) -> None:
        """What a variable of a sequence jumps to: after on before, of jumps in that direction."""
        seen, moved = self.jumps[j], np.diff(z[:, [j]], axis=0)
        alone = regression.jumps(moved, self.sums.unit[[j]])[1:, 0]
        size = np.abs(moved[1:, 0])
        left = np.abs(found.residuals[: len(size), j, k])
        n = len(left)
        at = np.flatnonzero(alone[:n] & (left > 0.5 * size[:n]))
        if not len(at):
            return
        t = int(at[0])
        before, after = z[t + 1], z[t + 2, j]
        alike = seen[(seen[:, -1] > seen[:, j]) == (after > before[j])]
        if not len(alike):
            return
        origins, landed = alike[:, :-1], alike[:, -1]
        slopes = _slopes(origins, landed)
        found.jump_at[k, j] = t
        found.jump_slope[k, j] = slopes
        found.jump_to[k, j] = after - slopes @ before
        found.jump_from[k, j] = np.stack([origins.min(0), origins.max(0)], 1)
        found.landing[k, j] = landed.min(), landed.max()

    # -- In a file ------------------------------------------------------------------------------

    def numbers(self) -> dict[str, Any]:
        """What it goes on with, besides `arrays`."""
        created = self.dead_ends.created if self.n_variables else 0
        return {name: getattr(self, name) for name in _COUNTED} | {"dead_ends": created}

    def arrays(self) -> dict[str, Floats]:
        """All arrays that it goes on with, but for the episode under way (`restore`)."""
        m, a = self.n_variables, self.size
        if not m:  # nothing was observed: all that depends on it is empty
            sizes = {"a": a}
            return {
                name: np.zeros([n if isinstance(n, int) else sizes.get(n, 0) for n in one.shape])
                for name, one in ARRAYS.items()
            } | {"used": self.used}
        jumps = [np.insert(rows, 0, j, axis=1) for j, rows in enumerate(self.jumps)]
        told, rows = [], [np.empty((0, 2 * m + a))]
        for one in self.sequences:
            kept = len(one.observations), one.episode, len(one.unforeseen) > 0
            told.append((*kept, *one.place))
            row = np.zeros((len(one.observations), 2 * m + a))
            row[:, :m], row[:-1, m : m + a] = one.observations, one.actions
            row[: len(one.unforeseen), m + a :] = one.unforeseen
            rows.append(row)
        return {
            **{f"sums_{name}": array for name, array in self.sums._asdict().items()},
            **{f"recent_{name}": array for name, array in self.recent._asdict().items()},
            **{name: getattr(self, name) for name in _OWN},
            **{f"dead_ends_{name}": getattr(self.dead_ends, name) for name in dead_ends.ARRAYS},
            "thresholds": np.array(self.thresholds, np.float64).reshape(-1, 3),
            "drifts": np.array(self.drifts, np.float64).reshape(-1, 3),
            "jumps": np.vstack(jumps),
            "sequences": np.array(told, np.float64).reshape(-1, 6),
            "sequence_rows": np.vstack(rows),
        }

    def restore(self, numbers: Mapping[str, Any], arrays: Mapping[str, Floats]) -> None:
        """Be what `numbers` and `arrays` were of, between two episodes.

        A ValueError if they contradict each other, or the actions: kernels trust their sizes.
        """
        m, a, p = len(arrays["origin"]), self.size, len(arrays["sums_squares"])
        for name, kind in _COUNTED.items():
            setattr(self, name, kind(numbers[name]))
        if len(arrays["used"]) != a:
            raise ValueError(f"used has {len(arrays['used'])} rows, but an action has {a} numbers")
        if not m:
            self.used = arrays["used"]
            return
        told, rows, jumps = arrays["sequences"], arrays["sequence_rows"], arrays["jumps"]
        refuse_too_many(m, a, box=not self.choices)
        if p != n_features(m, a, box=not self.choices):
            raise ValueError(f"sums of {p} features are not of {m} variables and {a} numbers")
        shapes = ("regions", "endings", "crashes")
        for name in ("thresholds", "drifts", "jumps", *shapes):
            if not np.isin(arrays[name][:, : 1 + (name in shapes)], np.arange(m)).all():
                raise ValueError(f"{name} are of variables that there are not")
            if name in shapes and (arrays[name][:, 4:6] <= 0.0).any():
                raise ValueError(f"{name} have units that are not positive")
        if jumps.shape[1] != m + 2 or rows.shape[1] != 2 * m + a:
            raise ValueError("jumps or sequences are of another number of variables")
        if (told != np.round(told))[:, :3].any() or (told[:, 1:3] < 0.0).any():
            raise ValueError("sequences are of no whole numbers of rows and episodes")
        if told[:, 0].sum() != len(rows) or (told[:, 0] < 3.0).any():
            raise ValueError(f"sequences have {len(rows)} rows, not those that they say")
        self._begin(arrays["origin"])
        self.sums = Sums(**{name: arrays[f"sums_{name}"].copy() for name in Sums._fields})
        self.recent = Recent(**{name: arrays[f"recent_{name}"] for name in Recent._fields})
        for name in _OWN:
            setattr(self, name, arrays[name])
        fits = self.events.shape[1] == 3 * m + 2 * a + 1
        if not fits or not np.isin(told[:, 3], np.arange(-1, m)).all():
            raise ValueError("places are of variables that there are not, or of other numbers")
        self.dead_ends = DeadEnds(
            **{name: arrays[f"dead_ends_{name}"] for name in dead_ends.ARRAYS},
            created=int(numbers["dead_ends"]),
        )
        self.dead_ends.refuse_forged(self.n_episodes)
        self.thresholds = [(int(j), sign, at) for j, sign, at in arrays["thresholds"].tolist()]
        self.drifts = [Drift(*map(int, row)) for row in arrays["drifts"]]
        self.jumps = [jumps[jumps[:, 0] == j, 1:] for j in range(m)]
        parts = np.split(rows, np.cumsum(told[:, 0]).astype(int)[:-1])
        self.sequences = [
            DisturbanceSequence(
                part[:, :m].copy(),
                part[:-1, m : m + a].copy(),
                int(episode),
                part[: -2 if of_then else 0, m + a :].copy(),
                (int(j), sign, at),
            )
            for part, row in zip(parts if len(told) else (), told.tolist(), strict=True)
            for _, episode, of_then, j, sign, at in [row]
        ]
        self.rebuild()


# Numbers that files hold, and their types.
_COUNTED: dict[str, type] = {
    **dict.fromkeys(("n_episodes", "quiet", "held"), int),
    **dict.fromkeys(("differs", "doubt_of_lags"), float),
    "ready": bool,
}
# What files hold, by name; an array of each kind that dynamics have under their own names.
_OBSERVED, _NOT_NEGATIVE = Numbers(least=-1e30, most=1e30), Numbers(least=0.0)
_EXTREME = Numbers(least=-np.inf, most=np.inf)  # the first ones to come are infinitely far out
_OWN: dict[str, Numbers] = {
    "weights": Numbers(("p", "m")),
    "origin": _OBSERVED.of("m"),
    "lowest": _EXTREME.of("m"),
    "highest": _EXTREME.of("m"),
    "reached": COUNT.of("m", 2),
    "failures": _OBSERVED.of("failed", "m"),
    "brinks": _OBSERVED.of("brinks", "m"),
    "survived": _OBSERVED.of("survived", "m"),
    "events": _OBSERVED.of("events", "event"),
    "regions": Numbers(("regions", regions.SIZE)),
    "ended": _OBSERVED.of("ended", "m"),
    "endings": Numbers(("endings", regions.SIZE)),
    "crashes": Numbers(("crashes", regions.SIZE)),
    "missed": _NOT_NEGATIVE.of("m", len(regression.GAINS)),
    "used": COUNT.of("a", 2),
}
_OF_SUMS: dict[str, Numbers] = {
    "mean": Numbers(("m",), -1e31, 1e31),
    **{name: Numbers(("m",)) for name in ("least", "most")},
    **{name: _NOT_NEGATIVE.of("m") for name in ("scatter", "variance", "unit", "scale", "noise")},
    **{name: _OBSERVED.of("m") for name in ("low", "high")},
    "counts": COUNT.of(2),
    "squares": Numbers(("p", "p")),
    "products": Numbers(("p", "m")),
    "early": _NOT_NEGATIVE.of(200, "m"),
    "moving": SHARE.of("m"),
}
ARRAYS: dict[str, Numbers] = {
    **_OWN,
    **{f"sums_{name}": _OF_SUMS[name] for name in Sums._fields},
    **{f"dead_ends_{name}": numbers for name, numbers in dead_ends.ARRAYS.items()},
    "recent_squares": Numbers(("p", "p")),
    "recent_products": Numbers(("p", "m")),
    "recent_doubt": _NOT_NEGATIVE.of("m"),
    "recent_since": COUNT.of("m"),
    "thresholds": Numbers(("thresholds", 3)),
    "drifts": COUNT.of("drifts", 3),
    "jumps": _OBSERVED.of("jumps", "jump"),
    "sequences": Numbers(("sequences", 6), -1e30, 1e30),
    "sequence_rows": Numbers(("rows", "row")),
}


def _slopes(before: Floats, after: Floats) -> Floats:
    """(m,) how where a variable lands depends on where all were, as far as jumps tell."""
    off = before - before.mean(0)
    squares = off.T @ off
    size = np.diag(squares)
    if len(after) < 3 or not size.any():
        return np.zeros(len(size))
    scale = np.sqrt(np.where(size > 0.0, size, 1.0))  # variables have units of their own
    held = squares / np.outer(scale, scale) + (_JUMP_PRIOR / len(after) + 1e-9) * np.eye(len(size))
    return np.asarray(np.linalg.solve(held, off.T @ (after - after.mean()) / scale) / scale)


def _range(
    low: ArrayLike | None, high: ArrayLike | None, *, is_none: bool
) -> tuple[Floats, Floats]:
    """The ends of the range of actions, (d,) each; empty where there is to be none."""
    if is_none != (low is None) or (low is None) != (high is None):
        raise ValueError("give either low and high, or n_actions")
    if low is None or high is None:
        return np.zeros(0), np.zeros(0)
    ends = [real_array(name, np.atleast_1d(end), 1) for name, end in (("low", low), ("high", high))]
    for name, end in zip(("low", "high"), ends, strict=True):
        refuse_unusable(name, end)
    if ends[0].shape != ends[1].shape or not (ends[0] < ends[1]).all():
        raise ValueError(f"low is {low} and high is {high}; low must be below high")
    return ends[0], ends[1]
