"""Two coupled tanks with two pumps; it fails where one overflows or runs dry.

Water leaves each tank by the root of its level (Torricelli), and flows through a pipe between them
by the root of the difference. A pump takes a while to follow what it is told, so that a tank may be
lost some time before it overflows. Now and then someone opens a tap for a while.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

import numpy as np

from studies.systems.system import Action, Box, Start, System, Vector

_DRY, _FULL = 0.1, 2.0  # levels that fail [m]
_MIDDLE = 1.0  # level at which an episode starts, about [m]
_OUTLET = 0.03  # outflow at a level of 1 m [m/s of level]
_PIPE = 0.02  # flow through the pipe at a difference of 1 m [m/s of level]
_PUMP = 0.15  # largest flow of a pump [m/s of level]
_LAG = 25.0  # time constant of a pump [s]
_SUBSTEPS = 4
# A tap: how likely one is opened in a step, for how many steps (the last is left out), and how much
# more leaves its tank, as a share of the outlet.
_TAP_OPENS = 0.02
_TAP_STEPS = (20, 60)
_TAP_FLOW = (0.3, 1.0)
# The one that wanders: how likely it sets each pump anew in a step.
_CHANGES = 0.05
# Feedback of the one whose sensors are exchanged, on the level above the middle.
_GAIN = 2.0


class Tanks(System):
    """300 steps; an action is the share of its largest flow that each pump is to give.

    Parameters
    ----------
    controller : str, optional
    """

    name = "tanks"
    variables = ("level 1 [m]", "level 2 [m]", "flow 1 [m/s]", "flow 2 [m/s]")
    actions = Box((0.0, 0.0), (1.0, 1.0))
    interval = 1.0
    steps = 300

    @property
    def controllers(self) -> Mapping[str, Callable[[Vector], Action]]:
        """Each by itself fails in all but every episode."""
        return {
            "full": lambda z: np.ones(2),
            "wander": lambda z: self._wander(),
            "exchanged": lambda z: np.clip(0.5 - _GAIN * (z[1::-1] - _MIDDLE), 0.0, 1.0),
        }

    def _wander(self) -> Vector:
        for pump in range(2):
            if self.whim.random() < _CHANGES:
                self._set[pump] = self.whim.uniform()
        return self._set.copy()

    def _begin(self, start: Start) -> None:
        self._levels = _MIDDLE + self.chance.uniform(-0.2, 0.2, 2)
        self._flows = _OUTLET * np.sqrt(self._levels)
        self._set = self.whim.uniform(size=2)
        self._taps = np.zeros(2)
        self._tap_left = 0

    def _observation(self) -> Vector:
        return np.concatenate([self._levels, self._flows])

    def _advance(self, action: Action) -> tuple[float, bool]:
        self._turn_taps()
        wanted = _PUMP * np.clip(np.asarray(action, dtype=np.float64), 0.0, 1.0)
        dt = self.interval / _SUBSTEPS
        for _ in range(_SUBSTEPS):
            first, second = self._levels
            across = _PIPE * math.copysign(math.sqrt(abs(first - second)), first - second)
            out = _OUTLET * (1.0 + self._taps) * np.sqrt(np.maximum(self._levels, 0.0))
            self._levels = self._levels + dt * (self._flows - out + [-across, across])
            self._flows = self._flows + dt / _LAG * (wanted - self._flows)
        failed = np.any((self._levels <= _DRY) | (self._levels >= _FULL))
        return 1.0, bool(failed)

    def _turn_taps(self) -> None:
        """Open a tap, or close the one that is open."""
        if self._tap_left > 0:
            self._tap_left -= 1
        elif self.chance.random() < _TAP_OPENS:
            self._tap_left = int(self.chance.integers(*_TAP_STEPS))
            self._taps = np.zeros(2)
            self._taps[self.chance.integers(2)] = self.chance.uniform(*_TAP_FLOW)
        else:
            self._taps = np.zeros(2)
