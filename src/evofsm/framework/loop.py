"""The framework's loop: observe, recognise, propose, revise, execute, learn.

Whoever the controller is and wherever it drives, what it proposes is revised before it is
executed, and what came of it is learnt before the next decision (the paper's Section 4.1).
"""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from evofsm.actions import IntervalActions
from evofsm.explanation import explain
from evofsm.framework.reviser import ActionReviser, Unrevised, speaks
from evofsm.framework.senses import Senses
from evofsm.machine import EvolvingFSM
from evofsm.naming import UNITS, VARIABLES, Labels
from evofsm.observations import Missing
from evofsm.protocols import (
    INCOMPLETE,
    STALE,
    Controller,
    Intake,
    Proposal,
    Reviser,
    Revision,
    Situation,
)
from evofsm.risk.outcome import LatentRisk
from evofsm.validation import positive
from evofsm.worlds.road import Episode, World
from evofsm.worlds.scenario import Scenario

if TYPE_CHECKING:
    from evofsm.framework.audit import AuditLog

_log = logging.getLogger(__name__)


# Actions that differ by less are the same [m/s²].
_SAME = 1e-9


class Explain(Enum):
    """Of which decisions the machine's experience is told (`Revision.explanation`)."""

    NONE = "none"
    SPOKEN = "spoken"  #: of those that change a proposal or warn
    ALL = "all"


class Decision(NamedTuple):
    """One decision: what was seen, what was proposed, what was executed, what came of it."""

    situation: Situation
    revision: Revision
    realised: float  #: mean acceleration until the next decision [m/s²]; NaN where none came


@dataclass(frozen=True, eq=False)
class Drive:
    """One run under the framework."""

    episode: Episode  #: every step, as the world has it
    decisions: tuple[Decision, ...]

    @property
    def proposed(self) -> NDArray[np.float64]:
        """(D,) ndarray: what the controller wanted [m/s²]."""
        return np.array([decision.revision.proposed for decision in self.decisions])

    @property
    def executed(self) -> NDArray[np.float64]:
        """(D,) ndarray: what was commanded [m/s²]."""
        return np.array([decision.revision.executed for decision in self.decisions])

    @property
    def changed(self) -> NDArray[np.bool_]:
        """(D,) ndarray: where the proposal was not executed, or was none that could be."""
        change = np.abs(self.executed - self.proposed)
        return np.asarray(~(change <= _SAME))  # also true of NaN


