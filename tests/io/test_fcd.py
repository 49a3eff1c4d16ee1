"""SUMO's FCD output: pairs derived from written-out timesteps, and from a file SUMO wrote."""

import gzip
import json
import re
import subprocess
import sys
from importlib.util import find_spec

import numpy as np
import pytest

from evofsm.fsm.observations import ObservationEncoder
from evofsm.io import following
from evofsm.io.fcd import VehicleLengths
from evofsm.io.traces import LogColumns, read_traces


def xml(timesteps):
    """FCD from ``{time: [(id, lane, pos, speed[, type]), ...]}``; a row each, timestep each."""
    lines = ["<fcd-export>"]
    for time, vehicles in timesteps.items():
        lines.append(f'<timestep time="{time}">')
        for name, lane, position, speed, *kind in vehicles:
            kind = f' type="{kind[0]}"' if kind else ""
            lines.append(
                f'<vehicle id="{name}" lane="{lane}" pos="{position}" speed="{speed}"{kind}/>'
            )
        lines.append("</timestep>")
    return "\n".join([*lines, "</fcd-export>", ""])


def write(path, text):
    path.write_text(text)
    return str(path)


def episodes(path, lengths=None, **columns):
    """Every episode as (observations, actions, times)."""
    found = []
    for chunk in read_traces([path], LogColumns(**columns), lengths):
        ends = [*chunk.starts[1:], len(chunk.times)]
        for start, end in zip(chunk.starts, ends, strict=True):
            part = slice(start, end)
            found.append((chunk.observations[part], chunk.actions[part], chunk.times[part]))
    return found


def refusal(path, **columns):
    with pytest.raises(ValueError, match=re.escape(path)) as caught:
        list(read_traces([path], LogColumns(**columns)))
    return str(caught.value)


def test_gap_is_between_bumpers_and_the_action_is_what_came_next(tmp_path):
    path = write(
        tmp_path / "a.xml",
        xml(
            {
                0.0: [("a", "e_0", 50.0, 8.0), ("b", "e_0", 20.0, 10.0)],
                0.5: [("a", "e_0", 54.0, 8.0), ("b", "e_0", 25.0, 9.0)],
                1.0: [("a", "e_0", 58.0, 9.0), ("b", "e_0", 29.5, 9.5)],
            }
        ),
    )
    ((observations, actions, times),) = episodes(path)
    assert observations.tolist() == [[25.0, 10.0, 8.0], [24.0, 9.0, 8.0], [23.5, 9.5, 9.0]]
    assert actions[:2].tolist() == [-2.0, 1.0]
    assert np.isnan(actions[2])
    assert times.tolist() == [0.0, 0.5, 1.0]


def test_pairs_are_neighbours_on_the_same_lane_only(tmp_path):
    road = {
        t: [
            ("a", "e_0", 90.0, 1.0),
            ("b", "e_1", 60.0, 2.0),
            ("c", "e_0", 50.0, 3.0),
            ("d", "e_0", 10.0, 4.0),
            ("e", "f_0", 20.0, 5.0),
        ]
        for t in (0.0, 0.1)
    }
    found = episodes(write(tmp_path / "a.xml", xml(road)))
    assert [observations[0].tolist() for observations, _, _ in found] == [
        [35.0, 4.0, 3.0],
        [35.0, 3.0, 1.0],
    ]


def test_an_episode_ends_when_somebody_cuts_in_or_a_pair_is_away(tmp_path):
    a, b, c = ("a", "e_0", 90.0, 1.0), ("b", "e_0", 10.0, 1.0), ("c", "e_0", 50.0, 1.0)
    road = {0.0: [a, b], 0.1: [a, b], 0.2: [a, b, c], 0.3: [a, b], 0.4: [a], 0.5: [a, b], 0.6: []}
    found = episodes(write(tmp_path / "a.xml", xml(road)))
    times = sorted(times.tolist() for _, _, times in found)
    assert times == [[0.0, 0.1], [0.2], [0.2], [0.3], [0.5]]


