"""Recognise the present state as a distribution over states: the paper's Section 2.2.2."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from evofsm._compile import kernel
from evofsm.states.clusters import nearest_center

# Below exp(-690) a belief is taken as 0: smaller numbers are denormal and slow every sum.
_LOWEST_EXPONENT = -690.0
# In place of 1 / width where that would overflow: only the nearest centres keep a belief.
_SHARPEST = 1e300


@kernel
def recognise(
    squared_distances: NDArray[np.float64], n: int, width: float, belief: NDArray[np.float64]
) -> int:
    """Write the belief over the first ``n`` states and return the most probable one.

    The similarity to a centre is ``exp(-distance^2 / width)``, normalised over the centres.
    The rule says how wide that is. Where it is 0 the nearest centres share the belief.
    """
    nearest = nearest_center(squared_distances, n)
    smallest = squared_distances[nearest]
    scale = 1.0 / width if width * _SHARPEST > 1.0 else _SHARPEST
    total = 0.0
    for i in range(n):
        exponent = (smallest - squared_distances[i]) * scale
        similarity = math.exp(exponent) if exponent > _LOWEST_EXPONENT else 0.0
        belief[i] = similarity
        total += similarity
    share = 1.0 / total
    for i in range(n):
        belief[i] *= share
    return nearest
