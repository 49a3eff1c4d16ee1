"""Jensen-Shannon divergence: how far a forecast was from what came."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

from evofsm._compile import kernel
from evofsm.validation import refuse_unless_distribution

# Stands in for 0 in a divisor or a logarithm whose result is multiplied by 0.
_TINY = 1e-300
# The series has seven terms; below this the eighth is under half a unit in the last place.
_SERIES_BELOW = 0.01
_BITS_PER_NAT = 1.0 / math.log(2.0)


@kernel
def jensen_shannon_kernel(p: NDArray[np.float64], q: NDArray[np.float64], n: int) -> float:
    """Divergence in bits of the first ``n`` entries of two distributions."""
    nats = 0.0
    for i in range(n):
        nats += _term(p[i], q[i])
    # Rounding may leave a hair outside [0, 1].
    return min(max(0.5 * nats * _BITS_PER_NAT, 0.0), 1.0)


@kernel
def _term(p: float, q: float) -> float:
    """One state's ``p ln(p/m) + q ln(q/m)``, where m is the mean of p and q.

    With ``d = (p - q) / (p + q)`` it is ``(p + q) (d^2/2 + d^4/12 + d^6/30 + ...)``. Close to
    p = q the two logarithms cancel, so the series is the exact way there, and the quick one.
    """
    total = max(p + q, _TINY)
    d = (p - q) / total
    x = d * d
    if x < _SERIES_BELOW:
        tail = 1.0 / 90.0 + x * (1.0 / 132.0 + x * (1.0 / 182.0))
        return total * x * (0.5 + x * (1.0 / 12.0 + x * (1.0 / 30.0 + x * (1.0 / 56.0 + x * tail))))
    more = p * math.log(max(1.0 + d, _TINY))
    return more + q * math.log(max(1.0 - d, _TINY))


@overload
def jensen_shannon(p: Sequence[float], q: Sequence[float]) -> float: ...
@overload
def jensen_shannon(p: ArrayLike, q: ArrayLike) -> Any: ...
def jensen_shannon(p: ArrayLike, q: ArrayLike) -> Any:
    """Jensen-Shannon divergence in bits (Lin 1991), between 0 (equal) and 1 (disjoint).

    The paper's Section 3.2.2 measures by it how far a forecast was from what came.

    Parameters
    ----------
    p, q : (..., n) array_like
        Distributions over the same n states; leading axes are broadcast.

    Returns
    -------
    float or (...) ndarray
        Divergence [bit]; a number for two single distributions.

    Raises
    ------
    ValueError
        If the last axes differ in length, or a row is no distribution.

    Examples
    --------
    >>> jensen_shannon([1.0, 0.0], [0.0, 1.0])
    1.0
    >>> jensen_shannon([[0.5, 0.5], [1.0, 0.0]], [0.5, 0.5]).round(3)
    array([0.   , 0.311])
    """
    p = np.asarray(p, dtype=np.float64)
    q = np.asarray(q, dtype=np.float64)
    if p.ndim == 0 or q.ndim == 0 or p.shape[-1] != q.shape[-1]:
        raise ValueError(
            f"p has shape {p.shape} and q has shape {q.shape}: "
            "both need the same number of states on their last axis"
        )
    refuse_unless_distribution("p", p)
    refuse_unless_distribution("q", q)
    shape = np.broadcast_shapes(p.shape, q.shape)
    n = shape[-1]
    rows_p = np.ascontiguousarray(np.broadcast_to(p, shape)).reshape(-1, n)
    rows_q = np.ascontiguousarray(np.broadcast_to(q, shape)).reshape(-1, n)
    result = np.empty(len(rows_p))
    _jensen_shannon_rows(rows_p, rows_q, result)
    return float(result[0]) if len(shape) == 1 else result.reshape(shape[:-1])


@kernel
def _jensen_shannon_rows(
    p: NDArray[np.float64], q: NDArray[np.float64], result: NDArray[np.float64]
) -> None:
    for row in range(len(result)):
        result[row] = jensen_shannon_kernel(p[row], q[row], p.shape[1])
