"""Numbers as a file states them: one number, a range, a choice, or a relation to another."""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Mapping, MutableMapping
from typing import Any
from zlib import crc32

import numpy as np

#: Where draws come from. What is learnt on one is scored on the other; they never meet.
SPLITS = ("train", "test")

#: Says by what chance a number falls as it does: for a place in the file, a number from 0 up to 1,
#: the same whenever the same place is asked for.
Chance = Callable[[str], float]

# Larger numbers are a mistake, or infinite.
_LARGEST = 1e100
_WANTED = "a number, a range [low, high], { one_of = [...] }, or { of = 'name of a value' }"


def check_number(value: Any, where: str) -> None:
    """Raise unless a value can be drawn from."""
    match value:
        case dict() if "of" in value:
            _check_relation(value, where)
        case {"one_of": [_, *_] as choices} if len(value) == 1:
            for choice in choices:
                check_number(choice, where)
        case [low, high] if is_number(low) and is_number(high):
            if not (math.isfinite(low) and math.isfinite(high)):
                raise ValueError(f"{where} is {value}; both ends of a range must be finite")
            if low > high:
                raise ValueError(f"{where} is {value}; the lower end of a range comes first")
        case _ if not is_number(value):
            raise ValueError(f"{where} is {value!r}; it must be {_WANTED}")


def check_unrelated(value: Any, where: str) -> None:
    """As `check_number`, for the values that others relate to."""
    check_number(value, where)
    if isinstance(value, dict):
        if "of" in value:
            raise ValueError(f"{where} is {value}; a value stands by itself, without 'of'")
        for choice in value["one_of"]:
            check_unrelated(choice, where)


def check_fixed(value: Any, where: str) -> None:
    """Raise unless it is one number."""
    if not is_number(value):
        raise ValueError(f"{where} is {value!r}; it must be one number")


def is_number(value: Any) -> bool:
    """Whether it is a number, which NaN, a boolean and what no float can hold are not."""
    real = isinstance(value, (int, float)) and not isinstance(value, bool)
    return real and (abs(value) <= _LARGEST or abs(value) == math.inf)


def is_relation_or_choice(value: Mapping[str, Any]) -> bool:
    """Whether a table stands for a number."""
    return "of" in value or "one_of" in value


def _check_relation(value: Mapping[str, Any], where: str) -> None:
    for name, part in value.items():
        if name not in ("of", "times", "plus", "least"):
            raise ValueError(
                f"{where}: there is no {name!r}; beside 'of' known are times, plus, least"
            )
        if name == "of" and not isinstance(part, str):
            raise ValueError(f"{where}.of is {part!r}; it must be the name of a value")
        if name != "of":
            check_number(part, f"{where}.{name}")


class Numbers:
    """The numbers of one draw.

    Each is drawn from a stream of its own, named by where it stands. So two families that differ
    in one number draw the same ones everywhere else.

    Parameters
    ----------
    values : mapping of str to value
        What relations relate to.
    seed, index : int
        Of the draw, from 0.
    split : {"train", "test"}

    Examples
    --------
    >>> numbers = Numbers({"speed": [10.0, 20.0]}, seed=1, index=0)
    >>> speed = numbers.draw({"of": "speed"}, "scenario.initial_speed")
    >>> 10.0 <= speed <= 20.0
    True
    >>> numbers.draw({"of": "speed", "times": 2.0, "plus": 1.0}, "gap") == 2.0 * speed + 1.0
    True
    """

    def __init__(
        self, values: Mapping[str, Any], seed: int, index: int, split: str = "train"
    ) -> None:
        if split not in SPLITS:
            raise ValueError(f"split is {split!r}; it must be one of {', '.join(SPLITS)}")
        for name, number in (("seed", seed), ("index", index)):
            if not 0 <= operator.index(number) < 2**32:
                raise ValueError(f"{name} is {number}; it must be from 0 to 2**32 - 1")
        self._values = values
        self._key = [SPLITS.index(split), int(seed), int(index)]

    def between(self, low: float, high: float, where: str) -> float:
        """A number from a range."""
        return float(self._stream(where).uniform(low, high))

    def below(self, n: int, where: str) -> int:
        """A whole number from 0 to n - 1."""
        return int(self._stream(where).integers(n))

    def _stream(self, where: str) -> np.random.Generator:
        """The random numbers that belong to a place in the file."""
        return np.random.default_rng([*self._key, crc32(where.encode())])

    def draw(self, value: Any, where: str) -> float:
        """One number; the same whenever the same place is asked for."""
        match value:
            case [low, high]:
                return self.between(low, high, where)
            case {"one_of": choices}:
                return self.draw(choices[self.below(len(choices), f"{where}.one_of")], where)
            case {"of": name}:
                if name not in self._values:
                    known = ", ".join(self._values) or "none"
                    raise ValueError(f"{where} is of {name!r}; values are: {known}")
                related = self.draw(self._values[name], f"values.{name}")
                times = self.draw(value.get("times", 1.0), f"{where}.times")
                plus = self.draw(value.get("plus", 0.0), f"{where}.plus")
                least = self.draw(value.get("least", -math.inf), f"{where}.least")
                return max(least, times * related + plus)
        return float(value)


class GivenNumbers(Numbers):
    """The numbers of a draw that given chances make, in place of a seed's.

    Parameters
    ----------
    values : mapping of str to value
        What relations relate to.
    chance : callable
    drawn : mapping, optional
        Where each number is put, by the place that it is drawn for.

    Examples
    --------
    >>> drawn = {}
    >>> numbers = GivenNumbers({}, {"gap": 0.25, "leader.one_of": 0.9}.__getitem__, drawn)
    >>> numbers.draw([2.0, 30.0], "gap"), numbers.draw({"one_of": [1.0, 2.0, 3.0]}, "leader")
    (9.0, 3.0)
    >>> drawn
    {'gap': 9.0, 'leader.one_of': 2}
    """

    def __init__(
        self,
        values: Mapping[str, Any],
        chance: Chance,
        drawn: MutableMapping[str, float] | None = None,
    ) -> None:
        super().__init__(values, 0, 0)
        self._chance = chance
        self._drawn = {} if drawn is None else drawn

    def between(self, low: float, high: float, where: str) -> float:
        """A number from a range."""
        number = low + (high - low) * self._checked(where)
        self._drawn[where] = number
        return number

    def below(self, n: int, where: str) -> int:
        """A whole number from 0 to n - 1."""
        number = int(n * self._checked(where))
        self._drawn[where] = number
        return number

    def _checked(self, where: str) -> float:
        chance = self._chance(where)
        if not 0.0 <= chance < 1.0:
            raise ValueError(f"the chance of {where} is {chance}; it must be from 0 up to 1")
        return chance
