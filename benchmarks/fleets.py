"""Many vehicles at once, against NumPy vectorised over vehicles."""

from __future__ import annotations

import itertools
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from evofsm.fleet.batch import Fleet
from reference import NumpyFSM
from single import pair
from streams import PAPER_ROUND, Stream
from turns import Result, Work, compare, timed
from vectorised import NumpyFleet

# Vehicle-steps a turn, and how many rows of the stream one vehicle is ahead of the next.
_VEHICLE_STEPS = 400_000
_LEAD = 13
# NumPy's arrays for so many vehicles still fit into the cache: more vehicles go in blocks.
_BLOCK = 1_000

Observe = Callable[[NDArray[np.float64], NDArray[np.int64]], object]


def fleet(n_vehicles: int, repeats: int, short: bool) -> Result:
    """`Fleet.observe` against NumPy, every vehicle somewhere else in the paper's runs."""
    steps = 2 if short else _VEHICLE_STEPS // n_vehicles
    machine, reference, stream = pair(7, PAPER_ROUND)
    machine.start_episode()

    def work(observe: Observe) -> Work:
        return each_step(observe, stream, n_vehicles, steps)

    return compare(
        f"a step of {n_vehicles:,} vehicles on all cores, per vehicle",
        work(Fleet(machine, n_vehicles, dtype=np.float64).observe),
        "NumPy over vehicles",
        work(in_blocks(reference, n_vehicles)),
        repeats,
        beside={"in float32": work(Fleet(machine, n_vehicles, dtype=np.float32).observe)},
    )


def each_step(observe: Observe, stream: Stream, n_vehicles: int, steps: int) -> Work:
    """So many steps of all vehicles, each elsewhere in the stream, and on from there next time."""
    clock = itertools.count(step=steps)

    def work() -> float:
        times = next(clock) + np.arange(steps)
        rows = (times[:, None] + _LEAD * np.arange(n_vehicles)) % len(stream.actions)
        given = list(zip(stream.observations[rows], stream.actions[rows], strict=True))

        def drive() -> None:
            for Z, A in given:
                observe(Z, A)

        return timed(drive, rows.size)

    return work


def in_blocks(reference: NumpyFSM, n_vehicles: int) -> Observe:
    """NumPy's fleet, in parts that fit the cache."""
    begins = range(0, n_vehicles, _BLOCK)
    parts = [slice(begin, min(begin + _BLOCK, n_vehicles)) for begin in begins]
    blocks = [NumpyFleet(reference, part.stop - part.start) for part in parts]

    def observe(Z: NDArray[np.float64], A: NDArray[np.int64]) -> None:
        for block, part in zip(blocks, parts, strict=True):
            block.observe(Z[part], A[part])

    return observe
