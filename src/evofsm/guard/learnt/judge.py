"""What decides: an action passes if after it some backup survives all that is remembered.

A predictive safety filter (Wabersich & Zeilinger, "A predictive safety filter for learning-based
control of constrained nonlinear dynamical systems", Automatica 2021), with model, disturbances and
backup policies learnt online. The guard feeds it: each observation, what was executed, and whether
the episode failed.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from evofsm import store
from evofsm.fsm.naming import Labels
from evofsm.fsm.proportions import poisson_bounds
from evofsm.fsm.sharing import Rollback
from evofsm.fsm.validation import action_name, positive
from evofsm.guard.actions import Mask
from evofsm.guard.api import ActionJudge, Fallback, Judgement, Search, Situation
from evofsm.guard.harm import OUTCOMES, SETTINGS, Harm
from evofsm.guard.learnt import library, regions, words
from evofsm.guard.learnt.dead_ends import LAST, distances_to, which_refuses
from evofsm.guard.learnt.dynamics import ARRAYS, DYNAMICS_PARTS, Dynamics, Episode
from evofsm.guard.learnt.library import Backups, Parts, Violations
from evofsm.guard.learnt.replay import CUT_SHORT, KEPT, Disturbances, Floats, Ints, pairs, search
from evofsm.guard.learnt.words import Remembered
from evofsm.store import COUNT, FROM_1, SHARE, SIZE, Kind, Numbers, Place

#: Parts that can be left out, to see what each is worth.
JUDGE_PARTS: tuple[str, ...] = ("margin", "backups", "dead-ends", *DYNAMICS_PARTS)

# Disturbances that are remembered.
_REMEMBERED = 10
# Backups that are asked in a decision, and of many variables; disturbances that mutants are tried
# on, besides none.
_ASKED, _ASKED_OF_MANY, _TRIED_ON = 3, 2, 5
# Products in the replays of a search, after which it is cut short: at most, and in a second.
_WORK, _WORK_RATE = 7e6, 8.75e8
# The margin [ordinary changes]: at first, at most, what is left of it an episode later, and what a
# violated certificate adds, which is also the least, for so many that may be.
_MARGIN, _LARGEST, _FADES, _ADDED, _RATE = 3.0, 8.0, 0.9, 0.25, 0.001
# The least margin where sensors are noisy: one is not quite where one seems to be.
_NOISY = 1.5
# Disturbances are taken to be harder than they were by so many over the number of episodes; by so
# much at most after a change: a change half as large again as any there was has no sequel.
_CAUTION, _AGAIN = 4.0, 0.44
# Steps that are looked ahead: at first, at least, at most; times those that it takes to fail, of
# which so much is left an episode later, and after one in which a dead end was none.
_HORIZON, _SHORTEST, _FARTHEST, _AHEAD = 64, 32, 144, 1.5
_LATEST, _REFUTED = 0.98, 0.8
# Backups closer than this are alike; an action that was used less often is tried.
_ALIKE, _TRIES = 0.02, 8
# No horizon that is given has more steps: memory and the time of a decision grow with it.
_MOST_STEPS = 10_000
# From so many situations on backups evolve, and disturbances are looked for.
_ENOUGH = 3
# What a backup says to an action that is not allowed.
_NEVER = -1e300
# What comes instead of the next part of a study that has none.
_OVER = object()


class LearntRisk(ActionJudge):
    """Judges actions by what it has learnt of how the system moves and fails.

    It is told neither what variables mean nor how they move. Before the first failure of an episode
    there is nothing that it could prevent, and all is kept; in the first episode also where failure
    was given as a function.

    It learns of at most 64 variables, fewer where actions have more than 25 numbers, and expects
    products of two up to 12 variables, of actions with variables up to 80 such products.

    Parameters
    ----------
    dt : float
        Time between two decisions [s].
    low, high : float or (d,) array_like, optional
        Range of the action, or of each of its components.
    n_actions : int, optional
        Number of actions, where an action is an index from 0.
    horizon : float, optional
        How far it looks ahead [s]. Without it, half as far again as it takes to fail where failure
        can no longer be avoided, from 32 to 144 steps.
    seed : int
        Of the draws with which backups evolve and situations are chosen.
    without : sequence of str
        Parts of `JUDGE_PARTS` that are left out.
    names, units : sequence of str
        Of the variables, for what people read; nothing is decided by them.

    Raises
    ------
    ValueError
        If ``dt`` is not positive and finite, ``without`` names no part, or not one of a range and
        ``n_actions`` is given.

    Notes
    -----
    A search is cut short after as many steps of replays as take a tenth of the interval, of three
    at least; its reason says so. They are counted, not timed: it comes out the same again.

    The risk of an action is the probability that within the horizon something begins that no
    backup survives after it: ``1 - exp(-unsurvived / exposure * horizon)``, from the number of
    remembered disturbances that are not survived and the time in which they were seen; 1 where not
    even an undisturbed future is survived. Its 90 % interval is that of a Poisson count (Garwood
    1936); it ends at 1 where all disturbances that it may remember are unsurvived, as those that it
    forgot may be, too. It speaks of what was seen: what never began is not in it.

    The margin follows adaptive conformal inference (Gibbs & Candes 2021): each violated certificate
    (a step ago some backup survived all, now none does even without a margin) adds to it, and it
    fades else.

    Examples
    --------
    >>> from evofsm.guard import Guard
    >>> guard = Guard(low=-2.0, high=2.0, interval=0.02)
    >>> guard.judge
    LearntRisk(dt=0.02, seed=0)
    """

    # Of the present episode.
    _at: Floats | None  # the situation in which one was last, by all that was seen
    _action: Floats  # what was done there
    _sought: tuple[Any, ...]  # an observation that was asked of, from where, and what it came to
    _certified: bool  # whether at the decision before some backup survived all
    _was_certified: bool  # and at any before
    _holds: bool  # and at this one
    _violated: bool  # whether a certificate was violated
    _refused: bool  # whether the latest proposal was
    _dead_end: bool  # whether nothing helped, even without any disturbance
    # of each observation that is to be studied both, and whether there it was certified
    _notes: list[tuple[bool, bool, bool]]
    _fails_after: float  # steps after which what was refused fails, at the latest
    _unsurvived: int
    _asked: int  # number of backups under which it is judged
    _ranks: Ints  # of backups, those first that passed last

    def __init__(
        self,
        dt: float,
        low: ArrayLike | None = None,
        high: ArrayLike | None = None,
        *,
        n_actions: int | None = None,
        horizon: float | None = None,
        seed: int = 0,
        without: Sequence[str] = (),
        names: Sequence[str] = (),
        units: Sequence[str] = (),
    ) -> None:
        self.dt = positive("dt", dt)
        self.given_horizon = None if horizon is None else positive("horizon", horizon)
        #: Steps that it looks ahead.
        self.horizon = _HORIZON if horizon is None else max(1, round(horizon / self.dt))
        if self.horizon > _MOST_STEPS:
            raise ValueError(
                f"horizon is {horizon:g} s, {self.horizon:,} decisions of {dt:g} s; a learnt judge "
                f"looks at most {_MOST_STEPS:,} ahead (is it in seconds?)"
            )
        self.seed = operator.index(seed)
        if unknown := set(without) - set(JUDGE_PARTS):
            raise ValueError(f"without names {sorted(unknown)}; there are {', '.join(JUDGE_PARTS)}")
        self.without = frozenset(without)
        self.labels = Labels(names=tuple(names), units=tuple(units), dt=self.dt)
        #: What it has learnt of how the system moves.
        self.dynamics = Dynamics(
            low,
            high,
            n_actions=n_actions,
            horizon=_FARTHEST if horizon is None else self.horizon,
            remembered=_REMEMBERED,
            without=without,
        )
        #: Whether it may try actions to learn what they do.
        self.learning = True
        #: What has to be left of the distance to failure [ordinary changes]; for each of them
        #: backups leave 1 % of half the range of actions unused.
        self.margin = 0.0 if "margin" in self.without else _MARGIN
        #: Certificates that were violated, and whether more are than used to be.
        self.n_violated, self.violations = 0, Violations()
        self.n_studied = self.n_scanned = 0
        self.n_failed = 0  #: episodes that it was told of that failed
        self.harm = Harm()  #: how episodes ended, guarded and alone
        #: Steps that it takes to fail at the latest, where that cannot be avoided.
        self.time_to_failure = _HORIZON / _AHEAD
        #: Steps in which a dead end is believed to fail, at most: the model was refuted beyond.
        self.believed = float(_FARTHEST)
        #: (s, 2m + a) situations on which backups and disturbances are tried: some anywhere, some
        #: tight.
        self.situations = np.empty((0, 0))
        self.backups: Backups | None = None
        self.disturbances: Disturbances | None = None
        # Of the study of an episode that goes on the rest; what it began with, and calls since.
        self._rest: Iterator[None] | None = None
        self._since: tuple[Rollback, list[Callable[[], Any]]] | None = None
        self._forget()

    @property
    def fallback(self) -> Fallback:
        """What is done without a usable proposal, and then revised like any."""
        if self.dynamics.choices:
            return Fallback(0.0, "the first action")
        middle = self.dynamics.decode(np.zeros(self.dynamics.size))
        return Fallback(middle if len(middle) > 1 else float(middle[0]), "the middle of the range")

    def refuse_unfit(self, low: Any, high: Any) -> None:
        """Raise for another range of actions than it learns of."""
        learnt = self.dynamics
        own = (0, learnt.choices - 1) if learnt.choices else (learnt.low, learnt.high)
        if not all(map(np.array_equal, map(np.atleast_1d, own), map(np.atleast_1d, (low, high)))):
            raise ValueError(
                f"the judge was made for actions from {own[0]} to {own[1]}, not from {low} to "
                f"{high}: give it low and high, or n_actions, of the guard"
            )

    # -- Deciding -------------------------------------------------------------------------------

    @property
    def disturbance_scale(self) -> float:
        """How much harder than they were disturbances are taken to be, while little was seen."""
        began_anew = self.violations.worse >= 0 or self.dynamics.drifts
        most = _AGAIN if began_anew else 0.5 * _CAUTION
        return 1.0 + min(most, _CAUTION / max(1, self.n_scanned))

    @property
    def remembered(self) -> Remembered:
        """Disturbances that it counts on, and the time in which they were seen."""
        dynamics = self.dynamics
        exposure = float(dynamics.sums.counts[0]) * self.dt if dynamics.n_variables else 0.0
        return Remembered(len(dynamics.sequences), exposure)

    @property
    def told_by_experience(self) -> str:
        """What was learnt so far, in words."""
        dynamics, called = self.dynamics, self._called
        if not dynamics.n_variables:
            return self._no_threshold
        fails = [(called[j], sign < 0.0, at) for j, sign, at in dynamics.thresholds]
        latest = {one.variable: one.since + 1 for one in dynamics.drifts}
        drifts = [(called[j], since) for j, since in latest.items()]
        noisy = [name for name, gain in zip(called, dynamics.gains, strict=True) if gain < 1.0]
        known = fails, self.remembered, self.margin, drifts, self.violations.worse + 1, noisy

        def places(found: Floats, seen: Floats, what: str = "failure") -> list[str]:
            inside = regions.inside(found, seen).sum(1).tolist()
            rows = zip(found.tolist(), inside, strict=True)
            return [words.region(called, row, count, what) for row, count in rows]

        failures = dynamics.failures
        there = places(dynamics.regions, failures)
        there += [f"if it ends {one}" for one in places(dynamics.crashes, failures)]
        over = places(dynamics.endings, dynamics.ended, "ending")
        only = [one.place for one in dynamics.sequences if one.place[0] >= 0]
        begin = [
            (called[j], sign < 0.0, [place[2] for place in only if place[:2] == (j, sign)])
            for j, sign in sorted({place[:2] for place in only})
        ]
        ends = dynamics.dead_ends.counts.astype(int).tolist()
        more = dynamics.differs, self._no_threshold, there, begin, ends, over
        told = words.experience(*known, *more)
        return told + words.harm(self.harm, learning=self.learning)

    def told_here(self, observation: Floats) -> tuple[str, Floats | None]:
        """What was learnt of an observation, in words, and the centre of the dead end it is near.

        Empty, and None, where it is in and near none, nor near a region of failures.
        """
        dynamics = self.dynamics
        if math.isnan(observation.dot(observation)) or not dynamics.n_variables:
            return "", None
        told, there = "", regions.distances(dynamics.regions, observation[None])[:, 0]
        if there.min(initial=np.inf) <= _LARGEST:
            k = int(there.argmin())
            count = int(regions.inside(dynamics.regions[[k]], dynamics.failures).sum())
            told = words.is_near_failure(self._called, dynamics.regions[k], count, float(there[k]))
        far, ends = distances_to(dynamics.model, observation), dynamics.dead_ends
        if far.min(initial=np.inf) > _LARGEST:
            return told, None
        k = int(far.argmin())
        near = words.is_near(int(ends.numbers[k]), int(ends.counts[k]), float(far[k]))
        return f"{told} {near}".lstrip(), ends.centres[k]

    @property
    def _called(self) -> Sequence[str]:
        """Names of variables, as people read them."""
        return self.labels.names or [f"variable {j + 1}" for j in range(self.dynamics.n_variables)]

    @property
    def _no_threshold(self) -> str:
        """Why nothing is refused."""
        dynamics = self.dynamics
        was_asked = bool(dynamics.n_variables) and dynamics.sums.counts[1] >= 1.0
        return words.no_threshold(self.n_failed, is_given=was_asked and dynamics.failed is not None)

    @property
    def effort(self) -> tuple[int, float]:
        """Backups that a search asks, and steps of replays after which it is cut short."""
        few = _ASKED if len(pairs(self.dynamics.n_variables)[0]) else _ASKED_OF_MANY
        count = 1 if self.disturbances is None else self.disturbances.residuals.shape[2]
        model = self.dynamics.model
        each = (model.weights.size + model.dead_ends.size) * count
        return few, max(min(_WORK, _WORK_RATE * self.dt) / each, few * self.horizon)

    def search(
        self,
        situation: Situation,
        wanted: Any,
        *,
        tolerance: float,
        revising: bool,
        mask: Mask | None = None,
    ) -> Search:
        """The closest action to ``wanted`` that passes, or else that of the longest-lasting backup.

        Of `Choices` it is one of ``mask``, and backups do what is in it: more may be allowed later,
        or less, which nobody knows.
        ``revising`` changes nothing: a band in which a proposal is refused longer gained nothing.
        """
        self._note(self.search, situation, wanted, tolerance=tolerance, revising=revising)
        dynamics, here, one = self.dynamics, self._here(situation.observation), np.array([wanted])
        self._sought = situation.observation, self._at, here
        disturbances, backups = self.disturbances, self.backups
        if disturbances is None or backups is None:
            return Search(one, _unjudged(1), 0, words.NOTHING_LEARNT)
        if here is None:
            return Search(one, _unjudged(1), 0, words.NOTHING_SEEN)
        if not dynamics.fails:
            return Search(one, _unjudged(1), 0, self._no_threshold)
        model = dynamics.daring if self.learning else dynamics.model
        if not len(model.thresholds) + len(model.regions) + len(model.crashes):
            return Search(one, _unjudged(1), 0, words.DOUBTED)
        proposal, scale = dynamics.encode(wanted), self.disturbance_scale
        few, most = self.effort
        remembered, ranks = self.remembered, self._ranks[:few]
        allowed = self._allowed(tolerance, remembered)
        policies = backups.policies
        if mask is not None:
            policies = policies.copy()
            policies[:, ~mask, 0] = _NEVER
        asked = model, here, policies, ranks, disturbances, scale
        how, action, which, left = search(*asked, proposal, self.margin, allowed, most)
        tried = None
        if which != ranks[0]:  # what passed now is asked first the next time
            self._ranks = np.append(which, self._ranks[self._ranks != which])
        passes, self._refused, cut = how < CUT_SHORT, how != KEPT, how == CUT_SHORT
        self._holds = passes
        if not passes:
            if self._certified and not cut:
                how = search(*asked, action, 0.0, allowed, most, lasting=False)[0]
                self._holds = how < CUT_SHORT
            self._certified &= how != CUT_SHORT  # whether one is violated is not known
            tried = self._untried(action, mask) if self.learning and left < _ALIKE else None
            action = action if tried is None else tried
        self._asked = 1 if most < 2 * few * self.horizon else few
        judged, self._dead_end, fails_after = self._judged(
            situation,
            here,
            policies,
            np.array((proposal, action) if self._refused else (proposal,)),
            left if passes and not allowed else None,
        )
        self._fails_after = max(self._fails_after, fails_after)
        backup = self._backup_text(which, policies)
        if not self._refused:
            return Search(one, judged, 0, words.kept(backup, remembered, left, allowed))
        why = words.refused(self._unsurvived, remembered, self.margin, scale, allowed)
        if not cut and len(model.dead_ends):
            k, after = which_refuses(*asked, proposal, self.margin, allowed)
            if k >= 0:
                ends = dynamics.dead_ends
                number, count = int(ends.numbers[k]), int(ends.counts[k])
                why = words.comes_near(self._backup_text(after, policies), number, count)
        if passes:
            instead = words.changed(backup, remembered, self.margin, allowed)
        else:
            instead = words.TRIED if tried is not None else words.lasting(backup, cut=cut)
        executed = np.reshape(dynamics.decode(action), np.shape(wanted))
        return Search(np.array((one[0], executed)), judged, 1, f"{why}; {instead}")

    def judge(self, situation: Situation, actions: ArrayLike) -> Judgement:
        """Risk of each action, (k,) or (k, d); NaN as long as nothing can be said."""
        given, here = np.asarray(actions, np.float64), self._here(situation.observation)
        if here is None or self.disturbances is None or not self.dynamics.fails:
            return _unjudged(len(given))
        assert self.backups is not None
        inner = np.array([self.dynamics.encode(one) for one in given])
        return self._judged(situation, here, self.backups.policies, inner)[0]

    def why(self, judged: Judgement) -> str:
        """Why the first action that was judged is dangerous, in a few words."""
        scale = self.disturbance_scale
        return words.refused(self._unsurvived, self.remembered, self.margin, scale)

    def _judged(
        self,
        situation: Situation,
        here: Floats,
        policies: Floats,
        actions: Floats,
        passes: float | None = None,
    ) -> tuple[Judgement, bool, float]:
        """Of some actions; ``passes`` is what is left after the last, if that is known to pass.

        And whether the last is lost for good, and after how many steps any of them fails at the
        latest.
        """
        asked = actions if passes is None else actions[:-1]
        best = policies[self._ranks[: self._asked]]
        each = [self._foresee(here, action[None], best) for action in asked]
        if passes is not None:
            each.append((0.0, passes, 0.0))
        unsurvived, left, after = zip(*each, strict=True)
        self._unsurvived = -1 if math.isinf(unsurvived[0]) else int(unsurvived[0])
        remembered = self.remembered
        soon = self._soon(remembered.seconds)
        risk, low, high = np.array([self._risk(one, soon) for one in unsurvived]).T
        judged = Judgement(
            risk, low, high, np.array(left), float(remembered.number), situation.seen
        )
        return judged, math.isinf(unsurvived[-1]), max(after)

    def _foresee(self, here: Floats, plan: Floats, policies: Floats) -> tuple[float, float, float]:
        """What comes of a situation and an action if the best of some backups follows.

        How many disturbances are not survived, infinite if it fails without any; the least distance
        to failure under the worst of them; and the steps after which it fails at the latest.
        """
        assert self.disturbances is not None
        model, steps = self.dynamics.model, self.disturbances.residuals.shape[0]
        ends = library.harm(model, here[None], policies, self.disturbances, 1.0, plan, 0.0)[:, 0]
        fails = ends[ends < 0.0]
        unsurvived = math.inf if ends[0] < 0.0 else float(len(fails))
        return unsurvived, float(ends.min()), float(fails.max(initial=-1.0 - steps)) + 1.0 + steps

    def _soon(self, exposure: float) -> float:
        """The horizon, as a share of the time in which all that is remembered was seen."""
        return self.horizon * self.dt / max(exposure, 1e-300)

    def _risk(self, unsurvived: float, soon: float) -> tuple[float, float, float]:
        """Probability, with its 90 % interval, that within the horizon something begins of those.

        Certain where nothing helps by the model, of which nobody knows how good it is. Where all
        that it may remember are not survived, it is not known how many more were forgotten.
        """
        if math.isinf(unsurvived):
            return 1.0, 0.0, 1.0
        low, high = poisson_bounds(int(unsurvived))
        high = high if unsurvived < self.dynamics.remembered else math.inf
        return -math.expm1(-unsurvived * soon), -math.expm1(-low * soon), -math.expm1(-high * soon)

    def _allowed(self, tolerance: float, remembered: Remembered) -> int:
        """How many of the disturbances need not be survived, by share and bound of the risk."""
        soon, most, allowed = self._soon(remembered.seconds), tolerance * remembered.number, 0
        while allowed + 1 <= most and self._risk(allowed + 1, soon)[2] <= tolerance:
            allowed += 1
        return allowed

    def _here(self, z: Floats) -> Floats | None:
        """The situation, if that is seen; what was not is taken to have gone on as before."""
        at, m, has_gaps = self._at, len(z), math.isnan(z.dot(z))
        if at is None:
            return None if has_gaps else np.append(z, np.zeros(m + self.dynamics.size))
        if has_gaps:
            z = np.where(np.isnan(z), at[:m] + at[m : 2 * m], z)
        z = self.dynamics.corrected(at, self._action, z)
        return np.concatenate([z, z - at[:m], self._action])

    def _untried(self, best: Floats, mask: Mask | None) -> Floats | None:
        """An action whose effect is hardly known, if there is one."""
        assert self.backups is not None
        used, order = self.dynamics.used, self.backups.actions  # of equals the first in that order
        if self.dynamics.choices:
            order = order if mask is None else order[mask[order]]
            i = int(order[used[order, 1].argmin()])
            if used[i, 1] < _TRIES and used[i, 1] < used[:, 1].max():
                return np.asarray(np.eye(len(used))[i])
            return None
        # The end that the controller seldom went to comes first.
        turned = np.where(self.backups.turns[:, None] > 0.0, used, used[:, ::-1])[order]
        k, end = divmod(int(turned.argmin()), 2)
        if turned[k, end] < _TRIES and turned[k, end] < turned[k, 1 - end]:
            best, i = best.copy(), order[k]
            best[i] = (-1.0, 1.0)[end] * self.backups.turns[i]
            return best
        return None

    def _backup_text(self, backup: int, policies: Floats | None = None) -> str:
        assert self.backups is not None
        policies = self.backups.policies if policies is None else policies
        if backup >= self.backups.n_constant:
            return f"feedback {backup - self.backups.n_constant + 1}"
        action = self.dynamics.decode(policies[backup, :, 0])
        if self.dynamics.choices:
            return f"always {action_name(int(action[0]))}"
        return words.constant(action.tolist())

    # -- Learning -------------------------------------------------------------------------------

    def _note(self, method: Callable[..., Any], *given: Any, **named: Any) -> None:
        """Note a call, to make it again where a study is taken back that goes on in it."""
        if self._since is not None:
            self._since[1].append(partial(method, *given, **named))

    def savepoint(self) -> Rollback:
        """What takes back all that it learns from now on."""
        dynamics = self.dynamics
        own, moves, noted = {**self.__dict__}, {**dynamics.__dict__}, len(self._notes)
        sums = [array.copy() for array in (dynamics.sums if dynamics.n_variables else ())]
        since, count = self._since, len(self._since[1]) if self._since else 0

        def rollback() -> None:
            self.__dict__, dynamics.__dict__ = {**own}, {**moves}
            del self._notes[noted:]
            for array, before in zip(moves["sums"] if sums else (), sums, strict=True):
                array[:] = before
            if since is not None:  # a study cannot go back: from its beginning once more
                since[0]()
                self._go_on(anew=True)
                for call in since[1][:count]:
                    call()

        return rollback

    def observe(self, observation: Floats) -> bool:
        """Learn the transition to an observation; whether something unexpected began with it.

        One of which something was not seen ends what can be learnt from.
        """
        self._note(self.observe, observation)
        dynamics = self.dynamics
        if dynamics.n_variables not in (0, len(observation)):
            raise ValueError(
                f"observation has {len(observation)} variables, but the judge learnt of "
                f"{dynamics.n_variables}"
            )
        has_gaps = math.isnan(observation.dot(observation))
        if has_gaps or not dynamics.has_acted:
            self._finish()
            dynamics.end(failed=False)
        return False if has_gaps else dynamics.observe(observation)

    def act(self, action: Any) -> None:
        """Take in what was executed after the latest observation; another one replaces it."""
        self._note(self.act, action)
        if self.dynamics.n_under_way:
            self.dynamics.act(self.dynamics.encode(action))

    def learn(self, observation: ArrayLike, action: Any, belief: ArrayLike) -> None:
        """Take in what was executed, and whether the certificate of before still held."""
        self._note(self.learn, observation, action, belief)
        if "margin" not in self.without and self.backups is not None:
            violated = self._certified and not self._holds
            self.n_violated += violated
            self._violated |= violated
            margin, least = self.margin + _ADDED * (violated - _RATE), _ADDED
            self.margin = min(_LARGEST, max(_NOISY if self.dynamics.is_noisy else least, margin))
        self._certified = self._holds
        self._was_certified |= self._holds
        self._take_in(observation, action)

    def watch(self, observation: ArrayLike, action: Any, belief: ArrayLike) -> None:
        """Take in what someone else does: then nothing was certified."""
        self._note(self.watch, observation, action, belief)
        self._certified = False
        self._take_in(observation, action)

    def _take_in(self, observation: ArrayLike, action: Any) -> None:
        self._keep_up(observation, action)
        self._notes.append((self._refused, self._dead_end, self._certified))
        # An episode that goes on may be long enough to study.
        self._go_on(anew=self.dynamics.n_episodes != self.n_studied)

    def follow(self, observation: ArrayLike, action: Any) -> None:
        """Keep up with what happens, without learning from it."""
        self._note(self.follow, observation, action)
        self._keep_up(observation, action)

    def _keep_up(self, observation: ArrayLike, action: Any) -> None:
        z, (seen, at, here) = np.asarray(observation, np.float64), self._sought
        if z is not seen or at is not self._at:
            here = self._here(z)
        if here is not None:
            self._at, self._action = here, self.dynamics.encode(action)

    def start_episode(self, *, learn: bool = True) -> None:
        """What comes is not a consequence of what was; the episode before is learnt from."""
        if learn:
            self.end(None, failed=False)
        else:
            self._finish()
            self.dynamics.forget_episode()
            self._forget()

    def end(self, observation: Floats | None, *, failed: bool, terminated: bool = False) -> None:
        """Learn from an episode; its last observation was taken in (`observe`)."""
        self.n_failed += int(failed)
        seen_whole = observation is None or not math.isnan(observation.dot(observation))
        self._finish()
        self.dynamics.end(failed=failed and seen_whole, terminated=terminated and seen_whole)
        if self.dynamics.n_episodes != self.n_studied:
            self._rest = self._study()
            self._finish()
        self._forget()

    def _forget(self) -> None:
        self._at, self._action, self._sought = None, np.zeros(0), (None, None, None)
        self._certified = self._was_certified = self._holds = self._violated = False
        self._refused = self._dead_end = False
        self._notes = []
        self._unsurvived, self._fails_after, self._asked = 0, 0.0, _ASKED
        self._ranks = np.zeros(0, int) if self.backups is None else self.backups.ranks

    def _go_on(self, *, anew: bool) -> None:
        """The next part of a study, or the first of another: no decision waits for more."""
        if anew:
            self._rest = self._since = None
            self._since = self.savepoint(), []
            self._rest = self._study()
        if self._rest is not None and next(self._rest, _OVER) is _OVER:
            self._rest = self._since = None
        if (over := len(self._notes) - self.dynamics.n_under_way) > 0:
            self._notes = self._notes[over:]

    def _finish(self) -> None:
        """The rest of a study: its episode is over."""
        for _ in self._rest or ():
            pass
        self._rest = self._since = None

    def __getstate__(self) -> dict[str, Any]:
        # A copy, as a file, has what was learnt so far.
        return {**self.__dict__, "_rest": None, "_since": None}

    def _study(self) -> Iterator[None]:
        """Learn from the latest episode: what to remember, and what to do about it."""
        dynamics = self.dynamics
        self.n_studied = dynamics.n_episodes
        if "margin" not in self.without:
            least = _NOISY if dynamics.is_noisy else _ADDED
            self.margin = max(least, _FADES * self.margin)
        moved = any(one.noticed == dynamics.n_episodes - 1 for one in dynamics.drifts)
        if moved or self._is_worse():
            self._begin_anew()
        episode = dynamics.latest
        if not dynamics.ready or (episode is None and self.disturbances is None):
            return
        random = np.random.default_rng([self.seed, dynamics.n_episodes])
        if self.backups is None:
            assert episode is not None
            self.backups = Backups.of(
                episode.observations,
                episode.actions,
                choices=bool(dynamics.choices),
                evolving="backups" not in self.without,
            )
        best = self.backups.policies[self.backups.ranks]
        if episode is not None:
            yield from self._study_whole(episode, best, random)
        elif self._scans:  # it was too short for more than to try again
            self.n_scanned += 1
        self.disturbances = yield from library.choose(
            dynamics, self.situations, self.horizon, best[:2], self.disturbance_scale
        )
        if dynamics.fails and len(self.situations) >= _ENOUGH:
            yield
            self.backups = yield from self.evolved(random)
        self._ranks = self.backups.ranks

    @property
    def _scans(self) -> bool:
        """Whether disturbances are looked for."""
        knows = self.dynamics.fails and len(self.situations) > _ENOUGH
        return knows and "stretches" not in self.dynamics.without

    def _study_whole(
        self, episode: Episode, best: Floats, random: np.random.Generator
    ) -> Iterator[None]:
        """What an episode of some length teaches; ``best`` are backups, in their order."""
        dynamics = self.dynamics
        # From where it went on for the horizon although nothing seemed to help.
        refuted = np.flatnonzero([dead_end for _, dead_end, _ in self._notes[: -self.horizon]])
        tight = [refused for refused, _, _ in self._notes]
        self.situations = library.noted(self.situations, episode, tight, self.horizon, random)
        dynamics.challenge(sum(tight))
        if "dead-ends" not in self.without and dynamics.fails:
            certified = [held for _, _, held in self._notes] if episode.failed else []
            unproven = self.horizon if episode.failed else 0 if episode.terminated else LAST
            given = episode.observations, certified, unproven, dynamics.model.inverse
            dynamics.dead_ends = dynamics.dead_ends.after(*given, dynamics.sums.unit)
            dynamics.rebuild()
        yield
        if self._scans:
            yield from library.scan(dynamics, self.situations, self.horizon, best[:1], random)
            self.n_scanned += 1
        yield
        dynamics.refute(refuted, self.horizon)
        yield
        if self.given_horizon is None and self.disturbances is not None and dynamics.fails:
            after = yield from library.failing_after(
                dynamics.model, self.situations, best[:_ASKED], self.disturbances
            )
            self._look_ahead(after, refuted=len(refuted) > 0, failed=episode.failed)
            yield

    def _is_worse(self) -> bool:
        """Whether disturbances got worse than those that are remembered."""
        before, violated, latest = self.violations, self._violated, self.dynamics.latest
        failed = violated and latest is not None and latest.failed
        self.violations = before.after(self.n_studied - 1, violated=violated, failed=failed)
        self._violated = False
        return self.violations.worse != before.worse

    def _begin_anew(self) -> None:
        """How far model and memory are to be trusted is not known yet.

        Disturbances are taken to be harder again than they were, and it may take longer to fail.
        """
        self.violations = Violations(worse=self.violations.worse)
        longer = _AHEAD * max(self.time_to_failure, _HORIZON / _AHEAD)
        self.time_to_failure = min(longer, _FARTHEST / _AHEAD)
        self.believed = float(_FARTHEST)
        self.n_scanned = 0
        if "margin" not in self.without:
            self.margin = max(self.margin, _MARGIN)

    def _look_ahead(self, after: int, *, refuted: bool, failed: bool) -> None:
        """As far as it takes to fail where nothing helps, and half as far again.

        That is ``after`` so many steps in the latest replays. Half as far again, too, after an
        episode that failed although it was certified not to; less far after one that went on for
        the whole horizon from where nothing seemed to help. What the model says of dead ends
        farther away than that is believed again little by little.
        """
        if not failed and refuted:  # it sees less far than it looks
            self.time_to_failure *= _REFUTED
            self.believed = max(self.time_to_failure, _SHORTEST / _AHEAD)
        else:
            self.believed = min(self.believed / _LATEST, float(_FARTHEST))
            longest = max(_LATEST * self.time_to_failure, min(self._fails_after, self.believed))
            if failed and self._was_certified:  # it did not look far enough
                longest = min(_AHEAD * longest, _FARTHEST / _AHEAD)
                self.believed = max(self.believed, longest)
            self.time_to_failure = max(min(float(after), self.believed), longest)
        each = self.dynamics.model.weights.size * (1 + self.dynamics.remembered)
        farthest = min(_FARTHEST, _WORK / each / _ASKED)  # less where a replay costs more
        self.horizon = int(max(min(_AHEAD * self.time_to_failure, farthest), _SHORTEST))

    def evolved(self, random: np.random.Generator) -> Parts[Backups]:
        """Backups that are worth more in the situations that are kept."""
        disturbances, backups = self.disturbances, self.backups
        assert disturbances is not None
        assert backups is not None
        count = disturbances.residuals.shape[2]
        if count > 1 + _TRIED_ON:
            some = 1 + random.permutation(count - 1)[:_TRIED_ON]
            disturbances = disturbances.of(np.append(0, some))
        scale, model = self.disturbance_scale, self.dynamics.model
        return backups.evolved(model, self.situations, disturbances, scale, random)

    # -- In a file ------------------------------------------------------------------------------

    def sums(self, n_states: int) -> dict[str, float]:
        """A few sums that whatever is learnt changes."""
        backups, disturbances = self.backups, self.disturbances
        return {
            "margin": self.margin,
            "violated": float(self.n_violated),
            "backups": 0.0 if backups is None else float(backups.policies.sum()),
            "disturbances": 0.0 if disturbances is None else float(disturbances.residuals.sum()),
            "harm": self.harm.kept + self.harm.n_episodes,
        }

    def save(self, path: Place, provenance: Mapping[str, Any] | None = None) -> None:
        """Write what was learnt to a file, with what it learnt from, for people (`provenance`)."""
        dynamics, own, backups = self.dynamics, self.__dict__, self.backups
        settings = {
            **{name: own[name] for name in ("dt", "seed", "given_horizon", *_NUMBERS)},
            **{name: getattr(dynamics, name).tolist() for name in ("low", "high")},
            **{name: list(getattr(self.labels, name)) for name in ("names", "units")},
            "n_actions": dynamics.choices or None,
            "without": sorted(self.without),
            "violations": self.violations._asdict(),
            "harm": {name: getattr(self.harm, name) for name in SETTINGS},
            "dynamics": dynamics.numbers(),
            "n_constant": 0 if backups is None else backups.n_constant,
        }
        arrays = {"situations": self.situations, **dynamics.arrays()}
        arrays["harm"] = self.harm.rows
        sizes = {"b": 0, "a": dynamics.size, "m": dynamics.n_variables}
        sizes["f"] = 1 + dynamics.n_variables
        for name, shape in _BACKUPS.items():
            nothing = np.zeros([sizes[letter] for letter in shape])
            array = nothing if backups is None else getattr(backups, name)
            arrays[f"backups_{name}"] = array.astype(np.float64)
        store.write(path, KIND, settings, arrays, provenance)

    @classmethod
    def load(cls, path: Place) -> Self:
        """Read what was learnt, between two episodes; a ValueError if the file is damaged."""
        settings, arrays = store.read(path, KIND)
        with store.explained(path):
            return cls._restored(settings, arrays)

    @classmethod
    def _restored(cls, settings: dict[str, Any], arrays: dict[str, NDArray[Any]]) -> Self:
        """Of settings and arrays that were read, and hold to `KIND`."""
        given = {
            name: settings[name] for name in ("n_actions", "seed", "without", "names", "units")
        }
        if given["n_actions"] is None:
            given |= {"low": settings["low"], "high": settings["high"]}
        judge = cls(settings["dt"], horizon=settings["given_horizon"], **given)
        judge.dynamics.restore(settings["dynamics"], arrays)
        for name in _NUMBERS:
            setattr(judge, name, settings[name])
        judge.violations = Violations(**settings["violations"])
        judge.harm = Harm.restored(settings["harm"], arrays["harm"])
        m, a = judge.dynamics.n_variables, judge.dynamics.size
        judge.situations = arrays["situations"]
        if len(judge.situations) and judge.situations.shape[1] != 2 * m + a:
            raise ValueError(f"situations are not of {m} variables and actions of {a} numbers")
        if len(arrays["backups_policies"]):
            found = {name: arrays[f"backups_{name}"] for name in _BACKUPS}
            judge.backups = Backups.restored(int(settings["n_constant"]), m, a, found)
            judge.disturbances = judge.dynamics.disturbances(judge.horizon)
        judge._forget()
        return judge

    def __repr__(self) -> str:
        return f"{type(self).__name__}(dt={self.dt:g}, seed={self.seed})"


# Numbers that it goes on with, and the arrays of backups: each action has features of its own.
_TIMES = ("margin", "time_to_failure", "believed")
_COUNTS = ("n_violated", "n_failed", "n_studied", "n_scanned")
_NUMBERS = (*_TIMES, *_COUNTS, "horizon")
_BACKUPS: dict[str, tuple[str, ...]] = {
    "policies": ("b", "a", "f"),
    "scores": ("b",),
    "variables": ("m",),
    "flips": ("m",),
    "actions": ("a",),
    "turns": ("a",),
}
_TIME, _SOME = Numbers(least=0.0, most=1e6), Numbers(least=-math.inf, most=math.inf)
_ENDS = Numbers(("ends",), -1e100, 1e100)
KIND = Kind(
    "learntrisk",
    {
        "situations": Numbers(("s", "w")),
        **{f"backups_{name}": _SOME.of(*shape) for name, shape in _BACKUPS.items()},
        "backups_policies": Numbers(_BACKUPS["policies"]),
        "harm": OUTCOMES,
        **ARRAYS,
    },
    {
        "dt": SIZE,
        "given_horizon": SIZE._replace(optional=True),
        "n_actions": FROM_1._replace(optional=True),
        **dict.fromkeys(("low", "high"), _ENDS),
        **dict.fromkeys(_TIMES, _TIME),
        **dict.fromkeys(("seed", *_COUNTS, "n_constant"), COUNT),
        "horizon": FROM_1._replace(most=_MOST_STEPS),
        **dict.fromkeys(("names", "units", "without"), list[str]),
        "violations": {
            "share": SHARE,
            "doubt": _TIME,
            "since": COUNT,
            "worse": COUNT._replace(least=-1.0),
        },
        "harm": SETTINGS,
        "dynamics": {
            **dict.fromkeys(("n_episodes", "quiet"), COUNT),
            "held": COUNT._replace(least=-1.0),
            "differs": SHARE,
            "doubt_of_lags": Numbers(least=0.0),
            "ready": bool,
            "dead_ends": COUNT,
        },
    },
)


def _unjudged(count: int) -> Judgement:
    nothing = np.full(count, math.nan)
    return Judgement(nothing, nothing, nothing, nothing, 0.0)
