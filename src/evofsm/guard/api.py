"""The few shapes that rooms agree on: who proposes, who judges, who revises."""

from __future__ import annotations

import math
from collections.abc import Mapping
from enum import IntFlag
from typing import TYPE_CHECKING, Any, Final, NamedTuple, Protocol, Self, runtime_checkable

from numpy.typing import ArrayLike

if TYPE_CHECKING:  # whoever asks for a number here waits for no compiler
    from evofsm.fsm.naming import Labels
    from evofsm.fsm.validation import Floats
    from evofsm.guard.actions import Action, ActionSet, Mask
    from evofsm.guard.harm import Harm
    from evofsm.store import Place

#: The highest risk, a probability of failure, that a reviser lets pass.
TOLERANCE: Final = 0.02
#: Share of a belief that a machine may leave out, which saves most of the time with many states.
BELIEF_TOLERANCE: Final = 1e-6


class Proposal(NamedTuple):
    """What a controller wants to do.

    Examples
    --------
    >>> Proposal(1.2)
    Proposal(action=1.2, mask=None)
    """

    #: of a car the acceleration [m/s²]; of `Choices` an index, of `BoxActions` a (d,) array
    action: Action
    #: (n,) which actions of `Choices` are allowed now, whatever is executed; None for all
    mask: Mask | None = None


class Intake(IntFlag):
    """What was wrong with an observation, and so what was done about it."""

    WHOLE = 0  #: nothing
    PARTIAL = 1  #: variables are missing: recognised by the others, and not learnt from
    GAP = 4  #: it came long after the one before: no transition is learnt to it
    REPEATED = 8  #: as old as the one before: nothing new is known, or learnt
    LATE = 16  #: older than the one before: left out


#: Observations that bring nothing new.
STALE = Intake.REPEATED | Intake.LATE


class Situation(NamedTuple):
    """Where the system is, as it was observed and as the machine recognised it."""

    observation: Floats  #: (m,) in the judge's units; NaN where not seen
    belief: Floats  #: (n,) distribution over states
    state: int | None  #: index of the most probable state; None where there is none yet
    surprise: float  #: divergence of forecast and belief [bit]; NaN where nothing was forecast
    time: float  #: [s]
    intake: Intake = Intake.WHOLE  #: whether the observation was whole and in time
    seen: float = math.nan  #: time spent in this state so far [s]; NaN where that is not known


def is_missing(z: Floats) -> bool:
    """Whether a variable of an observation is NaN; the quickest way to ask for it."""
    return math.isnan(z.dot(z))


class Revision(NamedTuple):
    """What a reviser made of a proposal, and why.

    Its actions are floats, of `Choices` whole numbers, of `BoxActions` (d,) arrays that are read
    only: compare them by `same_action`.
    """

    executed: Action  #: action to execute; of a car the acceleration [m/s²]
    proposed: Action  #: action that the controller wanted; NaN where it had none
    risk_proposed: float  #: `Judgement.risk` of the proposal; NaN where not judged
    risk_executed: float  #: the same for what is executed
    interval: tuple[float, float]  #: 90 % interval of `risk_executed`
    reason: str  #: in a few words
    evidence: float  #: number of disturbances that the risks rest on
    seen: float  #: time spent in states like this one before [s]; NaN where that is not known
    advised: Action  #: what the reviser would execute, whether or not it may act
    explanation: str = ""  #: what a machine's experience says of it, where that was asked for


class Controller(Protocol):
    """Anything that proposes actions."""

    def propose(self, observation: Floats, time: float = 0.0) -> Proposal:
        """What it wants to do at ``time`` [s], seeing ``observation``, as `Guard.decide` has it."""


class Reviser(Protocol):
    """Anything that keeps a proposal or replaces it by a better action."""

    @property
    def actions(self) -> ActionSet:
        """What it executes is one of them."""

    def start_episode(self) -> None:
        """Forget what was under way."""

    def revise(self, situation: Situation, proposal: Proposal) -> Revision:
        """What to execute instead of the proposal; the proposal itself where it will do."""


