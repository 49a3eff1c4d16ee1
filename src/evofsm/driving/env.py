"""Car following as a Gymnasium environment: ``evofsm/CarFollowing-v0``.

Importing this module registers it, so that one call does both::

    gymnasium.make("evofsm.driving.env:evofsm/CarFollowing-v0")
"""

from __future__ import annotations

import math
from contextlib import ExitStack
from os import PathLike
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from evofsm.driving.family import Draw, Family, load_family
from evofsm.driving.sumo import open_world
from evofsm.driving.world import Episode, Road
from evofsm.extras import needs
from evofsm.fsm.validation import Floats
from evofsm.guard.actions import put_into

with needs("gymnasium", "gym", "an environment of Gymnasium"):
    import gymnasium
    from gymnasium.spaces import Box

#: How it is asked for.
ID = "evofsm/CarFollowing-v0"

#: The range of an observation; what lies beyond is seen at its edge. A collision shows as a gap
#: of 0 or less.
LOW = (-10.0, 0.0, 0.0)
HIGH = (2000.0, 100.0, 100.0)

# Scenarios are drawn by an index below this.
_INDICES = 2**31


class CarFollowing(gymnasium.Env[Floats, Floats]):
    """Drive behind a leader who may brake, in scenarios of a family.

    An observation is ``[gap [m], v_follower [m/s], v_leader [m/s]]``, the gap from bumper to
    bumper; an action is an acceleration [m/s²] in the family's range, commanded for the family's
    interval. What lies beyond the range is commanded at its edge.

    The reward of a step is the distance travelled in it [m], less ``collision_cost`` where it ends
    in a collision. An episode terminates when two cars collide, and is truncated when its time is
    up. ``info`` holds ``time`` [s], ``gap`` [m] as it truly is, ``distance`` [m] and ``realised``
    acceleration [m/s²] of the step, ``failed``, whether the follower ran into its leader,
    ``rear_ended``, whether the car behind, if any, ran into the follower, which is no failure, and
    ``split`` and ``index`` of the scenario.

    Parameters
    ----------
    family : str, path or Family
        Name of a family of scenarios, a file with one, or one that `load_family` has made.
    world : str
        "kinematic" or "sumo".
    seed : int
        Of the family's draws. The seed of `reset` picks among them.
    collision_cost : float
        Taken from the reward of the step that ends in a collision [m].

    Examples
    --------
    >>> env = CarFollowing()
    >>> observation, info = env.reset(seed=1, options={"index": 7, "split": "test"})
    >>> info["split"], info["index"], info["time"]
    ('test', 7, 0.0)
    >>> observation, reward, terminated, truncated, info = env.step([1.0])
    >>> info["time"], terminated, truncated
    (0.25, False, False)
    """

    def __init__(
        self,
        family: str | PathLike[str] | Family = "emergency",
        world: str = "kinematic",
        *,
        seed: int = 0,
        collision_cost: float = 1000.0,
    ) -> None:
        if not 0.0 <= collision_cost < math.inf:
            raise ValueError(f"collision_cost is {collision_cost}; it must be finite, 0 or more")
        self.family = family if isinstance(family, Family) else load_family(family)
        self.seed = seed
        self.collision_cost = collision_cost
        self.draw: Draw | None = None  #: what is driven: its scenario, and its own controller
        self.observation_space = Box(np.array(LOW), np.array(HIGH), dtype=np.float64)
        actions = self.family.actions
        self.action_space = Box(actions.low, actions.high, (1,), np.float64)
        self._world = open_world(world)
        self._run = ExitStack()
        self._road: Road | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Floats, dict[str, Any]]:
        """Begin a scenario, drawn by ``seed`` or with ``split`` and ``index`` of ``options``."""
        super().reset(seed=seed)
        choices = dict(options or {})
        split = choices.pop("split", "train")
        random_index = int(self.np_random.integers(_INDICES))
        index = int(choices.pop("index", random_index))
        if choices:
            raise ValueError(f"there is no option {', '.join(choices)}; there are index and split")
        self.draw = self.family.draw(self.seed, index, split)
        self._which = {"split": split, "index": index}
        self._run.close()
        scenario = self.draw.scenario
        road = self._run.enter_context(self._world.open(scenario))
        road.every, self._road = scenario.steps(self.family.interval), road
        return np.clip(road.observation, LOW, HIGH), self._info(road.episode())

    def step(self, action: ArrayLike) -> tuple[Floats, float, bool, bool, dict[str, Any]]:
        """Drive for one interval with ``action`` commanded, which must be a finite number."""
        road = self._road
        if road is None or road.over:
            raise RuntimeError("step before reset: no episode is under way")
        acceleration = float(np.asarray(action, dtype=np.float64).reshape(()))
        if not math.isfinite(acceleration):
            raise ValueError(f"action is {acceleration}; an acceleration must be finite")
        row, command = road.row, put_into(self.family.actions, acceleration)
        observation, _, terminated, truncated, outcome = road.step(command)
        info = self._info(road.episode(first=row)) | {"realised": outcome["realised"]}
        reward = info["distance"] - (self.collision_cost if terminated else 0.0)
        return np.clip(observation, LOW, HIGH), reward, terminated, truncated, info

    def close(self) -> None:
        """Leave the road."""
        self._road = None
        self._run.close()

    def _info(self, step: Episode) -> dict[str, Any]:
        return {
            "time": float(step.time[-1]),
            "gap": float(step.observations[-1, 0]),
            "distance": float(np.trapezoid(step.observations[:, 1], step.time)),
            "failed": step.collided,
            "rear_ended": step.rear_ended,
            **self._which,
        }


if ID not in gymnasium.registry:
    gymnasium.register(ID, entry_point=f"{__name__}:{CarFollowing.__name__}")
