"""The learnt judge: told nothing but which episodes failed, it judges by replays of what may begin.

An action passes if after it some backup policy survives everything that is remembered, whichever of
it begins now, by a margin. What failure is, how the system moves, what disturbs it and for how long
is all learnt by the machine (`evofsm.fsm.Dynamics`); backups, margin and the situations on which
they are tried are learnt here.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from evofsm import store
from evofsm.fsm import (
    Disturbances,
    Dynamics,
    Here,
    Labels,
    action_name,
    from_bytes,
    poisson_bounds,
    positive,
    refuse_unusable,
    to_bytes,
)
from evofsm.fsm.dynamics.dynamics import DYNAMICS_PARTS
from evofsm.guard.learnt import words
from evofsm.guard.learnt.backups import Backups
from evofsm.guard.learnt.breaks import Breaks
from evofsm.guard.learnt.keeping import KIND, NUMBERS, Kept, arrays_of, restored
from evofsm.guard.learnt.remembering import Situations, choose, failing_after
from evofsm.guard.learnt.search import CHANGED, KEPT, NOTHING_PASSES, outcomes, search, worth
from evofsm.guard.learnt.words import Remembered
from evofsm.guard.protocols import Fallback, Judgement, Search, Situation, Trial
from evofsm.guard.senses import has_gaps
from evofsm.store import Place

_Floats = NDArray[np.float64]

#: Parts that can be left out, to see what each is worth.
JUDGE_PARTS = ("margin", "backups", "breaks", *DYNAMICS_PARTS)

# Backups that are asked in a decision, and disturbances that mutants are tried on, beside none.
_ASKED, _TRIED_ON = 3, 5
# The margin [ordinary changes]: at first, at most, what is left of it an episode later, and what a
# broken certificate adds, which is also the least, for so many that may be.
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
# Disturbances that are remembered.
_REMEMBERED = 10
# Backups closer than this are alike; an action that was used less often is tried.
_ALIKE, _TRIES = 0.02, 8


class Outlook(NamedTuple):
    """How it stands somewhere, if the best backup is followed from now on."""

    dead_end: bool  #: no known backup survives it, even if nothing disturbs it
    lost: int  #: remembered disturbances that no backup survives
    remembered: int  #: disturbances that were tried
    margin: float  #: escape margin: distance to failure under the worst of them [ordinary changes]
    #: probability, with its 90 % interval, that within the horizon one begins that is lost
    risk: tuple[float, float, float]
    #: how often such begin [1/h], with its 90 % interval; its end is infinite where all that it
    #: may remember are lost, as it is not known what was forgotten
    per_hour: tuple[float, float, float]


class LearntRisk:
    """Judges actions by what it has learnt of how the system moves and fails.

    It is told neither what variables mean nor how they move. Before the first failure of an episode
    there is nothing that it could prevent, and all is kept; in the first episode also where failure
    was told as a function.

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
    The risk of an action is the probability that within the horizon something begins that no
    backup survives after it: ``1 - exp(-lost / exposure * horizon)``, from the number of remembered
    disturbances that are lost and the time in which they were seen; 1 where not even an
    undisturbed future is survived. Its 90 % interval is that of a Poisson count (Garwood 1936); it
    ends at 1 where all disturbances that it may remember are lost, as those that it forgot may be
    lost too. It speaks of what was seen: what never began is not in it.

    A predictive safety filter as of Wabersich & Zeilinger (Automatica 2021), with model,
    disturbances and backups learnt online. The margin follows adaptive conformal inference (Gibbs
    & Candes 2021): each broken certificate (a step ago some backup survived all, now none does even
    without a margin) adds to it, and it fades else.

    Examples
    --------
    >>> from evofsm.guard import Guard
    >>> guard = Guard(low=-2.0, high=2.0, interval=0.02)
    >>> guard.judge
    LearntRisk(dt=0.02, seed=0)
    """

    # Of the present episode.
    _at: Here | None  # where one was last, by all that was seen
    _action: _Floats  # what was done there
    _certified: bool  # whether at the decision before some backup survived all
    _was_certified: bool  # and at any before
    _holds: bool  # and at this one
    _broke: bool  # whether a certificate was broken
    _tight: bool  # whether the latest proposal was refused
    _tights: list[bool]
    _dead_end: bool  # whether nothing helped, even without any disturbance
    _dead_ends: list[bool]
    _took: float  # steps after which what was refused fails, at the latest
    _lost: int
    _ranks: NDArray[np.int64]  # of backups, those first that passed last

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
        self.told_horizon = None if horizon is None else positive("horizon", horizon)
        #: Steps that it looks ahead.
        self.horizon = _HORIZON if horizon is None else max(1, round(horizon / self.dt))
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
            stretches=_REMEMBERED,
            without=[part for part in DYNAMICS_PARTS if part in self.without],
        )
        #: What is done without a usable proposal, and then revised like any.
        self.fallback = _fallback(self.dynamics)
        #: Whether it may try actions to learn what they do.
        self.learning = True
        #: What has to be left of the distance to failure [ordinary changes]; for each of them
        #: backups leave 1 % of half the range of actions unused.
        self.margin = 0.0 if "margin" in self.without else _MARGIN
        #: Certificates that were broken.
        self.broken = 0
        #: Whether they break more often than they used to.
        self.breaks = Breaks()
        self.n_studied = 0
        self.n_scanned = 0
        #: Steps that it takes to fail at the latest, where that cannot be avoided.
        self.takes = _HORIZON / _AHEAD
        #: Steps in which a dead end is believed to fail, at most: the model was refuted beyond.
        self.believed = float(_FARTHEST)
        self.situations = Situations()
        self.backups: Backups | None = None
        self.disturbances: Disturbances | None = None
        self._forget()

    def trial(self) -> Trial | None:
        """None: what it has to try, its search tries."""
        return None

    def effective(self, situation: Situation, actions: NDArray[np.float64]) -> NDArray[np.float64]:
        """All actions as they are."""
        return actions

    def refuse_unfit(self, low: Any, high: Any) -> None:
        """Raise for another range of actions than it learns of."""
        dynamics = self.dynamics
        own = (0, dynamics.choices - 1) if dynamics.choices else (dynamics.low, dynamics.high)
        if not all(map(np.array_equal, map(np.atleast_1d, own), map(np.atleast_1d, (low, high)))):
            raise ValueError(
                f"the judge was made for actions from {own[0]} to {own[1]}, not from {low} to "
                f"{high}: give it low and high, or n_actions, of the guard"
            )

    # -- Deciding -------------------------------------------------------------------------------

    @property
    def harder(self) -> float:
        """How much harder than they were disturbances are taken to be, while little was seen."""
        most = _AGAIN if self._began_anew else 0.5 * _CAUTION
        return 1.0 + min(most, _CAUTION / max(1, self.n_scanned))

    @property
    def exposure(self) -> float:
        """Time in which all that is remembered was seen [s]."""
        dynamics = self.dynamics
        return float(dynamics.sums.counts[0]) * self.dt if dynamics.n_variables else 0.0

    @property
    def remembered(self) -> Remembered:
        """Disturbances that it counts on, and the time in which they were seen."""
        return Remembered(len(self.dynamics.stretches), self.exposure)

    @property
    def told_by_experience(self) -> str:
        """What was learnt so far, in words."""
        dynamics, names = self.dynamics, self.labels.names
        if not dynamics.n_variables:
            return words.experience((), self.remembered, self.margin)

        def called(j: float) -> str:
            return names[int(j)] if names else f"variable {int(j) + 1}"

        fails = [(called(j), sign < 0.0, at) for j, sign, at, _ in dynamics.consequents.sides]
        latest = {one.variable: one.since + 1 for one in dynamics.drifts}
        drifts = [(called(j), since) for j, since in latest.items()]
        noisy = [called(j) for j, gain in enumerate(dynamics.consequents.gains) if gain < 1.0]
        return words.experience(
            fails, self.remembered, self.margin, drifts, self.breaks.worse + 1, noisy
        )

    def search(
        self, situation: Situation, wanted: Any, *, tolerance: float, revising: bool
    ) -> Search:
        """The closest action to ``wanted`` that passes, or else that of the longest-lasting backup.

        Parameters
        ----------
        situation : Situation
        wanted : float or (d,) array
        tolerance : float
            Share of the disturbances that need not be survived, where so much was seen that the
            upper bound of the risk is within it as well.
        revising : bool
            Not used: a band in which a proposal is refused longer was tried, and gained nothing.

        Returns
        -------
        Search
        """
        dynamics, here = self.dynamics, self._here(situation.observation)
        one = np.array([wanted])
        if self.disturbances is None or self.backups is None:
            return Search(one, _unjudged(1), 0, words.NOTHING_LEARNT)
        if here is None:
            return Search(one, _unjudged(1), 0, words.NOTHING_SEEN)
        known = dynamics.consequents
        if not len(known.sides):
            return Search(one, _unjudged(1), 0, words.NO_FAILURE)
        proposal, best = dynamics.encode(wanted), np.empty(dynamics.size)
        remembered, harder = self.remembered, self.harder
        allowed = self._allowed(tolerance, remembered)
        asked = self._ranks[:_ASKED]
        world = (self.backups.policies, asked, self.disturbances, harder)
        how, backup, left = search(known, here, proposal, *world, self.margin, allowed, best)
        if backup != asked[0]:  # what passed now is asked first the next time
            self._ranks = np.array([backup, *(q for q in self._ranks if q != backup)])
        self._tight = how != KEPT
        tried = (
            self._untried(best)
            if self.learning and how == NOTHING_PASSES and left < _ALIKE
            else None
        )
        self._holds = how != NOTHING_PASSES
        if not self._holds and self._certified:
            again = search(known, here, best, *world, 0.0, allowed, np.empty_like(best))
            self._holds = again[0] != NOTHING_PASSES
        then = self._backup_text(backup)
        if tried is not None:
            best = tried
        judged, self._dead_end, took = self._judged(
            situation,
            here,
            proposal[None] if how == KEPT else np.array((proposal, best)),
            None if how == NOTHING_PASSES or allowed else left,
        )
        self._took = max(self._took, took)
        if how == KEPT:
            return Search(one, judged, 0, words.kept(then, remembered, left, allowed))
        action = np.reshape(dynamics.decode(best), np.shape(wanted))
        if tried is not None:
            instead = words.tried()
        elif how == CHANGED:
            instead = words.changed(then, remembered, self.margin, allowed)
        else:
            instead = words.lasting(then)
        why = words.refused(self._lost, remembered, self.margin, harder, allowed)
        return Search(np.array((one[0], action)), judged, 1, f"{why}; {instead}")

    def judge(self, situation: Situation, actions: ArrayLike) -> Judgement:
        """Risk of each action.

        Parameters
        ----------
        situation : Situation
        actions : (k,) or (k, d) array_like

        Returns
        -------
        Judgement
            NaN as long as nothing can be said.
        """
        given, here = np.asarray(actions, np.float64), self._here(situation.observation)
        if here is None or self.disturbances is None or not self._fails:
            return _unjudged(len(given))
        inner = np.array([self.dynamics.encode(one) for one in given])
        return self._judged(situation, here, inner)[0]

    def assess(self, observation: ArrayLike, change: ArrayLike | None = None) -> Outlook:
        """How it stands somewhere if the best backup is followed from now on.

        Parameters
        ----------
        observation : (m,) array_like
        change : (m,) array_like, optional
            Since the observation before; without it nothing moved.

        Returns
        -------
        Outlook

        Raises
        ------
        ValueError
            If no failure is known yet, or an array is of another length than observations, or
            holds NaN or infinity.

        Examples
        --------
        A point that coasts to a wall at 1, and may push back in time:

        >>> from evofsm.guard import Guard
        >>> guard = Guard(low=-1.0, high=1.0, interval=0.1)
        >>> for episode in range(8):
        ...     x, v = -1.0, 0.0
        ...     for t in range(60):
        ...         u = guard.decide([x, v], proposal=1.0).executed
        ...         x, v = x + 0.1 * v, v + 0.1 * u
        ...         if x >= 1.0:
        ...             break
        ...     guard.end(failed=x >= 1.0, observation=[x, v])
        >>> guard.judge.assess([-1.0, 0.0]).dead_end, guard.judge.assess([0.7, 2.0]).dead_end
        (False, True)
        """
        dynamics = self.dynamics
        if self.disturbances is None or self.backups is None or not self._fails:
            raise ValueError("no failure is known yet: there is nothing to judge by")
        z = np.asarray(observation, np.float64)
        moved = np.zeros_like(z) if change is None else np.asarray(change, np.float64)
        if not z.shape == moved.shape == (dynamics.n_variables,):
            raise ValueError(
                f"observation and change have shapes {z.shape} and {moved.shape}; both must be "
                f"({dynamics.n_variables},)"
            )
        refuse_unusable("observation", z)
        refuse_unusable("change", moved)
        here = Here(z, moved, np.zeros(dynamics.size))
        found = np.empty((3, 1))
        self._foresee(here, np.empty((1, 0)), self.backups.ranks, found)
        lost, left, _ = found[:, 0].tolist()
        dead_end, hours = math.isinf(lost), self.exposure / 3600.0
        count = len(self.disturbances.residuals) - 1 if dead_end else int(lost)
        expected = self._expected(count)
        return Outlook(
            dead_end=dead_end,
            lost=count,
            remembered=self.remembered.number,
            margin=left,
            risk=self._risk(lost, self._soon(self.exposure)),
            per_hour=(expected[0] / hours, expected[1] / hours, expected[2] / hours),
        )

    @property
    def _fails(self) -> bool:
        return self.dynamics.n_variables > 0 and len(self.dynamics.consequents.sides) > 0

    def why(self, judged: Judgement) -> str:
        """Why the first action that was judged is dangerous, in a few words."""
        return words.refused(self._lost, self.remembered, self.margin, self.harder)

    def _judged(
        self, situation: Situation, here: Here, actions: _Floats, passes: float | None = None
    ) -> tuple[Judgement, bool, float]:
        """Of some actions; ``passes`` is what is left after the last, if that is known to pass.

        And whether the last is lost for good, and after how many steps any of them fails at the
        latest.
        """
        found = np.zeros((3, len(actions)))
        asked = actions if passes is None else actions[:-1]
        if len(asked):
            self._foresee(here, asked, self._ranks[:_ASKED], found)
        lost, left, took = found
        if passes is not None:
            left[-1] = passes
        self._lost = -1 if math.isinf(lost[0]) else int(lost[0])
        judged = self._judgement(lost, left, situation)
        return judged, math.isinf(lost[-1]), float(took.max())

    def _foresee(self, here: Here, actions: _Floats, ranks: NDArray[np.int64], to: _Floats) -> None:
        """What comes of actions, as `outcomes` has it."""
        assert self.disturbances is not None
        assert self.backups is not None
        known, policies = self.dynamics.consequents, self.backups.policies
        outcomes(known, here, actions, policies, ranks, self.disturbances, to)

    def _soon(self, exposure: float) -> float:
        """The horizon, as a share of the time in which all that is remembered was seen."""
        return self.horizon * self.dt / max(exposure, 1e-300)

    def _expected(self, lost: int) -> tuple[float, float, float]:
        """Disturbances that are lost, of all in the time observed, with their 90 % interval.

        Where all that it may remember are lost, those that it forgot may be lost too, and it is not
        known how many they were.
        """
        low, high = poisson_bounds(lost)
        return float(lost), low, high if lost < self.dynamics.n_stretches else math.inf

    def _risk(self, lost: float, soon: float) -> tuple[float, float, float]:
        """Probability, with its 90 % interval, that within the horizon something begins of those.

        Certain where nothing helps by the model, of which nobody knows how good it is.
        """
        if math.isinf(lost):
            return 1.0, 0.0, 1.0
        expected, low, high = self._expected(int(lost))
        return _within(expected * soon), _within(low * soon), _within(high * soon)

    def _judgement(self, lost: _Floats, left: _Floats, situation: Situation) -> Judgement:
        remembered, risks = self.remembered, np.empty((3, len(lost)))
        soon = self._soon(remembered.seconds)
        for k, each in enumerate(lost.tolist()):
            risks[:, k] = self._risk(each, soon)
        risk, low, high = risks
        return Judgement(risk, low, high, left, float(remembered.number), situation.seen)

    def _allowed(self, tolerance: float, remembered: Remembered) -> int:
        """How many of the disturbances need not be survived.

        No larger share of them than the tolerance, and no more than keep the upper bound of the
        risk within it.
        """
        soon, most, allowed = self._soon(remembered.seconds), tolerance * remembered.number, 0
        while allowed + 1 <= most and _within(poisson_bounds(allowed + 1)[1] * soon) <= tolerance:
            allowed += 1
        return allowed

    def _here(self, z: _Floats) -> Here | None:
        """Where one is, if that is seen; what was not is taken to have gone on as before."""
        at = self._at
        if has_gaps(z):
            if at is None:
                return None
            z = np.where(np.isnan(z), at.z + at.change, z)
        if at is None:
            return Here(z, np.zeros(len(z)), np.zeros(self.dynamics.size))
        z = self.dynamics.corrected(at, self._action, z)
        return Here(z, z - at.z, self._action)

    def _untried(self, best: _Floats) -> _Floats | None:
        """An action whose effect is hardly known, if there is one."""
        assert self.backups is not None
        used, order = self.dynamics.used, self.backups.actions  # of equals the first in that order
        if self.dynamics.choices:
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

    def _backup_text(self, backup: int) -> str:
        assert self.backups is not None
        if backup >= self.backups.n_constant:
            return words.feedback(backup - self.backups.n_constant)
        action = self.dynamics.decode(self.backups.policies[backup, :, 0])
        if self.dynamics.choices:
            return words.choice(action_name(int(action[0])))
        return words.constant(action.tolist())

    # -- Learning -------------------------------------------------------------------------------

    def observe(self, observation: _Floats) -> bool:
        """Learn the transition to an observation; whether something unexpected began with it.

        One of which something was not seen ends what can be learnt from: what comes does not
        follow from what was.
        """
        dynamics = self.dynamics
        if dynamics.n_variables not in (0, len(observation)):
            raise ValueError(
                f"observation has {len(observation)} variables, but the judge learnt of "
                f"{dynamics.n_variables}"
            )
        if has_gaps(observation):
            dynamics.break_off()
            return False
        with dynamics.whole:
            if not dynamics.has_acted:
                dynamics.break_off()
            dynamics.observe(observation)
            return dynamics.begins()

    def act(self, action: Any) -> None:
        """Take in what was executed after the latest observation; another one replaces it."""
        if self.dynamics.is_under_way:
            self.dynamics.act(self.dynamics.encode(action))

    def learn(self, observation: ArrayLike, action: Any, belief: ArrayLike) -> None:
        """Take in what was executed, and whether the certificate of before still held."""
        if "margin" not in self.without and self.backups is not None:
            broken = self._certified and not self._holds
            self.broken += broken
            self._broke |= broken
            self.margin = min(
                _LARGEST, max(self._least_margin, self.margin + _ADDED * (broken - _RATE))
            )
        self._certified = self._holds
        self._was_certified |= self._holds
        self._take_in(observation, action)

    @property
    def _least_margin(self) -> float:
        return _NOISY if self.dynamics.is_noisy else _ADDED

    def watch(self, observation: ArrayLike, action: Any, belief: ArrayLike) -> None:
        """Take in what someone else does: then nothing was certified."""
        self._certified = False
        self._take_in(observation, action)

    def _take_in(self, observation: ArrayLike, action: Any) -> None:
        self.follow(observation, action)
        self._tights.append(self._tight)
        self._dead_ends.append(self._dead_end)
        if self.dynamics.n_episodes != self.n_studied:  # it goes on, but was long enough to study
            self._study()
        for notes in (self._tights, self._dead_ends):  # an entry for each observation to be studied
            del notes[: max(0, len(notes) - self.dynamics.n_under_way)]

    def follow(self, observation: ArrayLike, action: Any) -> None:
        """Keep up with what happens, without learning from it."""
        here = self._here(np.array(observation, np.float64))
        if here is not None:
            self._at, self._action = here, self.dynamics.encode(action)

    def start_episode(self, *, learn: bool = True) -> None:
        """What comes is not a consequence of what was; the episode before is learnt from."""
        if learn:
            self._end(failed=False)
        else:
            self.dynamics.forget_episode()
            self._forget()

    def end(self, observation: NDArray[np.float64] | None, *, failed: bool) -> None:
        """Learn from an episode; its last observation was taken in (`observe`)."""
        self._end(failed=failed and (observation is None or not has_gaps(observation)))

    def _end(self, *, failed: bool) -> None:
        dynamics = self.dynamics
        with dynamics.whole:
            if failed and dynamics.is_under_way:
                dynamics.end(failed=True)
            else:
                dynamics.break_off()
        if dynamics.n_episodes != self.n_studied:
            self._study()
        self._forget()

    def _forget(self) -> None:
        self._at, self._action = None, np.zeros(0)
        self._certified = self._was_certified = self._holds = self._tight = False
        self._broke = False
        self._dead_end = False
        self._tights, self._dead_ends = [], []
        self._lost = 0
        self._took = 0.0
        self._ranks = np.zeros(0, int) if self.backups is None else self.backups.ranks.copy()

    def _study(self) -> None:
        """Learn from the latest episode: what to remember, and what to do about it."""
        dynamics = self.dynamics
        self.n_studied = dynamics.n_episodes
        if "margin" not in self.without:
            self.margin = max(self._least_margin, _FADES * self.margin)
        moved = any(one.noticed == dynamics.n_episodes - 1 for one in dynamics.drifts)
        if moved or self._is_worse():
            self._begin_anew()
        episode = dynamics.latest
        if episode is None or not dynamics.ready:
            return
        random = np.random.default_rng([self.seed, dynamics.n_episodes])
        if self.backups is None:
            self.backups = Backups(
                episode.observations,
                episode.actions,
                choices=bool(dynamics.choices),
                evolving="backups" not in self.without,
            )
        best = self.backups.policies[self.backups.ranks]
        self.situations.add(episode, self._tights, self.horizon, random)
        known, enough = dynamics.consequents, len(self.situations)
        if "stretches" not in dynamics.without and len(known.sides) and enough > 3:
            self.situations.scan(dynamics, self.horizon, best[:1], random)
            self.n_scanned += 1
        dynamics.refute(self._refuted, self.horizon)
        if self.told_horizon is None and self.disturbances is not None and enough:
            self._look_ahead(best[:_ASKED], failed=episode.failed)
        self.disturbances = choose(
            dynamics, self.situations, self.horizon, best[:2], self.harder, random
        )
        if len(known.sides) and enough >= 3:
            self._evolve(random)
        self._ranks = self.backups.ranks.copy()

    def _is_worse(self) -> bool:
        """Whether disturbances got worse than those that are remembered."""
        if "breaks" in self.without:
            return False
        before, broke, latest = self.breaks, self._broke, self.dynamics.latest
        failed = broke and latest is not None and latest.failed
        self.breaks = before.after(self.n_studied - 1, broke=broke, failed=failed)
        self._broke = False
        return self.breaks.worse != before.worse

    @property
    def _began_anew(self) -> bool:
        dynamics = self.dynamics
        return self.breaks.worse >= 0 or (dynamics.n_variables > 0 and bool(dynamics.drifts))

    def _begin_anew(self) -> None:
        """How far model and memory are to be trusted is not known yet.

        Disturbances are taken to be harder again than they were, and it may take longer to fail.
        """
        self.breaks = Breaks(worse=self.breaks.worse)
        self.takes = min(_AHEAD * max(self.takes, _HORIZON / _AHEAD), _FARTHEST / _AHEAD)
        self.believed = float(_FARTHEST)
        self.n_scanned = 0
        if "margin" not in self.without:
            self.margin = max(self.margin, _MARGIN)

    @property
    def _refuted(self) -> NDArray[np.int64]:
        """From which observations it went on for the horizon although nothing seemed to help."""
        return np.flatnonzero(self._dead_ends[: -self.horizon])

    def _look_ahead(self, policies: _Floats, *, failed: bool) -> None:
        """As far as it takes to fail where nothing helps, and half as far again.

        Half as far again, too, after an episode that failed although it was certified not to; less
        far after one that went on for the whole horizon from where nothing seemed to help. What the
        model says of dead ends farther away than that is believed again little by little.
        """
        assert self.disturbances is not None
        if not len(self.dynamics.consequents.sides):
            return
        if not failed and len(self._refuted):  # it sees less far than it looks
            self.takes *= _REFUTED
            self.believed = max(self.takes, _SHORTEST / _AHEAD)
        else:
            self.believed = min(self.believed / _LATEST, float(_FARTHEST))
            after = failing_after(self.dynamics, self.situations, policies, self.disturbances)
            takes = max(_LATEST * self.takes, min(self._took, self.believed))
            if failed and self._was_certified:  # it did not look far enough
                takes = min(_AHEAD * takes, _FARTHEST / _AHEAD)
                self.believed = max(self.believed, takes)
            self.takes = max(min(float(after), self.believed), takes)
        self.horizon = int(min(max(_AHEAD * self.takes, _SHORTEST), _FARTHEST))

    def _evolve(self, random: np.random.Generator) -> None:
        assert self.disturbances is not None
        assert self.backups is not None
        count = len(self.disturbances.residuals)
        which = np.arange(count)
        if count > 1 + _TRIED_ON:
            which = np.append(0, 1 + random.permutation(count - 1)[:_TRIED_ON])
        fixed = (self.disturbances, which, self.harder)
        known, arrays = self.dynamics.consequents, self.situations.arrays()
        self.backups.evolve(lambda policy: worth(known, *arrays, policy, *fixed), random)

    # -- Keeping it -----------------------------------------------------------------------------

    def sums(self, n_states: int) -> dict[str, float]:
        """A few sums that whatever is learnt changes."""
        backups, disturbances = self.backups, self.disturbances
        return {
            "margin": self.margin,
            "broken": float(self.broken),
            "backups": 0.0 if backups is None else float(backups.policies.sum()),
            "disturbances": 0.0 if disturbances is None else float(disturbances.residuals.sum()),
        }

    def save(self, path: Place, provenance: Mapping[str, Any] | None = None) -> None:
        """Write what was learnt to a file.

        Parameters
        ----------
        path : path-like, or file open for writing bytes
        provenance : mapping, optional
            What it learnt from, for people; kept in the file.

        Raises
        ------
        OSError
            If it cannot be written.
        """
        content = {name: getattr(self, name) for name in ("dt", "seed", "told_horizon", *NUMBERS)}
        content |= {"without": sorted(self.without)}
        content |= {"names": list(self.labels.names), "units": list(self.labels.units)}
        content |= self.breaks._asdict()
        content |= {"n_constant": 0 if self.backups is None else self.backups.n_constant}
        arrays = arrays_of(Kept(self.situations, self.backups, self.disturbances))
        arrays["dynamics"] = to_bytes(self.dynamics)
        store.write(path, KIND, content, arrays, provenance)

    @classmethod
    def load(cls, path: Place) -> Self:
        """Read what was learnt, between two episodes.

        Raises
        ------
        OSError
            If there is no such file, or it may not be read.
        ValueError
            If the file holds something else or is damaged.
        """
        content, arrays = store.read(path, KIND)
        with store.explained(path):
            dynamics = from_bytes(arrays.pop("dynamics"))
            if dynamics is None:
                raise ValueError("it lacks what was learnt of how the system moves")
            told = {name: content[name] for name in ("seed", "without", "names", "units")}
            told |= {name: dynamics.settings.get(name) for name in ("low", "high", "n_actions")}
            judge = cls(content["dt"], horizon=content["told_horizon"], **told)
            if judge.dynamics.settings != dynamics.settings:
                raise ValueError("judge and dynamics in it were made for different settings")
            judge.dynamics = dynamics
            kept = restored(int(content["n_constant"]), arrays)
            _refuse_strange(kept, dynamics)
        for name in NUMBERS:
            setattr(judge, name, content[name])
        judge.breaks = Breaks(*(content[name] for name in Breaks._fields))
        judge.situations, judge.backups, judge.disturbances = kept
        judge._forget()
        return judge

    def __repr__(self) -> str:
        return f"{type(self).__name__}(dt={self.dt:g}, seed={self.seed})"


def _fallback(dynamics: Dynamics) -> Fallback:
    """The first of some actions, or the middle of a range."""
    if dynamics.choices:
        return Fallback(0.0, "the first action")
    middle = dynamics.decode(np.zeros(dynamics.size))
    return Fallback(middle if len(middle) > 1 else float(middle[0]), "the middle of the range")


def _refuse_strange(kept: Kept, dynamics: Dynamics) -> None:
    """Raise where backups are of other numbers than dynamics: kernels check no index."""
    if kept.backups is None:
        return
    _, size, features = kept.backups.policies.shape
    if (dynamics.n_variables, dynamics.size) != (features - 1, size):
        raise ValueError(
            f"its backups are of {features - 1} variables and actions of {size} numbers, its "
            f"dynamics of {dynamics.n_variables} and {dynamics.size}"
        )


def _within(expected: float) -> float:
    """Probability of at least one event, of the number that is expected."""
    return -math.expm1(-expected)


def _unjudged(count: int) -> Judgement:
    nothing = np.full(count, math.nan)
    return Judgement(nothing, nothing, nothing, nothing, 0.0)
