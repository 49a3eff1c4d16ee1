"""The framework's loop in a world: observe, recognise, propose, revise, execute, learn.

Whoever the controller is and wherever it drives, what it proposes is revised before it is
executed, and what came of it is learnt before the next decision (the paper's Section 4.1).
"""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from evofsm.core import EvolvingFSM, IntervalActions, Missing, positive
from evofsm.driving.revisers import Unrevised
from evofsm.driving.worlds.road import Episode, World
from evofsm.driving.worlds.scenario import Scenario
from evofsm.guard import (
    Controller,
    Explain,
    LearningJudge,
    Oversight,
    Proposal,
    Reviser,
    Revision,
    Situation,
    Witness,
    own_risk,
    refuse_mismatch,
)

_log = logging.getLogger(__name__)

# Actions that differ by less are the same [m/s²].
_SAME = 1e-9


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
    risk : LearningJudge, optional
        Learns from what happens; without it the reviser's own, if it has one.
    learn : bool
        Whether machine and risk learn while driving. It may be changed between runs.
    interval : float
        Time between decisions [s].
    missing : Missing
        What to do where a variable was not observed (NaN). Controllers are given its latest value.
    audit : Witness, optional
        Is told what is decided: an `AuditLog`.
    explaining : Explain, optional
        Of which decisions the machine's experience is told; without it of none, and with an audit
        log of those that speak.

    Examples
    --------
    >>> from evofsm.driving import IDM, KinematicWorld, Leader
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
        risk: LearningJudge | None = None,
        learn: bool = True,
        interval: float = 0.25,
        missing: Missing = Missing.PARTIAL,
        audit: Witness | None = None,
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