def test_a_missing_timestep_is_a_time_jump(tmp_path):
    pair = [("a", "e_0", 90.0, 1.0), ("b", "e_0", 10.0, 1.0)]
    path = write(tmp_path / "a.xml", xml(dict.fromkeys((0.0, 0.1, 0.2, 0.5, 0.6), pair)))
    (chunk,) = read_traces([path])
    assert chunk.starts.tolist() == [0, 3]
    assert chunk.jumps == 1


def test_a_collision_is_kept_with_its_negative_gap(tmp_path):
    pair = [("a", "e_0", 14.0, 1.0), ("b", "e_0", 10.0, 1.0)]
    ((observations, _, _),) = episodes(write(tmp_path / "a.xml", xml({0.0: pair})))
    assert observations[0, 0] == -1.0


def test_lengths_are_those_of_the_leader_s_type(tmp_path):
    road = {0.0: [("a", "e_0", 50.0, 1.0, "truck@a"), ("b", "e_0", 20.0, 1.0, "car")]}
    path = write(tmp_path / "a.xml", xml(road))
    assert episodes(path, VehicleLengths.parse(["4", "truck=12"]))[0][0][0, 0] == 18.0
    assert episodes(path, VehicleLengths.parse(["4"]))[0][0][0, 0] == 26.0
    assert str(VehicleLengths.parse(["4", "truck=12"])) == "truck 12 m, others 4 m"
    with pytest.raises(ValueError, match=r"has the type 'lorry' .* the types are truck"):
        episodes(path, VehicleLengths.parse(["lorry=12"]))


@pytest.mark.parametrize("text", ["long", "truck=", "truck=-1", "0", "nan"])
def test_a_length_that_is_none_is_refused(text):
    with pytest.raises(ValueError, match="--vehicle-length is"):
        VehicleLengths.parse([text])


def test_variables_may_be_chosen_and_ordered(tmp_path):
    road = {0.0: [("a", "e_0", 50.0, 1.0), ("b", "e_0", 20.0, 2.0)]}
    path = write(tmp_path / "a.xml", xml(road))
    ((observations, _, _),) = episodes(path, observe=ObservationEncoder("v_leader", "gap"))
    assert observations.tolist() == [[1.0, 25.0]]
    assert "gap, v_follower, v_leader" in refusal(path, observe=ObservationEncoder("speed"))
    assert "a_follower" in refusal(path, action="accel")
    assert "with --dt" in refusal(path, dt=0.1)
    assert "with --episode" in refusal(path, episode=["run"])


def test_so_many_waiting_rows_are_handed_on_before_the_pairs_part(tmp_path, monkeypatch):
    monkeypatch.setattr(following, "_MOST_WAITING", 100)
    pair = [("a", "e_0", 90.0, 1.0), ("b", "e_0", 10.0, 1.0)]
    path = write(tmp_path / "a.xml", xml({k / 10: pair for k in range(250)}))
    (chunk,) = read_traces([path])
    assert len(chunk.times) == 250
    assert chunk.starts.tolist() == [0, 101, 202]
    assert chunk.cuts == 2
    assert np.isnan(chunk.actions).sum() == 3


def test_persons_and_vehicles_off_the_road_are_passed_over(tmp_path):
    text = xml({0.0: [("a", "e_0", 50.0, 1.0), ("b", "e_0", 20.0, 2.0)]}).replace(
        "</timestep>",
        '<person id="p" pos="30" speed="1" edge="e"/><vehicle id="x" pos="1" speed="0"/>'
        '<vehicle id="y" lane="" pos="-1073741824.0" speed="0"/></timestep>',
    )
    ((observations, _, _),) = episodes(write(tmp_path / "a.xml", text))
    assert observations.tolist() == [[25.0, 2.0, 1.0]]


