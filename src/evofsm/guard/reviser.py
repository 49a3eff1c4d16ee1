"""The action reviser: it keeps what a controller proposes, or replaces it by something better.

The module of the paper's Section 4.2, in both of its ways: to choose among the candidates that a
controller offers, or to improve on its proposal with any action of the set. The authors' own
sequel tests an action by predicting the states it leads to, and looks at others where those are
not appropriate (Han, Filev, Ozguner, arXiv:2006.08092).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from enum import Enum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from evofsm.core import compiled
from evofsm.guard.defaults import TOLERANCE
from evofsm.guard.protocols import (
    STALE,
    ActionJudge,
    ActionSet,
    Choices,
    Fallback,
    Judgement,
    Proposal,
    Reviser,
    Revision,
    Situation,
)

# Further decisions for which an action is held whose effect is not known yet.
_TRIAL = 4
# States that were seen for a shorter time are new [s].
_NEW = 0.5
#: Done without a usable proposal where nobody says what is better.
NOTHING = Fallback(0.0, "doing nothing")


class Mode(Enum):
    """How far a reviser goes."""

    OFF = "off"  #: proposals are executed, nothing is judged
    SHADOW = "shadow"  #: proposals are executed, what it would have done is recorded
    ADVISE = "advise"  #: as shadow, and the driver is told
    ACT = "act"  #: what it decides is executed


class Way(Enum):
    """Where another action may come from."""

    CHOOSE = "choose"  #: the candidates that the controller returns
    IMPROVE = "improve"  #: any action of the set


class Usable(NamedTuple):
    """A proposal that can be executed, and what had to be done to it."""

    action: float  #: [m/s²]
    remark: str  #: empty where it is what the controller proposed


def make_usable(proposal: Proposal, actions: ActionSet, fallback: Fallback = NOTHING) -> Usable:
    """An action of the set, whatever a controller came up with.

    A proposal outside an interval is put at its edge; NaN, infinity or an index of no action
    becomes the fallback.

    Examples
    --------
    >>> from evofsm import IntervalActions
    >>> actions = IntervalActions(low=-2.5, high=2.5, width=0.3)
    >>> make_usable(Proposal(9.0), actions)
    Usable(action=2.5, remark='proposal 9 is outside [-2.5, 2.5]')
    >>> make_usable(Proposal(float("nan")), actions)
    Usable(action=0.0, remark='no usable proposal (nan): doing nothing')
    """
    low, high = actions.low, actions.high
    is_none = isinstance(actions, Choices) and proposal.action not in actions
    if not math.isfinite(proposal.action) or is_none:
        action = min(max(fallback.action, low), high)
        return Usable(action, f"no usable proposal ({proposal.action:g}): {fallback.doing}")
    if not low <= proposal.action <= high:
        action = min(max(proposal.action, low), high)
        return Usable(action, f"proposal {proposal.action:g} is outside [{low:g}, {high:g}]")
    return Usable(float(proposal.action), "")


class ActionReviser:
    """Keeps a proposal whose latent risk is tolerable, and replaces any other.

    By the least change: the action closest to the proposal whose risk is within the tolerance;
    where there is none, the least risky one. Where the judge has to try an action first
    (`protocols.Trial`), that is held for a while instead: so a car's own brakes are learnt. Once it
    has begun to revise, it keeps on until the proposal is safe by a margin, so that it does not
    chatter.

    Where nothing of what it decides is executed (any mode but `Mode.ACT`, or the driver has taken
    over), nothing is tried, and nothing is asked that would change nothing.

    Parameters
    ----------
    risk : ActionJudge
        Usually a `LatentRisk`.
    actions : IntervalActions or Choices
        The set of actions. Nothing outside it is ever executed. Of `Choices` none is closer than
        another: a proposal is kept, or replaced by the least risky one.
    tolerance : float
        Highest latent risk that is accepted, in (0, 1).
    release : float
        Share of the tolerance below which a proposal is kept again, once revising.
    mode : Mode
    way : Way

    Examples
    --------
    >>> from evofsm import IntervalActions
    >>> actions = IntervalActions(low=-2.5, high=2.5, width=0.3)
    >>> from evofsm.driving import LatentRisk
    >>> reviser = ActionReviser(LatentRisk(lowest=-2.5), actions)
    >>> close = Situation(np.array([5.0, 20.0, 20.0]), np.ones(1), 0, 0.0, 0.0)
    >>> revision = reviser.revise(close, Proposal(1.0))
    >>> revision.executed, revision.risk_proposed
    (-2.5, 1.0)
    """

    def __init__(
        self,
        risk: ActionJudge,
        actions: ActionSet,
        *,
        tolerance: float = TOLERANCE,
        release: float = 0.9,
        mode: Mode = Mode.ACT,
        way: Way = Way.IMPROVE,
    ) -> None:
        if not 0.0 < tolerance < 1.0:
            raise ValueError(f"tolerance is {tolerance}; it is a probability, between 0 and 1")
        if not 0.0 < release <= 1.0:
            raise ValueError(f"release is {release}; it must lie in (0, 1]")
        risk.refuse_unfit(actions.low, actions.high)
        self.risk = risk
        self.actions = actions
        self.tolerance = tolerance
        self.release = release
        self.mode = mode
        self.way = way
        self._overridden = False
        self._lowest, self._highest = _bounds(actions)
        self.start_episode()

    def start_episode(self) -> None:
        """Nothing is under way yet."""
        self._revising = False
        self._trial = 0

    @property
    def fallback(self) -> Fallback:
        """What is done without a usable proposal."""
        return self.risk.fallback

    @property
    def overridden(self) -> bool:
        """Whether the driver has taken over."""
        return self._overridden

    @property
    def acts(self) -> bool:
        """Whether what it decides is executed."""
        return self.mode is Mode.ACT and not self._overridden

    def take_over(self) -> None:
        """The driver overrides: proposals are executed until `hand_back`."""
        self._overridden = True

    def hand_back(self) -> None:
        """The driver lets the reviser act again."""
        self._overridden = False

    def revise(self, situation: Situation, proposal: Proposal) -> Revision:
        """What to execute instead of the proposal; the proposal itself where it will do.

        Parameters
        ----------
        situation : Situation
        proposal : Proposal
            One that is no number, or outside the set, is first made usable.

        Returns
        -------
        Revision
        """
        wanted, remark = make_usable(proposal, self.actions, self.risk.fallback)
        if not self.acts:
            self._trial = 0
        if self.mode is Mode.OFF:
            return unjudged_revision(wanted, proposal, remark or "reviser is off")
        options = self._options(wanted, proposal)
        if not self.acts and self.way is Way.IMPROVE:
            options = self.risk.effective(situation, options)
        judged = self.risk.judge(situation, options)
        best, reason = self._decide(options, judged)
        executed = best if self.acts else 0
        if not self.acts and best != 0:
            who = "driver has taken over" if self._overridden else self.mode.value
            reason = f"{who}: {reason}"
        return Revision(
            executed=float(options[executed]),
            proposed=float(proposal.action),
            risk_proposed=float(judged.risk[0]),
            risk_executed=float(judged.risk[executed]),
            interval=(float(judged.low[executed]), float(judged.high[executed])),
            reason="; ".join(
                part
                for part in (
                    remark,
                    unseen_text(situation, self.risk.labels.names),
                    _novelty(judged),
                    reason,
                )
                if part
            ),
            evidence=judged.evidence,
            seen=judged.seen,
            advised=float(options[best]),
        )

    def _options(self, wanted: float, proposal: Proposal) -> NDArray[np.float64]:
        """What could be executed, the proposal first."""
        if self.way is Way.IMPROVE:
            return np.minimum(np.maximum(wanted, self._lowest), self._highest)
        offered = (make_usable(Proposal(one), self.actions) for one in proposal.candidates)
        return np.array([wanted, *(one.action for one in offered if not one.remark)])

    def _decide(self, options: NDArray[np.float64], judged: Judgement) -> tuple[int, str]:
        """Index of the best option, and why."""
        limit = self.tolerance * (self.release if self._revising else 1.0)
        trial = self.risk.trial()
        if self._trial > 0 and trial is not None:
            self._trial -= 1
            return _closest_to(trial.action, options), f"{trial.unknown}: {trial.doing}"
        if judged.risk[0] <= limit:
            self._revising = False
            return 0, "risk is within the tolerance"
        self._revising = True
        why = self.risk.why(judged)
        if trial is not None:
            if self.acts:
                self._trial = _TRIAL
                return _closest_to(trial.action, options), f"{why}; {trial.unknown}, so {trial.how}"
            why = f"{why}; {trial.unknown}, {trial.assumed}"
        # Once revising, what is safe by the margin; else whatever is tolerable.
        least = _least_risky(options, judged.risk)
        if isinstance(self.actions, Choices) and judged.risk[least] <= self.tolerance:
            return least, f"{why}; the least risky that can"
        for tolerated in (limit, self.tolerance):
            closest = _closest_within(options, judged.risk, tolerated)
            if closest >= 0:
                return closest, f"{why}; the closest that can"
        return least, f"{why}; nothing can, the least risky"


@compiled
def _closest_within(
    options: NDArray[np.float64], risk: NDArray[np.float64], tolerated: float
) -> int:
    """Index of the tolerable option that is closest to the first; -1 where none is."""
    best, change = -1, np.inf
    for k in range(len(options)):
        if risk[k] <= tolerated and abs(options[k] - options[0]) < change:
            best, change = k, abs(options[k] - options[0])
    return best


@compiled
def _least_risky(options: NDArray[np.float64], risk: NDArray[np.float64]) -> int:
    """Index of the option of the lowest risk; of several the lowest one."""
    best = 0
    for k in range(len(options)):
        if risk[k] < risk[best] or (risk[k] == risk[best] and options[k] < options[best]):
            best = k
    return best


def _closest_to(action: float, options: NDArray[np.float64]) -> int:
    return int(np.abs(options - action).argmin())


def unseen_text(situation: Situation, variables: Sequence[str]) -> str:
    """What is said of a situation that was not seen whole, or not in time."""
    if not situation.intake:
        return ""
    missing = [
        name
        for name, value in zip(variables, situation.observation, strict=False)
        if math.isnan(value)
    ]
    if missing:
        return f"not seen: {', '.join(missing)}"
    return "nothing new was seen" if situation.intake & STALE else ""


def _novelty(judged: Judgement) -> str:
    """Said of a situation that is new; whether it is dangerous is another question."""
    return "never seen before" if judged.seen < _NEW else ""


def is_spoken(reviser: Reviser, revision: Revision) -> bool:
    """Whether a decision changed something, would have, or raised an alarm."""
    proposed = revision.proposed
    if revision.executed != proposed or revision.advised != proposed:  # NaN differs
        return True
    return isinstance(reviser, ActionReviser) and revision.risk_proposed > reviser.tolerance


def _bounds(actions: ActionSet) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Lowest and highest value of the whole set, of each interval, and of both limits alone."""
    if isinstance(actions, Choices):
        every = np.arange(actions.n_actions, dtype=np.float64)
        return np.append(0.0, every), np.append(actions.high, every)
    lowest, highest = actions.edges[:-1].copy(), actions.edges[1:].copy()
    if actions.closed == "left":
        highest[:-1] = np.nextafter(highest[:-1], -math.inf)
    else:
        lowest[1:] = np.nextafter(lowest[1:], math.inf)
    low, high = actions.low, actions.high
    return np.array([low, *lowest, low, high]), np.array([high, *highest, low, high])


def unjudged_revision(executed: float, proposal: Proposal, reason: str) -> Revision:
    """A revision without a probability."""
    return Revision(
        executed=executed,
        proposed=float(proposal.action),
        risk_proposed=math.nan,
        risk_executed=math.nan,
        interval=(math.nan, math.nan),
        reason=reason,
        evidence=0.0,
        seen=math.nan,
        advised=executed,
    )
