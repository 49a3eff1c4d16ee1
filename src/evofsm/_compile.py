"""How kernels are compiled: one decorator, so that every kernel is built and cached the same way."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import numba

Function = TypeVar("Function", bound=Callable[..., object])


def kernel(function: Function) -> Function:
    """Compile a module-level function with Numba on its first call and keep the code on disk.

    Kernels follow NumPy's rules for division by zero. ``fastmath`` stays off: it reorders
    sums, and then the single step and the batch would no longer agree bit for bit.
    """
    compiled: Function = numba.njit(cache=True, error_model="numpy", _nrt=False, forceinline=True)(function)
    return compiled


def _drop_stale_caches(package: Path) -> None:
    """Delete cached code that is older than any kernel's source.

    Numba compares a cached kernel with the file it stands in only, not with the files of the
    kernels it calls, so editing one of those would silently leave the old code running.
    """
    caches = {path: path.stat().st_mtime for path in package.rglob("__pycache__/*.nbi")}
    sources = {path.parent.parent / f"{path.name.split('.')[0]}.py" for path in caches}
    sources.add(Path(__file__))
    newest = max(path.stat().st_mtime for path in sources if path.exists())
    for path, written in caches.items():
        if written < newest:
            path.unlink(missing_ok=True)


try:
    _drop_stale_caches(Path(__file__).parent)
except OSError:  # an installation that may not be written, or another process cleaning up too
    pass
