"""How kernels are compiled: one decorator, so that every kernel is built and cached alike."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import TypeVar, cast

import numba

Function = TypeVar("Function", bound=Callable[..., object])


def kernel(function: Function) -> Function:
    """Compile a module-level function with Numba on its first call, and keep the code on disk.

    Kernels are inlined into each other and own no memory: they work in arrays they are given,
    so counting references (``_nrt``) would only cost time, a fifth of a step. Division by zero
    is NumPy's. ``fastmath`` stays off: it reorders sums, and then a single step and a batch
    would no longer agree bit for bit.
    """
    return compiled(function, forceinline=True, _nrt=False)


def compiled(function: Function, *signature: object, **options: object) -> Function:
    """Compile with Numba and keep the code on disk, where there is a place to keep it."""
    compile_ = partial(numba.njit, *signature, error_model="numpy", **options)
    try:
        return cast(Function, compile_(cache=True)(function))
    except RuntimeError:  # neither the package nor the user's cache folder may be written
        return cast(Function, compile_()(function))


def _drop_stale_caches(package: Path) -> None:
    """Delete cached code that is older than any kernel's source.

    Numba compares a cached kernel with the file it stands in only, not with the files of the
    kernels it calls, so editing one of those would silently leave the old code running. Caches
    that Numba keeps elsewhere (``NUMBA_CACHE_DIR``) are for those who set it to clear.
    """
    caches = {path: path.stat().st_mtime for path in package.rglob("__pycache__/*.nb[ic]")}
    sources = {path.parent.parent / f"{path.name.split('.')[0]}.py" for path in caches}
    sources.add(Path(__file__))
    newest = max(path.stat().st_mtime for path in sources if path.exists())
    for path, written in caches.items():
        if written < newest:
            path.unlink(missing_ok=True)


# Not possible where the installation may not be written or another process cleans up too.
with suppress(OSError):
    _drop_stale_caches(Path(__file__).parent)
