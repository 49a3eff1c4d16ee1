"""The options that several commands share, each written once."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING

from evofsm.cli.commands.common import chosen_mode, split_names
from evofsm.cli.commands.declared import Command, argument, option
from evofsm.guard import TOLERANCE

if TYPE_CHECKING:
    from evofsm.cli.driving import Setup
    from evofsm.driving import Family


class WorldName(StrEnum):
    """Where to drive."""

    SUMO = "sumo"
    KINEMATIC = "kinematic"


class JudgeName(StrEnum):
    """What a judge was told."""

    KINEMATIC = "kinematic"
    LEARNT = "learnt"


@dataclass(frozen=True, kw_only=True)
class WithJson(Command):
    """A command that prints one JSON document where it is asked to."""

    as_json: bool = option(
        False, "Print one JSON document; counts from 0.", name="--json", is_setting=False
    )


@dataclass(frozen=True, kw_only=True)
class InWorld(Command):
    """A command that drives in one of the worlds."""

    world: WorldName = option(
        WorldName.KINEMATIC, "SUMO itself, or the same motion in closed form."
    )

    def packages(self) -> dict[str, str]:
        """Libsumo for SUMO."""
        return super().packages() | ({"libsumo": "sumo"} if self.world is WorldName.SUMO else {})


@dataclass(frozen=True, kw_only=True)
class Revised(InWorld):
    """A command that drives under a reviser."""

    controller: str = option(
        "family",
        "Who proposes: the family's own, aggressive, normal, acc, or sumo (SUMO's IDM).",
    )
    reviser: str = option(
        "least-risk",
        "Who revises: least-risk (what was learnt), none, rss, aeb, or another measure.",
    )
    judge: JudgeName = option(
        JudgeName.KINEMATIC,
        "Who judges for least-risk: kinematic (told how cars follow each other) or learnt (told "
        "nothing but which episodes failed).",
    )
    tolerance: float = option(
        TOLERANCE,
        "Share of leaders' hard brakes that need not be survived; for a learnt judge, of what it "
        "remembers.",
    )
    switches: tuple[str, ...] = option(
        (),
        "noise, delay, actuator, jerk, third_car; with commas.",
        name="--with",
        parse=split_names,
    )
    seed: int = option(0, "Of the draws.", min=0)

    def packages(self) -> dict[str, str]:
        """SciPy, for SUMO's distributions and exact intervals."""
        return {"scipy": "study"} | super().packages()

    def load_family(self, name: str) -> Family:
        """The family of this name, with the switches."""
        from evofsm.driving import load_family

        return load_family(name).with_switches(self.switches)


@dataclass(frozen=True, kw_only=True)
class Driven(Revised, WithJson):
    """A command that drives episodes of one family."""

    family: str = argument(
        "Family of scenarios: emergency, paper, shift, ..., or a Python file of your own."
    )
    mode: str = option("act", "How far least-risk goes: off, shadow, advise, act.")

    def setup(self, episodes: int, *, learn: bool, first: int = 0) -> Setup:
        """What is driven; ``first`` is how many episodes were driven before."""
        from evofsm.cli.driving import Setup

        return Setup(
            self.load_family(self.family),
            self.controller,
            self.reviser,
            self.judge.value,
            chosen_mode(self.mode),
            self.tolerance,
            episodes,
            self.seed,
            learn=learn,
            first=first,
        )
