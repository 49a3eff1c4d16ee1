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

from evofsm.driving.worlds.road import Episode, World
from evofsm.driving.worlds.scenario import Scenario
from evofsm.guard import BoxActions, Controller, Guard, Proposal, Revision, Situation, make_usable

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
    """Drives a controller under a guard, in any world.

    Parameters
    ----------
    controller : Controller
        Anything that proposes. Where it raises or proposes no number, the guard falls back. Where
        a variable was not observed, it is given the latest value.
    guard : Guard
        Made with the interval between decisions. It learns while driving unless it is frozen.

    Raises
    ------
    ValueError
        If the guard has no interval, or its actions are vectors.

    Examples
    --------
    >>> from evofsm.driving import IDM, KinematicWorld, Leader, Unrevised, guard_for_cars
    >>> guard = guard_for_cars(low=-2.5, high=2.5)
    >>> hasty = IDM(2.25, 28.0, 0.8, 0.3, 2.0, lowest=-2.5, highest=2.5)
    >>> leader = Leader(IDM(1.2, 25.0, 1.0, 1.0, 2.5), brake_decel=4.0, brake_time=12.0)
    >>> scenario = Scenario(leader, initial_gap=10.0)
    >>> unrevised = Guard.of(Unrevised(guard.actions), interval=0.25)
    >>> Framework(hasty, unrevised).drive(KinematicWorld(), scenario).episode.collided
    True
    >>> Framework(hasty, guard).drive(KinematicWorld(), scenario).episode.collided
    False
    """

    def __init__(self, controller: Controller, guard: Guard) -> None:
        if guard.interval is None:
            raise ValueError("the guard was made without an interval, the time between decisions")
        if isinstance(guard.actions, BoxActions):
            raise ValueError("the guard's actions are vectors, but a car is driven by one number")
        self.interval: float = guard.interval
        self.controller = controller
        self.guard = guard

    def drive(self, world: World, scenario: Scenario) -> Drive:
        """Drive one scenario; the guard learns from it unless it is frozen.

        Raises
        ------
        ValueError
            If the time between decisions is no whole number of the scenario's steps.
        """
        steps = scenario.steps_between(self.interval)
        guard = self.guard
        guard.begin()
        decided: list[tuple[int, Situation, Revision]] = []
        with world.open(scenario) as road:
            while not road.over:
                situation = guard.recognise(road.observation, road.time)
                revision = guard.revise(situation, self._ask(situation))
                decided.append((road.row, situation, revision))
                road.advance(revision.executed, steps)
            guard.end(road.collided, road.observation)
            return _drive(road.episode(), decided)

    def _ask(self, situation: Situation) -> Proposal:
        """What the controller proposes, seeing the latest values; NaN where it fails to."""
        try:
            proposal = self.controller.propose(self.guard.held, situation.time)
            action = float(proposal.action)
            candidates = tuple(float(candidate) for candidate in proposal.candidates)
        except Exception as error:  # whatever it is, someone has to go on driving
            _log.warning("controller failed at %g s: %r", situation.time, error)
            return Proposal(math.nan)
        if not math.isfinite(action):
            _log.warning("controller proposed %g at %g s", action, situation.time)
        elif make_usable(Proposal(action), self.guard.actions).remark:
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
