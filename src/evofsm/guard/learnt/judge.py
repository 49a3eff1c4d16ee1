"""What decides: an action passes if after it some backup survives all that is remembered.

A predictive safety filter (Wabersich & Zeilinger, "A predictive safety filter for learning-based
control of constrained nonlinear dynamical systems", Automatica 2021), with model, failure,
disturbances and backups learnt after each episode (`learn`). Within an episode only its rows, the
situation and the margin change.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from functools import cache
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike

from evofsm import store
from evofsm.fsm.kernels import COMPILES, announce_compiling
from evofsm.fsm.naming import Labels
from evofsm.fsm.proportions import binomial_bounds, poisson_bounds
from evofsm.fsm.sharing import Rollback, as_now
from evofsm.fsm.validation import action_name, ask, function, positive, whole
from evofsm.guard.actions import ActionSet, BoxActions, Choices, Mask, limits
from evofsm.guard.api import (
    Fallback,
    Judgement,
    ObservingJudge,
    Search,
    SearchingJudge,
    Situation,
    is_missing,
)
from evofsm.guard.harm import SETTINGS, Harm
from evofsm.guard.learnt import rollout, words
from evofsm.guard.learnt.backups import basis
from evofsm.guard.learnt.learn import learn
from evofsm.guard.learnt.motion import used_at
from evofsm.guard.learnt.rollout import CUT_SHORT, Floats, Ints, search
from evofsm.guard.learnt.state import KIND, Episode, Given, LearntSettings, Parts, State, unpacked
from evofsm.guard.learnt.words import Remembered
from evofsm.store import MOST_COUNTED, Place

# Rows of an episode that are learnt from before it ends.
_MOST_ROWS = 1024
# Of an episode that failed after fewer nobody could see how it moves.
_FEWEST_SEEN = 4
# No horizon that is given has more steps: memory and the time of a decision grow with it.
_MAX_STEPS = 10_000
# What a backup says to an action that is not allowed.
_NEVER = -1e300


class Consequence(NamedTuple):
    """What comes of an action if the best of some backups follows."""

    unsurvived: float  #: disturbances that are not survived; infinite if it fails without any
    left: float  #: least distance to failure under the worst of them [typical steps]
    fails_after: float  #: steps after which it fails, at the latest; 0 if it does not


class LearntRisk(ObservingJudge, SearchingJudge):
    """Judges actions by what it has learnt of how the system moves and fails.

    It is told neither what variables mean nor how they move. Before the first episode that failed
    there is nothing that it could prevent, and all is kept; where failure was given as a function,
    before the first episode is over.

    It learns of at most 64 variables, fewer where actions have more than 25 numbers, and expects
    products of two up to 12 variables, of actions with variables up to 80 such products.

    Parameters
    ----------
    dt : float
        Time between two decisions [s].
    low, high, n_actions, model, backup
        As in `Guard`.
    horizon : float, optional
        How far it looks ahead [s]. Without it, half as far again as it takes to fail where failure
        can no longer be avoided, from 32 to 144 steps. If that is too short a step lasts several
        decisions, as with a longer horizon that is given.
    seed : int
        Of the draws with which backups evolve and situations are chosen.
    names, units : sequence of str
        Of the variables, for what people read; nothing is decided by them.
    settings : LearntSettings, optional
        Its numbers.

    Raises
    ------
    ValueError
        If ``dt`` is not positive and finite, or not one of a range and ``n_actions`` is given.

    Notes
    -----
    A search is cut short after as many steps of rollouts as take a tenth of the interval, one
    horizon of each backup asked at least; its reason says so. They are counted, not timed: it comes
    out the same again.

    The risk of an action is the probability that within the horizon something begins that no
    backup survives after it: ``1 - exp(-unsurvived / exposure * horizon)``, from the number of
    remembered disturbances that are not survived and the time in which they were seen; 1 where not
    even an undisturbed future is survived. What never began is not in it.
    It is NaN from the fifth observation on end that lacks something.

    Examples
    --------
    >>> from evofsm.guard import Guard
    >>> guard = Guard(low=-2.0, high=2.0, interval=0.02)
    >>> guard.judge
    LearntRisk(dt=0.02, seed=0)
    """

    #: From so many observations on end that lack something on, the risk is not known.
    BLIND = 5

    # Of the present episode.
    _step: list[tuple[Floats, Floats]]  # situations and actions of the last step
    _z: list[Floats]  # observations that are to be learnt from
    _u: list[Floats]  # and actions after them
    # Of each decision: a proposal was refused, nothing helped even undisturbed, some backup held.
    _notes: list[tuple[bool, bool, bool]]
    _used: Floats  # (a, 2) how often numbers of an action were near an end of their range
    _certified: bool  # whether at the decision before some backup survived all
    _holds: bool  # and at this one
    _refused: bool  # whether the latest proposal was
    _lost: bool  # whether nothing helped, even without any disturbance
    _fails_after: float  # steps after which what was refused fails, at the latest
    _unsurvived: int
    _n_blind: int  # observations on end, up to the latest one, that lack something
    _first: Floats  # before one was whole: each variable as it was seen last
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
        names: Sequence[str] = (),
        units: Sequence[str] = (),
        settings: LearntSettings | None = None,
        model: Callable[[Floats, Any], ArrayLike] | None = None,
        backup: Callable[[Floats], ArrayLike] | None = None,
    ) -> None:
        self.dt = positive("dt", dt)
        self.given_horizon = None if horizon is None else positive("horizon", horizon)
        steps = None if horizon is None else max(1, round(horizon / self.dt))
        if steps is not None and steps > _MAX_STEPS:
            most = f"a learnt judge looks at most {_MAX_STEPS:,} ahead (is it in seconds?)"
            raise ValueError(f"horizon is {horizon:g} s, {steps:,} decisions of {dt:g} s; {most}")
        if not 0 <= (index := operator.index(seed)) <= MOST_COUNTED:
            raise ValueError(f"seed is {seed}; it must be from 0 to 2**53, as files hold it")
        self.seed = index
        self.model = function("model", model, "lambda z, u: z + 0.1 * u")
        self.backup = function("backup", backup, "lambda z: -1.0")
        texts = {"names": tuple(names), "units": tuple(units)}
        for name, values in (("names", names), ("units", units)):
            if isinstance(values, str) or not all(isinstance(text, str) for text in texts[name]):
                raise TypeError(f"{name} is {values!r}; it must be a text for each variable")
        self.labels = Labels(None, **texts, dt=self.dt)
        #: Number of actions; 0 where the action is a box.
        self.choices = 0 if n_actions is None else whole("n_actions", n_actions)
        if {low is None, high is None} != {n_actions is not None}:
            raise ValueError("give either low and high, or n_actions")
        self.low: Floats = np.zeros(0)
        self.high: Floats = np.zeros(0)
        if low is not None and high is not None:
            ends: Any = np.atleast_1d(low), np.atleast_1d(high)
            self.low, self.high = BoxActions(*ends).bounds
        self.middle, self.half = 0.5 * (self.low + self.high), 0.5 * (self.high - self.low)
        self.fallback = Fallback(0.0, "the first action")  #: revised like any proposal
        if not self.choices:
            middle = self.middle if len(self.middle) > 1 else float(self.middle[0])
            self.fallback = Fallback(middle, "the middle of the range")
        #: How many numbers an action has.
        self.size = self.choices or len(self.low)
        rollout.refuse_too_many(1, self.size, box=not self.choices)
        #: Whether it may try actions to learn what they do.
        self.learning = True
        #: From an observation to whether it is a failure, if that was given.
        self.failed: Callable[[Floats], bool] | None = None
        self.harm = Harm()  #: how episodes ended, guarded and alone
        #: All that it has learnt, and what decides, made of it.
        stride = 1
        numbers = LearntSettings() if settings is None else settings
        while steps is not None and steps > numbers.horizon_max:
            steps, stride = -(-steps // 2), 2 * stride
        self.state = State.none(numbers, 0, self.size, self.choices, steps)._replace(stride=stride)
        self.parts: Parts | None = None
        self.start_episode()

    @staticmethod
    @cache
    def warm() -> None:
        """Compile now what learnt judges need."""
        if not COMPILES:
            return
        announce_compiling()
        judge, random = LearntRisk(1.0, -1.0, 1.0), np.random.default_rng(0)
        for _ in range(3):
            for z in random.normal(size=(12, 2)).cumsum(axis=0):
                judge.observe(z)
                here = Situation(z, np.ones(1), None, 0.0, 0.0)
                judge.search(here, 0.5, tolerance=0.02)
                judge.act(0.5)
                judge.learn(z, 0.5)
            judge.end(None, failed=True)

    @property
    def n_variables(self) -> int:
        """Number of variables of an observation; 0 before the first."""
        return len(self.state.origin)

    @property
    def settings(self) -> LearntSettings:
        """Its numbers."""
        return self.state.settings

    def refuse_unfit(self, actions: ActionSet) -> None:
        """Raise for another range of actions than it learns of."""
        box: Any = self.low, self.high
        right = Choices(self.choices) if self.choices else BoxActions(*box)
        ends = np.ravel(limits(right)), np.ravel(limits(actions))
        if isinstance(actions, Choices) != bool(self.choices) or not np.array_equal(*ends):
            fault = f"the judge was made for {right}, but the guard has {actions}"
            raise ValueError(f"{fault}: give it low and high, or n_actions, of the guard")

    def encode(self, action: Any) -> Floats:
        """(a,) an action as it is learnt of: from -1 to 1, or 1 for the chosen one."""
        if self.choices:
            return np.asarray(np.eye(self.choices)[int(action)])
        return np.atleast_1d((np.asarray(action, np.float64) - self.middle) / self.half)

    def decode(self, inner: Floats) -> Floats:
        """The action that is so encoded."""
        if self.choices:
            return np.array([float(inner.argmax())])
        return np.minimum(np.maximum(self.middle + self.half * inner, self.low), self.high)

    # -- Deciding -------------------------------------------------------------------------------

    @property
    def remembered(self) -> Remembered:
        """Disturbances that it counts on, and the time in which they were seen."""
        seconds, ends = self.state.n_seen * self.state.stride * self.dt, self.state.lost
        return Remembered(len(self.state.windows), seconds, lost=(int(ends.sum()), len(ends)))

    def search(
        self, situation: Situation, wanted: Any, *, tolerance: float, mask: Mask | None = None
    ) -> Search:
        """An action near ``wanted`` that passes, or else that of the longest-lasting backup.

        Of `Choices` it is one of ``mask``, and backups do what is in it: more may be allowed later,
        or less, which nobody knows.
        There is no band in which a proposal is refused for longer: that gained nothing.
        """
        if not self.n_variables:
            rollout.refuse_too_many(len(situation.observation), self.size, box=not self.choices)
        here, options, parts = self._here(situation.observation), np.array([wanted]), self.parts
        if parts is None or here is None or not self.state.knows_failure:
            self._certified = False
            why = words.NOTHING_SEEN if parts and here is None else self._no_threshold
            why = why if parts or self.state.n_failed else words.NOTHING_LEARNT
            return Search(options, _unjudged(1), 0, why)
        model = parts.daring if self.learning else parts.model
        n_asked = parts.n_tried if self.learning else parts.n_asked
        proposal, scale, margin = self.encode(wanted), parts.scale, self.state.margin
        memory, ranks, most = self.remembered, self._ranks[:n_asked], parts.most
        memory = memory._replace(spared=self._allowed(tolerance, memory))
        policies, allowance = self.state.policies, memory.spared
        if mask is not None:
            policies = policies.copy()
            policies[:, ~mask, 0] = _NEVER
        inputs = model, here, policies, ranks, parts.residuals, scale
        longer = self.settings.longer if self.learning else rollout.NO_LONGER
        how, action, best, slack = search(*inputs, proposal, margin, allowance, most, longer=longer)
        trial = None
        if best != ranks[0]:  # what passed now is asked first the next time
            self._ranks = np.append(best, self._ranks[self._ranks != best])
        passes, cut = how < CUT_SHORT, how == CUT_SHORT
        self._holds, self._refused = passes, how != rollout.KEPT
        if not passes:
            if self._certified and not cut:
                how = search(*inputs, action, 0.0, allowance, most, lasting=False)[0]
                self._holds = how < CUT_SHORT
            self._certified &= how != CUT_SHORT  # whether one is violated is not known
            is_alike = self.learning and slack < self.settings.alike
            trial = self._untried(action, mask) if is_alike else None
            action = action if trial is None else trial
        outcomes = [self._foresee(here, proposal, policies)] if self._refused else []
        if passes and not allowance:  # the search says what is left
            outcomes.append(Consequence(0.0, slack, 0.0))
        else:
            outcomes.append(self._foresee(here, action, policies))
        self._lost = math.isinf(outcomes[-1].unsurvived)
        self._fails_after = max(self._fails_after, *(outcome.fails_after for outcome in outcomes))
        judgement = self._judged(situation, outcomes)
        doubt = words.BY_MODEL if math.isnan(judgement.risk[0]) else ""
        backup = self.backup_text(best, policies)
        if not self._refused:
            return Search(options, judgement, 0, doubt + words.kept(backup, memory, slack))
        why = doubt + words.refused(self._unsurvived, memory, margin, scale)
        why += "" if mask is None else words.IF_NO_MORE
        if passes:
            instead = words.changed(backup, memory, margin)
        elif trial is not None:
            instead = words.TRIED
        else:
            instead = words.NO_LONGER if action is proposal else words.lasting(backup, cut=cut)
        if self.choices == 1:
            why, instead = words.alone(why), words.NOBODY
        executed = wanted
        if action is not proposal:
            executed = np.reshape(self.decode(action), np.shape(wanted))
        return Search(np.array((options[0], executed)), judgement, 1, f"{why}; {instead}")

    def judge(self, situation: Situation, actions: ArrayLike) -> Judgement:
        """Risk of each action, (k,) or (k, d); NaN as long as nothing can be said."""
        options, here = np.asarray(actions, np.float64), self._here(situation.observation)
        if here is None or self.parts is None or not self.state.knows_failure:
            return _unjudged(len(options))
        policies = self.state.policies
        outcomes = [self._foresee(here, self.encode(action), policies) for action in options]
        return self._judged(situation, outcomes)

    def why(self, judged: Judgement) -> str:
        """Why the first action that was judged is dangerous, in a few words."""
        scale = 1.0 if self.parts is None else self.parts.scale
        why = words.refused(self._unsurvived, self.remembered, self.state.margin, scale)
        return words.alone(why) if self.choices == 1 else why

    def _foresee(self, here: Floats, action: Floats, policies: Floats) -> Consequence:
        """What comes of a situation and an action, by those backups that passed last."""
        assert self.parts is not None
        model, rest = self.parts.model, self.parts.residuals
        best = policies[self._ranks[: self.parts.n_judged]]
        ends = rollout.value_of(model, here[None], best, rest, 1.0, action[None], 0.0)[0]
        fails = ends[ends < 0.0]
        count = math.inf if ends[0] < 0.0 else float(len(fails))
        steps = len(rest)
        return Consequence(
            count, float(ends.min()), float(fails.max(initial=-1.0 - steps)) + 1.0 + steps
        )

    def _judged(self, situation: Situation, outcomes: Sequence[Consequence]) -> Judgement:
        """Of some actions; of the first it is kept why it is dangerous (`why`)."""
        counts = [outcome.unsurvived for outcome in outcomes]
        self._unsurvived = -1 if math.isinf(counts[0]) else int(counts[0])
        memory = self.remembered
        assert self.parts is not None
        z, (least, most) = situation.observation, self.parts.usual
        if ((z < least) | (z > most)).any():
            return _unjudged(len(counts))._replace(seen=0.0)
        if self._n_blind + 1 >= self.BLIND and is_missing(z):
            return _unjudged(len(counts))
        soon = self._soon(memory.seconds)
        risk, low, high = np.array([self._risk(n, soon) for n in counts]).T
        distances = np.array([outcome.left for outcome in outcomes])
        is_seen = memory.lost[1] > 0 or not math.isinf(counts[0])
        evidence = float(memory.number) if is_seen else 0.0
        return Judgement(risk, low, high, distances, evidence, situation.seen)

    def _soon(self, exposure: float) -> float:
        """The horizon, as a share of the time in which all that is remembered was seen."""
        return self.state.horizon * self.state.stride * self.dt / max(exposure, 1e-300)

    def _risk(self, unsurvived: float, soon: float) -> tuple[float, float, float]:
        """Probability, with its 90 % interval, that within the horizon something begins of those.

        Where nothing helps by the model it is the share of episodes that then failed; certain, as
        far as anybody knows, before there was any. Where all that it may remember are not survived,
        it is not known how many more were forgotten.
        """
        if math.isinf(unsurvived):
            n_failed, n = self.remembered.lost
            return (n_failed / n, *binomial_bounds(n_failed, n)) if n else (1.0, 0.0, 1.0)
        low, high = poisson_bounds(int(unsurvived))
        high = high if unsurvived < self.settings.n_disturbances else math.inf
        return -math.expm1(-unsurvived * soon), -math.expm1(-low * soon), -math.expm1(-high * soon)

    def _allowed(self, tolerance: float, remembered: Remembered) -> int:
        """How many of the disturbances need not be survived, by share and bound of the risk."""
        soon, most, allowance = self._soon(remembered.seconds), tolerance * remembered.number, 0
        while allowance + 1 <= most and self._risk(allowance + 1, soon)[2] <= tolerance:
            allowance += 1
        return allowance

    def _here(self, z: Floats) -> Floats | None:
        """The situation, if that is seen; what was not is taken to be as was expected."""
        row, m, stride = z, len(z), self.state.stride
        if not self._step:
            row = np.where(np.isnan(z), self._first, z)
            return None if is_missing(row) else np.append(row, np.zeros(m + self.size))
        if is_missing(z):
            situation, action = self._step[-1]
            row = situation[:m]
            if self.parts is not None:
                row = row + (rollout.expected(self.parts.model, situation, action) - row) / stride
            row = np.where(np.isnan(z), row, z)
        situations, actions = zip(*self._step, strict=True)
        change = (row - situations[0][:m]) * (stride / len(actions))
        return np.concatenate([row, change, sum(actions) / len(actions)])

    def _untried(self, best: Floats, mask: Mask | None) -> Floats | None:
        """An action whose effect is hardly known, if there is one."""
        uses, tries = self.state.used + self._used, self.settings.tries
        if self.choices:
            order = self.state.policies[self.state.linear == 0.0, :, 0].argmax(1)
            order = order if mask is None else order[mask[order]]  # of equals whose backup is first
            i = int(order[uses[order, 1].argmin()])
            is_rare = uses[i, 1] < tries and uses[i, 1] < uses[:, 1].max()
            return np.asarray(np.eye(len(uses))[i]) if is_rare else None
        order, turns = basis(self.state.situations[:, 2 * self.n_variables :])
        turned_uses = np.where(turns[:, None] > 0.0, uses, uses[:, ::-1])[order]
        k, end = divmod(int(turned_uses.argmin()), 2)
        if turned_uses[k, end] < min(tries, max(1.0, turned_uses[k, 1 - end])):
            best = best.copy()
            best[order[k]] = (-1.0, 1.0)[end] * turns[order[k]]
            return best
        return None

    def backup_text(self, backup: int, policies: Floats | None = None) -> str:
        """What a backup does, by its number."""
        policies = self.state.policies if policies is None else policies
        if self.state.linear[backup] == 2.0:
            return "the given backup"
        if self.state.linear[backup] == 1.0:
            return f"feedback {int((self.state.linear[: backup + 1] == 1.0).sum())}"
        action = self.decode(policies[backup, :, 0])
        if self.choices:
            return f"always {action_name(int(action[0]))}"
        return words.constant(action.tolist())

    # -- Learning -------------------------------------------------------------------------------

    def savepoint(self) -> Rollback:
        """What takes back all that it learns from now on."""
        return as_now(self, "_z", "_u", "_notes")

    def observe(self, observation: Floats) -> None:
        """Take in an observation, NaN where something was not seen; a ValueError if too long."""
        if not self.n_variables:
            rollout.refuse_too_many(len(observation), self.size, box=not self.choices)
        if len(self._z) > len(self._u):  # nothing was executed: it does not follow
            self._study(failed=False, terminated=False)
        self._z.append(observation.copy())
        self._holds = self._refused = self._lost = False  # as long as nothing was asked

    def act(self, action: Any) -> None:
        """Take in what was executed after the latest observation; another one replaces it."""
        if not self._z:
            return
        inner = self.encode(action)
        self._u = self._u[: len(self._z) - 1] if len(self._u) == len(self._z) else self._u
        self._u.append(inner)
        self._used = self._used + used_at(inner[None], self.choices)[0]

    def learn(self, observation: ArrayLike, action: Any, *, watched: bool = False) -> None:
        """Take in what was executed, and whether the certificate of before still held.

        Where someone else acts (``watched``) nothing was certified.
        """
        if not watched and self.parts is not None:
            is_violated = self._certified and not self._holds
            s = self.settings
            margin = self.state.margin + s.margin_step * (is_violated - s.violation_rate)
            self.state = self.state._replace(margin=min(s.margin_max, max(s.margin_step, margin)))
        self._certified = self._holds and not watched
        self.follow(observation, action)
        self._notes.append((self._refused, self._lost, self._certified))
        if len(self._z) > _MOST_ROWS * (stride := self.state.stride):
            z, u, latest = self._z, self._u, self._notes[-1]
            self._study(failed=False, terminated=False)
            self._z, self._u = z[-1 - stride :], u[-1 - stride :]  # the next change needs a step
            self._notes, self._goes_on = [(False, False, False)] * stride + [latest], True

    def follow(self, observation: ArrayLike, action: Any) -> None:
        """Keep up with what happens, without learning from it."""
        z = np.array(observation, np.float64)
        here = self._here(z)
        self._n_blind = self._n_blind + 1 if is_missing(z) else 0
        if here is None:
            self._first = np.where(np.isnan(z), self._first, z)
        else:
            self._step = [*self._step, (here, self.encode(action))][-self.state.stride :]

    def end(self, observation: Floats | None, *, failed: bool, terminated: bool = False) -> None:
        """Learn from an episode, whose last observation was taken in already (`observe`)."""
        self.state = self.state._replace(n_failed=self.state.n_failed + int(failed))
        self._study(failed=failed, terminated=terminated and not failed)
        self.start_episode()

    @property
    def _given(self) -> Given:
        """What the user says, of encoded actions."""
        move, act, m = self.model, self.backup, self.n_variables

        def model(z: Floats, inner: Floats) -> Floats:
            assert move is not None
            action = self.decode(inner)
            inputs = z, action if len(action) > 1 else action[0]
            after = ask("model", move, _numbers, *inputs)
            if after.shape != (m,) or not np.isfinite(after).all():
                fault = f"model gave {after} after {z} and {action}"
                raise ValueError(f"{fault}; it has to give {m} finite numbers")
            return after

        def backup(z: Floats) -> Floats:
            assert act is not None
            action = np.atleast_1d(ask("backup", act, _numbers, z))
            if action.shape != ((1,) if self.choices else (self.size,)) or np.isnan(action).any():
                raise ValueError(f"backup gave {action} at {z}; it has to give an action")
            return self.encode(action[0] if self.choices else np.clip(action, self.low, self.high))

        parts = self.failed, None if move is None else model, None if act is None else backup
        return Given(self.seed, self.given_horizon, *parts)

    def _study(self, *, failed: bool, terminated: bool) -> None:
        """Learn from the rows of an episode, and forget them."""
        z, n = np.array(self._z), max(0, len(self._z) - 1)
        u = np.array(self._u[:n]).reshape(-1, self.size)
        notes = np.zeros((n, 3))
        notes[: len(self._notes)] = np.array(self._notes, np.float64).reshape(-1, 3)[:n]
        self._z, self._u, self._notes = [], [], []
        if not len(z) or not np.isfinite(z).all(1).any() or not (n or failed):
            return
        is_early, fails_after = not self._goes_on and n < _FEWEST_SEEN, self._fails_after
        refusals, losses, certificates = notes.T
        ends = failed, terminated
        episode = Episode(z, u, *ends, refusals, losses, certificates, fails_after, is_early)
        if not self.n_variables:
            now = self.state
            blank = State.none(self.settings, z.shape[1], self.size, self.choices, now.horizon)
            self.state = blank._replace(stride=now.stride, margin=now.margin, n_failed=now.n_failed)
        n_drifts = len(self.state.drifts)
        self.state = learn(self.state, episode, self._given)
        if len(self.state.drifts) > n_drifts:  # another system: how one fares alone is not known
            self.harm = self.harm._replace(moved=self.harm.n_episodes)
        self.parts = Parts.of(self.state, self.dt)
        self._used, self._ranks = np.zeros((self.size, 2)), np.arange(len(self.state.policies))

    def remake(self) -> None:
        """Decide by `state`, between two episodes."""
        self.parts = Parts.of(self.state, self.dt)
        self.start_episode()

    def start_episode(self) -> None:
        """What comes is not a consequence of what was."""
        self._step, self._z, self._u, self._notes = [], [], [], []
        self._certified = self._holds = self._refused = self._lost = self._goes_on = False
        self._unsurvived, self._n_blind, self._fails_after = 0, 0, 0.0
        self._first = np.array(math.nan)
        self._used, self._ranks = np.zeros((self.size, 2)), np.arange(len(self.state.policies))

    # -- For people, and in a file --------------------------------------------------------------

    @property
    def _no_threshold(self) -> str:
        """Why nothing is refused."""
        if self.parts is None and self.state.n_failed:
            return words.NEVER_WHOLE
        n_seen, n_survived = len(self.state.failures), len(self.state.survived)
        is_given = self.failed is not None and self.state.n_episodes > 0
        return words.no_threshold(self.state.n_failed, n_seen, n_survived, is_given=is_given)

    @property
    def told_by_experience(self) -> str:
        """What was learnt so far, in words."""
        here = self.remembered, self.called, self._no_threshold
        text = words.experience(self.state, *here, learning=self.learning)
        text += f"; {self.uncovered}" if self.uncovered else ""
        return text + words.harm(self.harm, learning=self.learning)

    @property
    def uncovered(self) -> str:
        """At how many failures that were told a given function was false; empty where at none."""
        rows, failed = self.state.failures, self.failed
        n = 0 if failed is None else sum(not failed(z) for z in rows)
        return f"failed= was False at the last row of {n} of {len(rows)} failures" if n else ""

    def told_here(self, observation: Floats) -> tuple[str, Floats | None]:
        """What was learnt of an observation, in words, and the centre of the dead end it is near.

        Empty, and None, where it is in and near none, nor near where it fails.
        """
        if is_missing(observation) or self.parts is None:
            return "", None
        near = self.settings.margin_max
        return words.here(self.state, self.parts.model, self.called, observation, near)

    @property
    def called(self) -> Sequence[str]:
        """Names of variables; `words` makes them fit to be read."""
        return self.labels.names or [f"variable {j + 1}" for j in range(self.n_variables)]

    def save(self, path: Place, provenance: Mapping[str, Any] | None = None) -> None:
        """Write what was learnt to a file, with what it learnt from, for people (`provenance`)."""
        settings = {
            **{name: getattr(self, name) for name in ("dt", "seed", "given_horizon")},
            **{name: getattr(self, name).tolist() for name in ("low", "high")},
            **{name: list(getattr(self.labels, name)) for name in ("names", "units")},
            "n_actions": self.choices or None,
            "harm": {name: getattr(self.harm, name) for name in SETTINGS},
            "settings": asdict(self.settings),
        }
        arrays = {**self.state.packed(), "harm": self.harm.rows}
        store.write(path, KIND, settings, arrays, provenance)

    @classmethod
    def load(cls, path: Place) -> Self:
        """Read what was learnt, between two episodes; a ValueError if the file is damaged."""
        settings, arrays = store.read(path, KIND)
        with store.explained(path):
            names = ("n_actions", "seed", "names", "units")
            keywords = {name: settings[name] for name in names}
            if keywords["n_actions"] is None:
                keywords |= {"low": settings["low"], "high": settings["high"]}
            keywords |= {"horizon": settings["given_horizon"]}
            judge = cls(settings["dt"], settings=LearntSettings(**settings["settings"]), **keywords)
            judge.state = unpacked(arrays, judge.state)
            judge.harm = Harm.restored(settings["harm"], arrays["harm"])
            judge.remake()
        return judge

    def __repr__(self) -> str:
        return f"{type(self).__name__}(dt={self.dt:g}, seed={self.seed})"


def _numbers(answer: ArrayLike) -> Floats:
    return np.array(answer, np.float64)


def _unjudged(count: int) -> Judgement:
    nans = np.full(count, math.nan)
    return Judgement(nans, nans, nans, nans, 0.0)
