"""An aggressive driver behind leaders who brake suddenly, with and without the reviser.

    python examples/car_following.py

The environment is ``evofsm/CarFollowing-v0`` in the family `emergency`: from rest, brakes of
2.5 m/s², and a leader who at some time brakes by up to 4.5 m/s² until it stands. The reviser
learns from the draws of the one split, and is judged, frozen, on those of the other. A collision
is that of the driver with its leader; no one drives behind it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
from comparison import Result, compare, settings
from numpy.typing import NDArray

from evofsm.driving import CarFollowing, guard_for_family
from evofsm.guard import RevisedActions


def main(argv: Sequence[str] | None = None) -> tuple[Result, Result]:
    """Drive, print, and answer with what came of it: unrevised, revised."""
    chosen = settings("An aggressive driver, revised.", argv, episodes=100, train=40)
    env = gymnasium.make("evofsm.driving.env:evofsm/CarFollowing-v0", seed=chosen.seed)
    car = env.unwrapped
    assert isinstance(car, CarFollowing)

    def aggressive(observation: NDArray[np.float64], info: dict[str, Any]) -> NDArray[np.float64]:
        assert car.draw is not None  # within an episode
        return np.array([car.draw.controller.propose(observation, info["time"]).action])

    guard = guard_for_family(car.family)
    revised = RevisedActions(env, guard, failed=lambda step: step.info["failed"])
    results = compare(
        revised,
        aggressive,
        [{"options": {"split": "train", "index": i}} for i in range(chosen.train)],
        [{"options": {"split": "test", "index": i}} for i in range(chosen.episodes)],
        speed=lambda observation: observation[1],
    )
    env.close()
    return results


if __name__ == "__main__":
    main()
