"""Draws that policies are tried on."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple, Self

import numpy as np

from evofsm.driving import (
    Draw,
    Family,
    Outcome,
    Reference,
    Row,
    drive,
    held_out,
    references_of,
    score,
    summarise,
    try_out,
)
from evofsm.guard import Guard, Reviser


class Course(NamedTuple):
    """Draws that policies are tried on, and how the controller comes along in each by itself."""

    family: Family
    draws: Sequence[Draw]
    alone: Sequence[Reference]

    @classmethod
    def held_out(cls, family: Family, seed: int, episodes: int) -> Self:
        """Draws that nothing learns from."""
        return cls.of(family, held_out(family, seed, episodes))

    @classmethod
    def of(cls, family: Family, draws: Iterable[Draw]) -> Self:
        """These draws, once the controller has driven them alone."""
        every = list(draws)
        return cls(family, every, references_of(family, every))

    def first(self, n: int) -> Self:
        """The first so many of them."""
        return self._replace(draws=self.draws[:n], alone=self.alone[:n])

    def under(self, revisers: Iterable[Reviser]) -> list[Outcome]:
        """What comes of the draws, each with its reviser."""
        drives = (
            drive(Guard.of(reviser, interval=self.family.interval, learn=False), draw)
            for draw, reviser in zip(self.draws, revisers, strict=False)
        )
        return score(self.family, self.alone, drives)

    def by(self, guard: Guard) -> list[Outcome]:
        """What comes of the draws by what a guard has learnt so far."""
        return try_out(guard, self.family, self.draws, self.alone)

    def row(self, policy: str, group: str, outcomes: Sequence[Outcome], **others: Any) -> Row:
        """A line of the table."""
        return summarise(self.family.name, policy, group, outcomes, self.family.interval, **others)


def mobility_of(outcomes: Sequence[Outcome]) -> float:
    """Mean over episodes."""
    return float(np.mean([o.mobility for o in outcomes]))
