"""What a family of scenarios is: a Python function of numbers that are drawn by seed.

A `Family` has a function ``make(numbers)`` that returns a scenario and who drives the follower. It
asks `Numbers` for whatever is drawn, each number by the place that it is for, such as
``scenario.initial_gap``. Each place has random numbers of its own, whatever else is drawn. All are
in SI units.
"""

from __future__ import annotations

import operator
import runpy
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any, NamedTuple
from zlib import crc32

import numpy as np

from evofsm.driving.drivers import IDM, ChangingIDM, refuse_others
from evofsm.driving.naming import UNITS, VARIABLES
from evofsm.driving.scenarios import Scenario
from evofsm.fsm.actions import IntervalActions
from evofsm.fsm.naming import Labels

#: Where draws come from. What is learnt on one is scored on the other; they never meet.
SPLITS = ("train", "test")

# Numbers that are equal but for rounding.
_ROUNDING = 1e-9


# -- A draw ---------------------------------------------------------------------------------------


class Draw(NamedTuple):
    """One scenario of a family, and who drives the follower in it."""

    scenario: Scenario
    controller: IDM | ChangingIDM
    variant: str  #: name of the variant; that of the family where it has none


class Numbers:
    """The numbers of one draw, each by the place that it is for.

    Whoever searches among all draws there are derives from it, and says `between` and `below`.

    Examples
    --------
    >>> numbers = Numbers(seed=1, index=0)
    >>> gap = numbers.between("scenario.initial_gap", 2.0, 30.0)
    >>> 2.0 <= gap <= 30.0, gap == numbers.between("scenario.initial_gap", 2.0, 30.0)
    (True, True)
    """

    def __init__(self, seed: int, index: int, split: str = "train") -> None:
        if split not in SPLITS:
            raise ValueError(f"split is {split!r}; it must be one of {', '.join(SPLITS)}")
        for name, number in (("seed", seed), ("index", index)):
            if not 0 <= operator.index(number) < 2**32:
                raise ValueError(f"{name} is {number}; it must be from 0 to 2**32 - 1")
        #: Index of the variant; 0 where the family has none.
        self.variant = 0
        self._key = [SPLITS.index(split), int(seed), int(index)]

    def between(self, place: str, low: float, high: float) -> float:
        """A number from a range, evenly distributed.

        Parameters
        ----------
        place : str
            What it is for, such as ``"scenario.initial_gap"``.
        low, high : float
            Ends of the range.
        """
        return float(self._stream(place).uniform(low, high))

    def below(self, place: str, n: int) -> int:
        """An integer from 0 to n - 1, each as likely."""
        return int(self._stream(place).integers(n))

    def one_of(self, place: str, choices: Sequence[Any]) -> Any:
        """One of several, each as likely."""
        return choices[self.below(f"{place}.one_of", len(choices))]

    def _stream(self, place: str) -> np.random.Generator:
        return np.random.default_rng([*self._key, crc32(place.encode())])


#: What makes a draw: a scenario and who drives the follower.
Make = Callable[[Numbers], tuple[Scenario, IDM | ChangingIDM]]


