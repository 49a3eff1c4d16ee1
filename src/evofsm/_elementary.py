"""Exponential, logarithm and sum, written so that they are compiled to vector instructions.

Calls into the C library are not: they cost three times as much. Every path of the machine uses
these, so that all paths agree bit for bit.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic
from numpy.typing import NDArray

from evofsm._compile import inner_kernel

_LOG2_E = 1.4426950408889634
# ln 2 in two parts: a multiple of the first, up to 2^11 of them, is exact.
_LN_2_HIGH, _LN_2_LOW = 6.93147180369123816490e-01, 1.90821492927058770002e-10
# Added to a whole number below 2^51 it leaves it in the lowest bits.
_WHOLE = 1.5 * 2.0**52
_WHOLE_BITS = 0x4338_0000_0000_0000
# A float holds its exponent, plus 1023, above 52 bits of mantissa.
_BIAS, _PLACE = 1023, 52
# The bits of 1 less those of the root of 1/2: what a mantissa needs to be split off around 1.
_TO_ROOT = 0x3FF0_0000_0000_0000 - 0x3FE6_A09E_667F_3BCD


@intrinsic
def _bits_of_float(_context: Any, _number: Any) -> Any:
    """The bits of a float as an integer."""

    def generate(_: Any, builder: Any, __: Any, arguments: Any) -> Any:
        return builder.bitcast(arguments[0], ir.IntType(64))

    return types.int64(types.float64), generate


@intrinsic
def _float_of_bits(_context: Any, _bits: Any) -> Any:
    """The float that an integer's bits are."""

    def generate(_: Any, builder: Any, __: Any, arguments: Any) -> Any:
        return builder.bitcast(arguments[0], ir.DoubleType())

    return types.float64(types.int64), generate


@intrinsic
def _fused_multiply_add(_context: Any, _x: Any, _y: Any, _z: Any) -> Any:
    def generate(_: Any, builder: Any, __: Any, arguments: Any) -> Any:
        return builder.fma(*arguments)

    return types.float64(types.float64, types.float64, types.float64), generate


#: ``x * y + z``, rounded once: one instruction in place of two, and the same one everywhere.
fma: Callable[[float, float, float], float] = cast(Any, _fused_multiply_add)
# What a kernel sees of the others.
_bits_of: Callable[[float], int] = cast(Any, _bits_of_float)
_float_of: Callable[[int], float] = cast(Any, _float_of_bits)


@inner_kernel
def exponential(x: float) -> float:
    """``exp(x)`` to two units in the last place, for x from -700 to 700.

    ``exp(x) = 2^k exp(r)`` with ``|r| <= ln(2) / 2``, where the Taylor series of 14 terms is as
    exact as the numbers are. Its terms are summed in pairs, which can be worked on side by side.
    """
    rounded = fma(x, _LOG2_E, _WHOLE)
    k = rounded - _WHOLE
    r = fma(-k, _LN_2_LOW, fma(-k, _LN_2_HIGH, x))
    r2 = r * r
    r4 = r2 * r2
    first = fma(r2, fma(r, 1.0 / 6.0, 1.0 / 2.0), 1.0 + r)
    second = fma(r2, fma(r, 1.0 / 5040.0, 1.0 / 720.0), fma(r, 1.0 / 120.0, 1.0 / 24.0))
    third = fma(
        r2, fma(r, 1.0 / 39916800.0, 1.0 / 3628800.0), fma(r, 1.0 / 362880.0, 1.0 / 40320.0)
    )
    fourth = fma(r, 1.0 / 6227020800.0, 1.0 / 479001600.0)
    series = fma(r4, fma(r4, fma(r4, fourth, third), second), first)
    power = _float_of((_bits_of(rounded) + _BIAS) << _PLACE)  # 2^k
    return series * power


@inner_kernel
def logarithm(x: float) -> float:
    """``ln(x)`` to 1e-15, for normal x above 0.

    ``x = 2^k m`` with m between the roots of 1/2 and 2, and ``ln m = 2 atanh(s)`` with
    ``s = (m - 1) / (m + 1)``, ``|s| < 0.172``: eleven terms of its series.
    """
    bits = _bits_of(x)
    k = ((bits + _TO_ROOT) >> _PLACE) - _BIAS
    m = _float_of(bits - (k << _PLACE))
    s = (m - 1.0) / (m + 1.0)
    z = s * s
    z2 = z * z
    z4 = z2 * z2
    first = fma(z2, fma(z, 1.0 / 9.0, 1.0 / 7.0), fma(z, 1.0 / 5.0, 1.0 / 3.0))
    second = fma(z2, fma(z, 1.0 / 17.0, 1.0 / 15.0), fma(z, 1.0 / 13.0, 1.0 / 11.0))
    third = fma(z, 1.0 / 21.0, 1.0 / 19.0)
    series = fma(z4, fma(z4, third, second), first)
    whole = _float_of(_WHOLE_BITS + k) - _WHOLE  # k as a float
    return fma(whole, _LN_2_HIGH, fma(2.0 * s * z, series, fma(whole, _LN_2_LOW, 2.0 * s)))


@inner_kernel
def total(values: NDArray[np.float64], n: int) -> float:
    """Sum of the first ``n``, in four running sums, which can be worked on side by side."""
    a = b = c = d = 0.0
    whole = n // 4 * 4
    for i in range(0, whole, 4):
        a += values[i]
        b += values[i + 1]
        c += values[i + 2]
        d += values[i + 3]
    for i in range(whole, n):
        a += values[i]
    return (a + b) + (c + d)
