"""The framework's loop (the paper's Section 4.1): observe, recognise, propose, revise, learn."""

from __future__ import annotations

import copy
import math
import os
import warnings
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from functools import cache, partial
from io import BytesIO
from operator import attrgetter
from typing import Any, Protocol, Self, SupportsFloat

import numpy as np
from numpy.typing import ArrayLike, NDArray

from evofsm import store
from evofsm.fsm.actions import IntervalActions
from evofsm.fsm.arrays import VISITS
from evofsm.fsm.explanation import explain
from evofsm.fsm.kernels import COMPILES, announce_compiling
from evofsm.fsm.machine import EvolvingFSM, opened
from evofsm.fsm.model import FSMModel
from evofsm.fsm.naming import Labels, in_a_line
from evofsm.fsm.rules import reach
from evofsm.fsm.sharing import Rollback, alone, as_now, share, transaction, unshared
from evofsm.fsm.validation import ask, function, positive, real_array, setting, truth, usable_array
from evofsm.guard.actions import (
    Action,
    ActionSet,
    BoxActions,
    Choices,
    fixed,
    put_into,
    same_action,
)
from evofsm.guard.api import (
    BELIEF_TOLERANCE,
    STALE,
    TOLERANCE,
    ActionJudge,
    Fallback,
    Intake,
    LearningJudge,
    ObservingJudge,
    Proposal,
    Reviser,
    Revision,
    Situation,
    is_missing,
    refuse_lacking,
)
from evofsm.guard.learnt.judge import LearntRisk
from evofsm.guard.parts import outline, rebuild, settings_of
from evofsm.guard.reviser import NOTHING, ActionReviser, Mode, is_spoken, make_usable, proposed
from evofsm.store import COUNT, SIZE, Kind, Numbers, Place

# Intervals that a range of actions is divided into for the machine.
_INTERVALS = 17
# States of the machine that is made.
_MOST_STATES = 200
# So many observations that lack something, or come after a gap, are told of.
_MANY = 100
# Longer than so many intervals is a gap in time; where more observations on end than the other come
# no later than one before, its clock was set back, or stands still.
_GAP, _STALE = 1.5, 5
# Fourth powers of larger observations, summed over a long run, would lose all others.
_LARGEST_VALUE = 1e30


class DecisionLogger(Protocol):
    """Anything that records what a guard does in an episode, such as an audit log."""

    def begin(self, guard: Guard) -> None:
        """An episode begins."""

    def seen(self, observation: NDArray[np.float64], time: float) -> None:
        """An observation came in, at ``time`` [s]."""

    def decided(self, situation: Situation, proposal: Proposal, revision: Revision) -> None:
        """A decision was made: where the system was, what was proposed, and what came of that.

        Parameters
        ----------
        situation, proposal, revision
            As `Guard.revise` takes and returns them.
        """

    def ended(
        self, observation: Any, *, failed: bool, terminated: bool, score: float | None
    ) -> None:
        """The episode ended.

        Parameters
        ----------
        observation : (m,) ndarray or None
            The last one, if nothing was decided on it any more.
        failed, terminated, score
            As in `Guard.end`.
        """


# Settings that stand in a file as they are.
_PLAIN_SETTINGS = ("explaining", "interval", "learn", "n_episodes", "n_failed", "shadow")
# The files of the machine and of the judge, as bytes.
KIND = Kind(
    "guard",
    {name: Numbers((name,), dtype=np.uint8) for name in ("machine", "judge")},
    {
        **dict.fromkeys(("explaining", "failed", "learn", "shadow"), bool),
        **dict.fromkeys(("n_episodes", "n_failed"), COUNT),
        "interval": SIZE,
        "judge": str | None,
    },
)


def _of_reviser(name: str, doc: str) -> Any:
    """A setting of a guard's reviser, which may be changed by the guard, too."""

    def change(guard: Guard, value: Any) -> None:
        if not hasattr(guard.reviser, name):
            raise AttributeError(f"{type(guard.reviser).__name__} has no {name}, and heeds none")
        setattr(guard.reviser, name, value)

    return property(attrgetter(f"reviser.{name}"), change, doc=doc)


