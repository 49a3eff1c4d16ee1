"""In what share of settings claims hold, and which parameter decides that."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from evofsm.evidence.sensitivity.designs import Design
from evofsm.evidence.sensitivity.parameters import PARAMETERS, Parameter
from evofsm.evidence.sensitivity.setting import Row
from evofsm.extras import needs

with needs("scipy", "study", "exact intervals"):
    from scipy.stats import binomtest

# Into so many parts of equal size a range is cut, where there are points enough for it.
_BINS, _FEWEST_IN_BIN = 16, 8


class Share(NamedTuple):
    """So many of so many, with its 95 % interval (Clopper and Pearson 1934)."""

    held: int
    tried: int
    low: float
    high: float

    @property
    def value(self) -> float:
        """The share itself; NaN of none."""
        return self.held / self.tried if self.tried else math.nan


def share_of(verdicts: ArrayLike) -> Share:
    """Share of the true ones.

    The interval takes the draws for independent; those of a Latin hypercube are spread more evenly
    than that, so it is rather too wide than too narrow (Stein 1987).

    Parameters
    ----------
    verdicts : (n,) array_like of bool

    Examples
    --------
    >>> share = share_of([True] * 3 + [False] * 7)
    >>> share.value, round(share.low, 3), round(share.high, 3)
    (0.3, 0.067, 0.652)
    """
    values = np.asarray(verdicts, dtype=np.bool_)
    if not len(values):
        return Share(0, 0, 0.0, 1.0)
    held, tried = int(values.sum()), len(values)
    exact = binomtest(held, tried).proportion_ci(0.95, method="exact")
    return Share(held, tried, float(exact.low), float(exact.high))


class Harm(NamedTuple):
    """What a sweep of one parameter does to a claim."""

    parameter: Parameter
    kept: float  #: share of its other values with which the claim still holds


def worst_sweeps(rows: Sequence[Row], claim: str) -> list[Harm]:
    """How much of each parameter's range a claim survives, the most harmful parameter first.

    Parameters
    ----------
    rows : sequence of Row
        Of any design; only sweeps are looked at.
    claim : str
        Id of the claim.
    """
    found = []
    for one in PARAMETERS:
        others = [
            row.verdicts[claim]
            for row in rows
            if row.design == Design.SWEEP
            and row.varied == (one.name,)
            and getattr(row.setting, one.name) != one.recovered
        ]
        if others:
            found.append(Harm(one, float(np.mean(others))))
    return sorted(found, key=lambda harm: harm.kept)


class Index(NamedTuple):
    """First-order sensitivity index: share of a variance that one parameter alone explains."""

    value: float  #: 1 where it explains all; NaN where there is nothing to explain
    chance: float  #: what is hardly ever exceeded where it explains nothing

    @property
    def counts(self) -> bool:
        """Whether it is more than chance."""
        return self.value > self.chance


def first_order(rows: Sequence[Row], of: ArrayLike, parameter: Parameter) -> Index:
    """First-order sensitivity index: share of the variance that one parameter alone explains.

    Estimated from the points themselves by the means within parts of the range (Plischke,
    Borgonovo and Smith 2013, doi:10.1016/j.ejor.2012.11.047), less what so many parts explain of
    pure chance; so it may come out a little below 0.

    Parameters
    ----------
    rows : sequence of Row
        Of a design that fills a space.
    of : (n,) array_like
        What is explained: a verdict or a number of each row.
    parameter : Parameter
        Must be varied in these rows.

    Returns
    -------
    Index
        NaN where there is nothing to explain, or there are too few rows.
    """
    values = np.asarray(of, dtype=np.float64)
    places = [parameter.place_of(getattr(row.setting, parameter.name)) for row in rows]
    parts = _parts(np.array(places), len(parameter.choices))
    n, bins = len(values), len(np.unique(parts))
    if n <= bins or bins < 2 or not np.var(values) > 0.0:
        return Index(math.nan, math.nan)
    means = np.zeros(n)
    for part in np.unique(parts):
        means[parts == part] = values[parts == part].mean()
    unexplained = np.mean((values - means) ** 2) / np.var(values)
    spare = (n - 1) / (n - bins)
    # Of pure chance the explained share has a beta distribution with this standard deviation.
    deviation = math.sqrt(2.0 * (bins - 1) * (n - bins) / (n + 1)) / (n - 1)
    return Index(float(1.0 - unexplained * spare), 3.0 * deviation * spare)


def _parts(places: NDArray[np.float64], choices: int) -> NDArray[np.int64]:
    """Which part of the range each place is in: a choice each, or parts of equal size."""
    bins = choices or max(1, min(_BINS, len(places) // _FEWEST_IN_BIN))
    if choices:
        return np.minimum((places * bins).astype(np.int64), bins - 1)
    ranks = np.argsort(np.argsort(places, kind="stable"), kind="stable")
    return (ranks * bins) // max(len(places), 1)
