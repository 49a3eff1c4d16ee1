"""What is varied, and within which limits."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import Enum
from itertools import permutations
from typing import Any

import numpy as np

from evofsm.paper import CASES
from studies.sensitivity.setting import Scaling, Setting, recovered


class Standing(Enum):
    """What the paper says about a parameter."""

    OPEN = "left open"
    STATED = "stated"
    ADDED = "not in the paper"


class Scale(Enum):
    """How values are spaced over a range: evenly on this scale."""

    LINEAR = "linear"
    LOG = "logarithm"
    SQUARE = "square root"  #: small values are closer together, and 0 is one of them

    def there(self, value: float) -> float:
        """From a value to the scale."""
        match self:
            case Scale.LOG:
                return math.log(value)
            case Scale.SQUARE:
                return math.sqrt(value)
        return value

    def back(self, height: float) -> float:
        """From the scale to a value."""
        match self:
            case Scale.LOG:
                return math.exp(height)
            case Scale.SQUARE:
                return height * height
        return height


@dataclass(frozen=True)
class Parameter:
    """A parameter with its plausible range.

    Places run from 0, the lower end, to 1, the upper end; values are spaced by the scale.

    Parameters
    ----------
    name : str
        Its name in `Setting`.
    label : str
        What people call it.
    symbol : str
        The paper's letter, if it has one; as figures take it, in TeX.
    unit : str
        Empty where it has none.
    standing : Standing
    low, high : float
        The range; ignored where there are choices.
    scale : Scale
    choices : tuple
        All values, where they are no numbers on a scale; the recovered one first.
    why : str
        Where the range comes from.

    Examples
    --------
    >>> radius = Parameter("radius", "radius", "r", "", Standing.STATED, 0.1, 10.0, Scale.LOG)
    >>> round(radius.value_at(0.5), 6), round(radius.place_of(10.0), 6)
    (1.0, 1.0)
    """

    name: str
    label: str
    symbol: str
    unit: str
    standing: Standing
    low: float = 0.0
    high: float = 0.0
    scale: Scale = Scale.LINEAR
    choices: tuple[Any, ...] = ()
    why: str = ""

    @property
    def recovered(self) -> Any:
        """Its value in the recovered setting."""
        return getattr(recovered(), self.name)

    @property
    def is_number(self) -> bool:
        """Whether it has a range, and not a list of choices."""
        return not self.choices

    def value_at(self, place: float) -> Any:
        """Value at a place of the range, in [0, 1]."""
        if self.choices:
            return self.choices[min(int(place * len(self.choices)), len(self.choices) - 1)]
        if place in (0.0, 1.0):  # exactly, without rounding there and back
            return (self.low, self.high)[int(place)]
        low, high = self.scale.there(self.low), self.scale.there(self.high)
        return self.scale.back(low + place * (high - low))

    def place_of(self, value: Any) -> float:
        """Place of a value; the middle of its share of the range for a choice."""
        if self.choices:
            return (self.choices.index(value) + 0.5) / len(self.choices)
        low, high = self.scale.there(self.low), self.scale.there(self.high)
        return (self.scale.there(value) - low) / (high - low)

    def levels(self, number: int) -> list[Any]:
        """About so many values over the range, the recovered one exactly among them.

        All choices, where there are choices.
        """
        if self.choices:
            return list(self.choices)
        here = self.place_of(self.recovered)
        below = round(here * (number - 1))
        places = (
            np.linspace(0.0, here, below + 1)[:-1],
            np.linspace(here, 1.0, number - below)[1:],
        )
        left, right = ([self.value_at(float(place)) for place in part] for part in places)
        return [*left, self.recovered, *right]

    def within(self, share: float, place: float) -> Any:
        """Value at a place of the range of ± a share around the recovered one."""
        return self.recovered * (1.0 + share * (2.0 * place - 1.0))

    def show(self, value: Any, digits: int = 3) -> str:
        """A value as people read it, without the unit."""
        if isinstance(value, tuple):
            return "".join(map(str, value))
        return f"{value:.{digits}g}" if self.is_number else str(value)

    @property
    def range(self) -> str:
        """What is tried, as people read it."""
        if self.choices:
            return f"all {len(self.choices)}"
        return f"{self.show(self.low)}–{self.show(self.high)}"

    @property
    def axis(self) -> str:
        """What stands on its axis: its name, the paper's letter and the unit."""
        unit = f" [{self.unit}]" if self.unit else ""
        return f"{self.label} {self.symbol}".strip() + unit

    @property
    def in_unit(self) -> str:
        """What stands behind a value."""
        return f" {self.unit}" if self.unit else ""

    def moved(self, setting: Setting, value: Any) -> Setting:
        """The same setting with another value."""
        changes: dict[str, Any] = {self.name: value}
        return replace(setting, **changes)


PARAMETERS = (
    Parameter(
        *("brake_speed", "leader's top speed", r"$v_p^{max}$", "m/s", Standing.OPEN, 20.0, 24.9),
        why="the leader itself wants 25 m/s",
    ),
    Parameter(
        *("brake_decel", "leader's brake", "", "m/s²", Standing.OPEN, 3.0, 10.0),
        why="firm braking to the best a tyre can do",
    ),
    Parameter(
        *("initial_gap", "initial gap", "", "m", Standing.OPEN, 1.0, 20.0, Scale.LOG),
        why="queueing bumper to bumper to five car lengths",
    ),
    Parameter(
        *("bound", "follower's brake", "", "m/s²", Standing.OPEN, 2.5, 9.0),
        why="from the paper's range of actions to SUMO's emergencyDecel",
    ),
    Parameter(
        *("spread", "spread", "", "", Standing.OPEN, 0.5, 20.0, Scale.LOG),
        why="a factor of six either way",
    ),
    Parameter(
        *("learning_rate", "learning rate", "φ", "", Standing.OPEN),
        *(1e-3, 1e-1, Scale.LOG),
        why="a factor of ten either way",
    ),
    Parameter(
        *("prior_frequency", "prior frequency", "ε̄", "", Standing.OPEN),
        *(1e-5, 1e-1, Scale.LOG),
        why="a factor of a hundred either way; the paper wants it small",
    ),
    Parameter(
        *("order", "order of cases", "", "", Standing.OPEN),
        choices=tuple(permutations(CASES)),
        why="all 24",
    ),
    Parameter(
        *("radius", "radius", "ε", "", Standing.STATED, 0.1, 1.0, Scale.LOG),
        why="a factor of three either way",
    ),
    Parameter(
        *("distance_weight", "distance weight", "ρ", "", Standing.STATED, 0.7, 1.0),
        why="as far below the stated value as above it",
    ),
    Parameter(
        *("scaling", "scaling", "", "", Standing.ADDED),
        choices=tuple(Scaling),
        why="as it is, or divided by its standard deviation",
    ),
    Parameter(
        *("noise", "noise", "", "m", Standing.ADDED, 0.0, 0.3, Scale.SQUARE),
        why="up to what an automotive radar leaves",
    ),
)


def parameter(name: str) -> Parameter:
    """The parameter of that name."""
    return next(one for one in PARAMETERS if one.name == name)
