"""How kernels are compiled and cached, and the functions of mathematics that compile to vectors.

Constants that a kernel uses stand in a file of kernels: so a cache that is out of date is seen.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Callable
from functools import cache, partial
from hashlib import sha256
from pathlib import Path
from typing import Any, TypeVar, cast

import numba
import numpy as np
from numba.core import event
from numba.extending import register_jitable
from numpy.typing import NDArray

Function = TypeVar("Function", bound=Callable[..., object])

# Kernels own no memory, so there are no references to count. A product and a sum may be one
# instruction, but sums are in the order as written: a batch and single steps agree bit for bit.
_OPTIONS = {"fastmath": {"contract"}, "_nrt": False}
#: False with ``NUMBA_DISABLE_JIT=1``: kernels then run in Python, some thousand times slower.
COMPILES = not cast(Any, numba.config).DISABLE_JIT
_njit: Any = partial(numba.njit, error_model="numpy", no_cfunc_wrapper=True)


# Of what is cached: where each kernel's code lies, and for which sources.
_INDICES: list[Any] = []


@cache
def _all_kernels() -> bytes:
    """A checksum of all files of kernels: Numba looks at a kernel's own, not at those it calls."""
    uses = re.compile(rb"\n@(\w*kernel|compiled)\b")
    paths = filter(Path.is_file, sorted(Path(__file__).parents[1].rglob("*.py")))
    return sha256(b"".join(filter(uses.search, map(Path.read_bytes, paths)))).digest()


def compiled(function: Function, **options: Any) -> Function:
    """Compile with Numba on the first call, and keep the code on disk where there is a place."""
    if not COMPILES:
        return np.errstate(all="ignore")(function)
    try:
        dispatcher = _njit(cache=True, **options)(function)
    except RuntimeError:  # neither the package nor the user's cache folder may be written
        return cast(Function, _njit(**options)(function))
    index = dispatcher._cache._cache_file
    index._source_stamp = index._source_stamp, _all_kernels()
    _INDICES.append(index)
    return cast(Function, dispatcher)


def kernel(function: Function) -> Function:
    """A function that Python calls, in arrays that it is given."""
    return compiled(function, **_OPTIONS)


def inner_kernel(function: Function) -> Function:
    """A kernel that only kernels call, as a part of each of them."""
    return rare_kernel(function, forceinline=True)


def spliced_kernel(function: Function) -> Function:
    """A long kernel that is called in one place: it is compiled there, and not by itself."""
    return rare_kernel(function, inline="always")


def rare_kernel(function: Function, **options: Any) -> Function:
    """A kernel that only kernels call, and seldom."""
    return cast(Function, _njit(no_cpython_wrapper=True, **_OPTIONS, **options)(function))


def uncompiled(kernel: Function) -> Function:
    """The function of a kernel, where to compile it would take longer than it does."""
    return cast(Function, getattr(kernel, "py_func", kernel))


class Entry:
    """The quick way into a kernel: the types of the first call are those of all that follow."""

    def __init__(self, kernel: Any) -> None:
        self._kernel = kernel
        #: The kernel; once it is compiled, that is no call of Python.
        self.call: Callable[..., Any] = self._first if COMPILES else kernel

    def _first(self, *given: Any) -> Any:
        self.call = self._kernel.compile(tuple(map(numba.typeof, given)))
        return self.call(*given)


def records(shape: Any, kind: np.dtype[Any]) -> NDArray[Any]:
    """Records of zeros, with attributes as in kernels where those are functions of Python."""
    zeros = np.zeros(shape, kind)
    return zeros if COMPILES else zeros.view(np.recarray)


#: Numbers in a cache line.
LINE = 8


@register_jitable
def lanes(n: int) -> int:
    """``n`` rounded up to whole cache lines: a loop of so many turns is all vector instructions.

    What it does to states that are not there does no harm: nothing is believed of them.
    """
    return (n + LINE - 1) // LINE * LINE


# -- Mathematics ----------------------------------------------------------------------------------
# Calls of the C library would keep loops from being vectors, and take three times as long.