class Guard:
    """Keeps any controller from failing: a state machine, a judge and a reviser that learn.

    Before an action is executed, the judge says how likely it is that failure can no longer be
    avoided after it. A proposal that is tolerable (to a learnt judge by a margin, too) is kept; any
    other is replaced by the closest action that is, or else by the least risky, which may be the
    proposal. The machine recognises and counts the states in which that happens.
    An episode begins with the first `decide` after `end`.

    Parameters
    ----------
    low, high : float or (d,) array_like, optional
        Range of the action, where that is one number; of each component where they are arrays:
        then actions are vectors, also of length 1.
    n_actions : int, optional
        Number of actions, where an action is an index from 0; texts call the first a(1).
    interval : float
        Time between two decisions [s].
    judge : ActionJudge, optional
        Says how dangerous an action is. Without one it is learnt from what happens
        (`LearntRisk`); for cars `evofsm.driving.guard_for_cars` brings one that is told how cars
        move.
    failed : callable, optional
        From an observation to whether it is a failure; asked as an episode ends. A learnt judge
        also asks it around what was survived: so from the second episode on it knows of failures
        before one. It decides by how it explains them; `told_by_experience` says where that errs.
    model : callable, optional
        From an observation and an action to the next observation: how it moves, as far as that is
        known. A learnt judge asks it, after each episode, as often as that had decisions, around
        where it was; what is seen corrects it. Like `backup` it is code, and in no file: what it
        said stays learnt, and `load` takes it again.
    backup : callable, optional
        From an observation to an action that is thought to save. A learnt judge fits linear
        feedback to it, and tries that as one backup of several.
    names : sequence of str
        Of the variables of an observation, as a learnt judge says them.
    horizon : float, optional
        How far ahead a learnt judge looks, and what the machine's explanations call soon [s].
        Without it a learnt judge looks as far as it finds that it has to.
    tolerance : float
        Highest risk that is accepted, unless nothing has less, in (0, 1).
    mode : Mode
        Whether what it decides is executed, or only recorded.
    seed : int
        Of the judge that is made where none is given.
    audit : DecisionLogger, optional
        Records what is decided: an `AuditLog`, or `evofsm.io.FoxgloveSink`, which shows it.
    explaining : bool
        Whether `Revision.explanation` holds the machine's experience for every decision; with an
        audit log it does for those that change a proposal or warn.
    shadow : bool
        Whether proposals pass in some episodes while a learnt judge learns, where it is in doubt
        that it helps, and in all where it is frozen and does not (`evofsm.guard.harm`). Without it,
        one that does harm acts on.

    Raises
    ------
    ValueError
        If there is neither a range of actions nor a number of them (or both), a number is out of
        its range, or the judge was made for other actions or another interval.

    Notes
    -----
    Observe an angle that turns round as its cosine and sine: else little is foreseen.

    Threads may share a guard: each call is done before the next begins, and what it decides on is
    one stream of observations. `machine` and `judge` themselves have to be left alone meanwhile.

    Each call is done as a whole: where it raises (an input is refused, a judge or the audit log
    fails, Ctrl-C), guard, machine, judge and audit log are as before, and it may be made again. A
    judge, reviser or logger of your own takes part if it has a method ``savepoint``, which returns
    a function that takes back what was done since; else what raises in it should change nothing.

    Examples
    --------
    >>> from evofsm.driving import LatentRisk
    >>> from evofsm.guard import Guard
    >>> guard = Guard(low=-2.5, high=2.5, interval=0.25, judge=LatentRisk(lowest=-2.5))
    >>> for observation in ([9.0, 20.0, 20.0], [8.9, 20.2, 19.8]):  # gap, own speed, leader's
    ...     revision = guard.decide(observation, proposal=1.0)
    >>> revision.executed, revision.risk_proposed, guard.machine.n_states
    (-2.5, 1.0, 1)
    >>> guard.end(failed=False, observation=[8.7, 20.0, 19.5])
    >>> print(guard)
    Guard of actions from -2.5 to 2.5, each 0.25 s
    judge: LatentRisk (ActionReviser, tolerance 0.02, mode act)
    episodes: 1, failures: 0, states: 1, frozen: no
    failure: manoeuvres of leaders: 0 given or seen, and one assumed, by 10.0 m/s²; own brakes: not
    known yet
    """

    def __init__(
        self,
        low: ArrayLike | None = None,
        high: ArrayLike | None = None,
        *,
        n_actions: int | None = None,
        interval: float,
        judge: ActionJudge | None = None,
        failed: Callable[[NDArray[np.float64]], bool] | None = None,
        model: Callable[[NDArray[np.float64], Any], ArrayLike] | None = None,
        backup: Callable[[NDArray[np.float64]], ArrayLike] | None = None,
        names: Sequence[str] = (),
        horizon: float | None = None,
        tolerance: float = TOLERANCE,
        mode: Mode = Mode.ACT,
        seed: int = 0,
        audit: DecisionLogger | None = None,
        explaining: bool = False,
        shadow: bool = True,
    ) -> None:
        actions = _actions(low, high, n_actions)
        if isinstance(judge, type):
            raise TypeError(f"judge is {judge!r}; it must be an object with a method judge")
        interval = positive("interval", interval)
        soon = None if horizon is None else max(1, round(positive("horizon", horizon) / interval))
        arguments: dict[str, Any] = {"model": model, "backup": backup, "names": names}
        if judge is None:
            settings = {"n_actions": n_actions, "horizon": horizon, "seed": seed, **arguments}
            judge = LearntRisk(interval, low, high, **settings)
        elif model is not None or backup is not None or (names is not None and np.size(names)):
            asks = "asks no model, no backup and no names: leave them out"
            raise ValueError(f"{type(judge).__name__} {asks}")
        machine = EvolvingFSM(
            actions.n_actions,
            max_states=_MOST_STATES,
            belief_tolerance=BELIEF_TOLERANCE,
            failure_horizon=soon,
        )
        self._set_up(
            ActionReviser(judge, actions, tolerance=tolerance, mode=mode),
            interval=interval,
            machine=machine,
            failed=failed,
            audit=audit,
            explaining=explaining,
            shadow=shadow,
        )

    @classmethod
    def of(cls, reviser: Reviser, *, interval: float, **settings: Any) -> Self:
        """A guard of parts that were made before; nothing is added to them.

        Parameters
        ----------
        reviser : Reviser
            Any; what it returns is executed.
        interval : float
            Time between decisions [s]; an observation that comes later than 1.5 of them begins an
            episode anew.
        machine : EvolvingFSM, optional
            Without one nothing is recognised.
        judge : LearningJudge, optional
            Learns from what happens; without it the reviser's own, if it has one that learns.
        learn : bool
            Whether machine and judge learn.
        failed, audit, explaining, shadow
            As in `Guard`.

        Examples
        --------
        >>> from evofsm import IntervalActions
        >>> from evofsm.driving import Unrevised
        >>> actions = IntervalActions(low=-2.5, high=2.5, width=0.3, outside="clip")
        >>> guard = Guard.of(Unrevised(actions), interval=0.25)
        >>> guard.decide([5.0, 20.0, 10.0], 9.0).executed
        2.5
        """
        guard = cls.__new__(cls)
        guard._set_up(reviser, interval=interval, **settings)
        return guard

    def _set_up(
        self,
        reviser: Reviser,
        *,
        interval: float,
        machine: EvolvingFSM | None = None,
        judge: LearningJudge | None = None,
        learn: bool = True,
        failed: Callable[[NDArray[np.float64]], bool] | None = None,
        audit: DecisionLogger | None = None,
        explaining: bool = False,
        shadow: bool = True,
        n_episodes: int = 0,
        n_failed: int = 0,
    ) -> None:
        refuse_lacking("reviser", reviser)
        if audit is not None:
            refuse_lacking("audit", audit)
        share(self)
        #: In which it was made; None of what was copied as Python does, which learns for itself.
        self.process: int | None = os.getpid()
        self.actions = reviser.actions
        self._interval = positive("interval", interval)
        action_judge: Any = getattr(reviser, "risk", judge)
        if judge is None and hasattr(action_judge, "learn"):
            refuse_lacking("judge that learns", action_judge)
            judge = action_judge
        for part, of in (("judge", judge), ("reviser", reviser)):
            dt = getattr(of, "dt", None) or self.interval
            if not math.isclose(dt, self.interval):
                text = f"the {part} was made for decisions every {dt} s"
                raise ValueError(f"interval is {interval} s, but {text}")
        if machine is not None and machine.n_actions != self.actions.n_actions:
            counts = f"{machine.n_actions} actions, but the set has {self.actions.n_actions}"
            raise ValueError(f"the machine has {counts}")
        if isinstance(action_judge, LearntRisk):
            action_judge.warm()
        if machine is not None:
            _warm_machine()
        self._observing = judge if isinstance(judge, ObservingJudge) else None
        self.reviser = reviser
        self.machine = machine
        #: Learns from what happens; None where nothing but the machine does.
        self.judge = judge
        self.failed = failed
        self.audit: DecisionLogger | None = audit
        self.explaining = explaining
        labels = Labels() if action_judge is None else action_judge.labels
        #: What the judge calls the variables of an observation; empty where it does not say.
        self.variables: tuple[str, ...] = labels.names
        #: What is done without a usable proposal where nothing is judged.
        self.fallback: Fallback = getattr(reviser, "fallback", NOTHING)
        intervals = self.actions if isinstance(self.actions, IntervalActions) else None
        self._labels = labels._replace(actions=intervals, dt=interval)
        #: Episodes that it learnt from, and those of them that failed.
        self.n_episodes, self.n_failed = n_episodes, n_failed
        self._frozen: FSMModel | None = None
        self._forget()
        self._under_way, self._passing, self._learn = False, "", True
        self._begun = self._decisions = self._acted = self._watched = self._kept = 0
        self._lacking = 0  # observations since one was whole
        self._gaps = 0  # observations after a gap in time, less those without
        self._since = 0, 0  # episodes that ended since it was frozen, and those that failed
        self.shadow = shadow
        self.learn = learn

    mode = _of_reviser("mode", "How far its reviser goes, a `Mode`; may be changed at any time.")
    tolerance = _of_reviser("tolerance", "Highest risk that its reviser accepts, in (0, 1).")
    explaining: bool = setting("explaining", truth, "Whether experience is said of each decision.")
    shadow: bool = setting("shadow", truth, "Whether proposals pass where it is in doubt.")

    @property
    def interval(self) -> float:
        """Time between two decisions [s], of which all that it learns is."""
        return self._interval

    @property
    def failed(self) -> Callable[[NDArray[np.float64]], bool] | None:
        """From an observation to whether it is a failure; a learnt judge asks it, too."""
        return self._failed

    @failed.setter
    def failed(self, failed: Callable[[NDArray[np.float64]], bool] | None) -> None:
        self._failed = function("failed", failed, "lambda z: z[0] <= 0")
        if isinstance(judge := self._action_judge, LearntRisk):
            judge.failed = None if failed is None else partial(asked, failed)

    @property
    def _action_judge(self) -> Any:
        """What says how dangerous actions are; where nobody does, the judge that learns."""
        return getattr(self.reviser, "risk", self.judge)

    @property
    def learn(self) -> bool:
        """Whether machine and judge learn; if it is set, an episode under way is broken off."""
        return self._learn

    @learn.setter
    @transaction
    def learn(self, learn: bool) -> None:
        learn = self._learn = truth("learn", learn)
        self._since = (0, 0) if learn else self._since
        if self.judge is not None and hasattr(self.judge, "learning"):
            self.judge.learning = learn
        self._under_way = False
        if self.machine is not None and not learn:
            self.machine.start_episode()
        self._frozen = None if learn or self.machine is None else self.machine.model()

    @transaction
    def freeze(self) -> None:
        """Learn nothing from now on: the same episode is decided the same again, bit for bit.

        An episode that is under way is broken off: nothing more is learnt from it. Where guarded
        episodes ended worse than those of the controller alone, or prevented too few failures,
        proposals pass (`evofsm.guard.harm`). It warns of that, of one that refuses nearly all, or
        keeps it from its goal, and where ``failed`` misses some.
        """
        self.learn = False
        if why := self._why_passing():
            warnings.warn(f"this guard {why}: frozen so, proposals pass", stacklevel=3)
        elif why := getattr(self.judge, "uncovered", ""):
            warnings.warn(f"{why}; it has to cover each kind (another unit?)", stacklevel=3)
        elif self._observing is not None and (why := self._observing.harm.spoiling):
            warnings.warn(f"this guard {why}; learn on, or look at print(guard)", stacklevel=3)

    def _why_passing(self) -> str:
        """Why proposals pass in the episode to come; empty where they need not."""
        if self._observing is None or not self.shadow:
            return ""
        return self._observing.harm.passing(learning=self._learn)

    @property
    def situation(self) -> Situation:
        """Where the system is, as of the latest `decide` in this episode."""
        if self._latest is None:
            raise RuntimeError("no observation was given yet in this episode")
        return self._latest

    def _savepoint(self) -> Rollback:
        """What takes back all that is done from now on."""
        parts: Any = self.machine, self.judge, self.reviser, self.audit
        rollbacks = [part.savepoint() for part in parts if hasattr(part, "savepoint")]
        rollbacks.append(as_now(self))

        def rollback() -> None:
            for take_back in rollbacks:
                take_back()

        return rollback

    @transaction
    def begin(self, twin: Self | None = None) -> int:
        """Begin an episode; one that is under way is broken off, and nothing follows from it.

        Returns its number, from 1, by which `decide` and `end` know whose episode they are asked
        of. Where it was decided elsewhere (`revise`), ``twin`` is the guard that did.
        """
        self._begun += 1
        self._begin(twin)
        return self._begun

    def _begin(self, twin: Self | None = None) -> None:
        """Begin the episode of that number."""
        self._forget()
        self._decisions = self._acted = self._watched = self._kept = 0
        self.reviser.start_episode()
        self._passing = self._why_passing() if twin is None else twin._passing
        if hasattr(self.reviser, "passing"):
            self.reviser.passing = self._passing
        if self.judge is not None:
            self.judge.start_episode()
        if self.machine is not None and self._learn:
            self.machine.start_episode()
        if self.audit is not None:
            self.audit.begin(self)
        self._under_way = True

    def _forget(self) -> None:
        """Nothing was observed yet."""
        self._latest: Situation | None = None
        self._time = math.nan  # of the latest observation [s]
        self._stale = 0  # observations since one that was later than the one before
        # The latest value of each variable; NaN of one that was never seen.
        self._held: NDArray[np.float64] = np.empty(0)

    @transaction
    def decide(
        self,
        observation: ArrayLike,
        proposal: Proposal | ArrayLike | None,
        time: float | None = None,
        *,
        episode: int | None = None,
    ) -> Revision:
        """What to execute instead of a proposal; the proposal itself where that will do.

        Parameters
        ----------
        observation : (m,) array_like
            NaN where a variable was not observed.
        proposal : float, (d,) array_like, Proposal or None
            What the controller wants; None, or NaN, where it has nothing: a learnt judge is then
            asked of the middle of the range, or action 0, which need not be safe.
            ``Proposal(action, mask=...)`` also says which actions are allowed now.
        time : float, optional
            Of the observation, in this episode [s]; without it decisions are counted, one every
            `interval`. What is not later than the one before tells nothing new; across more than
            1.5 intervals nothing is learnt.
        episode : int, optional
            Its number, which `begin` returned: so several that feed one guard cannot mix their
            episodes up.

        Returns
        -------
        Revision
            What is executed is a whole number, of type int, where actions are `Choices`, and an
            array that is read only where they are `BoxActions`.

        Raises
        ------
        TypeError, ValueError
            If observation, proposal or time are not real numbers, or an entry is infinite, larger
            than 1e30, or beyond the judge's ``ranges``.
        RuntimeError
            If another episode was begun since the one of that number.
        """
        if episode not in (None, self._begun):
            raise RuntimeError(
                f"episode {episode} was broken off as another began with the same guard (several "
                "environments with one guard?); run them all under RevisedVectorActions or "
                "RevisedAgents, or give each a guard of its own, such as guard.copy(); then reset"
            )
        proposal = proposed(self.actions, proposal)
        if time is None:
            time = self._decisions * self.interval if self._under_way else 0.0
        return self.revise(self.recognise(observation, time), proposal)

    @transaction
    def recognise(self, observation: ArrayLike, time: float) -> Situation:
        """The first half of `decide`: where the system is; machine and judge learn from it.

        An observation that is no newer than the one before changes nothing: the situation is still
        that one. After five such the clock was set back, and goes on from there as after a gap; or
        it stands still, and nothing is seen.

        Parameters
        ----------
        observation, time
            As in `decide`.
        """
        z, time = self._checked(observation), self._seconds(time)
        if not self._under_way:
            self._begin()
        before, row = self._time, z
        intake, z = self._take(z, time)
        if intake and intake & STALE and self._latest is not None:
            situation = self._latest._replace(intake=intake)
        else:
            # What comes after a gap does not follow from what was before. The machine begins
            # first, as a judge learns from what it made of it.
            step, bridges = time - before, getattr(self.judge, "bridges", 0.0)
            is_gap = bool(intake and intake & Intake.GAP)
            if is_gap and self.machine is not None and self._learn:
                self.machine.start_episode()
            is_gap = is_gap and not 0.0 < step <= bridges
            if is_gap and self.judge is not None:
                if self._learn:
                    self.judge.end(None, failed=False)
                self.judge.start_episode()
            self._count_gaps(step, is_gap=is_gap)
            situation = self._latest = self._recognised(z, time, intake)
        if self.audit is not None:
            self.audit.seen(row, time)
        return situation

    def _take(self, z: NDArray[np.float64], time: float) -> tuple[Intake, NDArray[np.float64]]:
        """What is wrong with an observation, which is held unless it comes too late; and itself."""
        stands = time == self._time
        self._stale = self._stale + 1 if time <= self._time else 0
        if 0 < self._stale <= _STALE:
            return Intake.REPEATED if stands else Intake.LATE, z
        if self._stale == _STALE + 1:
            clock = "stands still: nothing is seen" if stands else "was set back, and goes on so"
            last = f"{self._time:g} s, the time of the one before: the clock {clock}"
            text = f"times of {self._stale} observations on end were no later than {last}"
            warnings.warn(text, stacklevel=6)
        z = np.full(len(z), math.nan) if stands else z
        intake, latest_row = Intake.WHOLE, z
        if is_missing(z):
            intake = Intake.PARTIAL
            if len(self._held) == len(z):  # what was seen of them before is still held
                latest_row = np.where(np.isnan(z), self._held, z)
        if time < self._time or time - self._time > _GAP * self.interval:  # false of the first
            intake |= Intake.GAP
        self._held, self._time = latest_row.copy(), time
        return intake, z

    def _seconds(self, time: float) -> float:
        """A time after which another is later by an interval."""
        is_number = type(time) is float or isinstance(time, SupportsFloat)  # asked quickly first
        seconds = float(time) if is_number else math.nan
        if not seconds < seconds + self.interval:  # nor is it of NaN, or infinite
            size = f"finite and small enough to tell {self.interval:g} s apart"
            hint = f"it must be a number of seconds, {size}: count from the start of the episode"
            raise ValueError(f"time is {time!r}; {hint}")
        return seconds

    def _checked(self, observation: ArrayLike) -> NDArray[np.float64]:
        """An observation that judge and machine can take in; NaN stays."""
        z = real_array("observation", observation, 1)
        z.setflags(write=False)  # judge, reviser and logger are shown it
        judge, machine = self._action_judge, self.machine
        count = len(self.variables) or getattr(judge, "n_variables", 0)
        count = count or (0 if machine is None else machine.n_variables) or len(self._held)
        if count and len(z) != count:
            names = in_a_line(f" ({', '.join(self.variables)})") if self.variables else ""
            raise ValueError(f"observation has {len(z)} variables; it must have {count}{names}")
        if fault := self.beyond(z):
            raise ValueError(" ".join(fault))
        self._count_missing(z)
        return z

    def beyond(self, z: NDArray[np.float64]) -> tuple[str, str] | None:
        """The first variable of an observation (m,) that cannot be so, and why; NaN can."""
        least, most = ends_of(self._action_judge, len(z))
        if True not in (wrong := ((z < least) | (z > most)).tolist()):
            return None
        k = wrong.index(True)
        name = in_a_line(self.variables[k]) if self.variables else f"observation[{k}]"
        return name, (
            f"is {z[k]:g}; it must lie between {least[k]:g} and {most[k]:g} (another unit, or "
            "direction, or does it stand for what was not seen? That is NaN, in JSON null)"
        )

    def _count_missing(self, z: NDArray[np.float64]) -> None:
        """Warn where no observation is whole for long: nothing is learnt from such."""
        self._lacking = self._lacking + 1 if is_missing(z) else 0
        if self._lacking == _MANY:
            names = ", ".join(map(self._labels.variable, np.flatnonzero(np.isnan(z)).tolist()))
            warnings.warn(
                f"none of {_MANY} observations on end was whole, and nothing is learnt from such: "
                f"missing (NaN) is {names}. Leave it out of what is observed, or see to the sensor",
                stacklevel=7,
            )

    def _count_gaps(self, step: float, *, is_gap: bool) -> None:
        """Warn where most observations come after a gap in time: nothing is learnt across."""
        self._gaps = self._gaps + 1 if is_gap else max(0, self._gaps - 1)
        if is_gap and self._gaps == _MANY:
            lag = f"the latest {step:.3g} s, where interval is {self.interval:g} s"
            warnings.warn(
                f"of late most observations come over {_GAP} intervals after the last one, {lag}: "
                "nothing is learnt or carried across. Is the loop too slow, or is time not in s?",
                stacklevel=6,
            )

    def _recognised(self, z: NDArray[np.float64], time: float, intake: Intake) -> Situation:
        """Where it is; machine and judge learn the transition to it."""
        machine, model, latest_row = self.machine, self._frozen, self._held
        belief, surprise, state_time = np.ones(1), math.nan, math.nan
        state: int | None = None
        is_incomplete = bool(intake) and bool(intake & Intake.PARTIAL)
        if model is not None:
            if model.n_states and not is_missing(latest_row):
                belief = model.recognise(latest_row)
                state = int(belief.argmax())
        elif machine is not None and not (is_incomplete and machine.n_states == 0):
            step = machine.observe(z, partial=is_incomplete)
            belief, state, surprise = step.belief, step.state, step.surprise
        if self._observing is not None and self._learn:
            self._observing.observe(z)
        if machine is not None and state is not None:
            learnt, settings = opened(machine)  # frozen, it stays as it is
            near = {"radius": settings.radius}
            offset = (latest_row - learnt.centers[:, state]) * settings.weights
            is_beyond = offset.dot(offset) > reach(machine.rule, near, machine.width) ** 2
            state_time = 0.0 if is_beyond else float(learnt.sums[VISITS, state]) * self.interval
        return Situation(z, belief, state, surprise, time, intake, state_time)

    @transaction
    def revise(
        self, situation: Situation, proposal: Proposal, executed: Action | None = None
    ) -> Revision:
        """The second half of `decide`: what to execute; machine and judge learn from it.

        Parameters
        ----------
        situation, proposal
            What `recognise` returned, and what the controller wants.
        executed : float or (d,) array_like, optional
            An action of the set, where it was decided elsewhere: that is learnt from. Not for a
            guard with an audit log, which could not be replayed then.
        """
        revision = self.reviser.revise(situation, proposal)
        if not isinstance(self.reviser, ActionReviser):  # which executes nothing else if it acts
            self._refuse_unfit(revision)
        if self.explaining or self.audit is not None:
            revision = self._explained(situation, revision)
        if self.audit is not None:
            self.audit.decided(situation, proposal, revision)
        self._take_in(situation, revision.executed if executed is None else fixed(executed))
        if isinstance(self.actions, Choices):
            choice, advice = int(revision.executed), int(revision.advised)
            revision = revision._replace(executed=choice, advised=advice)
        return revision

    def _refuse_unfit(self, revision: Any) -> None:
        """Raise for what somebody's own reviser would execute, if that is no action of the set."""
        name = type(self.reviser).__name__
        if not isinstance(revision, Revision):
            raise TypeError(f"{name}.revise gave {revision!r}; it has to give a Revision")
        with suppress(TypeError, ValueError):
            if not make_usable(Proposal(revision.executed), self.actions).remark:
                return
        raise ValueError(
            f"{name} would execute {revision.executed!r}, which is none of {self.actions}"
        )

    def _take_in(self, situation: Situation, executed: Action) -> None:
        """Machine and judge learn what was executed; what follows on none of the set is not theirs.

        A judge of cars is told of it, too: it knows what its own brakes cannot have done.
        """
        knows = self._learn and same_action(put_into(self.actions, executed), executed)
        self._decisions += 1
        if self.machine is not None and knows and situation.state is not None:
            self.machine.act(self.actions.encode(executed))
        if self._observing is not None and knows:
            self._observing.act(executed)
        if self.judge is None or (situation.intake and situation.intake & STALE):
            return
        if not self._learn:
            self.judge.follow(situation.observation, executed)
            return
        is_watched = not getattr(self.reviser, "acts", True)
        self.judge.learn(situation.observation, executed, watched=is_watched)
        if is_watched:
            self._watched += 1
        elif (refuses := getattr(self.reviser, "refuses", None)) is not None:
            self._acted += 1
            self._kept += not refuses

    def _explained(self, situation: Situation, revision: Revision) -> Revision:
        """With what the machine has seen come of what is executed, where that is asked for."""
        if self.machine is None or situation.state is None:
            return revision
        if not (self.explaining or is_spoken(self.reviser, revision)):
            return revision
        action = None
        if self.actions.n_actions > 1:  # else nobody acts
            action = self.actions.encode(put_into(self.actions, revision.executed))
        if self._frozen is None:
            text = self.machine.explain(action, self._labels).text
        else:
            nearest = self._frozen.nearest(self._held)
            text = explain(self._frozen, situation.belief, action, self._labels, nearest).text
        if words := self.told_here(situation.observation):
            text = f"{text} {words}"
        return revision._replace(explanation=text)

    def told_here(self, z: ArrayLike) -> str:
        """What the judge knows of failures and dead ends near an observation (m,), in words."""
        if self._observing is None or self.machine is None:
            return ""
        words, centre = self._observing.told_here(np.asarray(z, np.float64))
        if centre is None:
            return words
        state = (self._frozen or self.machine.model()).nearest(centre).state
        return f"{words} Its centre is in #{state + 1}."

    @transaction
    def end(
        self,
        failed: bool = False,
        observation: ArrayLike | None = None,
        *,
        terminated: bool = False,
        score: float | None = None,
        episode: int | None = None,
    ) -> None:
        """End the episode, and learn from how it ended.

        Parameters
        ----------
        failed : bool
            Whether it ended in failure; also if `failed` of the guard says so of the last
            observation.
        observation : (m,) array_like, optional
            The last one, on which nothing was decided any more.
        terminated : bool
            Whether it ended by itself, as where a goal is reached, and was not cut off: a learnt
            judge learns where, and looks no further. As in Gymnasium; what failed has failed.
        score : float, optional
            How well the episode went, more is better, as the sum of rewards: a guard under which
            episodes that do not fail get less than those of the controller alone does not help.
        episode : int, optional
            As in `decide`; of one that was broken off nothing is left to end.

        Raises
        ------
        TypeError, ValueError
            If ``failed`` or ``terminated`` is neither True nor False, ``score`` is no finite
            number, or as in `decide`.
        OSError
            If the audit log cannot be written. Give the guard another, or none, and end it then.
        """
        if episode not in (None, self._begun):
            return
        failed, terminated = truth("failed", failed), truth("terminated", terminated)
        if score is not None:
            score = float(usable_array("score", [score])[0])
        z = None if observation is None else self._checked(observation)
        if not self._under_way:
            self._begin()
        last = self._latest.observation if z is None and self._latest is not None else z
        if self.failed is not None and last is not None:
            failed = failed or asked(self.failed, last)
        terminated = terminated and not failed
        machine = self.machine if self._learn else None
        if machine is not None:
            has_gaps = z is not None and is_missing(z)
            if z is not None and (machine.n_states or not has_gaps):
                machine.observe(z, failed=failed, partial=has_gaps)
            elif failed and machine.state is not None:
                machine.fail()
            machine.tell_of_failures()
        if z is not None and self._observing is not None and self._learn:
            self._observing.observe(z)
        if machine is not None and not failed:
            machine.start_episode()
        if self.judge is not None:
            if self._learn:
                self.judge.end(z, failed=failed, terminated=terminated)
            self.judge.start_episode()
        self._under_way = False
        if self._learn:
            if (judge := self._observing) is not None:
                counts = self._acted, self._watched, self._kept
                judge.harm = judge.harm.after(counts, failed=failed, ended=terminated, score=score)
            self.n_episodes += 1
            self.n_failed += failed
        else:
            self._since = self._since[0] + 1, self._since[1] + failed
        if self.audit is not None:
            self.audit.ended(z, failed=failed, terminated=terminated, score=score)

    @alone
    def __str__(self) -> str:
        """Its judge, what it learnt from, and what it knows of failure, a line each."""
        judge, actions = self._action_judge, self.actions
        if isinstance(actions, Choices):
            span = f"{actions.n_actions} actions"
        else:
            span = f"actions from {actions.low} to {actions.high}"
        settings = (f"{name} {value}" for name, value in settings_of(self.reviser).items())
        how = ", ".join([type(self.reviser).__name__, *settings])
        is_tested = hasattr(self.reviser, "passing") and self._observing is not None
        if is_tested and (self._learn or not self.shadow):
            how += ", in shadow where in doubt" if self.shadow else ", harm is not noticed"
        latest = [] if self._observing is None else self._observing.harm.guarded
        of_late = f" ({sum(o.failed for o in latest)} of the latest {len(latest)} guarded)"
        since = f" ({self._since[1]} of {self._since[0]} episodes failed since)" * any(self._since)
        lines = [
            f"{type(self).__name__} of {span}, each {self.interval:g} s",
            f"judge: {'none' if judge is None else type(judge).__name__} ({how})",
            f"episodes: {self.n_episodes}, failures: {self.n_failed}"
            f"{of_late if latest else ''}, states: "
            f"{0 if self.machine is None else self.machine.n_states}, "
            f"frozen: {'no' if self._learn else 'yes'}{since}",
        ]
        if words := getattr(judge, "told_by_experience", ""):
            lines.append(f"failure: {words}")
        return "\n".join(lines)

    # What another process gets has a lock of its own, and what it learns there stays there.
    @alone
    def __getstate__(self) -> dict[str, Any]:
        # An audit log is the file of this one.
        return unshared(self) | {"audit": None, "process": None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        share(self)

    def __copy__(self) -> Self:
        return self.copy()

    @alone
    def copy(self, *, states: bool = True) -> Self:
        """A twin that learns for itself, as between two episodes; without the audit log.

        Parameters
        ----------
        states : bool
            Whether it has the machine too. Without it the same is decided, unless the judge asks
            the states, and nothing is recognised.
        """
        machine = None if self.machine is None else self.machine.copy()
        memo = {id(self.machine): machine}  # for a judge that asks the machine
        try:
            reviser, judge = copy.deepcopy((self.reviser, self.judge), memo)
        except Exception as error:
            text = "the judge or reviser cannot be copied, as for each of several environments"
            error.add_note(f"{text} that share a guard: give it __deepcopy__")
            raise
        settings = {name: getattr(self, name) for name in (*_PLAIN_SETTINGS, "failed")}
        machine = machine if states else None
        twin = type(self).of(reviser, judge=judge, machine=machine, **settings)
        vars(twin).update({**vars(self), **vars(twin)})  # with what a class of one's own adds
        return twin

    @alone
    def save(self, path: Place, provenance: Mapping[str, Any] | None = None) -> None:
        """Write all of it to one file: machine, judge and settings.

        An episode under way is not kept: whoever loads the file begins a new one. Neither are the
        audit log, attributes that a class of your own adds, and the function `failed`, which is
        code: `load` takes that again.

        Parameters
        ----------
        path : path-like, or file open for writing bytes
        provenance : mapping, optional
            What it learnt from, for people; kept in the file.

        Raises
        ------
        OSError
            If it cannot be written.
        ValueError
            If the reviser is of someone's own class, so that no file can say what it is.
        """
        parts = outline(self)
        if parts["reviser"] is None:
            names = f"{type(self.reviser).__name__} of {type(self.actions).__name__}"
            needs = "evofsm.participants declares it and its parts, with described and restored"
            raise ValueError(f"no file can hold {names}: {needs}; actions are evofsm's own")
        settings = {
            **parts,
            "failed": self.failed is not None,
            **{name: getattr(self, name) for name in _PLAIN_SETTINGS},
        }
        files = {"machine": _bytes(self.machine), "judge": _bytes(self.judge)}
        store.write(path, KIND, settings, files, provenance)

    @classmethod
    def load(
        cls,
        path: Place,
        *,
        judge: ActionJudge | type[LearningJudge] | None = None,
        failed: Callable[[NDArray[np.float64]], bool] | None = None,
        model: Callable[[NDArray[np.float64], Any], ArrayLike] | None = None,
        backup: Callable[[NDArray[np.float64]], ArrayLike] | None = None,
    ) -> Self:
        """Read a guard, as it was between two episodes.

        Parameters
        ----------
        path : path-like, or file open for reading bytes
        judge : type or ActionJudge, optional
            The class of the judge, or a judge as it is, where no installed package declares it as
            an entry point of ``evofsm.participants``.
        failed, model, backup : callable, optional
            As in `Guard`; ``failed`` is needed where the guard had one.

        Raises
        ------
        OSError, ValueError
            If the file cannot be read, holds something else or is damaged, or judge or ``failed``
            are needed.

        Examples
        --------
        >>> from io import BytesIO
        >>> from evofsm.driving import guard_for_cars
        >>> guard, file = guard_for_cars(low=-2.5, high=2.5), BytesIO()
        >>> guard.save(file)
        >>> Guard.load(BytesIO(file.getvalue())).interval
        0.25
        """
        settings, files = store.read(path, KIND)
        with store.explained(path):
            if settings["failed"] and failed is None:
                raise ValueError("this guard knew failures by a function; give it again: failed=")
            parts = rebuild(settings, files, judge)
            plain = {name: settings[name] for name in _PLAIN_SETTINGS}
            guard = cls.of(failed=failed, **parts, **plain)
            if isinstance(guard.judge, LearntRisk):
                guard.judge.model, guard.judge.backup = model, backup
            elif model is not None or backup is not None:
                raise ValueError(f"{type(guard.judge).__name__} asks no model and no backup")
            return guard


def warm() -> None:
    """Compile now what machines and guards need; say so where it takes long.

    Compiled code is kept on disk, so that this is quick from the second time on. A guard that is
    made compiles what it needs itself, what follows a first failure too: nobody expects to wait
    then.

    Examples
    --------
    >>> from evofsm import warm
    >>> warm()
    """
    Guard(-1.0, 1.0, interval=1.0)


@cache
def _warm_machine() -> None:
    """Compile what machines need."""
    if not COMPILES:
        return
    announce_compiling()
    machine = EvolvingFSM(1)
    machine.learn_many([[0.0, 0.0], [9.0, 0.0]], [0, 0])
    machine.observe([np.nan, 0.0], partial=True, failed=True)


def ends_of(judge: ActionJudge | None, m: int) -> NDArray[np.float64]:
    """(2, m) ndarray: least and most that each of m variables can be."""
    ranges = getattr(judge, "ranges", ((-_LARGEST_VALUE, _LARGEST_VALUE),))
    return _resized(tuple(map(tuple, ranges)), m)  # lists cannot be remembered


@cache
def _resized(ranges: tuple[tuple[float, float], ...], m: int) -> NDArray[np.float64]:
    return np.resize(ranges, (m, 2)).T


def answered(reply: Any) -> bool:
    """What a function ``failed`` returned: true or false, or a number that stands for it."""
    if np.size(reply) != 1 or np.asarray(reply).dtype.kind not in "biu":
        raise TypeError(f"failed returned {reply!r}; it must be True or False")
    return bool(reply)


def asked(failed: Callable[[NDArray[np.float64]], bool], z: NDArray[np.float64]) -> bool:
    """Whether a function says that an observation is a failure."""
    return ask("failed", failed, answered, z)


def _actions(low: ArrayLike | None, high: ArrayLike | None, n_actions: int | None) -> ActionSet:
    if n_actions is not None:
        if (low, high) != (None, None):
            raise ValueError("give low and high, or n_actions, not both")
        return Choices(n_actions)
    if low is None or high is None:
        raise ValueError("give low and high of the action, or n_actions")
    if np.ndim(low) or np.ndim(high):
        if not (np.ndim(low) and np.ndim(high)):  # a number is the end of each component
            low, high = np.broadcast_arrays(low, high)
        ends: Any = low, high
        return BoxActions(*ends)
    least, most = np.asarray(low, np.float64).item(), np.asarray(high, np.float64).item()
    width = (most - least) / _INTERVALS if least < most else 1.0
    return IntervalActions(least, most, width, outside="clip")


def _bytes(saved: EvolvingFSM | LearningJudge | None) -> NDArray[np.uint8]:
    """The file that it saves itself to, which can be loaded; empty where there is none."""
    file = BytesIO()
    if saved is not None:
        saved.save(file)
        name = type(saved).__name__
        if not file.getvalue():
            raise ValueError(f"{name}.save wrote nothing: what it learnt would be lost")
        again: Any = type(saved).load(BytesIO(file.getvalue()))
        if again is None:
            raise ValueError(f"{name}.load gave None: what it learnt would be lost")
        if isinstance(saved, ObservingJudge):
            rows, harm = ((*j.harm[1:], j.harm.rows.tolist()) for j in (again, saved))
            if rows != harm:  # by which a loaded guard knows whether to act
                raise ValueError(f"{name}.save does not keep harm, or load it")
    return np.frombuffer(file.getvalue(), np.uint8)
