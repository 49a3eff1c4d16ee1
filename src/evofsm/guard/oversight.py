"""The framework's loop: observe, recognise, propose, revise, execute, learn.

Whoever the controller is and wherever it drives, what it proposes is revised before it is
executed, and what came of it is learnt before the next decision (the paper's Section 4.1).
"""

from __future__ import annotations

import math
from enum import Enum
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from evofsm.core import EvolvingFSM, IntervalActions, Labels, Missing, explain
from evofsm.guard.protocols import (
    INCOMPLETE,
    STALE,
    Intake,
    LearningJudge,
    Proposal,
    Reviser,
    Revision,
    Situation,
)
from evofsm.guard.reviser import ActionReviser, speaks
from evofsm.guard.senses import Senses


class Explain(Enum):
    """Of which decisions the machine's experience is told (`Revision.explanation`)."""

    NONE = "none"
    SPOKEN = "spoken"  #: of those that change a proposal or warn
    ALL = "all"


class Participants(NamedTuple):
    """Everything that a decision depends on but the observation and the proposal."""

    actions: IntervalActions
    reviser: Reviser
    machine: EvolvingFSM | None
    risk: LearningJudge | None


class Witness(Protocol):
    """Anything that is told what happens in an episode, such as an audit log."""

    def begin(
        self, who: Participants, *, interval: float | None, learn: bool, missing: Missing
    ) -> None:
        """An episode begins."""
        ...

    def seen(self, observation: NDArray[np.float64], time: float) -> None:
        """An observation came in, at ``time`` [s]."""
        ...

    def decided(self, situation: Situation, proposal: Proposal, revision: Revision) -> None:
        """A decision was made."""
        ...

    def ended(self, observation: NDArray[np.float64] | None, *, failed: bool) -> None:
        """The episode ended."""
        ...


