"""Exponential and logarithm, written so that a loop over them is compiled to vector instructions.

Calls into the C library are not: they cost three times as much. Every path of the machine uses
these, so that all paths agree bit for bit.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

from llvmlite import ir
from numba import types
from numba.extending import intrinsic

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


# What a kernel sees of them.
_bits_of: Callable[[float], int] = cast(Any, _bits_of_float)
_float_of: Callable[[int], float] = cast(Any, _float_of_bits)


@inner_kernel
def exponential(x: float) -> float:
    """``exp(x)`` to two units in the last place, for x from -700 to 700.

    ``exp(x) = 2^k exp(r)`` with ``|r| <= ln(2) / 2``, where the Taylor series of 14 terms is as
    exact as the numbers are. Its terms are summed in pairs, which can be worked on side by side.
    """
    rounded = x * _LOG2_E + _WHOLE
    k = rounded - _WHOLE
    r = x - k * _LN_2_HIGH - k * _LN_2_LOW
    r2 = r * r
    r4 = r2 * r2
    first = (1.0 + r) + r2 * (1.0 / 2.0 + r * (1.0 / 6.0))
    second = (1.0 / 24.0 + r * (1.0 / 120.0)) + r2 * (1.0 / 720.0 + r * (1.0 / 5040.0))
    third = (1.0 / 40320.0 + r * (1.0 / 362880.0)) + r2 * (1.0 / 3628800.0 + r * (1.0 / 39916800.0))
    fourth = 1.0 / 479001600.0 + r * (1.0 / 6227020800.0)
    series = first + r4 * (second + r4 * (third + r4 * fourth))
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
    first = (1.0 / 3.0 + z * (1.0 / 5.0)) + z2 * (1.0 / 7.0 + z * (1.0 / 9.0))
    second = (1.0 / 11.0 + z * (1.0 / 13.0)) + z2 * (1.0 / 15.0 + z * (1.0 / 17.0))
    third = 1.0 / 19.0 + z * (1.0 / 21.0)
    series = first + z4 * (second + z4 * third)
    whole = _float_of(_WHOLE_BITS + k) - _WHOLE  # k as a float
    return whole * _LN_2_HIGH + (2.0 * s + (2.0 * s * z * series + whole * _LN_2_LOW))
