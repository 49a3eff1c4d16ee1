"""How fast a step is, as a ratio against a plain NumPy loop in the same run.

Usage: python benchmarks/speed.py [--repeats 7] [--json FILE]
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evofsm.machine import EvolvingFSM
from evofsm.studies.paper import Settings
from evofsm.worlds.kinematic import KinematicWorld
from reference import NumpyFSM

_BATCH_ROWS = 1_000_000
_CALL_ROWS = 50_000
_REFERENCE_ROWS = 20_000


def main() -> int:
    """Measure, print a table, and fail where a ratio is below what the project promises."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    results = measure(arguments.repeats)
    print(f"{'one step, 7 states, 17 actions':<34}{'ours':>10}{'NumPy loop':>13}{'ratio':>9}")
    for result in results:
        print(
            f"{result['what']:<34}{1e6 * result['ours_s']:>7.2f} µs"
            f"{1e6 * result['reference_s']:>10.1f} µs{result['ratio']:>8.0f}x"
            f"   (promised: {result['promised']}x)"
        )
    if arguments.json:
        arguments.json.write_text(json.dumps(results, indent=2) + "\n")
    return int(any(result["ratio"] < result["promised"] for result in results))


def measure(repeats: int) -> list[dict[str, Any]]:
    """Seconds a step, median over repeats; ours and the reference take turns."""
    observations, actions, starts = paper_stream(_BATCH_ROWS)
    trained = EvolvingFSM.paper()
    trained.learn_many(observations[:14_000], actions[:14_000], starts[starts < 14_000])
    reference = NumpyFSM(17)
    loop(reference, observations[:14_000], actions[:14_000])

    def batch() -> float:
        return timed(lambda: trained.copy().learn_many(observations, actions, starts), _BATCH_ROWS)

    def call() -> float:
        machine = trained.copy()
        rows, labels = observations[:_CALL_ROWS], actions[:_CALL_ROWS]
        return timed(lambda: loop(machine, rows, labels), _CALL_ROWS)

    def numpy_loop() -> float:
        rows, labels = observations[:_REFERENCE_ROWS], actions[:_REFERENCE_ROWS]
        return timed(lambda: loop(reference, rows, labels), _REFERENCE_ROWS)

    seconds: dict[str, list[float]] = {"batch_7": [], "call_7": [], "numpy": []}
    for _ in range(repeats):
        seconds["batch_7"].append(batch())
        seconds["numpy"].append(numpy_loop())
        seconds["call_7"].append(call())
    medians = {name: statistics.median(values) for name, values in seconds.items()}
    names = {"batch_7": ("a million rows, learn_many", 100), "call_7": ("observe + act", 8)}
    return [
        {
            "id": id_,
            "what": what,
            "ours_s": medians[id_],
            "reference": "NumPy loop",
            "reference_s": medians["numpy"],
            "ratio": medians["numpy"] / medians[id_],
            "promised": promised,
        }
        for id_, (what, promised) in names.items()
    ]


def paper_stream(
    rows: int,
) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.int64]]:
    """The paper's four cases, over and over, until there are enough rows."""
    settings = Settings.load()
    world = KinematicWorld()
    episodes = [world.run(settings.scenario, driver) for driver in settings.drivers.values()]
    observations = np.concatenate([episode.observations for episode in episodes])
    commanded = np.concatenate([episode.accelerations for episode in episodes])
    lengths = [len(episode.time) for episode in episodes]
    times = -(-rows // len(observations))
    starts = np.cumsum([0, *(lengths * times)])
    return (
        np.tile(observations, (times, 1))[:rows],
        np.tile(settings.actions.encode(commanded), times)[:rows],
        starts[starts < rows],
    )


def loop(
    machine: EvolvingFSM | NumpyFSM, observations: NDArray[np.float64], actions: NDArray[np.int64]
) -> None:
    """Every row by a call from Python."""
    for z, action in zip(observations, actions.tolist(), strict=True):
        machine.observe(z)
        machine.act(action)


def timed(work: Callable[[], object], steps: int) -> float:
    """Seconds a step."""
    begin = time.perf_counter()
    work()
    return (time.perf_counter() - begin) / steps


if __name__ == "__main__":
    sys.exit(main())
