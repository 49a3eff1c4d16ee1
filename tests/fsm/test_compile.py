import os
import subprocess
import sys
from pathlib import Path

import pytest

from evofsm.fsm import kernels

CALLER = """
from compiled.core.kernels import kernel
from compiled.callee import callee

@kernel
def caller(x: float) -> float:
    return callee(x) + 1.0

if __name__ == "__main__":
    print(caller(1.0), sum(caller.stats.cache_hits.values()))
"""
CALLEE = """
from compiled.core.kernels import kernel

@kernel
def callee(x: float) -> float:
    return x * FACTOR
"""


@pytest.fixture
def package(tmp_path):
    """A package of two kernels, one calling the other, compiled as those of evofsm are."""
    folder = tmp_path / "compiled"
    (folder / "core").mkdir(parents=True)
    (folder / "__init__.py").touch()
    (folder / "core" / "__init__.py").touch()
    (folder / "core" / "kernels.py").write_text(Path(kernels.__file__).read_text())
    (folder / "caller.py").write_text(CALLER)
    (folder / "callee.py").write_text(CALLEE.replace("FACTOR", "2.0"))
    return folder


def run(package, cache):
    environment = {**os.environ, "NUMBA_CACHE_DIR": cache and str(package.with_name(cache))}
    command = [sys.executable, "-m", "compiled.caller"]
    finished = subprocess.run(
        command, cwd=package.parent, env=environment, capture_output=True, text=True, check=True
    )
    result, hits = finished.stdout.split()
    return float(result), int(hits)


@pytest.mark.slow
@pytest.mark.parametrize("cache", ["", "elsewhere"], ids=["beside it", "elsewhere"])
def test_editing_a_kernel_takes_effect_in_the_kernels_that_call_it(package, cache):
    assert run(package, cache) == (3.0, 0)
    assert run(package, cache) == (3.0, 1)  # the second process finds the compiled code
    (package / "callee.py").write_text(CALLEE.replace("FACTOR", "5.0"))
    assert run(package, cache) == (6.0, 0)


WARMED = """
import numpy as np
from numba.core import event
from evofsm import EvolvingFSM, Guard, warm

class Listener(event.Listener):
    def on_start(self, event): ...
    def on_end(self, event): print(event.data["dispatcher"])

warm()
event.register("numba:compile", Listener())
for most in (None, 2):
    machine = EvolvingFSM(2, max_states=most)
    machine.learn_many(np.random.default_rng(0).normal(size=(50, 3)), [0] * 50)
    machine.act(1)
    machine.observe([np.nan, 1.0, 2.0], partial=True)
    machine.fail()
    machine.model().recognise([0.0, 1.0, 2.0])
guard = Guard(n_actions=3, interval=0.1)
for seed in range(3):
    for z in np.random.default_rng(seed).normal(size=(9, 3)):
        guard.decide(z, 1)
    guard.end(failed=True, observation=z)
guard.freeze()
guard.decide(z, 0)
"""


@pytest.mark.slow
@pytest.mark.parametrize("disable", ["0", "1"])  # as projects set it for their tests, or to debug
def test_who_is_warm_or_runs_in_python_compiles_no_more(disable, tmp_path):
    """Not after a first failure either, where nobody expects to wait."""
    fresh = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path), "NUMBA_DISABLE_JIT": disable}
    command = [sys.executable, "-W", "error", "-c", WARMED]
    finished = subprocess.run(command, env=fresh, capture_output=True, text=True, check=True)
    assert finished.stdout == ""
