"""The action reviser of the paper's Section 4.2: it keeps what is proposed, or finds a better one.

The authors' own sequel tests an action by predicting the states it leads to (Han, Filev, Ozguner,
arXiv:2006.08092).
"""

from __future__ import annotations

import math
import operator
import warnings
from copy import copy
from enum import Enum
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from evofsm.fsm.naming import Labels
from evofsm.fsm.sharing import Rollback
from evofsm.fsm.validation import Floats, action_name, check_index, number, probability, setting
from evofsm.guard.actions import (
    Action,
    ActionSet,
    BoxActions,
    Choices,
    Mask,
    action_text,
    checked_mask,
    distances,
    fixed,
    is_usable,
    limits,
    nearest_bounds,
    no_action,
    put_into,
    same_action,
)
from evofsm.guard.api import (
    STALE,
    TOLERANCE,
    ActionJudge,
    Fallback,
    Judgement,
    Proposal,
    Reviser,
    Revision,
    Search,
    SearchingJudge,
    Situation,
    refuse_lacking,
)

# Further decisions for which an action is held whose effect is not known yet.
_TRIAL = 4
# Share of the tolerance below which a proposal is kept again, once revising.
_RELEASE = 0.9
# So many proposals on end that are outside the range by more than so many widths are told of.
_CLIPPED, _CLEARLY = 100, 10.0
# States that were seen for a shorter time are new [s].
_NEW = 0.5
_KEPT = "risk is within the tolerance"
_ESTIMATED = "by an estimate alone, so its risk is not known"
#: Done without a usable proposal where nobody says what is better.
NOTHING = Fallback(0.0, "doing nothing")


class Mode(Enum):
    """How far a reviser goes."""

    OFF = "off"  #: proposals are executed, nothing is judged
    SHADOW = "shadow"  #: proposals are executed, what it would have done is recorded
    ACT = "act"  #: what it decides is executed

    @classmethod
    def _missing_(cls, value: object) -> None:
        raise ValueError(f"mode is {value!r}; it is one of {', '.join(m.value for m in cls)}")


def proposed(actions: ActionSet | None, reply: Proposal | ArrayLike | None) -> Proposal:
    """What a controller wants, of the right type, whatever its values; of None no action."""
    action, mask = reply if isinstance(reply, Proposal) else (reply, None)
    if actions is None:  # of which nothing is known
        return Proposal(action)
    if action is None:
        action = no_action(actions)
    elif isinstance(actions, BoxActions):
        action = actions.checked("proposal", action)
    elif type(action) is not float:
        if isinstance(action, np.ndarray | list):  # of one number, as policies predict it
            if np.size(action) != 1:
                raise ValueError(f"proposal has {np.size(action)} numbers; it must be a single one")
            action = np.ravel(action)[0]
        action = number("proposal", action)
    return Proposal(action, checked_mask(actions, mask))


class Usable(NamedTuple):
    """A proposal that can be executed, and what had to be done to it."""

    action: Action  #: of a car the acceleration [m/s²]
    remark: str  #: empty where it is what the controller proposed


def make_usable(proposal: Proposal, actions: ActionSet, fallback: Fallback = NOTHING) -> Usable:
    """An action of the set, whatever a controller came up with.

    A proposal outside an interval is put at its edge; NaN, infinity or an index of no action
    becomes the fallback, and so does one that is not allowed; or else the first that is.

    Parameters
    ----------
    proposal : Proposal
    actions : IntervalActions, Choices or BoxActions
    fallback : Fallback

    Examples
    --------
    >>> from evofsm import IntervalActions
    >>> actions = IntervalActions(low=-2.5, high=2.5, width=0.3)
    >>> make_usable(Proposal(9.0), actions)
    Usable(action=2.5, remark='proposal 9 is outside [-2.5, 2.5]')
    >>> make_usable(Proposal(float("nan")), actions)
    Usable(action=0.0, remark='no usable proposal (nan): doing nothing')
    """
    request, mask = proposal.action, proposal.mask
    if is_usable(actions, request, mask):
        action = put_into(actions, request)
        if same_action(action, request):
            return Usable(action, "")
        low, high = (action_text(limit) for limit in limits(actions))
        return Usable(action, f"proposal {action_text(request)} is outside [{low}, {high}]")
    action, words = put_into(actions, fallback.action), fallback.doing
    if mask is not None and not mask[int(action)]:
        action, words = float(mask.argmax()), "the first that is allowed"
    is_barred = is_usable(actions, request)
    name = f"{action_name(int(request))}, not allowed here" if is_barred else action_text(request)
    return Usable(action, f"no usable proposal ({name}): {words}")


