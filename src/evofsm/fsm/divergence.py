"""Jensen-Shannon divergence: how far a forecast was from what came."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, overload

import numpy as np
from numpy.typing import ArrayLike

from evofsm.fsm.kernels import inner_kernel, kernel, lanes, logarithm, total
from evofsm.fsm.validation import Floats, refuse_unless_distribution

# Stands in for 0 in a divisor or a logarithm whose result is multiplied by 0.
_TINY = 1e-300
# The series has seven terms; below this the eighth is under half a unit in the last place.
_SERIES_BELOW = 0.01
_LN_2 = math.log(2.0)
# Marks a term that the series cannot give; no term is below 0.
_OPEN = -1.0


@inner_kernel
def jensen_shannon_kernel(p: Floats, q: Floats, n: int, terms: Floats) -> float:
    """Divergence in bits of the first ``n`` entries (whole lines) of two distributions.

    A state's ``p ln(p/m) + q ln(q/m)``, where m is the mean of p and q, is ``(p + q) / 2`` times
    ``(1 + d) ln(1 + d) + (1 - d) ln(1 - d)`` with ``d = |p - q| / (p + q)``. As p nears q the
    logarithms cancel, and ``d^2 + d^4/6 + d^6/15 + ...`` is the exact way, and the quick one.

    ``terms`` is room to work in: loops that fill it, with neither branches nor sums, are compiled
    to vector instructions.
    """
    for i in range(n):
        mass = p[i] + q[i]
        d = (p[i] - q[i]) / max(mass, _TINY)
        x = d * d
        terms[i] = mass * (_series(x) if x < _SERIES_BELOW else _OPEN)
    any_open = False
    for i in range(n):
        any_open |= terms[i] < 0.0
    if any_open:
        _use_logarithms(p, q, n, terms)
    nats = total(terms, n)
    # Rounding may leave a hair outside [0, 1].
    return min(max(0.25 * nats / _LN_2, 0.0), 1.0)


@inner_kernel
def _series(x: float) -> float:
    x2 = x * x
    last = 1 / 45 + x * (1 / 66) + x2 * (1 / 91)
    return x * (1.0 + x * (1 / 6) + x2 * (1 / 15 + x * (1 / 28) + x2 * last))


@inner_kernel
def _use_logarithms(p: Floats, q: Floats, n: int, terms: Floats) -> None:
    """Fill in the terms that were left open."""
    for i in range(n):
        mass = p[i] + q[i]
        less = 2.0 * min(p[i], q[i]) / max(mass, _TINY)  # 1 - d, with all of its digits
        more = 2.0 - less
        term = mass * (more * logarithm(more) + less * logarithm(max(less, _TINY)))
        terms[i] = terms[i] if terms[i] >= 0.0 else term


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
        raise ValueError(
            f"p has shape {p.shape} and q has shape {q.shape}: "
            "both need the same number of states on their last axis"
        )
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
