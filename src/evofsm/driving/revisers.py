"""Revisers that know a car: brake where a classic measure calls for it, or never."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any, Self

import numpy as np

from evofsm.driving import measures
from evofsm.driving.naming import LABELS
from evofsm.fsm.actions import IntervalActions
from evofsm.fsm.sharing import Rollback, as_now
from evofsm.fsm.validation import Floats, positive
from evofsm.guard import Fallback, Proposal, Revision, RiskMeasure, Situation, make_usable
from evofsm.guard.parts import part_class, part_name
from evofsm.guard.reviser import unjudged_revision, unseen_text

#: Without a usable proposal a car brakes gently [m/s²].
GENTLE_BRAKE = Fallback(-1.0, "braking gently")


class EnvelopeReviser:
    """Brakes in full wherever a measure of danger calls for it, and else keeps the proposal.

    So time to collision becomes an emergency brake, a safe distance the proper response of RSS.

    Examples
    --------
    >>> from evofsm.driving.measures import TimeToCollision
    >>> actions = IntervalActions(low=-2.5, high=2.5, width=0.3)
    >>> reviser = EnvelopeReviser(TimeToCollision(threshold=1.5), actions)
    >>> close = Situation(np.array([5.0, 20.0, 10.0]), np.ones(1), 0, 0.0, 0.0)
    >>> reviser.revise(close, Proposal(1.0)).executed
    -2.5
    """

    fallback = GENTLE_BRAKE

    def __init__(self, measure: RiskMeasure, actions: IntervalActions, dt: float = 0.25) -> None:
        self.measure = measure
        self.actions = actions
        self.dt = positive("dt", dt)
        self.start_episode()

    def start_episode(self) -> None:
        """What was seen before belongs to another episode."""
        self._seen: list[Floats] = []

    def savepoint(self) -> Rollback:
        """What takes back all that is seen from now on."""
        return as_now(self)

    def revise(self, situation: Situation, proposal: Proposal) -> Revision:
        """Full braking where the measure is above 0, else the proposal."""
        action, remark = make_usable(proposal, self.actions, self.fallback)
        self._seen = [*self._seen[-1:], situation.observation.copy()]
        danger = float(self.measure.score(np.array(self._seen), self.dt)[-1])
        if danger <= 0.0:
            return unjudged_revision(action, proposal, remark or "measure calls for nothing")
        reason = remark or f"measure calls for it: {danger:.3g}"
        if math.isnan(danger):
            reason = unseen_text(situation, LABELS) or "danger unknown"
        return unjudged_revision(self.actions.low, proposal, reason)

    def described(self) -> dict[str, Any] | None:
        """What it takes to make it again; None where its measure is someone's own."""
        cls = type(self.measure)
        if cls is not getattr(measures, cls.__name__, None) and part_name(self.measure) is None:
            return None
        return {"dt": self.dt, "measure": {"class": cls.__name__, **asdict(self.measure)}}  # type: ignore[call-overload]

    @classmethod
    def restored(cls, described: Mapping[str, Any], actions: IntervalActions) -> Self:
        """The one that was `described`."""
        settings = dict(described["measure"])
        name = settings.pop("class")
        kind = getattr(measures, name, None) or part_class(name)
        return cls(kind(**settings), actions, described["dt"])


class Unrevised:
    """Executes every proposal that can be executed: no reviser at all."""

    fallback = GENTLE_BRAKE

    def __init__(self, actions: IntervalActions) -> None:
        self.actions = actions

    def start_episode(self) -> None:
        """Nothing to forget."""

    def revise(self, situation: Situation, proposal: Proposal) -> Revision:
        """The proposal, made usable."""
        action, remark = make_usable(proposal, self.actions, self.fallback)
        return unjudged_revision(action, proposal, remark or "not revised")

    def described(self) -> dict[str, Any]:
        """Nothing: its class says all."""
        return {}

    @classmethod
    def restored(cls, described: Mapping[str, Any], actions: IntervalActions) -> Self:
        """The one that was `described`."""
        return cls(actions)
