"""How many of our functions a decision and an end of the learnt guard call, in how many files.

Usage: python benchmarks/calls.py [-v]

That is what a reader has to follow. CartPole is driven until the guard knows what failure is; then
`sys.setprofile` counts. Kernels, and functions of other packages, are not counted. With -v by file.
Ends with 1 where there are more than there may be.
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
#: By method: the most calls of our functions, and the most files that they are in.
MOST_CALLS = {"decide": (110, 9), "end": (300, 9)}


class Calls(NamedTuple):
    """Python calls of functions of the package, by file; kernels are not counted."""

    files: Counter[str]

    def __str__(self) -> str:
        return f"{self.files.total()} calls in {len(self.files)} files"


def main() -> int:
    """Drive, count and print."""
    env = gymnasium.make("CartPole-v1")
    guard = Guard(n_actions=2, interval=0.02)
    draw = np.random.default_rng(0)
    found: dict[str, list[Calls]] = {"decide": [], "end": []}
    for episode in range(30):
        z, _ = env.reset(seed=episode)
        failed = False
        while not failed:
            revision, called = calls_of(guard.decide, z, int(draw.integers(2)))
            if episode == 29:
                found["decide"].append(called)
            z, _, failed, over, _ = env.step(revision.executed)
            if over:
                break
        called = calls_of(guard.end, failed, z)[1]
        if episode >= 20:
            found["end"].append(called)
    all_held = True
    for name, (most, files) in MOST_CALLS.items():
        ordered = sorted(found[name], key=lambda one: one.files.total())
        median = ordered[len(ordered) // 2]
        held = median.files.total() <= most and len(median.files) <= files
        all_held &= held
        print(
            f"Guard.{name}: {median} (median; at most {ordered[-1]}); target {most} in {files}"
            f"{'' if held else ': missed'}"
        )
        for file, count in median.files.most_common() if "-v" in sys.argv else ():
            print(f"{count:5}  {Path(file).relative_to(_PACKAGE)}")
    return int(not all_held)


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


if __name__ == "__main__":
    sys.exit(main())
