"""Places in words: where a centre lies, with its numbers and units."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from functools import cache
from importlib.metadata import entry_points
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from evofsm.fsm.actions import IntervalActions
from evofsm.fsm.validation import action_name, counted

# All but what surely is plain.
_ODD = re.compile(r"[^\n\t -~]")


def visible(text: str) -> str:
    """A text in which nothing tells a terminal what to do, or cannot be seen: as JSON writes it."""
    return _ODD.sub(lambda m: m[0] if m[0].isprintable() else json.dumps(m[0])[1:-1], text)


def in_a_line(text: str) -> str:
    """The same of a name: without tabs and newlines."""
    return visible(text).replace("\n", r"\n").replace("\t", r"\t")


class Words(NamedTuple):
    """How one kind of system is told: an entry point ``evofsm.words``, named as its variables."""

    place: Callable[[ArrayLike], str]  #: of a centre
    unit: str  #: of an action


@cache
def _words_of(names: tuple[str, ...]) -> Words | None:
    points = entry_points(group="evofsm.words", name=",".join(names))
    return next((point.load() for point in points), None)


class Labels(NamedTuple):
    """What the numbers of a machine mean, for words and pictures.

    Examples
    --------
    >>> labels = Labels(names=("gap", "speed"), units=("m", "m/s"), dt=0.25)
    >>> labels.place([9.21, 4.0]), labels.variable(0), labels.action(16), labels.duration(20)
    ('gap 9.21 m, speed 4 m/s', 'gap [m]', 'a(17)', '5 s')
    >>> Labels(IntervalActions(low=-2.5, high=2.5, width=0.3)).action(16), Labels().place([9.2, 4])
    ('a(17) [2.3, 2.5]', '(9.2, 4)')
    """

    actions: IntervalActions | None = None  #: what the action indices mean
    names: tuple[str, ...] = ()  #: of the variables
    units: tuple[str, ...] = ()  #: of the variables
    dt: float | None = None  #: time between two observations [s]

    def place(self, center: ArrayLike) -> str:
        """Where a centre (m,) lies: in words where a package declares some, else by its numbers."""
        if words := _words_of(self.names):
            return words.place(center)
        values = [f"{value:.3g}" for value in np.asarray(center, np.float64).tolist()]
        if not self.names:
            return f"({', '.join(values)})"
        units = self.units or ("",) * len(values)
        entries = zip(self.names, values, units, strict=True)
        return in_a_line(", ".join(" ".join(part for part in parts if part) for parts in entries))

    def variable(self, index: int) -> str:
        """Name and unit of a variable (from 0), as far as they are known."""
        if not self.names:
            return f"variable {index + 1}"
        unit = self.units[index] if self.units else ""
        return in_a_line(f"{self.names[index]} [{unit}]" if unit else self.names[index])

    def action(self, index: int) -> str:
        """An action (from 0) with its interval, where that is known."""
        name = action_name(index)
        if self.actions is None:
            return name
        words = _words_of(self.names)
        return f"{name} {self.actions.label(index)}{f' {words.unit}' if words else ''}"

    def duration(self, observations: int) -> str:
        """How long so many observations last: in seconds where that is known, else their number."""
        if self.dt is None:
            return counted(observations, "observation")
        return f"{observations * self.dt:.4g} s"
