"""Recognise the present state as a distribution over states: the paper's Section 2.2.2."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from evofsm._compile import inner_kernel
from evofsm._elementary import exponential, total

# Below exp(-690) a belief is taken as 0: smaller numbers are denormal and slow every sum.
_LOWEST_EXPONENT = -690.0
# In place of 1 / width where that would overflow: only the nearest centres keep a belief.
_SHARPEST = 1e300


@inner_kernel
def recognise(
    squared_distances: NDArray[np.float64],
    n: int,
    nearest: int,
    width: float,
    tolerance: float,
    belief: NDArray[np.float64],
) -> None:
    """Write the belief over the first ``n`` states, of which ``nearest`` is the nearest.

    The similarity to a centre is ``exp(-distance^2 / width)``, normalised over the centres.
    The rule says how wide that is. Where it is 0 the nearest centres share the belief.

    States too unlikely to matter get none: the belief differs from the exact one by at most
    ``tolerance``, summed over all states. What is left out, at most n similarities of
    ``tolerance / 2n`` each, is missing in them and spread over the others.
    """
    smallest = squared_distances[nearest]
    scale = 1.0 / width if width * _SHARPEST > 1.0 else _SHARPEST
    lowest = _LOWEST_EXPONENT
    if tolerance > 0.0:
        lowest = max(lowest, math.log(0.5 * tolerance / n))
    for i in range(n):
        exponent = (smallest - squared_distances[i]) * scale
        similarity = exponential(max(exponent, _LOWEST_EXPONENT))
        belief[i] = similarity if exponent > lowest else 0.0
    share = 1.0 / total(belief, n)
    for i in range(n):
        belief[i] *= share
