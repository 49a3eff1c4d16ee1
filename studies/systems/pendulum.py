"""Pendulum-v1 of Gymnasium, held upright; it fails where it leans too far."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

import numpy as np

from evofsm.extras import needs
from studies.systems.rivals.pole import pendulum_shield
from studies.systems.system import Action, Box, Judge, Start, System, Vector

with needs("gymnasium", "gym", "Pendulum-v1"):
    import gymnasium

# Leaning further is a failure [rad].
_FAILS = 0.5
# Where it starts: largest angle [rad] and rate [rad/s].
_FIRST_ANGLE, _FIRST_RATE = 0.1, 0.3
# How likely the one that wanders takes another torque.
_CHANGES = 0.1
# Feedback of the bad one on angle and rate: the rate's has the wrong sign.
_BAD_ANGLE, _BAD_RATE = -4.0, 0.6


class Pendulum(System):
    """200 steps; an action is a torque from -2 to 2 Nm. The return counts the steps.

    Parameters
    ----------
    controller : str, optional
    circular : bool
        Whether the angle is seen as its cosine and sine, as Gymnasium shows it.
    """

    actions = Box((-2.0,), (2.0,))
    interval = 0.05
    steps = 200

    def __init__(self, controller: str | None = None, *, circular: bool = False) -> None:
        self.name = "pendulum-cos" if circular else "pendulum"
        seen = ("cos", "sin") if circular else ("angle [rad]",)
        self.variables = (*seen, "rate [rad/s]")
        self._circular = circular
        self._env = gymnasium.make("Pendulum-v1").unwrapped
        super().__init__(controller)

    @property
    def controllers(self) -> Mapping[str, Callable[[Vector], Action]]:
        """Each by itself lets it fall in all but every episode."""
        return {
            "random": lambda z: float(self.whim.uniform(-2.0, 2.0)),
            "wander": lambda z: self._wander(),
            "badpd": lambda z: self._bad_feedback(),
        }

    @property
    def rivals(self) -> Mapping[str, Callable[[], Judge]]:
        """Told the linear model, and how the angle is seen."""
        return {"lqr-shield": lambda: pendulum_shield(self.actions, _FAILS, self._circular)}

    def _wander(self) -> float:
        if self.whim.random() < _CHANGES:
            self._torque = float(self.whim.uniform(-2.0, 2.0))
        return self._torque

    def _bad_feedback(self) -> float:
        angle, rate = self._state
        return float(np.clip(_BAD_ANGLE * math.sin(angle) + _BAD_RATE * rate, -2.0, 2.0))

    @property
    def _state(self) -> tuple[float, float]:
        """Angle from upright, in [-pi, pi) [rad], and its rate [rad/s]."""
        angle, rate = self._env.state  # type: ignore[attr-defined]
        return (float(angle) + math.pi) % (2.0 * math.pi) - math.pi, float(rate)

    def _begin(self, start: Start) -> None:
        self._env.reset(seed=0)
        first = np.array([_FIRST_ANGLE, _FIRST_RATE])
        self._env.state = self.chance.uniform(-first, first)  # type: ignore[attr-defined]
        self._torque = 0.0

    def _observation(self) -> Vector:
        angle, rate = self._state
        seen = (math.cos(angle), math.sin(angle)) if self._circular else (angle,)
        return np.array([*seen, rate])

    def _advance(self, action: Action) -> tuple[float, bool]:
        self._env.step(np.array([float(action)]))
        return 1.0, abs(self._state[0]) > _FAILS
