"""The labelled tasks of masa-safe-rl; it fails where the package's own labels cost something.

An episode ends with the first such step. The package needs dozens of others, of which these tasks
need none: ``pip install --no-deps masa-safe-rl``.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from functools import partial
from importlib import import_module
from typing import Any

import numpy as np

from studies.systems.rivals.masa import obstacle_shield, road_shield
from studies.systems.rivals.pole import cart_shield
from studies.systems.system import Action, Box, Discrete, Judge, Start, System, Vector

PACKAGE = "masa"
#: What installs it, in words.
INSTALL = "pip install --no-deps masa-safe-rl"
# Steps of an episode of the poles, and of all others: the package sets no limit.
_POLE_STEPS, _STEPS = 500, 200
# How likely the one that wanders takes another action, and the hasty one does not hurry.
_CHANGES, _PAUSES = 0.1, 0.2
# Where the curious one goes: to and fro between places drawn from here, some in the obstacle.
_PLACES = np.array([[-0.4, 2.0], [0.0, 3.4]])
_ARRIVED = 0.1
_TO_PLACE, _SLOWING = 4.0, 40.0


class Masa(System):
    """One of them; the return is the sum of the package's own rewards.

    Parameters
    ----------
    controller : str, optional
    task : str
        Such as ``"cont_cartpole"``.

    Raises
    ------
    ModuleNotFoundError
        If the package is not installed.
    """

    def __init__(self, controller: str | None = None, *, task: str) -> None:
        module, name, self.variables = _TASKS[task]
        try:
            found = import_module(f"{PACKAGE}.envs.{module}")
        except ModuleNotFoundError as error:
            raise ModuleNotFoundError(f"masa-{task} needs masa-safe-rl: {INSTALL}") from error
        self.name, self._task = f"masa-{task}", task
        self._cost: Callable[[Any], float] = lambda seen: found.cost_fn(found.label_fn(seen))
        with warnings.catch_warnings():  # that its boxes are cast to 32 bits
            warnings.simplefilter("ignore", UserWarning)
            self._env = getattr(found, name)()
        space = self._env.action_space
        self.actions: Box | Discrete
        if hasattr(space, "n"):
            self.actions = Discrete(int(space.n))
        else:
            self.actions = Box(tuple(map(float, space.low)), tuple(map(float, space.high)))
        self._is_pole = task.endswith("cartpole")
        self.interval = 0.02 if self._is_pole else 1.0
        self.steps = _POLE_STEPS if self._is_pole else _STEPS
        self._wanted: Action | None = None
        self._goes_to: Vector = np.zeros(2)
        super().__init__(controller)

    @property
    def controllers(self) -> Mapping[str, Callable[[Vector], Action]]:
        """Each by itself fails in most episodes."""
        if self._task == "disc_cartpole":
            return {"random": lambda z: int(self.whim.integers(2))}
        if self._task == "obstacle":
            return {"curious": self._curious, "wander": self._wander}
        if self._is_pole:
            return {"wander": self._wander, "random": lambda z: self._drawn()}
        return {"hasty": self._hasty, "wander": self._wander}

    @property
    def rivals(self) -> Mapping[str, Callable[[], Judge]]:
        """Told the equations and what fails."""
        if self._is_pole:
            return {"lqr-shield": lambda: cart_shield(self.actions)}
        shield = obstacle_shield if self._task == "obstacle" else road_shield
        return {"brake-shield": partial(shield, self.actions)}

    def _drawn(self) -> Action:
        assert isinstance(self.actions, Box)
        drawn = self.whim.uniform(self.actions.low, self.actions.high)
        return float(drawn[0]) if len(drawn) == 1 else drawn

    def _wander(self, observation: Vector) -> Action:
        if self._wanted is None or self.whim.random() < _CHANGES:
            self._wanted = self._drawn()
        return self._wanted

    def _hasty(self, observation: Vector) -> Action:
        assert isinstance(self.actions, Box)
        if self.whim.random() < _PAUSES:
            return self._drawn()
        return self.actions.high[0] if len(self.actions.high) == 1 else np.array(self.actions.high)

    def _curious(self, observation: Vector) -> Action:
        place, speed = observation[:2], observation[2:]
        if np.abs(self._goes_to - place).max() < _ARRIVED:
            self._goes_to = self.whim.uniform(*_PLACES.T)
        return np.clip(_TO_PLACE * (self._goes_to - place) - _SLOWING * speed, -2.0, 2.0)

    def _begin(self, start: Start) -> None:
        # The package takes a seed of 0 for none.
        self._seen, _ = self._env.reset(seed=1 + int(self.chance.integers(2**31 - 1)))
        self._wanted = None
        self._goes_to = self.whim.uniform(*_PLACES.T)
        self._arrived = False

    def _observation(self) -> Vector:
        return np.asarray(self._seen, dtype=np.float64)

    def _advance(self, action: Action) -> tuple[float, bool]:
        given: Any = int(action) if isinstance(self.actions, Discrete) else self._in_box(action)
        self._seen, reward, self._arrived, _, _ = self._env.step(given)
        return float(reward), self._cost(self._seen) > 0.0

    def _in_box(self, action: Action) -> Any:
        space = self._env.action_space
        return np.clip(np.atleast_1d(np.asarray(action, np.float32)), space.low, space.high)

    def _is_over(self) -> bool:
        return bool(self._arrived) or super()._is_over()


_POLE = ("x [m]", "speed [m/s]", "angle [rad]", "rate [rad/s]")
_PLANE = ("x", "y", "speed x", "speed y")
# Module, class, and what it observes.
_TASKS: dict[str, tuple[str, str, tuple[str, ...]]] = {
    "cont_cartpole": ("continuous.cartpole", "ContinuousCartpole", _POLE),
    "disc_cartpole": ("discrete.cartpole", "DiscreteCartpole", _POLE),
    "road_1d": ("continuous.road_1d", "Road1D", ("x", "speed")),
    "road_2d": ("continuous.road_2d", "Road2D", _PLANE),
    "obstacle": ("continuous.obstacle", "Obstacle", _PLANE),
}
#: By name: makes the task with a controller.
MASA: dict[str, Callable[[str | None], System]] = {
    f"masa-{task}": partial(Masa, task=task) for task in _TASKS
}