# -- A family -------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Family:
    """Scenarios that are drawn by seed.

    Examples
    --------
    >>> from evofsm.driving import Leader, load_family
    >>> def make(numbers):
    ...     calm = IDM(1.2, 25.0, 1.0, 1.0, 2.5, lowest=-4.0, highest=2.5)
    ...     decel = numbers.between("leader.brake_decel", 2.0, 6.0)
    ...     leader = Leader(calm, brake_decel=decel, brake_time=10.0)
    ...     return Scenario(leader, initial_gap=10.0), calm
    >>> family = Family("mine", "The leader stops.", make, -4.0, 2.5, decel=4.0, leader_decel=6.0)
    >>> family.draw(seed=0, index=1) == family.draw(seed=0, index=1)
    True
    >>> load_family("shift").shifted.decel, load_family("paper").draw(0, 6).variant
    (2.5, 'case 3')
    """

    name: str
    about: str  #: what happens, in a sentence
    make: Make  #: the seed of the sensors' noise is drawn besides
    low: float  #: range of the actions [m/s²]
    high: float
    #: The true hardest braking of the follower, and of any leader [m/s²], positive: for those who
    #: may know it.
    decel: float
    leader_decel: float
    interval: float = 0.25  #: time between decisions [s]
    width: float = 0.3  #: of an interval of actions [m/s²]
    variants: tuple[str, ...] = ()  #: ``numbers.variant`` is the index of the one that is drawn ...
    in_turn: bool = False  #: ... or that of the draw, modulo their number
    shifted: Family | None = None  #: the family after its shift
    switches: tuple[str, ...] = ()  #: those of `SWITCHES` that are on
    fixed: bool = False  #: whether nothing is drawn, the sensors' noise neither
    source: str = ""  #: the file that it is from

    def __post_init__(self) -> None:
        refuse_others(self, "family's", "decel leader_decel interval")
        for name in self.switches:
            if name not in SWITCHES:
                raise ValueError(f"there is no switch {name!r}; there are {', '.join(SWITCHES)}")
        _ = self.actions

    @cached_property
    def actions(self) -> IntervalActions:
        """The set of actions; made with ``outside="clip"``."""
        return IntervalActions(self.low, self.high, self.width, outside="clip")

    @property
    def labels(self) -> Labels:
        """What the numbers of a machine mean that drove it."""
        return Labels(self.actions, VARIABLES, UNITS, self.interval)

    @property
    def cases(self) -> int:
        """How many variants come in turn; 1 where none do."""
        return max(1, len(self.variants)) if self.in_turn else 1

    def with_switches(self, names: Iterable[str]) -> Family:
        """The family with some of `SWITCHES` on; what it draws is otherwise the same."""
        on = tuple(names)
        after = None if self.shifted is None else self.shifted.with_switches(on)
        return replace(self, switches=(*self.switches, *on), shifted=after)

    def draw(self, seed: int, index: int, split: str = "train") -> Draw:
        """One scenario: always the same for the same arguments.

        Parameters
        ----------
        seed, index : int
            From 0; each pair is another draw.
        split : {"train", "test"}
            Draws of one are never those of the other.
        """
        numbers = Numbers(seed, index, split)
        return self.draw_by(numbers, index % self.cases if self.cases > 1 else None)

    def draw_by(self, numbers: Numbers, variant: int | None = None) -> Draw:
        """The scenario that given numbers make; without a variant they say which."""
        if variant is None and self.variants:
            variant = numbers.below("variant", len(self.variants))
        numbers.variant = variant or 0
        noise = None if self.fixed else numbers.below("sensors.seed", 2**32)
        scenario, driver = self.make(numbers)
        if noise is not None:
            scenario = replace(scenario, sensors=replace(scenario.sensors, seed=noise))
        for name in self.switches:
            part, values = SWITCHES[name]
            scenario = replace(scenario, **{part: replace(getattr(scenario, part), **values)})
        self._check_limits(scenario, driver)
        return Draw(
            scenario, driver, self.variants[numbers.variant] if self.variants else self.name
        )

    def _check_limits(self, scenario: Scenario, driver: IDM | ChangingIDM) -> None:
        """Who is given the limits must be able to rely on them."""
        where, leader = self.source or f"family {self.name}", scenario.leader
        leader_brakes = max([leader.brake_decel, *(-wave for _, wave in leader.waves)])
        if leader_brakes > self.leader_decel + _ROUNDING:
            raise ValueError(
                f"{where}: a leader brakes by {leader_brakes:g} m/s², but leader_decel is "
                f"{self.leader_decel:g}"
            )
        lowest_command = min(self.low, float(driver.parameters[:, 7].min()))
        brakes = -max(scenario.body.lowest, lowest_command)
        if brakes > self.decel + _ROUNDING:
            raise ValueError(
                f"{where}: the follower can brake by {brakes:g} m/s², but decel is "
                f"{self.decel:g}; bound its body, or the driver and the actions"
            )

    def __reduce__(self) -> Any:
        """From a file it is read anew in other processes, which do not know its functions."""
        if self.source:
            return read_family, (self.source, self.switches)
        values = {part.name: getattr(self, part.name) for part in fields(self)}
        return partial(type(self), **values), ()


def read_family(path: str | Path, switches: Iterable[str] = ()) -> Family:
    """The ``family`` that a file of Python defines."""
    try:
        definition = runpy.run_path(str(path)).get("family")
        if not isinstance(definition, Family):
            raise ValueError("it defines no Family that is called family")
        family = replace(definition, source=str(path)).with_switches(switches)
        for version in filter(None, (family, family.shifted)):
            for variant in range(max(1, len(version.variants))):
                version.draw_by(Numbers(0, 0), variant)  # so that a mistake shows at once
    except Exception as error:
        text = str(error) if isinstance(error, ValueError) else f"{type(error).__name__}: {error}"
        where = "" if text.startswith(f"{path}: ") else f"{path}: "
        raise ValueError(f"{where}{text}") from error
    return family


def training(
    family: Family, seed: int, learning_seed: int, episodes: int, first: int = 0
) -> Iterator[Draw]:
    """Draws to learn from, other ones for every learning seed.

    Parameters
    ----------
    family : Family
    seed, learning_seed : int
        Of the draws; the second is from 0 to 999.
    episodes, first : int
        How many, and the index of the first.
    """
    for index in range(first, first + episodes):
        yield family.draw(seed * 1000 + learning_seed, index, split="train")


def held_out(family: Family, seed: int, episodes: int) -> list[Draw]:
    """Draws that nothing learns from.

    Parameters
    ----------
    family, seed, episodes
        As in `training`.
    """
    return [family.draw(seed, index, split="test") for index in range(episodes)]


# -- Switches -------------------------------------------------------------------------------------
# The sizes are our own: what a production radar and brake system roughly show.


#: What can be switched on in any family, by name: what of a part of its scenarios is changed.
SWITCHES: Mapping[str, tuple[str, dict[str, float]]] = {
    "noise": ("sensors", {"gap_noise": 0.5, "speed_noise": 0.3}),  # white, on all, at every step
    "delay": ("sensors", {"delay": 0.2}),  # of what is seen
    "actuator": ("body", {"delay": 0.2}),  # from a command to its effect
}
