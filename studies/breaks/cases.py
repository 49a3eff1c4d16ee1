"""Cases that were found: their numbers with units, and how far they are from ordinary."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from typing import Any

from evofsm.cli import number
from evofsm.extras import needs
from studies.breaks.amounts import TOY
from studies.breaks.splitting import Case, to_chance
from studies.breaks.subjects import load

with needs("scipy", "study", "the study"):
    from scipy.stats import chi2

#: Units of numbers by the last part of their place; others have none.
_UNITS = {
    **dict.fromkeys(("initial_gap", "gap", "min_gap", "gap_noise"), "m"),
    **dict.fromkeys(("initial_speed", "speed", "slower", "fast", "slow", "brake_speed"), "m/s"),
    **dict.fromkeys(("desired_speed", "speed_noise"), "m/s"),
    **dict.fromkeys(("brake_decel", "decel", "accel", "lowest", "highest"), "m/s²"),
    **dict.fromkeys(("time", "brake_time", "start", "duration", "cruise", "pause", "delay"), "s"),
    **dict.fromkeys(("at", "time_headway"), "s"),
    "jerk": "m/s³",
}
# It decides which noise there is, if there is any; how it lies in its range says nothing.
_SEED = "sensors.seed"


@dataclass(frozen=True)
class Number:
    """One number of a case."""

    place: str  #: in the family's file, such as ``"scenario.initial_gap"``
    value: float
    unit: str
    below: float  #: share of ordinary draws that have a smaller one

    @property
    def text(self) -> str:
        """Its name, value and unit."""
        return " ".join(part for part in (self.place, f"{self.value:.4g}", self.unit) if part)


@dataclass(frozen=True)
class FoundCase:
    """A case that failed."""

    numbers: tuple[Number, ...]
    as_far: float  #: share of ordinary draws whose numbers lie as far from the middle of all

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        return asdict(self)

    @property
    def about(self) -> str:
        """What is far from ordinary in it, the farthest first."""
        far = sorted(self.numbers, key=lambda one: min(one.below, 1.0 - one.below))
        told = [f"{one.text} ({_where(one.below)})" for one in far[:4]]
        return f"As far from the middle: {odds(self.as_far)} of ordinary draws. {'; '.join(told)}."


def ordinary(cases: Iterable[Case], most: int) -> list[Case]:
    """The most likely of some cases first, so many at most."""
    return sorted(cases, key=lambda case: _distance(case))[:most]


def found_case(family: str, switches: tuple[str, ...], case: Case) -> FoundCase:
    """What there is to say about a case that failed."""
    drawn: dict[str, float] = {}
    if family == TOY:
        drawn = dict(case.latent)
    else:
        load(family, switches).draw_by(case.chance, drawn)
    numbers = tuple(
        Number(place, float(value), _unit(place), to_chance(case.latent[place]))
        for place, value in drawn.items()
        if place != _SEED
    )
    degrees = max(len(numbers), 1)
    return FoundCase(numbers, float(chi2.sf(_distance(case), degrees)))


def odds(share: float) -> str:
    """So many of how many."""
    if not share > 0.0:
        return "none"
    return "most" if share > 0.5 else f"1 in {1.0 / share:,.0f}"


def _distance(case: Case) -> float:
    """Squared, of its normal numbers from the middle of all."""
    return math.fsum(z * z for place, z in case.latent.items() if place != _SEED)


def _unit(place: str) -> str:
    parts = [part for part in place.split(".") if not part.isdigit()]
    last = parts[-1]
    if last == "plus":  # which adds to the number that it stands in
        last = parts[-2]
    return _UNITS.get(last, "")


def _where(below: float) -> str:
    """In words, where a number lies among ordinary ones."""
    side, share = ("lowest", below) if below < 0.5 else ("highest", 1.0 - below)
    return f"{side} {number(100.0 * share, 1 if share >= 0.001 else 3)} %"
