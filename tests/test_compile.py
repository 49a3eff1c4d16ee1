import os
import subprocess
import sys
from pathlib import Path

import pytest

from evofsm import _compile

CALLER = """
from kernels import _compile
from kernels.callee import callee

@_compile.kernel
def caller(x: float) -> float:
    return callee(x) + 1.0

if __name__ == "__main__":
    print(caller(1.0), sum(caller.stats.cache_hits.values()))
"""
CALLEE = """
from kernels import _compile

@_compile.kernel
def callee(x: float) -> float:
    return x * FACTOR
"""


@pytest.fixture
def package(tmp_path):
    """A package of two kernels, one calling the other, compiled as those of evofsm are."""
    folder = tmp_path / "kernels"
    folder.mkdir()
    (folder / "__init__.py").touch()
    (folder / "_compile.py").write_text(Path(_compile.__file__).read_text())
    (folder / "caller.py").write_text(CALLER)
    (folder / "callee.py").write_text(CALLEE.replace("FACTOR", "2.0"))
    return folder


def run(package):
    environment = {k: v for k, v in os.environ.items() if k != "NUMBA_CACHE_DIR"}
    command = [sys.executable, "-m", "kernels.caller"]
    finished = subprocess.run(
        command, cwd=package.parent, env=environment, capture_output=True, text=True, check=True
    )
    result, hits = finished.stdout.split()
    return float(result), int(hits)


def test_editing_a_kernel_takes_effect_in_the_kernels_that_call_it(package):
    assert run(package) == (3.0, 0)
    assert run(package) == (3.0, 1)  # the second process finds the compiled code
    (package / "callee.py").write_text(CALLEE.replace("FACTOR", "5.0"))
    assert run(package) == (6.0, 0)


def test_caches_older_than_any_kernel_are_dropped_and_newer_ones_kept(tmp_path):
    written = Path(_compile.__file__).stat().st_mtime + 1000
    caches = tmp_path / "room" / "__pycache__"
    caches.mkdir(parents=True)
    for module, compiled_after in (("old", -5), ("new", 5)):
        (tmp_path / "room" / f"{module}.py").write_text("from package._compile import kernel")
        os.utime(tmp_path / "room" / f"{module}.py", (written, written))
        cache = caches / f"{module}.kernel-3.py311.nbi"
        cache.touch()
        os.utime(cache, (written + compiled_after,) * 2)
    _compile._drop_stale_caches(tmp_path)
    assert [path.name for path in caches.iterdir()] == ["new.kernel-3.py311.nbi"]


def test_editing_what_holds_no_kernels_keeps_the_caches(tmp_path):
    caches = tmp_path / "__pycache__"
    caches.mkdir()
    (caches / "old.kernel-3.py311.nbi").touch()
    os.utime(caches / "old.kernel-3.py311.nbi", (1000, 1000))
    (tmp_path / "page.py").write_text("draws nothing that is compiled")
    _compile._drop_stale_caches(tmp_path)
    assert len(list(caches.iterdir())) == 1
