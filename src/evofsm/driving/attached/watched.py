"""Cars that are only watched: how close they came, by measures that need no guard."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from evofsm.driving.attached.seen import Seeing
from evofsm.driving.measures import deceleration_to_avoid_collision, time_to_collision

_NONE = np.empty((0, 3))
# Needed decelerations from which on a car is amber, or red [m/s²].
_CAREFUL, _HARD = 1.0, 3.35


class Watching:
    """Measures each car against whoever is ahead of it.

    Attributes
    ----------
    ids : list of str
        Cars with somebody ahead, now.
    observations : (len(ids), 3) ndarray
        Gap [m], speed of the car and of the one ahead [m/s], of each.
    ttc, drac : (len(ids),) ndarray
        Time to collision [s] and deceleration to avoid it [m/s²], of each.
    lowest_ttc, highest_drac : dict from str to float
        Of each car that ever closed in, so far.
    """

    def __init__(self, seeing: Seeing) -> None:
        self._seeing = seeing
        self._cars: dict[str, None] = {}
        self.ids: list[str] = []
        self.observations: NDArray[np.float64] = _NONE
        self.ttc = self.drac = np.empty(0)
        self.lowest_ttc: dict[str, float] = {}
        self.highest_drac: dict[str, float] = {}

    def __len__(self) -> int:
        return len(self._cars)

    def __iter__(self) -> Any:
        return iter(self._cars)

    def add(self, car: str) -> None:
        """Watch it from now on."""
        self._cars[car] = None

    def remove(self, car: str) -> None:
        """Watch it no longer; what was measured stays."""
        self._cars.pop(car, None)

    def leave(self, car: str) -> None:
        """It has left the simulation."""
        self.remove(car)

    def urgency(self) -> dict[str, int]:
        """0 to 2 of each car."""
        needed = dict(zip(self.ids, self.drac.tolist(), strict=True))
        drac = {car: needed.get(car, 0.0) for car in self._cars}
        return {car: (each > _CAREFUL) + (each > _HARD) for car, each in drac.items()}

    def step(self) -> int:
        """Look at every car; returns how many there are."""
        ids, rows, pair_of = [], [], self._seeing.pair
        for car in self._cars:
            pair = pair_of(car)
            if pair is not None:
                ids.append(car)
                rows.append(pair)
        self.ids, self.observations = ids, np.array(rows) if rows else _NONE
        self.ttc = time_to_collision(self.observations)
        self.drac = deceleration_to_avoid_collision(self.observations)
        for k in np.flatnonzero(np.isfinite(self.ttc)).tolist():
            car, ttc, drac = ids[k], float(self.ttc[k]), float(self.drac[k])
            self.lowest_ttc[car] = min(ttc, self.lowest_ttc.get(car, ttc))
            self.highest_drac[car] = max(drac, self.highest_drac.get(car, drac))
        return len(self._cars)
