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
from numba.np import arrayobj
from numpy.typing import NDArray

from evofsm.fsm.kernels import LINE, NOT_COMPILED, inner_kernel

_arrays = cast(Any, arrayobj)  # Numba has no types for it

_LOG2_E = 1.4426950408889634
# The first part of ln 2: a multiple of it, up to 2^11 of them, is exact.
_LN_2_HIGH = 6.93147180369123816490e-01
# The rest of it.
_LN_2_LOW = 1.90821492927058770002e-10
# Added to a whole number below 2^51 it leaves it in the lowest bits.
_WHOLE = 1.5 * 2.0**52
_WHOLE_BITS = 0x4338_0000_0000_0000
# A float holds its exponent plus this ...
_BIAS = 1023
# ... above so many bits of mantissa.
_PLACE = 52
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


# The innermost work of a step. In a loop Numba's compiler would not know that the arrays lie apart.
@intrinsic
def _work_on_line(
    _context: Any,
    matrix: Any,
    i: Any,
    j: Any,
    predicted: Any,
    reached: Any,
    believed: Any,
    kept: Any,
    gain: Any,
) -> Any:
    numbers = [types.float64] * 3
    return (
        types.void(matrix, types.intp, types.intp, predicted, reached, *numbers),
        _work_on_rows(matrix, predicted, reached),
    )


@intrinsic
def _work_on_two_lines(
    _context: Any,
    matrix: Any,
    i: Any,
    j: Any,
    predicted: Any,
    reached: Any,
    believed: Any,
    kept: Any,
    gain: Any,
    believed_next: Any,
    kept_next: Any,
    gain_next: Any,
) -> Any:
    numbers = [types.float64] * 6
    return (
        types.void(matrix, types.intp, types.intp, predicted, reached, *numbers),
        _work_on_rows(matrix, predicted, reached),
    )


def _work_on_rows(matrix: Any, predicted: Any, reached: Any) -> Any:
    """Generate the work on as many rows below one another as there are numbers for."""

    def generate(context: Any, builder: Any, _: Any, arguments: Any) -> Any:
        rows, row, column, forecasts, targets, *numbers = arguments
        rows = _arrays.make_array(matrix)(context, builder, rows)
        forecasts = _arrays.make_array(predicted)(context, builder, forecasts)
        targets = _arrays.make_array(reached)(context, builder, targets)
        length = builder.extract_value(rows.shape, 1)
        begin = builder.add(builder.mul(row, length), column)
        in_forecast = _Line(builder, forecasts, column)
        forecast, target = in_forecast.load(), _Line(builder, targets, column).load()
        for place in range(0, len(numbers), 3):
            believed, kept, gain = (_everywhere(builder, x) for x in numbers[place : place + 3])
            in_row = _Line(builder, rows, begin)
            old = in_row.load()
            forecast = _fma_of_lines(builder, believed, old, forecast)
            in_row.store(_fma_of_lines(builder, gain, target, builder.fmul(kept, old)))
            begin = builder.add(begin, length)
        in_forecast.store(forecast)
        return context.get_dummy_value()

    return generate


_VECTOR = ir.VectorType(ir.DoubleType(), LINE)


class _Line:
    """So many numbers of an array that one instruction works on, in double precision."""

    def __init__(self, builder: Any, array: Any, begin: Any) -> None:
        self._builder = builder
        kind = array.data.type.pointee
        self._type = ir.VectorType(kind, LINE)
        self._bytes = 8 if kind == ir.DoubleType() else 4
        self._pointer = builder.bitcast(builder.gep(array.data, [begin]), self._type.as_pointer())

    def load(self) -> Any:
        line = self._builder.load(self._pointer, align=self._bytes)
        return line if self._type == _VECTOR else self._builder.fpext(line, _VECTOR)

    def store(self, line: Any) -> None:
        line = line if self._type == _VECTOR else self._builder.fptrunc(line, self._type)
        self._builder.store(line, self._pointer, align=self._bytes)


def _everywhere(builder: Any, number: Any) -> Any:
    """A line with the same number in every place."""
    nothing = ir.Constant(_VECTOR, ir.Undefined)
    first = builder.insert_element(nothing, number, ir.IntType(32)(0))
    places = ir.Constant(ir.VectorType(ir.IntType(32), LINE), [0] * LINE)
    return builder.shuffle_vector(first, nothing, places)


def _fma_of_lines(builder: Any, x: Any, y: Any, z: Any) -> Any:
    name = f"llvm.fma.v{LINE}f64"
    function = builder.module.globals.get(name)
    if function is None:
        function = ir.Function(builder.module, ir.FunctionType(_VECTOR, [_VECTOR] * 3), name)
    return builder.call(function, [x, y, z])


# The same in Python, for where nothing is compiled; a product is then rounded before its sum.
def _multiply_add(x: float, y: float, z: float) -> float:
    return x * y + z


def _work(
    matrix: NDArray[np.float64],
    i: int,
    j: int,
    predicted: NDArray[np.float64],
    reached: NDArray[np.float64],
    *numbers: float,
) -> None:
    columns = slice(j, j + LINE)
    for k in range(len(numbers) // 3):
        believed, kept, gain = numbers[3 * k : 3 * k + 3]
        row = matrix[i + k, columns]
        predicted[columns] += believed * row
        row[:] = kept * row + gain * reached[columns]


#: ``x * y + z``, rounded once: one instruction in place of two, and the same one everywhere.
fma: Callable[[float, float, float], float] = (
    _multiply_add if NOT_COMPILED else cast(Any, _fused_multiply_add)
)
#: ``work_on_line(matrix, i, j, predicted, reached, believed, kept, gain)``, for a line of columns
#: from j on: ``predicted += believed * row``, then ``row = kept * row + gain * reached``.
work_on_line: Callable[..., None] = _work if NOT_COMPILED else cast(Any, _work_on_line)
#: The same for two rows, i and the next one, with three numbers for each: a sum is loaded once.
work_on_two_lines: Callable[..., None] = _work if NOT_COMPILED else cast(Any, _work_on_two_lines)
# What a kernel sees of the others.
_bits_of: Callable[[float], int] = (
    (lambda number: int(np.float64(number).view(np.int64)))
    if NOT_COMPILED
    else cast(Any, _bits_of_float)
)
_float_of: Callable[[int], float] = (
    (lambda bits: float(np.uint64(bits & 0xFFFF_FFFF_FFFF_FFFF).view(np.float64)))
    if NOT_COMPILED
    else cast(Any, _float_of_bits)
)


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


@inner_kernel
def total_below(values: NDArray[np.float64], n: int, limit: float) -> float:
    """Sum of those of the first ``n`` that lie below a limit."""
    a = b = c = d = 0.0
    whole = n // 4 * 4
    for i in range(0, whole, 4):
        a += values[i] if values[i] < limit else 0.0
        b += values[i + 1] if values[i + 1] < limit else 0.0
        c += values[i + 2] if values[i + 2] < limit else 0.0
        d += values[i + 3] if values[i + 3] < limit else 0.0
    for i in range(whole, n):
        a += values[i] if values[i] < limit else 0.0
    return (a + b) + (c + d)


@inner_kernel
def largest(values: NDArray[np.float64], n: int) -> float:
    """The largest of the first ``n``, none of which is below 0, found in the same way."""
    a = b = c = d = 0.0
    whole = n // 4 * 4
    for i in range(0, whole, 4):
        a = max(a, values[i])
        b = max(b, values[i + 1])
        c = max(c, values[i + 2])
        d = max(d, values[i + 3])
    for i in range(whole, n):
        a = max(a, values[i])
    return max(max(a, b), max(c, d))