@pytest.mark.parametrize(
    ("before", "after", "message"),
    [
        (' lane="e_0"', "", "line 3: there is no 'lane'; SUMO writes it unless --fcd-output"),
        (' speed="2.0"', "", "line 4: there is no 'speed'"),
        ('pos="20.0"', 'pos="nan"', "line 4, pos: nan cannot be learnt"),
        ('pos="20.0"', 'pos="here"', "line 4, pos: 'here' is no number"),
        ('time="0.0"', 'time="00:00:01"', "--human-readable-time"),
        ('time="0.1"', 'time="0.0"', "line 6: time goes from 0 to 0"),
        ("<fcd-export>", "<tripinfos>", "begins with <tripinfos>"),
        ("</fcd-export>", "", "not whole XML"),
        ("vehicle", "person", "no vehicle on a lane"),
        ('"e_0" pos="20', '"e_1" pos="20', "no vehicle ever follows another"),
    ],
)
def test_what_is_wrong_in_xml_is_named(tmp_path, before, after, message):
    vehicles = [("a", "e_0", 50.0, 1.0), ("b", "e_0", 20.0, 2.0)]
    text = xml({0.0: vehicles, 0.1: vehicles})
    assert before in text
    text = text.replace(before, after)
    if before == "<fcd-export>":
        text = text.replace("</fcd-export>", "</tripinfos>")
    assert message in refusal(write(tmp_path / "a.xml", text))


def test_a_truncated_gzip_of_xml_is_refused(tmp_path):
    pair = [("a", "e_0", 90.0, 1.0), ("b", "e_0", 10.0, 1.0)]
    packed = gzip.compress(xml({k / 10: pair for k in range(2000)}).encode())
    path = tmp_path / "a.xml.gz"
    path.write_bytes(packed[: len(packed) // 2])
    assert "gzip data ends early" in refusal(str(path))


def test_columns_of_an_empty_timestep_and_of_persons_are_understood(tmp_path):
    # SUMO names the columns after what it writes first, here a person.
    text = """timestep_time;person_id;person_speed;person_pos;person_lane
0.00;;;;
0.10;p;1.00;5.00;
0.10;a;1.00;50.00;e_0
0.10;b;2.00;20.00;e_0
"""
    ((observations, _, times),) = episodes(write(tmp_path / "a.csv", text))
    assert observations.tolist() == [[25.0, 2.0, 1.0]]
    assert times.tolist() == [0.1]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("timestep_time;vehicle_id;vehicle_speed;vehicle_pos\n0;a;1;1\n", "no 'vehicle_lane'"),
        ("timestep_time\n0.00\n", "no vehicle on a lane"),
        (
            "timestep_time,vehicle_id,vehicle_speed,vehicle_pos,vehicle_lane\n0,a,1,,e_0\n",
            "line 2, pos: the field is empty",
        ),
        (
            "timestep_time,vehicle_id,vehicle_speed,vehicle_pos,vehicle_lane\n1,a,1,1,e_0\n"
            "0,a,1,1,e_0\n",
            "line 3: time goes from 1 to 0",
        ),
    ],
)
def test_what_is_wrong_in_a_table_is_named(tmp_path, text, message):
    assert message in refusal(write(tmp_path / "a.csv", text))


# -- A file that SUMO itself wrote ----------------------------------------------------------------

