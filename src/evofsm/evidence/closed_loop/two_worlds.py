"""The same learnt model in SUMO and in closed form: it must revise the same way."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from evofsm.driving import WORLDS, Family, Learner, held_out, open_world, training


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
    learner = Learner.new(family)
    learner.teach(family, training(family, seed, 0, train), learner.reviser(family, tolerance))
    found = []
    for name in WORLDS:
        frozen = learner.frozen()
        reviser = frozen.reviser(family, tolerance)
        with open_world(name) as world:
            drives = [
                frozen.drive(family, draw, reviser, learn=False, world=world)
                for draw in held_out(family, seed, test)
            ]
        found.append(
            InWorld(
                name,
                test,
                sum(drive.episode.collided for drive in drives),
                float(np.mean([drive.episode.observations[:, 1].mean() for drive in drives])),
                float(np.concatenate([drive.changed for drive in drives]).mean()),
            )
        )
    return {"worlds": found}
