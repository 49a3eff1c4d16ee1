"""Full throttle on a highway that knows nothing of this package, with and without the reviser.

    pip install '.[gym]' highway-env
    python examples/highway.py

A policy that always commands full throttle drives in ``highway-fast-v0`` of highway-env, on three
lanes among cars that follow each other and change lanes as they please, also to right in front of
it. It has no steering. The reviser makes a car follower of it.

What is counted as a collision is what the environment itself calls ``crashed``: the car met any
other, whoever is to blame. All others start ahead of it, but those that it overtakes in other
lanes may run into it later, or push in from the side: that counts too. An unrevised episode ends
early, on the way to 40 m/s; what can be kept of that is the speed of the traffic.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium
import highway_env  # noqa: F401  (registers its environments)
import numpy as np
from comparison import Result, compare, settings
from gymnasium.wrappers import RescaleAction
from highway_env.vehicle.kinematics import Vehicle
from numpy.typing import NDArray

from evofsm.driving import guard_for_cars
from evofsm.guard import RevisedActions

FULL = 5.0  # throttle and brakes [m/s²]; the environment's own actions are shares of it
INTERVAL = 0.25  # between decisions [s]
PRESENCE, X, Y, SPEED = range(4)  # columns of its observation; the first row is the car itself
CONFIG = {
    "lanes_count": 3,
    "vehicles_count": 12,
    "duration": 20,  # [s]
    "policy_frequency": round(1 / INTERVAL),
    "simulation_frequency": 12,
    "action": {
        "type": "ContinuousAction",
        "lateral": False,
        "acceleration_range": (-FULL, FULL),
        "speed_range": (0.0, 40.0),
    },
    "observation": {
        "type": "Kinematics",
        "features": ["presence", "x", "y", "vx"],
        "vehicles_count": 8,
        "absolute": True,
        "normalize": False,
    },
}


def ahead(observation: NDArray[np.float32]) -> NDArray[np.float64] | None:
    """Gap from bumper to bumper [m] and both speeds [m/s]; None where no one is ahead.

    Ahead is whoever overlaps sideways with the car, by a margin, so that who changes lanes is
    seen as soon as it touches this one. Its positions are those of the cars' middles.
    """
    car, others = observation[0], observation[1:]
    beside = np.abs(others[:, Y] - car[Y]) < Vehicle.WIDTH + 0.5
    found = others[(others[:, PRESENCE] == 1.0) & beside & (others[:, X] > car[X])]
    if len(found) == 0:
        return None
    leader = found[found[:, X].argmin()]
    gap = leader[X] - car[X] - Vehicle.LENGTH
    return np.array([gap, max(car[SPEED], 0.0), max(leader[SPEED], 0.0)], dtype=np.float64)


def full_throttle(observation: NDArray[np.float32], info: dict[str, Any]) -> NDArray[np.float32]:
    """The policy."""
    return np.full(1, FULL, dtype=np.float32)


def main(argv: Sequence[str] | None = None) -> tuple[Result, Result]:
    """Drive, print, and answer with what came of it: unrevised, revised."""
    chosen = settings("Full throttle on a highway, revised.", argv, episodes=25, train=10)
    env = gymnasium.make("highway-fast-v0", config=CONFIG)
    revised = RevisedActions(
        RescaleAction(env, np.float32(-FULL), np.float32(FULL)),
        guard_for_cars(-FULL, FULL, INTERVAL, width=0.5),
        observe=ahead,
        failed=lambda step: step.info["crashed"],
    )
    held_out = range(chosen.seed, chosen.seed + chosen.episodes)
    training = range(held_out.stop, held_out.stop + chosen.train)
    results = compare(
        revised,
        full_throttle,
        [{"seed": seed} for seed in training],
        [{"seed": seed} for seed in held_out],
        speed=lambda observation: observation[0, SPEED],
        failed="crashed",
    )
    revised.close()
    return results


if __name__ == "__main__":
    main()
