"""SUMO itself plays what was written, in a process of its own: libsumo has room for one run."""

import json
import subprocess
import sys
import xml.etree.ElementTree as ET

import numpy as np
import pytest

pytest.importorskip("mcap")

from evofsm.io.mcap import RecordedEpisode
from evofsm.io.sumo_gui import car_names, write_replay

PLAY = """
import json, sys, libsumo
libsumo.start(["sumo", "-c", sys.argv[1]])
steps = []
while libsumo.simulation.getTime() < libsumo.simulation.getEndTime():
    libsumo.simulationStep()
    cars = libsumo.vehicle
    steps.append({car: cars.getLanePosition(car) for car in cars.getIDList()})
colors = {car: libsumo.vehicletype.getColor(cars.getTypeID(car)) for car in cars.getIDList()}
libsumo.close()
print(json.dumps([steps, colors]))
"""


def episode(risks):
    """Behind a leader at 10 m/s, ever nearer; the decisions' risks are given."""
    time = 0.25 * np.arange(len(risks))
    columns = {
        "time": time,
        "gap": 20.0 - 2.0 * time,
        "v_follower": np.full(len(risks), 12.0),
        "v_leader": np.full(len(risks), 10.0),
        "risk_proposed": np.array(risks),
    }
    end = 0.25 * len(risks)
    return RecordedEpisode(columns, False, False, end, np.array([20.0 - 2.0 * end, 12.0, 10.0]))


def test_sumo_drives_the_car_of_the_present_risk_behind_the_leader(tmp_path):
    pytest.importorskip("libsumo")
    risks = [np.nan, 0.0, 0.0005, 0.05, 0.05, 0.9, 0.9, 0.3]
    configuration = write_replay(tmp_path / "replay", episode(risks))
    played = subprocess.run(
        [sys.executable, "-c", PLAY, str(configuration)], capture_output=True, text=True, check=True
    )
    steps, colors = json.loads(played.stdout)
    names = car_names()
    wanted = [names[k] for k in (0, 1, 1, 3, 3, 5, 5, 4) for _ in range(5)]
    start = None
    for k, name in enumerate(wanted):
        cars = steps[k + 1]  # the first step puts the cars in place
        assert set(cars) == {*names, "leader"}
        place = cars[name]
        start = place if start is None else start
        assert place - start == pytest.approx(12.0 * 0.05 * k, abs=0.002)
        assert cars["leader"] - 5.0 - place == pytest.approx(20.0 - 2.0 * 0.05 * k, abs=0.002)
        assert all(cars[other] < 300.0 for other in names if other != name)  # they wait
    assert set(colors) == {*names, "leader"}
    assert len(set(map(tuple, colors.values()))) == len(colors)


def test_a_hole_in_the_observations_is_driven_through(tmp_path):
    holed = episode([0.0] * 6)
    holed.columns["gap"][2:4] = np.nan
    write_replay(tmp_path, holed)
    root = ET.parse(tmp_path / "positions.fcd.xml").getroot()
    gaps = []
    for timestep in root[1:]:
        cars = {car.get("id"): float(car.get("pos")) for car in timestep}
        gaps.append(cars["leader"] - 5.0 - cars["risk_0_to_0.001"])
    np.testing.assert_allclose(gaps, 20.0 - 0.1 * np.arange(len(gaps)), atol=0.002)


def test_what_cannot_be_played_is_refused(tmp_path):
    with pytest.raises(ValueError, match="no column 'risk'"):
        write_replay(tmp_path, episode([0.1]), risk="risk")
    blind = episode([0.1, 0.1])
    blind.columns["gap"][:] = np.nan
    with pytest.raises(ValueError, match="fewer than two whole observations"):
        write_replay(tmp_path, blind)
