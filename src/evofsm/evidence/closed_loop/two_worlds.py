"""The same learnt model in SUMO and in closed form: it must revise the same way."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from evofsm.driving import (
    WORLDS,
    Family,
    drive,
    guard_for_family,
    held_out,
    open_world,
    teach,
    training,
)


class InWorld(NamedTuple):
    """What came of the same held-out draws in one world."""

    world: str
    episodes: int
    collisions: int
    mean_speed: float  #: [m/s]
    intervention_rate: float


def run_two_worlds(
    family: Family, train: int, test: int, tolerance: float, seed: int = 0
) -> dict[str, list[Any]]:
    """Learn in closed form, then drive the same draws in every world with learning frozen."""
    guard = guard_for_family(family, tolerance=tolerance)
    teach(guard, training(family, seed, 0, train))
    found = []
    for name in WORLDS:
        frozen = guard.copy(states=False)
        frozen.freeze()
        with open_world(name) as world:
            drives = [drive(frozen, draw, world) for draw in held_out(family, seed, test)]
        found.append(
            InWorld(
                name,
                test,
                sum(one.episode.collided for one in drives),
                float(np.mean([one.episode.observations[:, 1].mean() for one in drives])),
                float(np.concatenate([one.changed for one in drives]).mean()),
            )
        )
    return {"worlds": found}
