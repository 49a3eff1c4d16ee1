"""Our own policy, as the study teaches and tests it."""

from __future__ import annotations

import copy
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

from evofsm.core import EvolvingFSM, Novelty, StateRule
from evofsm.driving.families.family import Draw, Family
from evofsm.driving.framework import Drive, Framework
from evofsm.driving.outcomes import Outcome, Reference, outcome, reference
from evofsm.driving.revisers import Unrevised
from evofsm.driving.risk.by_state import RiskByState
from evofsm.driving.risk.outcome import LatentRisk
from evofsm.driving.worlds.kinematic import KinematicWorld
from evofsm.driving.worlds.road import World
from evofsm.guard import ActionReviser, AuditLog, Controller, Explain, Mode, Reviser

#: The state rule for safety work: fine enough to steer by. The study compares the rules.
SAFETY_RULE = Novelty(radius=1.0, scales=(4.0, 2.0, 2.0))

# With hundreds of states this makes a step several times as quick.
_BELIEF_TOLERANCE = 1e-6
# What its explanations call soon [s].
_SOON = 5.0
_MACHINE, _RISK = "machine.evofsm", "risk.evofsm"


@dataclass
class Learner:
    """A machine and the latent risk that learns beside it."""

    machine: EvolvingFSM
    risk: LatentRisk

    @classmethod
    def new(cls, family: Family, rule: StateRule | None = SAFETY_RULE) -> Self:
        """One that has seen nothing."""
        return cls(
            EvolvingFSM(
                family.actions.n_actions,
                rule=rule,
                belief_tolerance=_BELIEF_TOLERANCE,
                failure_horizon=round(_SOON / family.interval),
            ),
            LatentRisk(family.actions.low, family.interval),
        )

    @classmethod
    def load(cls, folder: Path) -> Self:
        """One that was saved."""
        return cls(EvolvingFSM.load(folder / _MACHINE), LatentRisk.load(folder / _RISK))

    def save(self, folder: Path, provenance: Mapping[str, Any] | None = None) -> None:
        """Write both files, with what they learnt from."""
        folder.mkdir(parents=True, exist_ok=True)
        self.machine.save(folder / _MACHINE, provenance)
        self.risk.save(folder / _RISK, provenance)

    def frozen(self) -> Self:
        """A copy that goes its own way."""
        return type(self)(self.machine, copy.deepcopy(self.risk))

    def reviser(self, family: Family, tolerance: float, mode: Mode = Mode.ACT) -> ActionReviser:
        """The action reviser that asks this risk."""
        return ActionReviser(self.risk, family.actions, tolerance=tolerance, mode=mode)

    def reviser_by_state(self, family: Family, tolerance: float) -> ActionReviser:
        """The action reviser that asks the states."""
        by_state = RiskByState(self.risk, self.machine)
        return ActionReviser(by_state, family.actions, tolerance=tolerance)

    def teach(
        self,
        family: Family,
        draws: Iterable[Draw],
        reviser: Reviser,
    ) -> list[Drive]:
        """Drive and learn, each draw in turn."""
        return [self.drive(family, draw, reviser, learn=True) for draw in draws]

    def drive(
        self,
        family: Family,
        draw: Draw,
        reviser: Reviser,
        *,
        learn: bool,
        world: World | None = None,
        controller: Controller | None = None,
        audit: AuditLog | None = None,
        explaining: Explain | None = None,
    ) -> Drive:
        """Drive one draw."""
        framework = Framework(
            controller or draw.controller,
            family.actions,
            reviser,
            machine=self.machine,
            risk=self.risk,
            learn=learn,
            interval=family.interval,
            audit=audit,
            explaining=explaining,
        )
        return framework.drive(world or KinematicWorld(), draw.scenario)


def drive_alone(
    family: Family,
    draw: Draw,
    reviser: Reviser,
    risk: LatentRisk | None,
    world: World | None = None,
    controller: Controller | None = None,
) -> Drive:
    """Drive one draw without a machine and without learning.

    What a frozen risk decides is the same, since it judges situations where they are.
    """
    framework = Framework(
        controller or draw.controller,
        family.actions,
        reviser,
        risk=risk,
        learn=False,
        interval=family.interval,
    )
    return framework.drive(world or KinematicWorld(), draw.scenario)


def held_out(family: Family, seed: int, episodes: int) -> list[Draw]:
    """Draws that nothing learns from."""
    return [family.draw(seed, index, split="test") for index in range(episodes)]


def training(
    family: Family, seed: int, learning_seed: int, episodes: int, first: int = 0
) -> Iterator[Draw]:
    """Draws to learn from, other ones for every learning seed."""
    for index in range(first, first + episodes):
        yield family.draw(seed * 1000 + learning_seed, index, split="train")


def references(family: Family, draws: Sequence[Draw]) -> list[Reference]:
    """How far the controller comes by itself in each draw."""
    unrevised = Unrevised(family.actions)
    return [
        reference(drive_alone(family, draw, unrevised, None), draw.scenario.leader.brake_decel)
        for draw in draws
    ]


def score(family: Family, unrevised: Sequence[Reference], drives: Iterable[Drive]) -> list[Outcome]:
    """Outcomes of driven draws."""
    return [
        outcome(drive, base, family.interval) for base, drive in zip(unrevised, drives, strict=True)
    ]