def passed(proposal: Proposal, usable: Usable, reviser: Reviser) -> Usable:
    """What is executed of a proposal that passes: in any mode but `Mode.ACT` the very proposal.

    That may lie outside the set, or not be allowed: whoever does not act changes nothing.
    """
    can_pass = usable.remark and is_usable(reviser.actions, proposal.action)
    if not can_pass or getattr(reviser, "mode", Mode.ACT) is Mode.ACT:
        return usable
    is_barred = same_action(put_into(reviser.actions, proposal.action), proposal.action)
    remark = f"proposal {action_text(proposal.action)} is not allowed here"
    return Usable(fixed(proposal.action), remark if is_barred else usable.remark)


class ActionReviser:
    """Keeps a proposal whose latent risk is tolerable, and replaces any other.

    By the least change: the action closest to the proposal whose risk is within the tolerance;
    where there is none, the least risky one, of several the closest. Where the judge has to try an
    action first (`api.Trial`), that is held for a while instead. Once it has begun to revise, it
    keeps on until the proposal is safe by a margin, so that it does not chatter.

    A judge that looks for an action itself (`api.SearchingJudge`) is asked for it. Where nothing of
    what it decides is executed (any mode but `Mode.ACT`), nothing is tried.

    Parameters
    ----------
    risk : ActionJudge
        Usually a `LatentRisk`.
    actions : IntervalActions, Choices or BoxActions
        In `Mode.ACT` nothing outside it is ever executed. Of `Choices` none is closer than another:
        a proposal is kept, or replaced by the least risky one. In a box change is counted in half
        ranges.
    tolerance : float
        Highest latent risk that is accepted, in (0, 1).
    mode : Mode
        May be changed at any time, as where a driver takes over.

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
        mode: Mode = Mode.ACT,
    ) -> None:
        refuse_lacking("judge", risk)
        risk.refuse_unfit(actions)
        self.risk = risk
        self.fallback = risk.fallback  #: what is done without a usable proposal
        self.actions = actions
        self._refuse_unusable("fallback", self.fallback.action)
        self.tolerance = tolerance
        self.mode = mode
        #: Why proposals pass in this episode although it might act; empty where they need not.
        self.passing = ""
        self._searches = isinstance(risk, SearchingJudge)
        self._lowest, self._highest = nearest_bounds(actions)
        self._low, self._high = limits(actions)
        self._far, self._clipped = _CLEARLY * (self._high - self._low), 0
        self.start_episode()

    mode: Mode = setting("mode", lambda _, mode: Mode(mode), "How far it goes.")
    tolerance: float = setting("tolerance", probability, "Highest latent risk that is accepted.")

    def start_episode(self) -> None:
        """Nothing is under way yet."""
        self.refuses = False  #: whether the latest proposal would rather not be executed
        self._trial = 0

    def savepoint(self) -> Rollback:
        """What takes back all that is decided from now on."""
        now = {name: getattr(self, name) for name in ("refuses", "passing", "_trial", "_clipped")}
        return partial(vars(self).update, now)

    @property
    def acts(self) -> bool:
        """Whether what it decides is executed."""
        return self.mode is Mode.ACT and not self.passing

    def revise(self, situation: Situation, proposal: Proposal) -> Revision:
        """What to execute instead of the proposal, of which is judged what `make_usable` makes."""
        acts = self.acts
        action, remark = usable = make_usable(proposal, self.actions, self.fallback)
        original, remark = passed(proposal, usable, self)
        is_far = remark[:8] == "proposal" and np.any(abs(proposal.action - action) > self._far)
        self._clipped = self._clipped + 1 if is_far else 0
        if self._clipped == _CLIPPED:
            warnings.warn(f"{remark} by far, as {_CLIPPED} on end are (a unit?)", stacklevel=6)
        if not acts:
            self._trial = 0
        if self.mode is Mode.OFF:
            revision = unjudged_revision(original, proposal, remark or "reviser is off")
            return revision._replace(advised=fixed(action))
        options, judgement, best, reason = self._search(situation, action, acts, proposal.mask)
        if math.isnan(judgement.evidence):
            nans = np.full(len(options), math.nan)
            judgement = judgement._replace(risk=nans, low=nans, high=nans, evidence=0.0)
            reason = _ESTIMATED if reason == _KEPT else f"{_ESTIMATED}: {reason}"
        index, advice = best if acts else 0, fixed(options[best])
        if not acts and best != 0:
            reason = f"{self.passing or self.mode.value}: {reason}"
        unseen = unseen_text(situation, self.risk.labels) if situation.intake else ""
        # Of a situation that is new: whether it is dangerous is another question.
        new = "never seen before, as far as the states tell" if judgement.seen < _NEW else ""
        return Revision(
            executed=advice if acts else fixed(original),
            proposed=fixed(proposal.action),
            risk_proposed=float(judgement.risk[0]),
            risk_executed=float(judgement.risk[index]),
            interval=(float(judgement.low[index]), float(judgement.high[index])),
            reason="; ".join(filter(None, (remark, unseen, new, reason))),
            evidence=judgement.evidence,
            seen=judgement.seen,
            advised=advice,
        )

    def _search(
        self, situation: Situation, wanted: Action, acts: bool, mask: Mask | None
    ) -> Search:
        """Which option should be executed: the judge's own, or the best of those it is given."""
        if self._searches:
            how = {"tolerance": self.tolerance, "mask": copy(mask)}
            search = self.risk.search(situation, copy(wanted), **how)  # type: ignore[attr-defined]
            return self._checked(search, wanted, mask)
        options = np.minimum(np.maximum(wanted, self._lowest), self._highest)
        if mask is not None:
            options = options[np.append(True, mask)]
        if not acts:
            options = self._clip(self.risk.effective(situation, options))
        if self.risk.trial() is None:  # most proposals are kept: this one is looked at first
            judgement = self._judged(situation, options[:1])
            if judgement.risk[0] <= self.tolerance * (_RELEASE if self.refuses else 1.0):
                self.refuses = False
                return Search(options[:1], judgement, 0, _KEPT)
        judgement = self._judged(situation, options)
        return Search(options, judgement, *self._decide(situation, options, judgement, acts))

    def _clip(self, options: Floats) -> Floats:
        """What a judge made of options, put at the edge of the set where it lies outside."""
        return np.minimum(np.maximum(options, self._low), self._high)

    def _judged(self, situation: Situation, options: Floats) -> Judgement:
        """What the judge says of options, of which it gets a copy: it may work in place."""
        return self._fit(self.risk.judge(situation, options.copy()), len(options))

    def _fit(self, judgement: Judgement, count: int) -> Judgement:
        """What the judge said, if it is a judgement of so many options."""
        risk = np.asarray(getattr(judgement, "risk", None), np.float64)
        is_fit = risk.shape == (count,) and len(judgement.low) == len(judgement.high) == count
        if not is_fit or any(p < 0.0 or p > 1.0 for p in risk.tolist()):
            name = f"{type(self.risk).__name__}.judge"
            text = f"{name} gave {judgement!s:.200} of {count} actions; it has to give a Judgement"
            raise ValueError(f"{text} with a risk in [0, 1], or NaN, of each")
        return judgement if judgement.risk is risk else judgement._replace(risk=risk)

    def _checked(self, search: Search, wanted: Action, mask: Mask | None) -> Search:
        """What a judge found that looks for an action itself, if that may be executed."""
        try:
            options = self._clip(search.options)
            judgement, best = self._fit(search.judged, len(options)), operator.index(search.best)
            is_usable_one = best >= 0 and is_usable(self.actions, options[best], mask)
            if is_usable_one and same_action(options[0], wanted):
                self.refuses = best != 0
                return Search(options, judgement, best, search.reason)
        except (AttributeError, IndexError, TypeError, ValueError):
            pass  # what it is instead is said
        text = f"{type(self.risk).__name__}.search gave {search!s:.200}; it has to give a Search:"
        parts = (
            "the index of one that is allowed as best, and judged, a risk in [0, 1] or NaN of each"
        )
        raise ValueError(f"{text} the proposal, {wanted}, as the first of its options, {parts}")

    def _refuse_unusable(self, name: str, action: Action) -> None:
        """Raise if what the judge names is not an action, put at the edge of the set or not."""
        if not is_usable(self.actions, put_into(self.actions, action)):
            text = f"{type(self.risk).__name__}.{name} is {action}"
            raise ValueError(f"{text}; it has to be one of {self.actions}")

    def _decide(
        self, situation: Situation, options: Floats, judged: Judgement, acts: bool
    ) -> tuple[int, str]:
        """Index of the best option, and why."""
        limit = self.tolerance * (_RELEASE if self.refuses else 1.0)
        trial = self.risk.trial()
        if self._trial > 0 and trial is not None:
            self._trial -= 1
            return self._closest_to(trial.action, options), f"{trial.unknown}: {trial.doing}"
        if not judged.risk[0] > limit:
            self.refuses = False
            is_known = judged.risk[0] <= limit
            return 0, _KEPT if is_known else "its risk is not known yet"
        self.refuses = True
        why = self.risk.why(judged) or "risk is above the tolerance"
        if trial is not None:
            if acts:
                self._trial = _TRIAL
                index = self._closest_to(trial.action, options)
                return index, f"{why}; {trial.unknown}, so {trial.how}"
            why = f"{why}; {trial.unknown}, {trial.assumed}"
        # Once revising, what is safe by the margin; else whatever is tolerable.
        choice = self.risk.choose(situation, options.copy(), judged, (limit, self.tolerance))
        if choice is not None:
            name = f"{type(self.risk).__name__}.choose: option"
            best = check_index(name, choice[0], len(options))
            self.refuses = best != 0
            return best, f"{why}; {choice[1]}"
        change = distances(self.actions, options, options[0])
        # Of several that are least risky the closest to the proposal, unless to brake is better.
        rank = options if getattr(self.risk, "lowest_first", False) else change
        least = int(np.lexsort((rank, judged.risk))[0])
        if isinstance(self.actions, Choices) and judged.risk[least] <= self.tolerance:
            return least, f"{why}; the least risky that can"
        for bound in (limit, self.tolerance):
            if (tolerable := np.flatnonzero(judged.risk <= bound)).size:
                return int(tolerable[change[tolerable].argmin()]), f"{why}; the closest that can"
        return least, f"{why}; nothing can, the least risky"

    def _closest_to(self, action: Action, options: Floats) -> int:
        self._refuse_unusable("trial", action)
        return int(distances(self.actions, options, action).argmin())


def unseen_text(situation: Situation, labels: Labels) -> str:
    """What is said of a situation that was not seen whole, or not in time."""
    if gaps := np.flatnonzero(np.isnan(situation.observation)).tolist():
        return f"not seen: {', '.join(map(labels._replace(units=()).variable, gaps))}"
    return "nothing new was seen" if situation.intake & STALE else ""


def is_spoken(reviser: Reviser, revision: Revision) -> bool:
    """Whether a decision changed something, would have, or raised an alarm."""
    proposed = revision.proposed  # NaN differs
    if not (same_action(revision.executed, proposed) and same_action(revision.advised, proposed)):
        return True
    return isinstance(reviser, ActionReviser) and revision.risk_proposed > reviser.tolerance


def unjudged_revision(executed: Action, proposal: Proposal, reason: str) -> Revision:
    """A revision without a probability."""
    executed = fixed(executed)
    return Revision(
        executed=executed,
        proposed=fixed(proposal.action),
        risk_proposed=math.nan,
        risk_executed=math.nan,
        interval=(math.nan, math.nan),
        reason=reason,
        evidence=0.0,
        seen=math.nan,
        advised=executed,
    )
