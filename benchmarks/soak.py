"""Do the numbers hold for years? A machine takes a thousand million steps.

Usage: python benchmarks/soak.py [--steps 1e9] [--json FILE]

At every power of ten of steps it is looked at whether beliefs and rows still sum to 1, all numbers
are finite, and the memory is as it was; and then, with a million steps each, whether they hold for
observations that are far off, tiny, huge, constant, repeated or denormal.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from evofsm.fsm.machine import EvolvingFSM
from evofsm.fsm.rules import Novelty, Paper, StateRule
from fsm_rows import paper_stream

# 1e9 steps are 116 days of decisions every 10 ms, or eight years of decisions every 0.25 s.
_STEPS, _HOSTILE_STEPS = 1_000_000_000, 1_000_000
_ROWS = 1_000_000
#: Sums of probabilities may be off by so much.
MOST_OFF = 1e-9
_RULES: dict[str, tuple[StateRule, int | None]] = {
    "paper": (Paper(), None),
    "novelty": (Novelty(radius=2.0, scales=(6.0, 3.0, 3.0)), None),
}


class Health(NamedTuple):
    """How a machine is after so many steps."""

    stream: str
    steps: int
    states: int
    rows_off: float  #: largest distance from 1 of a row's sum
    belief_off: float  #: the same of the belief
    lowest: float  #: smallest probability in any matrix
    finite: bool  #: whether all that it holds is
    newest: int  #: observation that created the newest state
    kilobytes: float  #: size of the machine

    @property
    def holds(self) -> bool:
        """Whether all is as it must be."""
        off = max(self.rows_off, self.belief_off)
        return self.finite and off <= MOST_OFF and self.lowest >= 0.0


def main() -> int:
    """Soak, print what was found, and fail where something does not hold."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=lambda text: int(float(text)), default=_STEPS)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    found = []
    print(
        f"{'stream':<34}{'steps':>14}{'states':>7}{'rows off':>10}{'belief off':>11}"
        f"{'newest at':>14}{'kB':>7}  holds"
    )
    for health in soak(arguments.steps):
        found.append(health)
        print(
            f"{health.stream:<34}{health.steps:>14,}{health.states:>7}{health.rows_off:>10.0e}"
            f"{health.belief_off:>11.0e}{health.newest:>14,}{health.kilobytes:>7.0f}"
            f"  {'yes' if health.holds else 'NO'}",
            flush=True,
        )
    if arguments.json:
        rows = [{**one._asdict(), "holds": one.holds} for one in found]
        arguments.json.write_text(json.dumps(rows, indent=2) + "\n")
    return int(not all(health.holds for health in found))


def soak(steps: int) -> Iterator[Health]:
    """Every rule for so many steps, then the hostile streams."""
    stream = paper_stream(min(_ROWS, steps))
    for name, (rule, most) in _RULES.items():
        machine = EvolvingFSM(17, rule=rule, max_states=most)
        yield from _go_on(name, machine, stream.observations, stream.actions, steps)
    hostile_steps = min(_HOSTILE_STEPS, steps)
    for name, Z in _hostile(stream.observations[:hostile_steps]):
        machine = EvolvingFSM(17, max_states=64)
        *_, last = _go_on(name, machine, Z, stream.actions[:hostile_steps], hostile_steps)
        yield last


def _go_on(
    name: str,
    machine: EvolvingFSM,
    Z: NDArray[np.float64],
    I: NDArray[np.int64],
    steps: int,
) -> Iterator[Health]:
    """Learn the same rows again and again; look at the machine at every power of ten, and last."""
    done, next_look = 0, len(Z)
    while done < steps:
        rows = min(len(Z), steps - done)
        machine.learn_many(Z[:rows], I[:rows])
        done += rows
        if done >= next_look or done == steps:
            next_look *= 10
            yield look(name, machine, done)


def look(name: str, machine: EvolvingFSM, steps: int) -> Health:
    """How it is now."""
    matrices, belief = machine.transition_matrices, machine.belief
    held = (matrices, belief, machine.centers, machine.potentials, machine.origin_frequency)
    return Health(
        stream=name,
        steps=steps,
        states=machine.n_states,
        rows_off=float(np.abs(matrices.sum(axis=2) - 1.0).max()),
        belief_off=float(abs(belief.sum() - 1.0)),
        lowest=float(matrices.min()),
        finite=all(bool(np.isfinite(array).all()) for array in held),
        newest=int(machine.model().created.max()),
        kilobytes=machine.nbytes / 1e3,
    )


def _hostile(Z: NDArray[np.float64]) -> Iterator[tuple[str, NDArray[np.float64]]]:
    """The same observations, as they may come in other units and from broken sensors."""
    rng = np.random.default_rng(0)
    yield "offset of 1e6", Z + 1e6
    for scale in (1e-6, 1e6):
        yield f"scale of {scale:g}", Z * scale
    yield "scales from 1e-6 to 1e6", Z * [1e-6, 1.0, 1e6]
    yield "constant", np.ones_like(Z)
    yield (
        "every row a thousand times",
        np.repeat(Z[:: max(1, len(Z) // 1000)], 1000, axis=0)[: len(Z)],
    )
    yield "denormal", Z * 1e-310
    yield "denormal among ordinary", np.where(rng.random(Z.shape) < 0.01, 5e-324, Z)


if __name__ == "__main__":
    sys.exit(main())
