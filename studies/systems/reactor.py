"""A reactor that is fed step by step, whose cooling fails for a while; it fails by thermal runaway.

What is fed reacts the faster the hotter it is, and heats the reactor as it does. What has not
reacted yet is heat to come: fed too fast, nothing can stop it once the cooling fails. Whether it
has failed is not observed, and shows in the temperature only some steps later.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from studies.systems.system import Action, Discrete, Start, System, Vector

_FAILS = 100.0  # temperature of the runaway [°C]
_COOLANT = 20.0  # [°C]
_COOLING = 0.1  # share of the difference to the coolant that is lost in a step
_BROKEN = 0.01  # the same while the cooling fails
_HEAT = 80.0  # of a unit that reacts [K]
_RATE = 0.05  # share that reacts in a step at 60 °C ...
_REFERENCE = 60.0  # [°C]
_DOUBLES = 10.0  # ... and which doubles with so much more [K]
_FEEDS = (0.0, 0.015, 0.04)  # units fed in a step
_NOISE = 0.1  # of the temperature in a step [K]
# How likely the cooling fails in a step, and for how many (the last is left out).
_FAILURE_BEGINS = 0.02
_FAILURE_STEPS = (20, 61)
# The thermostat feeds up to this temperature [°C].
_THERMOSTAT = 70.0


class Reactor(System):
    """300 steps; an action is 0 to feed nothing, 1 to feed slowly, 2 to feed fast.

    The return is what was fed, in units.

    Parameters
    ----------
    controller : str, optional
    """

    name = "reactor"
    variables = ("temperature [°C]", "unreacted")
    actions = Discrete(len(_FEEDS))
    interval = 1.0
    steps = 300

    @property
    def controllers(self) -> Mapping[str, Callable[[Vector], Action]]:
        """Each by itself fails in all but every episode."""
        return {
            "hurried": lambda z: 2,
            "thermostat": lambda z: 2 if z[0] < _THERMOSTAT else 0,
            "random": lambda z: int(self.whim.integers(3)),
        }

    def _begin(self, start: Start) -> None:
        self._temperature = float(self.chance.uniform(35.0, 45.0))
        self._unreacted = 0.0
        self._fails_for = 0

    def _observation(self) -> Vector:
        return np.array([self._temperature, self._unreacted])

    def _advance(self, action: Action) -> tuple[float, bool]:
        if self._fails_for > 0:
            self._fails_for -= 1
        elif self.chance.random() < _FAILURE_BEGINS:
            self._fails_for = int(self.chance.integers(*_FAILURE_STEPS))
        lost = _BROKEN if self._fails_for > 0 else _COOLING
        speed = _RATE * 2.0 ** ((self._temperature - _REFERENCE) / _DOUBLES)
        reacted = self._unreacted * (1.0 - np.exp(-speed))
        fed = _FEEDS[int(action)]
        self._temperature += float(
            _HEAT * reacted
            - lost * (self._temperature - _COOLANT)
            + self.chance.normal(0.0, _NOISE)
        )
        self._unreacted += float(fed - reacted)
        return fed, self._temperature >= _FAILS
