"""Jensen-Shannon divergence: how far a forecast was from what came."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from evofsm.fsm.kernels import inner_kernel, kernel, lanes, logarithm, total
from evofsm.fsm.validation import Floats, refuse_unless_distribution

# Stands in for 0 in a divisor or a logarithm whose result is multiplied by 0.
_TINY = 1e-300
_LN_2 = math.log(2.0)


@inner_kernel
def jensen_shannon_kernel(p: Floats, q: Floats, n: int, terms: Floats) -> float:
    """Divergence in bits of the first ``n`` entries (whole lines) of two distributions.

    A state's ``p ln(p/m) + q ln(q/m)``, where m is the mean of p and q, goes into ``terms`` first:
    a loop without a sum is compiled to vector instructions.
    """
    for i in range(n):
        middle = max(0.5 * (p[i] + q[i]), _TINY)
        of_p = p[i] * logarithm(max(p[i] / middle, _TINY))
        terms[i] = of_p + q[i] * logarithm(max(q[i] / middle, _TINY))
    # Rounding may leave a hair outside [0, 1].
    return min(max(0.5 * total(terms, n) / _LN_2, 0.0), 1.0)


def jensen_shannon(p: ArrayLike, q: ArrayLike) -> Any:
    """Jensen-Shannon divergence in bits (Lin 1991), between 0 (equal) and 1 (disjoint).

    The paper's Section 3.2.2 measures by it how far a forecast was from what came.

    Parameters
    ----------
    p, q : (..., n) array_like
        Distributions over the same n states; leading axes are broadcast, and those of the result.

    Examples
    --------
    >>> jensen_shannon([1.0, 0.0], [0.0, 1.0])
    1.0
    >>> jensen_shannon([[0.5, 0.5], [1.0, 0.0]], [0.5, 0.5]).round(3)
    array([0.   , 0.311])
    """
    p, q = np.asarray(p, dtype=np.float64), np.asarray(q, dtype=np.float64)
    if p.ndim == 0 or q.ndim == 0 or p.shape[-1] != q.shape[-1]:
        shapes = f"p has shape {p.shape} and q has shape {q.shape}"
        raise ValueError(f"{shapes}: both need the same number of states on their last axis")
    refuse_unless_distribution("p", p)
    refuse_unless_distribution("q", q)
    shape = np.broadcast_shapes(p.shape, q.shape)
    n = shape[-1]
    rows = np.zeros((2, *shape[:-1], lanes(n)))
    rows[..., :n] = np.broadcast_to(p, shape), np.broadcast_to(q, shape)
    rows_p, rows_q = rows.reshape(2, -1, lanes(n))
    result = np.empty(len(rows_p))
    _jensen_shannon_rows(rows_p, rows_q, np.empty(lanes(n)), result)
    return float(result[0]) if len(shape) == 1 else result.reshape(shape[:-1])


@kernel
def _jensen_shannon_rows(p: Floats, q: Floats, terms: Floats, result: Floats) -> None:
    for row in range(len(result)):
        result[row] = jensen_shannon_kernel(p[row], q[row], p.shape[1], terms)
