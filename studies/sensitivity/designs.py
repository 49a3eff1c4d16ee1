"""Which settings are tried.

Sweeps move one parameter at a time away from the recovered setting, maps two; edges look for the
value at which the first claim breaks. Latin hypercubes (McKay, Beckman, Conover 1979), scrambled
by a seed, fill a whole space evenly, whatever their number of points: all that the paper leaves
open, everything, and the surroundings of the recovered setting.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from enum import StrEnum
from itertools import product
from typing import Any, NamedTuple

from evofsm.extras import needs
from studies.sensitivity.parameters import PARAMETERS, Parameter, Standing, parameter
from studies.sensitivity.setting import Setting, recovered

with needs("scipy", "study", "designs of experiments"):
    from scipy.stats import qmc

#: What "near the recovered setting" means.
NEAR = 0.05
#: The pairs that are mapped: those that act on the same thing.
PAIRS = (
    ("brake_speed", "initial_gap"),
    ("brake_decel", "bound"),
    ("brake_speed", "bound"),
    ("radius", "spread"),
    ("learning_rate", "prior_frequency"),
    ("noise", "radius"),
)


class Design(StrEnum):
    """Why a setting is tried."""

    RECOVERED = "recovered"
    SWEEP = "sweep"
    MAP = "map"
    EDGE = "edge"
    OPEN = "open"  #: all that the paper leaves open is drawn at once
    ALL = "all"  #: and so is the rest
    NEAR = "near"  #: numbers that the paper has or leaves open, within `NEAR` of the recovered ones


class Trial(NamedTuple):
    """A setting, and why it is tried."""

    design: Design
    varied: tuple[str, ...]
    setting: Setting


def sweeps(levels: int, noise_seed: int) -> Iterator[Trial]:
    """One parameter at a time, over its whole range."""
    base = replace(recovered(), noise_seed=noise_seed)
    for one in PARAMETERS:
        for value in one.levels(levels):
            yield Trial(Design.SWEEP, (one.name,), one.moved(base, value))


def maps(side: int, noise_seed: int) -> Iterator[Trial]:
    """Two parameters at a time; those that need new runs change last."""
    base = replace(recovered(), noise_seed=noise_seed)
    for names in PAIRS:
        one, other = map(parameter, names)
        for value, beside in product(one.levels(side), other.levels(side)):
            setting = other.moved(one.moved(base, value), beside)
            yield Trial(Design.MAP, names, setting)


def filling(design: Design, number: int, seed: int) -> Iterator[Trial]:
    """So many points of a Latin hypercube; each has noise of its own.

    Parameters
    ----------
    design : Design
        ``OPEN``, ``ALL`` or ``NEAR``.
    number : int
    seed : int
        Of the hypercube, and of the noise.
    """
    varied, value_at = _space(design)
    order = list(Design).index(design)
    sampler = qmc.LatinHypercube(len(varied), rng=[seed, order])
    names = tuple(one.name for one in varied)
    for index, point in enumerate(sampler.random(number)):
        setting = replace(recovered(), noise_seed=noise_seed(seed, order, index))
        for one, place in zip(varied, point, strict=True):
            setting = one.moved(setting, value_at(one, float(place)))
        yield Trial(design, names, setting)


def noise_seed(seed: int, order: int, index: int) -> int:
    """One number for three, so that it can stand in a table; different for different ones."""
    return (seed * len(Design) + order) * 1_000_000 + index


def _space(design: Design) -> tuple[Sequence[Parameter], Callable[[Parameter, float], Any]]:
    """What a hypercube varies, and the value at a place of it."""
    match design:
        case Design.ALL:
            return PARAMETERS, Parameter.value_at
        case Design.OPEN:
            return [one for one in PARAMETERS if one.standing is Standing.OPEN], Parameter.value_at
        case Design.NEAR:
            numbers = [one for one in PARAMETERS if one.is_number and one.recovered > 0.0]
            return numbers, lambda one, place: one.within(NEAR, place)
    raise ValueError(f"design {design.value} fills no space")
