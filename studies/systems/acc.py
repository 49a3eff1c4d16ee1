"""Adaptive cruise control of REVEL, SPICE and VELM, from the equations.

x is minus the gap and v the speed at which it closes; x' = x + dt v and v' = v + dt (a + noise).
Closer pays more, so that who learns for the reward alone drives into what cannot be left again.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from studies.systems.rivals.acc import Barrier, CbfPy, StoppingDistance
from studies.systems.system import Action, Box, Judge, Start, System, Vector

_DT = 0.02  # [s]
_STEPS = 300
_NOISE = 0.5  # standard deviation of the acceleration
_LARGEST = 10.0  # of position and speed
_UNSAFE = -10.0  # reward of a step that is unsafe


class Acc(System):
    """The task; unsafe is x >= 0.

    An unsafe step ends the episode; those that are left are paid as unsafe ones.

    Parameters
    ----------
    controller : str, optional
    hold : int
        Steps from a decision to the next one.
    """

    variables = ("x", "v")
    actions = Box((-2.0,), (2.0,))
    train = 50

    def __init__(self, controller: str | None = None, *, hold: int = 1) -> None:
        self.name = "acc" if hold == 1 else f"acc-{hold}"
        self.interval = hold * _DT
        self.steps = _STEPS // hold
        self._hold = hold
        super().__init__(controller)

    @property
    def controllers(self) -> Mapping[str, Callable[[Vector], Action]]:
        """Full throttle alone."""
        return {"full throttle": lambda z: 2.0}

    @property
    def rivals(self) -> Mapping[str, Callable[[], Judge]]:
        """Told the equations and the noise."""
        told = (_DT, self._hold, self.actions.high[0], _NOISE)
        return {
            "stopping-distance": lambda: StoppingDistance(*told),
            "barrier": lambda: Barrier(*told),
            "cbfpy": lambda: CbfPy(*told),
        }

    def _begin(self, start: Start) -> None:
        self._x = float(self.chance.uniform(-1.1, -0.9))
        self._v = float(self.chance.uniform(-0.1, 0.1))
        self._noise = self.chance.normal(0.0, _NOISE, _STEPS)
        self._step = 0

    def _observation(self) -> Vector:
        return np.array([self._x, self._v])

    def _advance(self, action: Action) -> tuple[float, bool]:
        reward = 0.0
        for _ in range(self._hold):
            speed = self._v + _DT * (float(action) + self._noise[self._step])
            self._x = _clipped(self._x + _DT * self._v)
            self._v = _clipped(speed)
            self._step += 1
            if self._x >= 0.0:
                return reward + _UNSAFE * (1 + _STEPS - self._step), True
            reward += 2.0 + self._x
        return reward, False


def _clipped(value: float) -> float:
    return float(min(max(value, -_LARGEST), _LARGEST))
