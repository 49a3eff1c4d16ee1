"""By how much the whole loop (observe, recognise, judge, revise, learn) slows a SUMO run.

Usage: python benchmarks/sumo_loop.py [--repeats 7] [--json FILE]

The reference is the same run: the same cars in the same SUMO, the same controller asked at the
same times, and what the reviser had executed, replayed, so that both drive the same way to the
last bit. It does not recognise, judge, revise or learn. Time is that of the processor, which both
sides keep busy, so that what else the computer does hardly counts.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from decision import teach
from evofsm.driving.cars import guard_for_family, learnt_by
from evofsm.driving.episodes import drive
from evofsm.driving.families import load_family
from evofsm.driving.family import Draw, Family
from evofsm.driving.sumo import SumoWorld
from evofsm.driving.world import Episode
from evofsm.fsm.rules import Novelty
from evofsm.guard.guard import Guard

_PROMISED = 1.25
# Time between decisions [s]: the one that is promised, and stricter ones; the last at every step.
_INTERVAL, _STRICTER = 0.25, (0.1, 0.01)
_DRAWS = 4


def main() -> int:
    """Measure, print a table, and fail where the run is slowed by more than is promised."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    promised = measure(arguments.repeats)
    results = [promised, *measure_stricter(arguments.repeats)]
    print(
        f"{'one step of SUMO, two cars':<52}{'with our loop':>15}{'without':>11}{'slowed by':>11}"
    )
    for result in results:
        print(
            f"{result['what']:<52}{1e6 * result['ours_s']:>12.1f} µs"
            f"{1e6 * result['reference_s']:>8.1f} µs{result['slowed_percent']:>9.1f} %"
        )
    print(f"promised, for decisions every {_INTERVAL:g} s: at most {100 * (_PROMISED - 1):.0f} %")
    if arguments.json:
        arguments.json.write_text(json.dumps(results, indent=2) + "\n")
    return int(promised["ratio"] > _PROMISED)


def measure(repeats: int) -> dict[str, Any]:
    """Seconds per step of SUMO with and without our loop, decisions every 0.25 s."""
    return _measure("sumo_loop", _INTERVAL, repeats)


def measure_stricter(repeats: int) -> list[dict[str, Any]]:
    """The same with more decisions, which nothing is promised for."""
    return [_measure(f"sumo_loop_{interval:g}", interval, repeats) for interval in _STRICTER]


def _measure(id_: str, interval: float, repeats: int) -> dict[str, Any]:
    """Medians over repeats; both sides take turns. Every repeat drives the same draws."""
    family = load_family("emergency")
    family = replace(family, interval=interval)
    guard = guard_for_family(family, rule=Novelty(radius=1.0, scales=(2.0, 1.0, 1.0)))
    teach(family, guard)
    draws = [family.draw(0, index, split="test") for index in range(_DRAWS)]
    ours: list[float] = []
    reference: list[float] = []
    with SumoWorld() as world:
        drive_timed(guard, draws[0], world)  # compiles, or reads what was compiled
        for _ in range(repeats):
            taken, steps = np.zeros(2), 0
            for draw in draws:
                seconds, driven = drive_timed(guard, draw, world)
                seconds_without, replayed = replay(family, draw, driven.executed.tolist(), world)
                if not np.array_equal(driven.record, replayed.record):
                    raise RuntimeError("the reference drives another way: the ratio means nothing")
                taken += seconds, seconds_without
                steps += len(replayed.time) - 1
            ours.append(taken[0] / steps)
            reference.append(taken[1] / steps)
    ours_s, reference_s = statistics.median(ours), statistics.median(reference)
    ratio = statistics.median(np.divide(ours, reference).tolist())
    return {
        "id": id_,
        "what": f"decisions every {interval:g} s, {learnt_by(guard)[0].n_states} states",
        "ours_s": ours_s,
        "reference": "the same SUMO run, replayed",
        "reference_s": reference_s,
        "ratio": ratio,
        "slowed_percent": 100.0 * (ratio - 1.0),
        "promised": _PROMISED if interval == _INTERVAL else None,
    }


def drive_timed(guard: Guard, draw: Draw, world: SumoWorld) -> tuple[float, Episode]:
    """Seconds taken, and what was driven under the guard, which goes on learning."""
    begun = time.process_time()
    driven = drive(guard, draw, world)
    return time.process_time() - begun, driven


def replay(
    family: Family, draw: Draw, executed: list[float], world: SumoWorld
) -> tuple[float, Episode]:
    """Seconds taken, and what was driven with these actions executed, whatever is proposed."""
    begun = time.process_time()
    steps = draw.scenario.steps(family.interval)
    with world.open(draw.scenario) as road:
        for action in executed:
            draw.controller.propose(road.observation, road.time)
            road.advance(action, steps)
        episode = road.episode()
    return time.process_time() - begun, episode


if __name__ == "__main__":
    sys.exit(main())
