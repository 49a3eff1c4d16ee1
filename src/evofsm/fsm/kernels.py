"""How kernels are compiled: one decorator, so that every kernel is built and cached alike."""

from __future__ import annotations

import json
import os
import re
import sys
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from hashlib import sha256
from pathlib import Path
from threading import Timer
from time import monotonic
from typing import Any, ClassVar, TypeVar, cast

import numba
from numba.core import event, types
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import CompilerBase, DefaultPassBuilder
from numba.core.compiler_machinery import AnalysisPass, register_pass
from numba.core.typed_passes import AnnotateTypes
from numba.extending import register_jitable

Function = TypeVar("Function", bound=Callable[..., object])


#: Whether kernels are plain Python, to be debugged or covered (``NUMBA_DISABLE_JIT=1``).
NOT_COMPILED: bool = cast(Any, numba.config).DISABLE_JIT

_INLINED = {"forceinline": True, "_nrt": False}


def kernel(function: Function) -> Function:
    """Compile a module-level function with Numba on its first call, and keep the code on disk.

    Kernels are inlined into each other and own no memory: they work in arrays they are given,
    so counting references (``_nrt``) would only cost time, a fifth of a step. Division by zero
    is NumPy's. ``fastmath`` stays off: it reorders sums, and then a single step and a batch
    would no longer agree bit for bit.
    """
    return compiled(function, no_cfunc_wrapper=True, **_INLINED)


def inner_kernel(function: Function) -> Function:
    """A kernel that only kernels call: without a way in from Python it is compiled sooner."""
    return _inside(function, **_INLINED)


def rare_kernel(function: Function) -> Function:
    """An inner kernel that is seldom needed, compiled once and not into each of its callers."""
    return _inside(function, _nrt=False)


def _inside(function: Function, **options: Any) -> Function:
    """Compile with Numba as a part of the kernels that call it."""
    njit: Any = numba.njit
    options |= {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}
    options |= {"pipeline_class": _InnerCompiler, "error_model": "numpy"}
    return cast(Function, njit(**options)(function))


class _Linkable(JITCodeLibrary):
    """The code of an inner kernel: it is optimised, and made machine code, in its callers alone.

    Numba would do both for each kernel by itself, and then again with all that it calls in each
    of its callers: of a chain of calls the innermost kernel as often as the chain is long.
    """

    def _optimize_final_module(self) -> None:
        pass

    def _finalize_final_module(self) -> None:
        cast(Any, self)._finalize_dynamic_globals()
        self._finalized = True

    def get_pointer_to_function(self, name: str) -> int:
        return 0

    @property
    def codegen(self) -> Any:
        return _WithoutEnvironment(self._codegen)


class _WithoutEnvironment:
    """Numba's code generator, for what has no place in memory where its environment would stand.

    Only code that raises or prints asks for that.
    """

    def __init__(self, codegen: Any) -> None:
        self._codegen = codegen

    def set_env(self, name: str, environment: object) -> None:
        pass

    def __getattr__(self, name: str) -> Any:
        return getattr(self._codegen, name)


@register_pass(mutates_CFG=False, analysis_only=True)
class _LinkOnly(AnalysisPass):
    _name = "evofsm_link_only"

    def __init__(self) -> None:
        AnalysisPass.__init__(self)

    def run_pass(self, state: Any) -> bool:
        state.library = cast(Any, _Linkable)(state.targetctx.codegen(), state.func_id.func_qualname)
        state.library.enable_object_caching()
        return False


class _InnerCompiler(CompilerBase):
    def define_pipelines(self) -> list[Any]:
        manager = DefaultPassBuilder.define_nopython_pipeline(self.state)
        manager.add_pass_after(_LinkOnly, AnnotateTypes)
        manager.finalize()
        return [manager]


def compiled(function: Function, *signature: object, **options: Any) -> Function:
    """Compile with Numba and keep the code on disk, where there is a place to keep it.

    What a kernel sees of it is compiled as a part of that kernel.
    """
    compile_ = partial(numba.njit, *signature, error_model="numpy", **options)
    try:
        dispatcher = compile_(cache=True)(function)
    except RuntimeError:  # neither the package nor the user's cache folder may be written
        dispatcher = compile_()(function)
    if not NOT_COMPILED:
        inlined = {name: value for name, value in options.items() if name in _INLINED}
        for_kernels: Any = _inside(function, **inlined)
        known = dispatcher.typingctx
        known._remove_global(dispatcher)
        known.insert_global(dispatcher, types.Dispatcher(for_kernels))
    return cast(Function, dispatcher)


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