class Oversight:
    """Watches over one episode: recognises, revises and learns, wherever it is driven.

    An episode begins when it is made, and is over with `end`.

    Parameters
    ----------
    actions : IntervalActions
    reviser : Reviser
    machine : EvolvingFSM, optional
    risk : LatentRisk, optional
    learn : bool
        Whether machine and risk learn.
    missing : Missing
        What to do where a variable was not observed (NaN).
    interval : float, optional
        Time between observations [s]; one that comes later begins an episode anew.
    audit : AuditLog, optional
        Writes down what is decided.
    explaining : Explain, optional
        Of which decisions the machine's experience is told; without it of none, and with an audit
        log of those that speak.

    Examples
    --------
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
        risk: LatentRisk | None = None,
        learn: bool = True,
        missing: Missing = Missing.PARTIAL,
        interval: float | None = None,
        audit: AuditLog | None = None,
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
        self._labels = Labels(actions, VARIABLES, UNITS, interval)
        self._latest: Situation | None = None
        self._frozen = None if learn or machine is None else machine.model()
        reviser.start_episode()
        if risk is not None:  # of an episode that was broken off nothing follows
            risk.start_episode(learn=False)
        if machine is not None and learn:
            machine.start_episode()
        if audit is not None:
            audit.begin(self)

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


def own_risk(reviser: Reviser | None) -> LatentRisk | None:
    """The latent risk that a reviser asks, if it asks one."""
    if isinstance(reviser, ActionReviser) and isinstance(reviser.risk, LatentRisk):
        return reviser.risk
    return None


def refuse_mismatch(machine: EvolvingFSM | None, actions: IntervalActions) -> None:
    """Raise where a machine was made for another set of actions."""
    if machine is not None and machine.n_actions != actions.n_actions:
        raise ValueError(
            f"the machine has {machine.n_actions} actions, but the set has "
            f"{actions.n_actions} intervals"
        )


class Framework:
    """Drives a controller under a reviser, and learns while it drives.

    Parameters
    ----------
    controller : Controller
        Anything that proposes. Where it raises or proposes no number, the reviser falls back.
    actions : IntervalActions
        The set of actions; made with ``outside="clip"``.
    reviser : Reviser, optional
        Without one every proposal is executed.
    machine : EvolvingFSM, optional
        Recognises and learns; without one nothing is recognised.
    risk : LatentRisk, optional
        Learns from what happens; without it the reviser's own, if it has one.
    learn : bool
        Whether machine and risk learn while driving. It may be changed between runs.
    interval : float
        Time between decisions [s].
    missing : Missing
        What to do where a variable was not observed (NaN). Controllers are given its latest value.
    audit : AuditLog, optional
        Writes down what is decided.
    explaining : Explain, optional
        Of which decisions the machine's experience is told; without it of none, and with an audit
        log of those that speak.

    Examples
    --------
    >>> from evofsm.drivers.idm import IDM
    >>> from evofsm.worlds.kinematic import KinematicWorld
    >>> from evofsm.worlds.scenario import Leader
    >>> actions = IntervalActions(low=-2.5, high=2.5, width=0.3, outside="clip")
    >>> hasty = IDM(2.25, 28.0, 0.8, 0.3, 2.0, lowest=-2.5, highest=2.5)
    >>> leader = Leader(IDM(1.2, 25.0, 1.0, 1.0, 2.5), brake_decel=4.0, brake_time=12.0)
    >>> scenario = Scenario(leader, initial_gap=10.0)
    >>> Framework(hasty, actions).drive(KinematicWorld(), scenario).episode.collided
    True
    >>> revised = Framework(hasty, actions, ActionReviser(LatentRisk(lowest=-2.5), actions))
    >>> revised.drive(KinematicWorld(), scenario).episode.collided
    False
    """

    def __init__(
        self,
        controller: Controller,
        actions: IntervalActions,
        reviser: Reviser | None = None,
        *,
        machine: EvolvingFSM | None = None,
        risk: LatentRisk | None = None,
        learn: bool = True,
        interval: float = 0.25,
        missing: Missing = Missing.PARTIAL,
        audit: AuditLog | None = None,
        explaining: Explain | None = None,
    ) -> None:
        refuse_mismatch(machine, actions)
        self.interval = positive("interval", interval)
        risk = own_risk(reviser) if risk is None else risk
        if risk is not None and not math.isclose(risk.dt, interval):
            raise ValueError(
                f"interval is {interval} s, but the risk was made for decisions every {risk.dt} s"
            )
        self.controller = controller
        self.actions = actions
        self.reviser = Unrevised(actions) if reviser is None else reviser
        self.machine = machine
        self.risk = risk
        self.learn = learn
        self.missing = missing
        self.audit = audit
        self.explaining = explaining

    def drive(self, world: World, scenario: Scenario) -> Drive:
        """Drive one scenario, and learn from it if `learn`.

        Raises
        ------
        ValueError
            If the time between decisions is no whole number of the scenario's steps.
        """
        steps = scenario.steps(self.interval)
        if steps < 1 or not math.isclose(steps * scenario.dt, self.interval):
            raise ValueError(
                f"interval is {self.interval} s, which is no whole number of the scenario's "
                f"steps of {scenario.dt} s"
            )
        oversight = Oversight(
            self.actions,
            self.reviser,
            machine=self.machine,
            risk=self.risk,
            learn=self.learn,
            missing=self.missing,
            interval=self.interval,
            audit=self.audit,
            explaining=self.explaining,
        )
        decided: list[tuple[int, Situation, Revision]] = []
        with world.open(scenario) as road:
            while not road.over:
                situation = oversight.recognise(road.observation, road.time)
                revision = oversight.revise(situation, self._ask(situation, oversight.senses.held))
                decided.append((road.row, situation, revision))
                road.advance(revision.executed, steps)
            oversight.end(road.observation, failed=road.collided)
            return _drive(road.episode(), decided)

    def _ask(self, situation: Situation, held: NDArray[np.float64]) -> Proposal:
        """What the controller proposes, seeing what was ``held``; NaN where it fails to."""
        try:
            proposal = self.controller.propose(held.copy(), situation.time)
            action = float(proposal.action)
            candidates = tuple(float(candidate) for candidate in proposal.candidates)
        except Exception as error:  # whatever it is, someone has to go on driving
            _log.warning("controller failed at %g s: %r", situation.time, error)
            return Proposal(math.nan)
        if not math.isfinite(action):
            _log.warning("controller proposed %g at %g s", action, situation.time)
        elif not self.actions.low <= action <= self.actions.high:
            _log.info("controller proposed %g at %g s, outside the set", action, situation.time)
        return Proposal(action, candidates)


def _drive(episode: Episode, decided: Sequence[tuple[int, Situation, Revision]]) -> Drive:
    """With what the body did, whatever the sensors showed of it."""
    rows = [row for row, _, _ in decided] + [len(episode.time) - 1]
    speed, time = episode.observations[rows, 1], episode.time[rows]
    lasted = np.diff(time)
    realised = np.divide(np.diff(speed), lasted, np.full(len(decided), np.nan), where=lasted > 0)
    return Drive(
        episode,
        tuple(
            Decision(situation, revision, float(did))
            for (_, situation, revision), did in zip(decided, realised, strict=True)
        ),
    )
