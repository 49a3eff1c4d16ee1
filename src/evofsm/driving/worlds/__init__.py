"""Where it drives: the same scenario with the same controllers, in closed form or in SUMO."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from evofsm.driving.worlds.road import World

#: The worlds there are.
WORLDS = ("sumo", "kinematic")


def open_world(name: str) -> AbstractContextManager[World]:
    """Open a world by its name, one of `WORLDS`, for use in a ``with`` statement."""
    if name == "sumo":
        from evofsm.driving.worlds.sumo import SumoWorld

        return SumoWorld()
    if name == "kinematic":
        from evofsm.driving.worlds.kinematic import KinematicWorld

        return nullcontext(KinematicWorld())
    raise ValueError(f"there is no world {name!r}; there are {', '.join(WORLDS)}")
