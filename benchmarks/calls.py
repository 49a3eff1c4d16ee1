"""How many of our functions a decision and an end of the learnt guard call, in how many files.

``python benchmarks/calls.py`` drives CartPole until the guard knows what failure is, then counts
with `sys.setprofile` what one `Guard.decide` and one `Guard.end` call: it is what somebody has to
read to follow one. Kernels, and functions of other packages, are not counted.
"""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import Any, NamedTuple

import gymnasium
import numpy as np

import evofsm
from evofsm import Guard

_PACKAGE = str(Path(evofsm.__file__).parent)


class Calls(NamedTuple):
    """Python calls of functions of the package, by file."""

    files: Counter[str]

    def __str__(self) -> str:
        return f"{self.files.total()} calls in {len(self.files)} files"


def calls_of(act: Callable[..., Any], *given: Any) -> tuple[Any, Calls]:
    """What something returns, and the functions of ours that it calls."""
    files: Counter[str] = Counter()

    def note(frame: FrameType, event: str, argument: Any) -> None:
        if event == "call" and frame.f_code.co_filename.startswith(_PACKAGE):
            files[frame.f_code.co_filename] += 1

    sys.setprofile(note)
    try:
        returned = act(*given)
    finally:
        sys.setprofile(None)
    return returned, Calls(files)


def main() -> None:
    """Drive and count."""
    env = gymnasium.make("CartPole-v1")
    guard = Guard(n_actions=2, interval=0.02)
    draw = np.random.default_rng(0)
    decided, ended = [], []
    for episode in range(30):
        z, _ = env.reset(seed=episode)
        for _ in range(200):
            revision, calls = calls_of(guard.decide, z, int(draw.integers(2)))
            if episode == 29:
                decided.append(calls)
            z, _, failed, _, _ = env.step(revision.executed)
            if failed:
                break
        ended.append(calls_of(guard.end, failed, z)[1])
    decided.sort(key=lambda one: one.files.total())
    print(f"decide: {decided[len(decided) // 2]} (median), at most {decided[-1]}")
    ended = sorted(ended[-10:], key=lambda one: one.files.total())
    print(f"end:    {ended[len(ended) // 2]} (median), at most {ended[-1]}")
    if "-v" in sys.argv:
        for calls in (decided[len(decided) // 2], ended[len(ended) // 2]):
            for file, count in calls.files.most_common():
                print(f"{count:5}  {Path(file).relative_to(_PACKAGE)}")


if __name__ == "__main__":
    main()