NET = """<net version="1.20">
  <location netOffset="0,0" convBoundary="0,0,2000,0" origBoundary="0,0,2000,0" projParameter="!"/>
  <edge id="e" from="a" to="b" priority="1">
    <lane id="e_0" index="0" speed="30" length="2000" shape="0,-4.8 2000,-4.8"/>
    <lane id="e_1" index="1" speed="30" length="2000" shape="0,-1.6 2000,-1.6"/>
  </edge>
  <junction id="a" type="dead_end" x="0" y="0" incLanes="" intLanes="" shape="0,0 0,-6.4"/>
  <junction id="b" type="dead_end" x="2000" y="0" incLanes="e_0 e_1" intLanes="" shape="0,0 0,1"/>
</net>"""
ROUTES = """<routes>
  <vType id="car" length="5" sigma="0.5"/>
  <vType id="truck" length="12" maxSpeed="20"/>
  <route id="r" edges="e"/>
  <vehicle id="a" type="car" route="r" depart="1" departLane="0"/>
  <vehicle id="b" type="truck" route="r" depart="3" departLane="0"/>
  <vehicle id="c" type="car" route="r" depart="6" departLane="0"/>
  <vehicle id="d" type="car" route="r" depart="7" departLane="1"/>
</routes>"""
DRIVE = """
import json, sys
import libsumo
libsumo.start(["sumo", "-n", "net.xml", "-r", "routes.xml", "--step-length", "0.1",
               "--no-step-log", "--fcd-output", sys.argv[1], *sys.argv[2:]])
seen = []
while libsumo.simulation.getTime() < 20:
    libsumo.simulationStep()
    if {"b", "c"} <= set(libsumo.vehicle.getIDList()):
        lanes = [libsumo.vehicle.getLaneID(name) for name in "bc"]
        if lanes == ["e_0", "e_0"]:
            place = libsumo.vehicle.getLanePosition
            gap = place("b") - libsumo.vehicle.getLength("b") - place("c")
            seen.append([gap, libsumo.vehicle.getSpeed("c"), libsumo.vehicle.getSpeed("b")])
libsumo.close()
json.dump(seen, open("truth.json", "w"))
"""


@pytest.fixture(scope="module")
def sumo(tmp_path_factory):
    """Writes FCD with SUMO, in a process of its own as libsumo needs."""
    if find_spec("libsumo") is None:
        pytest.skip("libsumo is not installed")
    folder = tmp_path_factory.mktemp("sumo")
    (folder / "net.xml").write_text(NET)
    (folder / "routes.xml").write_text(ROUTES)

    def drive(name, *options):
        command = [sys.executable, "-c", DRIVE, name, *options]
        subprocess.run(command, cwd=folder, check=True, capture_output=True)
        return str(folder / name)

    return drive


def test_pairs_are_those_that_sumo_drove(sumo, tmp_path):
    path = sumo("truth.xml", "--precision", "6")
    with open(path.replace("truth.xml", "truth.json")) as file:
        truth = np.array(json.load(file))
    found = episodes(path, VehicleLengths.parse(["truck=12"]))
    mine = np.vstack([rows for rows, _, _ in found if abs(rows[0, 0] - truth[0, 0]) < 1e-5])
    assert len(mine) > 30
    assert mine == pytest.approx(truth[: len(mine)], abs=2e-6)
    actions = next(actions for rows, actions, _ in found if abs(rows[0, 0] - truth[0, 0]) < 1e-5)
    assert actions[:-1] == pytest.approx(np.diff(mine[:, 1]) / 0.1, abs=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("ending", ["xml.gz", "csv", "csv.gz", "parquet"])
def test_all_of_sumo_s_formats_tell_the_same(sumo, ending):
    if ending == "parquet":
        pytest.importorskip("polars")
    reference = episodes(sumo("same.xml", "--precision", "6"))
    other = episodes(sumo(f"same.{ending}", "--precision", "6"))
    assert len(reference) == len(other) > 2
    for mine, theirs in zip(reference, other, strict=True):
        for a, b in zip(mine, theirs, strict=True):
            assert a == pytest.approx(b, abs=2e-5, nan_ok=True)


@pytest.mark.slow
def test_sumo_without_lanes_is_refused_with_the_option(sumo):
    for name in ("bare.xml", "bare.csv"):
        path = sumo(name, "--fcd-output.attributes", "speed,pos")
        assert "--fcd-output.attributes" in refusal(path)