_LOG2_E = 1.4426950408889634
# The first part of ln 2, of which products with up to 2^11 are exact, and the rest.
_LN_2_HIGH, _LN_2_LOW = 6.93147180369123816490e-01, 1.90821492927058770002e-10
# Added to an integer below 2^51, it leaves that in the lowest bits.
_INTEGER, _INTEGER_BITS = 1.5 * 2.0**52, 0x4338_0000_0000_0000
# A float holds its exponent plus a bias above the bits of its mantissa.
_BIAS, _MANTISSA = 1023, 52
# The bits of 1 less those of the root of 1/2: what it takes to split off a mantissa around 1.
_TO_ROOT = 0x3FF0_0000_0000_0000 - 0x3FE6_A09E_667F_3BCD


@inner_kernel
def exponential(x: float) -> float:
    """``exp(x)`` to two units in the last place, for x from -700 to 700.

    ``exp(x) = 2^k exp(r)`` with ``|r| <= ln(2) / 2``: 14 terms of the Taylor series.
    """
    k_bits = x * _LOG2_E + _INTEGER
    k = k_bits - _INTEGER
    r = (x - k * _LN_2_HIGH) - k * _LN_2_LOW
    r2 = r * r
    r4 = r2 * r2
    first = (1.0 + r) + r2 * (1 / 2 + r * (1 / 6))
    second = 1 / 24 + r * (1 / 120) + r2 * (1 / 720 + r * (1 / 5040))
    third = 1 / 40320 + r * (1 / 362880) + r2 * (1 / 3628800 + r * (1 / 39916800))
    fourth = 1 / 479001600 + r * (1 / 6227020800)
    series = first + r4 * (second + r4 * (third + r4 * fourth))
    power = (np.float64(k_bits).view(np.int64) + _BIAS) << _MANTISSA
    return float(series * np.int64(power).view(np.float64))


@inner_kernel
def logarithm(x: float) -> float:
    """``ln(x)`` to 1e-15, for normal x above 0.

    ``x = 2^k m`` with m between the roots of 1/2 and 2; ``ln m = 2 atanh(s)`` with
    ``s = (m - 1) / (m + 1)``: eleven terms of the series.
    """
    bits = np.float64(x).view(np.int64)
    k = ((bits + _TO_ROOT) >> _MANTISSA) - _BIAS
    m = np.int64(bits - (k << _MANTISSA)).view(np.float64)
    s = (m - 1.0) / (m + 1.0)
    z = s * s
    z2 = z * z
    z4 = z2 * z2
    first = 1 / 3 + z * (1 / 5) + z2 * (1 / 7 + z * (1 / 9))
    second = 1 / 11 + z * (1 / 13) + z2 * (1 / 15 + z * (1 / 17))
    series = first + z4 * (second + z4 * (1 / 19 + z * (1 / 21)))
    exponent = np.int64(_INTEGER_BITS + k).view(np.float64) - _INTEGER
    return float(exponent * _LN_2_HIGH + (2.0 * s * z * series + (exponent * _LN_2_LOW + 2.0 * s)))


@inner_kernel
def total(values: NDArray[np.float64], n: int) -> float:
    """Sum of the first ``n``, a whole number of lines, in four sums that run abreast."""
    a = b = c = d = 0.0
    for i in range(0, n, 4):
        a += values[i]
        b += values[i + 1]
        c += values[i + 2]
        d += values[i + 3]
    return (a + b) + (c + d)


_log = logging.getLogger("evofsm")


class _Announcement(event.Listener):
    """Says once that kernels are compiled, of those to come not again while some are cached."""

    said = False

    def on_start(self, event: object) -> None:
        if not (self.said or any(index._load_index() for index in _INDICES)):
            _log.warning("compiling kernels, once; this takes some seconds ...")
        self.said = True

    def on_end(self, event: object) -> None: ...


@cache
def announce_compiling() -> None:
    """From now on, log once (on stderr, unless told otherwise) that kernels are compiled."""
    event.register("numba:compile", _Announcement())
