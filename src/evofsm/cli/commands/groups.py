"""The options that several commands share, each written once."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING

from evofsm.cli.commands.declared import Command, option

if TYPE_CHECKING:
    pass


class WorldName(StrEnum):
    """Where to drive."""

    SUMO = "sumo"
    KINEMATIC = "kinematic"


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
