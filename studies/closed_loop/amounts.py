"""How much is driven."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

from evofsm.cli import option
from evofsm.guard import TOLERANCE
from studies.own_measure import ABOUT


@dataclass(frozen=True)
class ShiftPlan:
    """How much is driven around a shift."""

    before: int = 100  #: episodes of the stream before the shift
    after: int = 60  #: and after it
    held_out: int = 200  #: episodes of each test
    machine_seeds: int = 5  #: learning seeds of `evofsm-machine` at most
    machine_held_out: int = 100  #: episodes of each of its tests at most


@dataclass(frozen=True)
class Amounts:
    """All that the study is told."""

    id: ClassVar[str] = "closed-loop"
    question: ClassVar[str] = (
        "Does latent risk, learnt online, prevent collisions, at what cost, and against whom?"
    )

    family: str = option("emergency", "Family of scenarios, or a Python file of your own.")
    train: int = option(300, "Training episodes of a learning seed.", min=1)
    test: int = option(1000, "Held-out episodes of every policy.", min=1)
    seeds: int = option(20, "Learning seeds.", min=1)
    machine_train: int = option(
        100,
        "Training episodes of evofsm-machine, no more than of a learning seed; 0: no such row.",
        min=0,
    )
    seed: int = option(0, "Of everything.", min=0)
    tolerance: float = option(TOLERANCE, "Share of leaders' hard brakes that need not be survived.")
    switches: str = option(
        "", "noise, delay, actuator, jerk, third_car; with commas.", name="--with"
    )
    measure: str = option("", ABOUT)
    rule_seeds: int = option(2, "Learning seeds in the comparison of state rules; 0: none.", min=0)
    rule_test: int = 100  #: held-out episodes in it, and in the trade-off
    side_train: int = 100  #: training episodes of the studies beside the table
    side_test: int = 300  #: held-out episodes of them
    world_test: int = 50  #: episodes driven in both worlds
    machine_test: int = 1000  #: held-out episodes of `evofsm-machine` at most
    machine_checks: int = 50  #: held-out episodes of its tests on the way
    shift: ShiftPlan = field(default_factory=ShiftPlan)
