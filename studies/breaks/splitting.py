"""Adaptive multilevel splitting: how likely what is rare is, and cases of it.

A case is made by random numbers, one for each place that asks for one; here they are standard
normal ones. A score says how close a case came to failing, infinite where it failed. Many cases are
drawn; those of the lowest scores are given up for copies of others, which are moved at random
but never below the level that was reached; and so on, until what is left has failed. The shares
that were kept, multiplied, are the probability (Cérou and Guyader 2007; Au and Beck 2001). Cases
of the same score are kept or given up together.

What moves a case keeps the distribution of ordinary cases (a Metropolis step whose proposals turn
some of the normal numbers towards fresh ones, by shares from small to large): so nothing has to be
tuned, and cases may ask for other places, and more of them, than those that they came from.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from statistics import NormalDist
from typing import NamedTuple

import numpy as np

#: Says by what chance a number falls as it does, from 0 up to 1, by the place that asks for it.
Chance = Callable[[str], float]
#: How close a case came to failing, by the chances that make it; infinite where it failed.
Score = Callable[[Chance], float]

# Share of the cases that is given up at a level, and what a number is moved by.
_GIVEN_UP = 0.2
_SMALLEST_MOVE, _MOVED = 0.15, 0.8
# The largest number below 1.
_BELOW_ONE = math.nextafter(1.0, 0.0)
_NORMAL = NormalDist()


@dataclass(frozen=True)
class Amount:
    """How much is tried in one run.

    Parameters
    ----------
    cases : int
        That are kept side by side.
    moves : int
        Of each copy, at each level.
    least : float
        It is given up below this probability.
    """

    cases: int = 100
    moves: int = 5
    least: float = 1e-9


class Case(NamedTuple):
    """One case, and how close it came to failing."""

    score: float
    latent: Mapping[str, float]  #: the normal numbers that make it, by place

    @property
    def failed(self) -> bool:
        """Whether it failed."""
        return self.score == math.inf

    @property
    def chance(self) -> Chance:
        """The chances that make it."""
        return lambda place: to_chance(self.latent[place])


class Level(NamedTuple):
    """One level of a run."""

    score: float  #: that all cases had to exceed from then on
    probability: float  #: of exceeding it, as estimated
    accepted: float  #: share of the moves that were


@dataclass(frozen=True)
class Split:
    """What came of one run."""

    probability: float  #: of failing; 0 where no case did
    tried: int  #: cases that were played
    levels: tuple[Level, ...]
    best: float  #: the highest score of those that did not fail
    failed: tuple[Case, ...]  #: cases that failed, each once
    ended: str  #: ``"failed"``, ``"alike"``: all scores were the same, or ``"least"``


def to_chance(normal: float) -> float:
    """The chance, from 0 up to 1, that a standard normal number stands for."""
    return min(_NORMAL.cdf(normal), _BELOW_ONE)


def split(score: Score, amount: Amount, seed: Sequence[int]) -> Split:
    """One run of splitting.

    Parameters
    ----------
    score : callable
    amount : Amount
    seed : sequence of int
        The same gives the same run.

    Examples
    --------
    >>> def score(chance):
    ...     return math.inf if chance("x") >= 0.999 else chance("x")
    >>> found = split(score, Amount(cases=200), seed=[0])
    >>> 0.0005 < found.probability < 0.002, found.ended
    (True, 'failed')
    >>> split(lambda chance: -1.0, Amount(cases=20), seed=[0]).ended
    'alike'
    """
    rng = np.random.default_rng(seed)
    cases = [_played(score, {}, rng) for _ in range(amount.cases)]
    probability, levels = 1.0, []
    tried, ended = len(cases), "failed"
    best = _best(cases)
    while True:
        scores = np.sort([case.score for case in cases])
        level = float(scores[math.ceil(_GIVEN_UP * len(cases)) - 1])
        if level == math.inf:
            break
        kept = [case for case in cases if case.score > level]
        if not kept:
            probability, ended = 0.0, "alike"
            break
        probability *= len(kept) / len(cases)
        if probability < amount.least and not any(case.failed for case in kept):
            probability, ended = 0.0, "least"
            break
        accepted = 0
        copies = []
        for parent in rng.integers(len(kept), size=len(cases) - len(kept)).tolist():
            case = kept[parent]
            for _ in range(amount.moves):
                moved = _played(score, case.latent, rng, _move(rng))
                best = max(best, _best([moved]))
                if moved.score > level:
                    case, accepted = moved, accepted + 1
            copies.append(case)
        tried += len(copies) * amount.moves
        levels.append(Level(level, probability, accepted / (len(copies) * amount.moves)))
        cases = kept + copies
    failed = [case for case in cases if case.failed]
    each = {tuple(sorted(case.latent.items())): case for case in failed}
    return Split(
        probability * len(failed) / len(cases) if ended == "failed" else 0.0,
        tried,
        tuple(levels),
        best,
        tuple(each.values()),
        ended,
    )


def plain(score: Score, n: int, seed: Sequence[int]) -> int:
    """How many of so many ordinary cases fail."""
    rng = np.random.default_rng(seed)
    return sum(_played(score, {}, rng).failed for _ in range(n))


def _best(cases: Sequence[Case]) -> float:
    return max((case.score for case in cases if not case.failed), default=-math.inf)


def _move(rng: np.random.Generator) -> float:
    """By what share a proposal turns towards fresh numbers: small ones and large ones."""
    return float(_SMALLEST_MOVE ** rng.random())


def _played(
    score: Score, start: Mapping[str, float], rng: np.random.Generator, move: float = 0.0
) -> Case:
    """Play a case near another, or a new one.

    A place that the start lacks gets a fresh number: the start's score does not depend on it, so it
    is distributed as ever. For the same reason what is asked for no more is forgotten.
    """
    latent: dict[str, float] = {}

    def chance(place: str) -> float:
        if place not in latent:
            old, fresh = start.get(place), rng.standard_normal()
            if old is None:
                latent[place] = fresh
            elif rng.random() < _MOVED:
                latent[place] = math.sqrt(1.0 - move * move) * old + move * fresh
            else:
                latent[place] = old
        return to_chance(latent[place])

    return Case(score(chance), latent)
