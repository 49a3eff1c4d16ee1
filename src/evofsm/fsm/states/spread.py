"""Recognise the present state as a distribution over states: the paper's Section 2.2.2."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from evofsm.fsm.elementary import exponential, total, total_below
from evofsm.fsm.kernels import inner_kernel

# Below exp(-690) a belief is taken as 0: smaller numbers are denormal and slow every sum.
_LOWEST_EXPONENT = -690.0
# In place of 1 / width where that would overflow: only the nearest centres keep a belief.
_SHARPEST = 1e300
# Factor by which the cut-off is raised while what is left out stays below `tolerance`.
_COARSENESS = 4.0


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
    ``tolerance``, summed over all states. What is left out is missing in them and spread over the
    others, so it may be half of that.
    """
    smallest = squared_distances[nearest]
    scale = 1.0 / width if width * _SHARPEST > 1.0 else _SHARPEST
    for i in range(n):
        exponent = (smallest - squared_distances[i]) * scale
        similarity = exponential(max(exponent, _LOWEST_EXPONENT))
        belief[i] = similarity if exponent > _LOWEST_EXPONENT else 0.0
    if tolerance > 0.0:
        _leave_out(belief, n, 0.5 * tolerance * total(belief, n))
    share = 1.0 / total(belief, n)
    for i in range(n):
        belief[i] *= share


@inner_kernel
def _leave_out(similarities: NDArray[np.float64], n: int, most: float) -> None:
    """Set the smallest to 0, about as many as together come to ``most``."""
    limit = most / n  # all n of these would not be too much
    while total_below(similarities, n, _COARSENESS * limit) <= most:
        limit *= _COARSENESS
    for i in range(n):
        similarities[i] = similarities[i] if similarities[i] >= limit else 0.0
