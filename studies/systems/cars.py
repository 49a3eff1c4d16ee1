"""Families of car following; it fails where the follower hits its leader."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import lru_cache

import numpy as np

from evofsm.driving import (
    Draw,
    Family,
    KinematicWorld,
    Reference,
    load_family,
    outcome_of,
    references_of,
)
from studies.systems.system import Action, Box, Start, System, Vector


class Cars(System):
    """A family, driven in closed form by the drivers that it draws.

    Parameters
    ----------
    controller : str, optional
    family : str
        Its name, as `load_family` takes it.
    """

    variables = ("gap [m]", "own speed [m/s]", "leader's speed [m/s]")
    train = 100
    measure = "mobility"

    def __init__(self, controller: str | None = None, *, family: str) -> None:
        self.family = _family(family)
        self.name = family
        low, high = self.family.actions.low, self.family.actions.high
        self.actions = Box((low,), (high,))
        self.interval = self.family.interval
        super().__init__(controller)

    @property
    def controllers(self) -> Mapping[str, Callable[[Vector], Action]]:
        """The driver of each draw."""
        return {"driver": self._driver}

    def _driver(self, observation: Vector) -> float:
        wanted = self._draw.controller.propose(observation, self._road.time).action
        return float(np.clip(wanted, self.family.actions.low, self.family.actions.high))

    def _begin(self, start: Start) -> None:
        self._start = start
        self._draw = _draw(self.family, start)
        scenario = self._draw.scenario
        self._per_decision = scenario.steps(self.interval)
        self.steps = round(scenario.duration / self.interval)
        with KinematicWorld().open(scenario) as road:
            self._road = road

    def _observation(self) -> Vector:
        return np.asarray(self._road.observation, dtype=np.float64)

    def _advance(self, action: Action) -> tuple[float, bool]:
        self._road.advance(float(action), self._per_decision)
        return 0.0, self._road.collided

    def _is_over(self) -> bool:
        return self._road.over

    @property
    def score(self) -> float:
        """Mobility: distance, in those of the driver alone in the same draw."""
        alone = _alone(self.name, self._start)
        return outcome_of(self._road.episode(), alone, self.interval).mobility


def _draw(family: Family, start: Start) -> Draw:
    return family.draw(start.seed, start.episode, split=start.split)


@lru_cache
def _family(name: str) -> Family:
    return load_family(name)


@lru_cache(maxsize=4096)
def _alone(name: str, start: Start) -> Reference:
    """How far the driver comes by itself; the same draws are driven by every judge."""
    family = _family(name)
    (reference,) = references_of(family, [_draw(family, start)])
    return reference
