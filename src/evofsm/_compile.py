"""How kernels are compiled: one decorator, so that every kernel is built and cached alike."""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any, TypeVar, cast

import numba
import numpy as np
from numba import extending, types
from numba.core import cgutils
from numba.extending import register_jitable, type_callable
from numba.np import arrayobj
from numpy.typing import NDArray

Function = TypeVar("Function", bound=Callable[..., object])
# Numba has no types for these.
_arrays, _codegen, _extending = cast(Any, arrayobj), cast(Any, cgutils), cast(Any, extending)

Floating = TypeVar("Floating", bound=np.floating)


def kernel(function: Function) -> Function:
    """Compile a module-level function with Numba on its first call, and keep the code on disk.

    Kernels are inlined into each other and own no memory: they work in arrays they are given,
    so counting references (``_nrt``) would only cost time, a fifth of a step. Division by zero
    is NumPy's. ``fastmath`` stays off: it reorders sums, and then a single step and a batch
    would no longer agree bit for bit.
    """
    return compiled(function, forceinline=True, _nrt=False, no_cfunc_wrapper=True)


def inner_kernel(function: Function) -> Function:
    """A kernel that only kernels call: without a way in from Python it is compiled sooner."""
    return _compiled_inside(function, forceinline=True)


def rare_kernel(function: Function) -> Function:
    """An inner kernel that is seldom needed, compiled once and not into each of its callers."""
    return _compiled_inside(function)


def _compiled_inside(function: Function, **options: object) -> Function:
    njit: Any = numba.njit
    inside = {"_nrt": False, "no_cpython_wrapper": True, "no_cfunc_wrapper": True}
    return cast(Function, njit(error_model="numpy", **inside, **options)(function))


def parallel_kernel(function: Function) -> Function:
    """A kernel that shares a ``prange`` out over all cores."""
    return compiled(function, parallel=True)


def compiled(function: Function, *signature: object, **options: object) -> Function:
    """Compile with Numba and keep the code on disk, where there is a place to keep it."""
    compile_ = partial(numba.njit, *signature, error_model="numpy", **options)
    try:
        return cast(Function, compile_(cache=True)(function))
    except RuntimeError:  # neither the package nor the user's cache folder may be written
        return cast(Function, compile_()(function))


#: Numbers in a cache line; the arrays in which a step works are whole lines.
LINE = 8


@register_jitable
def lanes(n: int) -> int:
    """``n`` rounded up to whole cache lines.

    A loop of so many turns is compiled to vector instructions alone, without a rest to work off
    one by one. What such loops do to states that are not there does no harm: these have no
    belief, and no transition leads to them.
    """
    return (n + LINE - 1) // LINE * LINE


def part(array: NDArray[Floating], start: int, shape: tuple[int, ...]) -> NDArray[Floating]:
    """Part of a flat array, in another shape; a view that lives no longer than the array."""
    return array[start : start + math.prod(shape)].reshape(shape)


# In kernels not by ``reshape``, which takes tens of nanoseconds to find out that it need not copy.
@type_callable(part)
def _type_of_part(_context: Any) -> Any:
    def type_of(array: Any, start: Any, shape: Any) -> Any:
        return types.Array(array.dtype, len(shape), "C")

    return type_of


def _lower_part(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    array, start, shape = arguments
    source = _arrays.make_array(signature.args[0])(context, builder, array)
    view = _arrays.make_array(signature.return_type)(context, builder)
    lengths = _codegen.unpack_tuple(builder, shape)
    itemsize = context.get_constant(types.intp, context.get_abi_sizeof(source.data.type.pointee))
    strides = [itemsize]
    for length in reversed(lengths[1:]):
        strides.insert(0, builder.mul(strides[0], length))
    _arrays.populate_array(
        view,
        data=builder.gep(source.data, [start]),
        shape=lengths,
        strides=strides,
        itemsize=itemsize,
        meminfo=None,
    )
    return view._getvalue()


_extending.lower_builtin(part, types.Array, types.Integer, types.UniTuple)(_lower_part)


def _drop_stale_caches(package: Path) -> None:
    """Delete cached code that is older than any kernel's source.

    Numba compares a cached kernel with the file it stands in only, not with the files of the
    kernels it calls, so editing one of those would silently leave the old code running. Caches
    that Numba keeps elsewhere (``NUMBA_CACHE_DIR``) are for those who set it to clear.
    """
    caches = {path: path.stat().st_mtime for path in package.rglob("__pycache__/*.nb[ic]")}
    oldest = min(caches.values(), default=math.inf)
    edited = {path: path.stat().st_mtime for path in package.rglob("*.py")}
    newest = max(
        (
            written
            for path, written in edited.items()
            if written > oldest and Path(__file__).stem in path.read_text("utf-8")
        ),
        default=-math.inf,
    )
    for path, written in caches.items():
        if written < newest:
            path.unlink(missing_ok=True)


# Not possible where the installation may not be written or another process cleans up too.
with suppress(OSError):
    _drop_stale_caches(Path(__file__).parent)