class Judgement(NamedTuple):
    """How dangerous some actions are; an entry for each of them.

    ``risk`` is the probability that failure can no longer be avoided if the action is taken now, of
    cars if the leader brakes hard right then, with its 90 % interval from ``low`` to ``high``.
    """

    risk: Floats  #: (k,)
    low: Floats  #: (k,)
    high: Floats  #: (k,)
    critical: Floats  #: (k,) hardest disturbance that is survived, in its own unit
    evidence: float  #: number of disturbances it rests on; NaN: the risks decide, but are not known
    seen: float = math.nan  #: time spent in states like this one [s]; NaN where that is not known


class Fallback(NamedTuple):
    """What is done where a controller proposes nothing that can be executed."""

    #: put at the edge of the set where it lies outside; a number stands for every component
    action: Action
    doing: str  #: in words


class Trial(NamedTuple):
    """An action that has to be tried, because the judge does not know yet what it brings."""

    action: Action
    unknown: str  #: what is not known, such as "own brakes not known yet"
    how: str  #: such as "in full"
    doing: str  #: such as "braking in full to learn them"
    assumed: str  #: what is assumed until it is known


class ActionJudge(Protocol):
    """Anything that can be asked how dangerous an action is, whatever system it knows.

    Actions come as a (k,) array, of `BoxActions` as a (k, d) one; it changes none of what it is
    given, and an observation is read only. Where environments share a guard, each has a copy of it
    (`copy.deepcopy`). One that knows what the variables of an observation can be may say so as
    ``ranges``, (least, most) of each, of more in turn: a guard refuses all else. With
    ``lowest_first`` true the lowest of several actions that are least risky is taken, as cars
    brake; else the one closest to the proposal.
    """

    #: What it calls the variables of an observation.
    labels: Labels
    #: What is done without a usable proposal.
    fallback: Fallback

    def judge(self, situation: Situation, actions: ArrayLike, /) -> Judgement:
        """How dangerous each action is."""

    def why(self, judged: Judgement, /) -> str:
        """Why the first action that was judged is dangerous, in a few words."""

    def trial(self) -> Trial | None:
        """What it has to try before its judgement can be relied on; None if nothing."""
        return None

    def effective(self, situation: Situation, actions: Floats, /) -> Floats:
        """What actions come to here, where some of them would change nothing."""
        return actions

    def choose(
        self,
        situation: Situation,
        options: Floats,
        judged: Judgement,
        tolerances: tuple[float, float],
        /,
    ) -> tuple[int, str] | None:
        """Index of the best option where the first, the proposal, is not tolerable, and why it is.

        None leaves it to the reviser: the closest that is tolerable, else the least risky.

        Parameters
        ----------
        situation : Situation
        options : (k,) or (k, d) ndarray
            Actions of the set, the proposal first.
        judged : Judgement
            What `judge` said of them.
        tolerances : (float, float)
            Highest risks that are accepted; the first is asked for before the second is.
        """
        return None

    def refuse_unfit(self, actions: ActionSet, /) -> None:
        """Raise a ValueError if it counts on others than these actions."""


class Search(NamedTuple):
    """What a judge found that looks for an action itself."""

    options: Floats  #: (k,) or (k, d), in the set of actions; the proposal first
    judged: Judgement  #: with an entry for each of them
    best: int  #: index of what should be executed; 0 where the proposal will do
    reason: str  #: in a few words


@runtime_checkable
class SearchingJudge(ActionJudge, Protocol):
    """A judge that looks for the best action itself, instead of judging those that it is given."""

    def search(
        self, situation: Situation, wanted: Action, /, *, tolerance: float, mask: Mask | None
    ) -> Search:
        """The action closest to ``wanted`` that is within the tolerance.

        Parameters
        ----------
        situation : Situation
        wanted : action
            The proposal, one of the set.
        tolerance : float
            Highest risk that is accepted.
        mask : (n,) ndarray of bool, optional
            Which of `Choices` are allowed, ``wanted`` among them; None where all are.
        """


