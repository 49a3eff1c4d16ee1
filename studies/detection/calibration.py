"""Reliability: predicted probabilities and what came of them, in bins."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from studies.old.scores import brier

_BINS = 10


class Bin(NamedTuple):
    """Predictions of about the same height, and what came."""

    predicted: float  #: mean
    observed: float  #: share of failures
    cases: int


class Reliability(NamedTuple):
    """How well predicted probabilities fit what came."""

    what: str
    bins: tuple[Bin, ...]
    brier: float  #: mean squared error
    base_brier: float  #: the same for always predicting the share of failures
    cases: int
    failures: int

    @property
    def title(self) -> str:
        """What is predicted, and how well."""
        what = f"{self.what[:1].upper()}{self.what[1:]}"
        return f"{what}\nBrier {self.brier:.3f}, of the base rate {self.base_brier:.3f}"


def reliability(what: str, predicted: Sequence[float], came: Sequence[bool]) -> Reliability:
    """Bins of equal width over [0, 1]; empty ones are left out."""
    p, y = np.array(predicted), np.array(came, dtype=np.float64)
    index = np.minimum((p * _BINS).astype(int), _BINS - 1)
    bins = tuple(
        Bin(float(p[index == i].mean()), float(y[index == i].mean()), int((index == i).sum()))
        for i in range(_BINS)
        if (index == i).any()
    )
    return Reliability(what, bins, brier(p, y), float(y.var()), len(y), int(y.sum()))