class Announcement(event.Listener):
    """Says once, on stderr, that kernels are compiled, where that takes longer than a second."""

    _PATIENCE: ClassVar = 1.0  # [s], over all kernels

    def __init__(self) -> None:
        self._depth = 0
        self._spent = self._begun = 0.0
        self._timer = Timer(0.0, self._say)

    def on_start(self, event: object) -> None:
        """A kernel is compiled, perhaps for another one."""
        if self._depth == 0 and self._spent < self._PATIENCE:
            self._begun = monotonic()
            self._timer = Timer(self._PATIENCE - self._spent, self._say)
            self._timer.daemon = True
            self._timer.start()
        self._depth += 1

    def on_end(self, event: object) -> None:
        """It is done."""
        self._depth -= 1
        if self._depth == 0 and self._spent < self._PATIENCE:
            self._timer.cancel()
            self._spent += monotonic() - self._begun

    def _say(self) -> None:
        self._spent = self._PATIENCE
        print("compiling kernels, once ...", file=sys.stderr, flush=True)


def announce_compiling() -> None:
    """From now on say where compiling takes long; for commands."""
    event.register("numba:compile", Announcement())


# A name that a face offers, and its module.
_OFFERS = re.compile(r"^from \.([\w.]+) import (\w+)", re.MULTILINE)


def sources_of_kernels(package: Path) -> list[Path]:
    """The files of a package that kernels are made of, in the order of their names.

    Those that import this file, which has the decorators, and what they import in turn: constants
    that a kernel uses are a part of it.
    """
    modules = {
        ".".join(path.relative_to(package).with_suffix("").parts): path
        for path in sorted(package.rglob("*.py"))
    }
    homes = {
        (room, name): f"{room}.{module}"
        for face in package.rglob("__init__.pyi")
        for room in [".".join(face.parent.relative_to(package).parts)]
        for module, name in _OFFERS.findall(face.read_text("utf-8"))
    }
    imports = re.compile(rf"^from {package.name}\.?([\w.]*) import (\([^)]*\)|.*)", re.MULTILINE)
    found: set[str] = set()
    for name, path in modules.items():
        imported = {
            part
            for room, names in imports.findall(path.read_text("utf-8"))
            for one in re.findall(r"\w+", names)
            for part in (room, homes.get((room, one), f"{room}.{one}".strip(".")))
        }
        if any(part.rpartition(".")[2] == Path(__file__).stem for part in imported):
            found |= {name} | (imported & set(modules))
    return [path for name, path in modules.items() if name in found]


def _drop_stale_caches(package: Path) -> None:
    """Delete cached code that was made from other sources than those there are.

    Numba compares a cached kernel with the file it stands in only, not with the files of the
    kernels it calls, so editing one of those would silently leave the old code running. What the
    caches were made from is kept beside them, as a digest. Caches that Numba keeps elsewhere
    (``NUMBA_CACHE_DIR``) are for those who set it to clear.
    """
    kept = package / "__pycache__" / "kernels.json"
    stats = ((path, path.stat()) for path in sorted(package.rglob("*.py")))
    times = [
        [str(path.relative_to(package)), stat.st_size, stat.st_mtime_ns] for path, stat in stats
    ]
    before: dict[str, Any] = {}
    with suppress(OSError, ValueError):
        before = json.loads(kept.read_text("utf-8"))
    if before.get("times") == times:
        return
    digest = sha256(b"".join(path.read_bytes() for path in sources_of_kernels(package)))
    if before.get("digest") != digest.hexdigest():
        for path in package.rglob("__pycache__/*.nb[ic]"):
            path.unlink(missing_ok=True)
    kept.parent.mkdir(exist_ok=True)
    written = kept.with_name(f"{kept.name}.{os.getpid()}")
    written.write_text(json.dumps({"times": times, "digest": digest.hexdigest()}), "utf-8")
    written.replace(kept)


# Not possible where the installation may not be written or another process cleans up too.
with suppress(OSError):
    _drop_stale_caches(Path(__file__).parents[1])