class Oversight:
    """Watches over one episode: recognises, revises and learns, wherever it is driven.

    An episode begins when it is made, and is over with `end`.

    Parameters
    ----------
    actions : IntervalActions
    reviser : Reviser
    machine : EvolvingFSM, optional
    risk : LearningJudge, optional
    learn : bool
        Whether machine and risk learn.
    missing : Missing
        What to do where a variable was not observed (NaN).
    interval : float, optional
        Time between observations [s]; one that comes later begins an episode anew.
    audit : Witness, optional
        Is told what is decided: an `AuditLog`.
    explaining : Explain, optional
        Of which decisions the machine's experience is told; without it of none, and with an audit
        log of those that speak.

    Examples
    --------
    >>> from evofsm.driving import Unrevised
    >>> actions = IntervalActions(low=-2.5, high=2.5, width=0.3, outside="clip")
    >>> oversight = Oversight(actions, Unrevised(actions))
    >>> situation = oversight.recognise(np.array([5.0, 20.0, 10.0]), time=0.0)
    >>> oversight.revise(situation, Proposal(9.0)).executed
    2.5
    >>> oversight.end(np.array([-0.1, 20.0, 10.0]), failed=True)
    """

    def __init__(
        self,
        actions: IntervalActions,
        reviser: Reviser,
        *,
        machine: EvolvingFSM | None = None,
        risk: LearningJudge | None = None,
        learn: bool = True,
        missing: Missing = Missing.PARTIAL,
        interval: float | None = None,
        audit: Witness | None = None,
        explaining: Explain | None = None,
    ) -> None:
        self.actions = actions
        self.reviser = reviser
        self.machine = machine
        self.risk = risk
        self.learn = learn
        self.senses = Senses(missing, interval)
        self.audit = audit
        self.explaining = explaining or (Explain.NONE if audit is None else Explain.SPOKEN)
        judge = reviser.risk if isinstance(reviser, ActionReviser) else risk
        labels = Labels() if judge is None else judge.labels
        self._labels = labels._replace(actions=actions, dt=interval)
        self._latest: Situation | None = None
        self._frozen = None if learn or machine is None else machine.model()
        reviser.start_episode()
        if risk is not None:  # of an episode that was broken off nothing follows
            risk.start_episode(learn=False)
        if machine is not None and learn:
            machine.start_episode()
        if audit is not None:
            who = Participants(actions, reviser, machine, risk)
            audit.begin(who, interval=interval, learn=learn, missing=missing)

    def recognise(self, observation: NDArray[np.float64], time: float) -> Situation:
        """Where the vehicle is at ``time`` [s]; the machine learns the transition to it.

        NaN says that a variable was not observed. An observation that is no newer than the one
        before changes nothing: the situation is still that one.
        """
        intake = self.senses.take(observation, time)
        if intake and intake & STALE and self._latest is not None:
            situation = self._latest._replace(intake=intake)
        else:
            if intake and intake & Intake.GAP:
                self._begin_anew()
            situation = self._latest = self._recognised(observation, time, intake)
        if self.audit is not None:
            self.audit.seen(observation, time)
        return situation

    def _begin_anew(self) -> None:
        """What comes after a hole in time does not follow from what was before it."""
        if self.risk is not None:
            self.risk.start_episode(learn=self.learn)
        if self.machine is not None and self.learn:
            self.machine.start_episode()

    def _recognised(
        self, observation: NDArray[np.float64], time: float, intake: Intake
    ) -> Situation:
        nothing = Situation(observation, np.ones(1), None, math.nan, time, intake)
        incomplete = bool(intake) and bool(intake & INCOMPLETE)
        if self.machine is None or (incomplete and self.machine.n_states == 0):
            return nothing
        if self._frozen is None:
            policy = Missing.REJECT
            if incomplete:
                policy = self.senses.missing if self.machine.state is not None else Missing.PARTIAL
            step = self.machine.observe(observation, missing=policy)
            return Situation(observation, step.belief, step.state, step.surprise, time, intake)
        if self._frozen.n_states == 0 or np.isnan(self.senses.held).any():
            return nothing
        belief = self._frozen.recognise(self.senses.held)
        return Situation(observation, belief, int(belief.argmax()), math.nan, time, intake)

    def revise(self, situation: Situation, proposal: Proposal) -> Revision:
        """What to execute; machine and risk are told of it."""
        revision = self.reviser.revise(situation, proposal)
        if self.explaining is not Explain.NONE:
            revision = self._explained(situation, revision)
        if self.audit is not None:
            self.audit.decided(situation, proposal, revision)
        executed = revision.executed
        if self.machine is not None and self.learn and self.machine.state is not None:
            self.machine.act(self.actions.encode(executed))
        if situation.intake and situation.intake & STALE:  # it was learnt from before
            return revision
        if self.risk is not None and self.learn:
            watched = isinstance(self.reviser, ActionReviser) and not self.reviser.acts
            take_in = self.risk.watch if watched else self.risk.learn
            take_in(situation.observation, executed, situation.belief)
        elif self.risk is not None:
            self.risk.follow(situation.observation, executed)
        return revision

    def _explained(self, situation: Situation, revision: Revision) -> Revision:
        """With what the machine has seen come of what is executed."""
        if self.machine is None or situation.state is None:
            return revision
        if self.explaining is Explain.SPOKEN and not speaks(self.reviser, revision):
            return revision
        action = int(self.actions.encode(revision.executed))
        if self._frozen is None:
            text = self.machine.explain(action, self._labels).text
        else:
            nearest = self._frozen.nearest(self.senses.held)
            text = explain(self._frozen, situation.belief, action, self._labels, nearest).text
        return revision._replace(explanation=text)

    def end(self, observation: NDArray[np.float64] | None, *, failed: bool) -> None:
        """The episode ends with this observation, or unseen (None); perhaps in failure."""
        if self.machine is not None and self.learn:
            if observation is not None and (
                self.machine.n_states or not np.isnan(observation).any()
            ):
                self.machine.observe(observation, failed=failed, missing=Missing.PARTIAL)
            elif failed and self.machine.state is not None:
                self.machine.fail()
            self.machine.tell_of_failures()
        if self.risk is not None:
            self.risk.start_episode(learn=self.learn)
        if self.audit is not None:
            self.audit.ended(observation, failed=failed)


def own_risk(reviser: Reviser | None) -> LearningJudge | None:
    """The judge that a reviser asks, if that learns."""
    if isinstance(reviser, ActionReviser) and isinstance(reviser.risk, LearningJudge):
        return reviser.risk
    return None


def refuse_mismatch(machine: EvolvingFSM | None, actions: IntervalActions) -> None:
    """Raise where a machine was made for another set of actions."""
    if machine is not None and machine.n_actions != actions.n_actions:
        raise ValueError(
            f"the machine has {machine.n_actions} actions, but the set has "
            f"{actions.n_actions} intervals"
        )
