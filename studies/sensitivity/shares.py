"""In what share of settings claims hold, and which parameter decides that."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from studies.sensitivity.designs import Design
from studies.sensitivity.parameters import PARAMETERS, Parameter
from studies.sensitivity.setting import Row

# Into so many parts of equal size a range is cut, where there are points enough for it.
_BINS, _FEWEST_IN_BIN = 16, 8


class Harm(NamedTuple):
    """What a sweep of one parameter does to a claim."""

    parameter: Parameter
    kept: float  #: share of its other values with which the claim still holds

    @property
    def label(self) -> str | None:
        """The parameter, if it does any harm."""
        return self.parameter.label if self.kept < 1.0 else None


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

    @property
    def percent(self) -> str:
        """The share in whole percent; 0 where it is no more than chance."""
        return f"{100.0 * self.value:.0f}" if self.counts else "0"


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
