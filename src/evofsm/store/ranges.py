"""What a file of a kind may hold: arrays with their shapes and ranges, and settings with theirs.

A room that keeps something in files registers its `Kind`. What was read is held against it, and
what is to be written: a file whose checksum is right may still hold what no learning could have
left. The bounds are those of learning from observations up to `LARGEST_OBSERVATION` in size, with
room for rounding, so that whatever was learnt can be kept.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

#: Squares of larger numbers, summed over a long run, would overflow.
LARGEST_OBSERVATION = 1e100
#: The smallest number above 0.
SMALLEST = math.ulp(0.0)
#: Counts that go up by 1 end here.
MOST_COUNTED = float(1 << 53)
#: Part of a number by which rounding may be off.
ROUNDING = 1e-6
#: Products of two observations, each over the smallest scale there may be, and sums of many.
LARGEST_PRODUCT = 1e300


class Range(NamedTuple):
    """From the least number to the most, both included."""

    least: float
    most: float
    whole: bool = False

    def refuse_others(self, name: str, numbers: NDArray[Any]) -> None:
        """Raise for a number that is not in the range, or not whole where it must be."""
        if not numbers.size:
            return
        for number in (float(numbers.min()), float(numbers.max())):
            if not self.least <= number <= self.most:  # as NaN never is
                raise ValueError(
                    f"{name} of {number:g} cannot be right: it must lie between {self.least:g} and "
                    f"{self.most:g}"
                )
        if self.whole and (numbers != np.rint(numbers)).any():
            raise ValueError(f"{name} holds a fraction; it must be whole")


COUNT = Range(0.0, MOST_COUNTED, whole=True)
FROM_1 = Range(1.0, MOST_COUNTED, whole=True)
SUM = Range(0.0, MOST_COUNTED)
FLAG = Range(0.0, 1.0, whole=True)
SHARE = Range(0.0, 1.0 + ROUNDING)
SIZE = Range(SMALLEST, LARGEST_OBSERVATION)
PRODUCT = Range(0.0, LARGEST_PRODUCT)

Settings: TypeAlias = "Mapping[str, Range | Settings]"


class Member(NamedTuple):
    """An array of a kind of file."""

    shape: tuple[int | str, ...]  #: a letter stands for the same number throughout a file
    range: Range | None  #: None where `Kind.limits` has it
    since: int = 1  #: the version of the format from which on files have it; before, it is 0


def _no_limits(settings: Mapping[str, Any]) -> Mapping[str, Range]:
    return {}


def _as_it_is(version: int, settings: dict[str, Any], arrays: dict[str, NDArray[Any]]) -> None:
    pass


class Kind(NamedTuple):
    """A kind of file, as the room that owns it describes it."""

    name: str
    members: Mapping[str, Member] | None  #: None: it holds what its work needs
    settings: Settings
    #: Gives the ranges of arrays that depend on settings.
    limits: Callable[[Mapping[str, Any]], Mapping[str, Range]] = _no_limits
    #: Gives a file of an earlier version, in place, what it lacks and is not 0.
    upgrade: Callable[[int, dict[str, Any], dict[str, NDArray[Any]]], None] = _as_it_is


#: Kinds of files by name, as far as their rooms were imported.
KINDS: dict[str, Kind] = {}


def register(kind: Kind) -> Kind:
    """Let files of a kind be written and read."""
    KINDS[kind.name] = kind
    return kind


def refuse_others(
    kind: str, settings: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]] = {}
) -> None:
    """Raise a ValueError for a number that a file of some kind may not hold, naming it.

    Examples
    --------
    >>> from evofsm import FSMModel  # which has its kind registered
    >>> refuse_others("model", {"width": float("nan")})
    Traceback (most recent call last):
    ValueError: width of nan cannot be right: it must lie between 0 and 1e+308
    """
    its = KINDS[kind]
    _refuse_settings(settings, its.settings)
    limits = its.limits(settings)
    for name, array in arrays.items():
        member = (its.members or {}).get(name)
        wanted = limits.get(name, member.range if member else None)
        if wanted is not None:
            wanted.refuse_others(name, array)


def _refuse_settings(settings: Mapping[str, Any], ranges: Settings, within: str = "") -> None:
    """The same of settings, those within settings included; None says that one is not set."""
    for name, value in settings.items():
        wanted = ranges.get(name)
        if wanted is None or value is None:
            continue
        if not isinstance(wanted, Range):
            if isinstance(value, Mapping):
                _refuse_settings(value, wanted, f"{within}{name}.")
            continue
        numbers = np.array(value)
        if numbers.dtype.kind not in "iuf":
            raise ValueError(f"{within}{name} is {value!r}; it must be a number")
        wanted.refuse_others(f"{within}{name}", numbers)
