"""What one decision costs: belief, latent risk of every action, revision, learning.

Usage: python benchmarks/decision.py [--steps 1000000]

The stream is what revised training episodes observed, over and over, with a machine of at least
200 states. A decision must fit into a tenth of a 10 ms control step, in 99 of 100 cases.
"""

from __future__ import annotations

import argparse
import sys
import time

import numpy as np
from numpy.typing import NDArray

from evofsm.driving.cars import guard_for_family, learnt_by
from evofsm.driving.episodes import drive
from evofsm.driving.families import load_family
from evofsm.driving.family import Family
from evofsm.fsm.rules import Novelty
from evofsm.guard.guard import Guard

_STATES = 200
_CONTROL_STEP = 0.010
_PROMISED = 0.1


def main() -> int:
    """Measure, print, and fail where the promise is not kept."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=1_000_000)
    steps = parser.parse_args().steps
    family = load_family("emergency")
    guard = guard_for_family(family, rule=Novelty(radius=1.0, scales=(2.0, 1.0, 1.0)))
    stream = teach(family, guard)
    seconds = measure(family, guard, stream, steps)
    median, p99, worst = np.quantile(seconds, [0.5, 0.99, 1.0])
    share = p99 / _CONTROL_STEP
    print(
        f"one decision, {learnt_by(guard)[0].n_states} states, {family.actions.n_actions} actions, "
        f"{steps} decisions: median {1e6 * median:.0f} µs, p99 {1e6 * p99:.0f} µs, "
        f"longest {1e3 * worst:.1f} ms\n"
        f"p99 is {share:.1%} of a 10 ms control step (promised: {_PROMISED:.0%})"
    )
    return int(share > _PROMISED)


def teach(family: Family, guard: Guard) -> list[NDArray[np.float64]]:
    """Learn until there are states enough; returns what was observed, by episode."""
    stream: list[NDArray[np.float64]] = []
    while learnt_by(guard)[0].n_states < _STATES:
        driven = drive(guard, family.draw(0, len(stream)))
        stream.append(np.array([decision.situation.observation for decision in driven.decisions]))
    return stream


def measure(
    family: Family, guard: Guard, stream: list[NDArray[np.float64]], steps: int
) -> NDArray[np.float64]:
    """(steps,) seconds of each decision."""
    seconds = np.empty(steps)
    done = 0
    wishes = np.random.default_rng(0).uniform(family.actions.low, family.actions.high, steps)
    while done < steps:
        for observation in stream[done % len(stream)]:
            begun = time.perf_counter()
            guard.decide(observation, float(wishes[done]))
            seconds[done] = time.perf_counter() - begun
            done += 1
            if done == steps:
                break
        guard.end()
    return seconds


if __name__ == "__main__":
    sys.exit(main())
