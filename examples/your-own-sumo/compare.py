"""Collisions and speeds with and without guards in the hasty cars, and what guarding costs.

python compare.py --seeds 3
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
from pathlib import Path
from typing import NamedTuple

import libsumo
from make import write_cars

from evofsm.driving import attach

END = 400.0  # [s]


class Run(NamedTuple):
    """What came of one simulation."""

    cars: int  # most of them at once
    hasty: int
    by_hasty: int  # collisions in which a hasty car ran into another one
    into_hasty: int  # ... in which one that is not hasty ran into a hasty one
    others: int
    speed: float  # mean of the hasty cars [m/s]
    speed_of_others: float
    guarding: float  # of a guard's decision [µs], all that guarding takes
    watching: float  # of a car that is only watched, and step [µs]


def drive(seed: int, *, guarded: bool) -> Run:
    """Simulate once; all cars are watched, the hasty ones guarded or not."""
    with tempfile.TemporaryDirectory() as folder:
        start = ["sumo", "-c", str(write_cars(Path(folder), seed)), "--seed", str(seed)]
        libsumo.start(start)
        watch = attach(libsumo, "all", mode="watch")
        guards = attach(libsumo, "type:hasty") if guarded else None
        kinds: dict[str, str] = {}
        speeds: dict[str, list[float]] = {"hasty": [], "normal": []}
        most = 0
        while libsumo.simulation.getTime() < END:
            libsumo.simulationStep()
            for car in libsumo.simulation.getDepartedIDList():
                kinds[car] = libsumo.vehicle.getTypeID(car)
            cars = libsumo.vehicle.getIDList()
            most = max(most, len(cars))
            for car in cars:
                speeds[kinds[car]].append(libsumo.vehicle.getSpeed(car))
        for attachment in filter(None, (watch, guards)):
            attachment.detach()
        libsumo.close()
    who = [(kinds[each.collider], kinds[each.victim]) for each in watch.collisions]
    by = sum(collider == "hasty" for collider, _ in who)
    into = sum(pair == ("normal", "hasty") for pair in who)
    cost = 0.0
    if guards is not None and guards.guarding is not None:
        cost = 1e6 * guards.seconds / guards.guarding.decisions
    return Run(
        most,
        sum(kind == "hasty" for kind in kinds.values()),
        by,
        into,
        len(who) - by - into,
        statistics.fmean(speeds["hasty"]),
        statistics.fmean(speeds["normal"]),
        cost,
        1e6 * watch.seconds / watch.looked,
    )


def main() -> None:
    """Print a line for each run, and what guarding came to."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=3)
    seeds = range(parser.parse_args().seeds)
    print("seed  guards  cars  hasty  collisions by/into hasty, others  speed of hasty, others")
    runs: dict[bool, list[Run]] = {False: [], True: []}
    for seed in seeds:
        for guarded, found in runs.items():
            run = drive(seed, guarded=guarded)
            found.append(run)
            print(
                f"{seed:4}  {'yes' if guarded else 'no':6}  {run.cars:4}  {run.hasty:5}  "
                f"{run.by_hasty:17} / {run.into_hasty}, {run.others:<6}  "
                f"{run.speed:12.2f}, {run.speed_of_others:.2f} m/s"
            )
    alone, guarded_runs = runs[False], runs[True]
    before, after = (sum(run.by_hasty for run in each) for each in (alone, guarded_runs))
    kept = [b.speed / a.speed for a, b in zip(alone, guarded_runs, strict=True)]
    print(f"Collisions by hasty cars: {before} -> {after}; speed kept: {min(kept):.1%} at least")
    print(f"Run into by others: {sum(run.into_hasty for run in guarded_runs)}")
    print(f"A guard takes {max(run.guarding for run in guarded_runs):.0f} µs a decision, ", end="")
    print(f"watching {max(run.watching for run in alone):.1f} µs a car and step, at most")


if __name__ == "__main__":
    main()
