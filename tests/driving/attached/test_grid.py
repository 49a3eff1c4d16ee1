"""The example: a grid of streets by netgenerate, 600 cars, one in ten hasty."""

import runpy
from pathlib import Path

import pytest

from evofsm.driving import attach

libsumo = pytest.importorskip("libsumo")

EXAMPLE = Path(__file__).parents[3] / "examples" / "your-own-sumo"
UNTIL = 150.0  # [s]


def drive(configuration, mode):
    """The attachment, mean speed of the hasty cars, and their names."""
    libsumo.start(["sumo", "-c", str(configuration), "--seed", "0"])
    guards = attach(libsumo, "type:hasty", mode=mode)
    distance = cars = 0
    while libsumo.simulation.getTime() < UNTIL:
        libsumo.simulationStep()
        distance += sum(map(libsumo.vehicle.getSpeed, guards.cars))
        cars += len(guards.cars)
    libsumo.close()
    return guards, distance / cars


@pytest.mark.slow
def test_collisions_of_hasty_cars_are_prevented_and_none_is_caused_behind_them(tmp_path):
    made = runpy.run_path(str(EXAMPLE / "make.py"))
    configuration = made["write_cars"](tmp_path, seed=0)
    alone, speed_alone = drive(configuration, "shadow")
    guarded, speed = drive(configuration, "act")
    hasty = alone.ever
    before = sum(each.collider in hasty for each in alone.collisions)
    after = sum(each.collider in hasty for each in guarded.collisions)
    assert before >= 10
    assert after <= 0.1 * before
    assert not any(
        each.victim in hasty for each in guarded.collisions if each.collider not in hasty
    )
    assert speed >= 0.9 * speed_alone
