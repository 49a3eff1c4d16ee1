"""What a fresh install waits for: the first call of each kind, with empty caches of kernels.

Each is timed in a process of its own, beside the same call once the kernels are cached, so that the
ratio says how much of it is compiling. Targets are in seconds, on two cores.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from typing import Any

from turns import Result

_BEGIN = "import time, numpy as np, evofsm; machine = evofsm.EvolvingFSM(2); z = np.zeros((9, 3))\n"
_OBSERVE = "machine.observe(z[0])\n"
_TIMED = "begun = time.perf_counter()\n{}print(time.perf_counter() - begun)"
#: What is run, and the most that it may take [s].
FIRST: dict[str, tuple[str, str, float]] = {
    "first_observe": ("the first observe", _BEGIN + _TIMED.format(_OBSERVE), 6.0),
    "first_learn_many": (
        "the first learn_many, after observe",
        _BEGIN + _OBSERVE + _TIMED.format("machine.learn_many(z, [0] * 9)\n"),
        6.0,
    ),
    "first_drive": (
        "evofsm drive emergency --episodes 1, with the start of Python",
        "import subprocess, sys, time\n"
        + _TIMED.format(
            "subprocess.run([sys.executable, '-m', 'evofsm', 'drive', 'emergency', "
            "'--episodes', '1'], check=True, stdout=subprocess.DEVNULL)\n"
        ),
        20.0,
    ),
}


def first(id_: str, repeats: int, short: bool) -> Result:
    """Seconds with empty caches, beside those with full ones: medians of up to three runs."""
    what, code, _ = FIRST[id_]
    cold: list[float] = []
    warm: list[float] = []
    for _ in range(1 if short else min(repeats, 3)):
        with tempfile.TemporaryDirectory() as caches:
            cold.append(_seconds(code, caches))
            warm.append(_seconds(code, caches))
    return {
        "what": what,
        "ours_s": sorted(cold)[len(cold) // 2],
        "reference": "the same, kernels cached",
        "reference_s": sorted(warm)[len(warm) // 2],
        "beside": {},
        "notes": [],
        "ours_turns_s": cold,
        "reference_turns_s": warm,
    }


def _seconds(code: str, caches: str) -> float:
    environment: dict[str, Any] = {**os.environ, "NUMBA_CACHE_DIR": caches}
    finished = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True
    )
    return float(finished.stdout)