@runtime_checkable
class LearningJudge(ActionJudge, Protocol):
    """A judge that learns from what happens, and can be kept in a file.

    One that also learns from being asked, or tries actions, may have an attribute ``learning``: the
    guard sets it to whether anything may be learnt; ``bridges``, ``n_variables``, ``uncovered`` and
    ``told_by_experience`` it reads: call nothing else so. A method that raises should leave it as
    it was; what others did in the same call a guard takes back where it has a method ``savepoint``.
    """

    dt: float  #: time between decisions [s]

    def learn(self, observation: ArrayLike, action: Action, /, *, watched: bool = False) -> None:
        """Take in an observation, and the action executed after it.

        Parameters
        ----------
        observation : (m,) array_like
            In the judge's units; NaN where not seen.
        action : action
            One of the set.
        watched : bool
            Whether someone else acts, as where proposals pass.
        """

    def follow(self, observation: ArrayLike, action: Action, /) -> None:
        """Keep up with what happens, without learning from it."""

    def start_episode(self) -> None:
        """What comes is not a consequence of what was, which is not learnt from any more."""

    def end(self, observation: Floats | None, *, failed: bool, terminated: bool = False) -> None:
        """Learn how an episode ended, or a part of one before a gap in time.

        Parameters
        ----------
        observation : (m,) ndarray or None
            The last one, if there is one.
        failed, terminated : bool
            As in `Guard.end`.
        """

    def save(self, path: Place, provenance: Mapping[str, Any] | None = None) -> None:
        """Write what was learnt to a file."""

    @classmethod
    def load(cls, path: Place) -> Self:
        """Read what was learnt, between two episodes."""


@runtime_checkable
class ObservingJudge(LearningJudge, Protocol):
    """A learning judge that, while it learns, sees each observation, asked or not.

    Meanwhile the controller drives some episodes alone, and it may be found to do harm
    (`evofsm.guard.harm`). Its `save` keeps `harm`. Frozen, it is shown decisions alone (`follow`).
    """

    harm: Harm  #: how episodes ended, guarded and alone: `Harm()` at first, then the guard's

    def observe(self, observation: Floats, /) -> None:
        """Take in an observation (m,), NaN where something was not seen."""

    def act(self, action: Action, /) -> None:
        """Take in what was executed after it; another one replaces it."""

    def told_here(self, observation: Floats, /) -> tuple[str, Floats | None]:
        """What it knows of failure near an observation, and the centre of the dead end there."""
        return "", None


class RiskMeasure(Protocol):
    """Anything that says how dangerous a situation is."""

    def score(self, observations: Floats, dt: float) -> Floats:
        """(T,) danger of each row of an episode, from it and the rows before it only.

        Rows are gap [m], speed of the follower and of the leader [m/s], ``dt`` [s] apart. Danger is
        in the measure's own unit; above 0 it calls for braking.
        """


# Of each kind of part its protocol, and what is asked of it.
_PARTS_HAVE = {
    "judge": ("ActionJudge", "judge why labels fallback trial effective choose refuse_unfit"),
    "judge that learns": ("LearningJudge", "dt learn follow start_episode end save load"),
    "reviser": ("Reviser", "actions revise start_episode"),
    "audit": ("DecisionLogger", "begin seen decided ended"),
}


def refuse_lacking(kind: str, part: object) -> None:
    """Raise a TypeError where a judge, a reviser or an audit lacks what it is asked for."""
    protocol, names = _PARTS_HAVE[kind]
    if lacks := [name for name in names.split() if getattr(part, name, None) is None]:
        hint = f"no {', '.join(lacks)} (is it a subclass of evofsm.guard.{protocol}?)"
        raise TypeError(f"{kind} is {part!r}, which has {hint}")
