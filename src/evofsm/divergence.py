"""Jensen-Shannon divergence: how far a forecast was from what came."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from evofsm._compile import kernel

# Stands in for 0 where the logarithm is multiplied by 0 anyway.
_TINY = 1e-300
_BITS_PER_NAT = 1.0 / math.log(2.0)


@kernel
def jensen_shannon_kernel(p: NDArray[np.float64], q: NDArray[np.float64], n: int) -> float:
    """Divergence in bits of the first ``n`` entries of two distributions."""
    nats = 0.0
    for i in range(n):
        middle = max(0.5 * (p[i] + q[i]), _TINY)
        nats += p[i] * math.log(max(p[i], _TINY) / middle)
        nats += q[i] * math.log(max(q[i], _TINY) / middle)
    # Rounding may leave a hair outside [0, 1].
    return min(max(0.5 * nats * _BITS_PER_NAT, 0.0), 1.0)


def jensen_shannon(p: ArrayLike, q: ArrayLike) -> NDArray[np.float64] | float:
    """Jensen-Shannon divergence in bits (Lin 1991), between 0 (equal) and 1 (disjoint).

    Parameters
    ----------
    p, q : (..., n) array_like
        Distributions over the same n states; leading axes are broadcast.

    Returns
    -------
    float or (...) ndarray
        Divergence [bit].

    Raises
    ------
    ValueError
        If the last axes differ in length, or an entry is negative or not finite.

    Examples
    --------
    >>> jensen_shannon([1.0, 0.0], [0.0, 1.0])
    1.0
    >>> jensen_shannon([0.5, 0.5], [0.5, 0.5])
    0.0
    """
    p = np.asarray(p, dtype=np.float64)
    q = np.asarray(q, dtype=np.float64)
    if p.ndim == 0 or q.ndim == 0 or p.shape[-1] != q.shape[-1]:
        raise ValueError(
            f"p has shape {p.shape} and q has shape {q.shape}: "
            "both need the same number of states on their last axis"
        )
    for name, distribution in (("p", p), ("q", q)):
        if not (np.isfinite(distribution).all() and (distribution >= 0.0).all()):
            raise ValueError(
                f"{name} holds a negative or non-finite entry; it must be a distribution"
            )
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
