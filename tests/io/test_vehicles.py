"""Recordings of many vehicles: FCD of SUMO, tables of objects, ASAM OSI."""

import gzip
import math

import betterosi as osi
import libsumo
import numpy as np
import polars
import pytest
from mcap.writer import IndexType
from tests.fuzz.fuzz import osi_mcap, osi_traces
from tests.io.test_logs import refusal

from evofsm import ObservationEncoder
from evofsm.cli.learning import warnings_of
from evofsm.cli.options import lengths_given
from evofsm.io import LogColumns, episodes_of, read_traces, vehicles
from evofsm.io.logs import Noted

OBJECTS = "id,t,x,y,vx,vy,length,lane"


def write(path, text):
    path.write_text(text)
    return str(path)


def episodes(path, **columns):
    """Every episode as (observations, actions, times)."""
    chunks = read_traces([str(path)], LogColumns(**columns))
    return [(one.observations, one.actions, one.times) for one in episodes_of(chunks)]


# -- FCD ------------------------------------------------------------------------------------------


FIELDS = ("id", "lane", "pos", "speed", "type")


def xml(timesteps, fields=FIELDS):
    """FCD from ``{time: [(id, lane, pos, speed[, type]), ...]}``, or other fields; a row each."""
    lines = ["<fcd-export>"]
    for time, present in timesteps.items():
        lines.append(f'<timestep time="{time}">')
        for one in present:
            told = zip(fields, one, strict=False)
            seen = " ".join(f'{name}="{value}"' for name, value in told)
            lines.append(f"<vehicle {seen}/>")
        lines.append("</timestep>")
    return "\n".join([*lines, "</fcd-export>", ""])


PAIR = [("a", "e_0", 50.0, 1.0), ("b", "e_0", 20.0, 2.0)]


def test_an_episode_ends_when_somebody_cuts_in_or_a_pair_is_away(tmp_path):
    a, b, c = ("a", "e_0", 90.0, 1.0), ("b", "e_0", 10.0, 1.0), ("c", "e_0", 50.0, 1.0)
    road = {0.0: [a, b], 0.1: [a, b], 0.2: [a, b, c], 0.3: [a, b], 0.4: [a], 0.5: [a, b], 0.6: []}
    path = write(tmp_path / "a.xml", xml(road))
    times = sorted(times.tolist() for _, _, times in episodes(path))
    assert times == [[0.0, 0.1], [0.2], [0.2], [0.3], [0.5]]
    (chunk,) = read_traces([path], LogColumns(failed="gap<=35"))
    assert chunk.observations[chunk.fails, 0].tolist() == [35.0, 35.0]


def test_lengths_are_those_of_the_leader_s_type(tmp_path):
    road = {0.0: [("a", "e_0", 50.0, 1.0, "truck@a"), ("b", "e_0", 20.0, 1.0, "car")]}
    path = write(tmp_path / "a.xml", xml(road))
    assert episodes(path, lengths=lengths_given(["4", "truck=12"]))[0][0][0, 0] == 18.0
    assert episodes(path, lengths=lengths_given(["4"]))[0][0][0, 0] == 26.0
    assert str(lengths_given(["4", "truck=12"])) == "truck 12 m, others 4 m"
    with pytest.raises(ValueError, match=r"has the type 'lorry' .* the types are car, truck"):
        episodes(path, lengths=lengths_given(["lorry=12"]))
    for text in ("truck=", "-1", "nan"):
        with pytest.raises(ValueError, match="--vehicle-length is"):
            lengths_given([text])


def test_variables_may_be_chosen_and_ordered_and_nothing_else(tmp_path):
    path = write(tmp_path / "a.xml", xml({0.0: PAIR}))
    ((observations, _, _),) = episodes(path, observe=ObservationEncoder("v_leader", "gap"))
    assert observations.tolist() == [[1.0, 25.0]]
    assert "gap, v_follower, v_leader" in refusal(path, observe=ObservationEncoder("speed"))
    for asked in ({"action": "accel"}, {"dt": 0.1}, {"episode": ["run"]}, {"failed": "crash"}):
        assert f"cannot be read with --{next(iter(asked))}" in refusal(path, **asked)
    assert "cannot be read with --unit: write it in s, m" in refusal(path, units={"v": "km/h"})
    noted, of_ms = Noted(), write(tmp_path / "b.xml", xml({0: PAIR, 100: PAIR}))
    assert len(list(read_traces([of_ms], noted=noted))) == 1
    assert "time=ms converts it; a table of objects has to be in s" in warnings_of(noted)[0]


def test_so_many_waiting_rows_are_handed_on_before_the_pairs_part(tmp_path, monkeypatch):
    monkeypatch.setattr(vehicles, "_MOST_WAITING", 100)
    path = write(tmp_path / "a.xml", xml({k / 10: PAIR for k in range(250)}))
    (chunk,) = read_traces([path])
    assert len(chunk.times) == 250
    assert np.flatnonzero(chunk.begins).tolist() == [0, 101, 202]
    assert np.isnan(chunk.actions).sum() == 3
    beside = [("c", "f_0", 50.0, 1.0), ("d", "f_0", 20.0, 2.0)]
    apart = {k / 10: [*beside, *(PAIR if k % 10 else [])] for k in range(80)}
    (chunk,) = read_traces([write(tmp_path / "b.xml", xml(apart))])
    assert chunk.begins.sum() == 1 + 8  # what has ended does not wait
    monkeypatch.setattr(vehicles, "_ROWS_AT_ONCE", 100)
    assert [len(chunk.times) for chunk in read_traces([path])] == [101, 101, 48]


def test_persons_and_vehicles_off_the_road_are_passed_over(tmp_path):
    foreign = (
        '<person id="p" pos="30" speed="1" edge="e"/><vehicle id="x" pos="1" speed="0"/>'
        '<vehicle id="y" lane="" pos="-1073741824.0" speed="0"/><note><b who="me"/></note>'
    )
    text = xml({0.0: PAIR}).replace('0.0">', f'0.0">{foreign}')
    ((observations, _, _),) = episodes(write(tmp_path / "a.xml", text))
    assert observations.tolist() == [[25.0, 2.0, 1.0]]


@pytest.mark.parametrize(
    ("before", "after", "message"),
    [
        (' lane="e_0"', "", "or --fcd-output.attributes without lane?"),
        (' id="b"', "", "line 4: there is no 'id'"),
        ('pos="20.0"', 'pos="nan"', "line 4, pos: nan cannot be learnt"),
        ('time="0.0"', 'time="00:00:01"', "--human-readable-time"),
        ('time="0.1"', 'time="0.0"', "line 6: time goes from 0 to 0"),
        ("fcd-export>", "tripinfos>", "begins with <tripinfos>"),
        ("</fcd-export>", "", "XML is cut off or damaged"),
        ('id="b"', 'id="a"', "line 4: 'a' is there twice"),
        ("vehicle", "person", "no vehicle on a lane"),
        ('"e_0" pos="20', '"e_1" pos="20', "no vehicle ever follows another"),
    ],
)
def test_what_is_wrong_in_xml_is_named(tmp_path, before, after, message):
    text = xml({0.0: PAIR, 0.1: PAIR})
    assert before in text
    assert message in refusal(write(tmp_path / "a.xml", text.replace(before, after)))


def bad_and_left_out(path, said, **columns):
    """What is read without a bad moment, which is refused where none may be left out."""
    noted = Noted()
    assert said in refusal(path, **columns)
    chunks = list(read_traces([str(path)], LogColumns(**columns), noted=noted))
    assert said in " ".join(warnings_of(noted))
    return [one.times.round(3).tolist() for one in episodes_of(chunks)]


def test_a_bad_moment_is_left_out_with_all_that_is_there_then(tmp_path):
    """Without one of its vehicles, others would be taken for pairs."""
    road = {k / 10: [("a", "e", 90, 1), ("b", "e", 50 + k, 1), ("c", "e", 10, 1)] for k in range(6)}
    text, path = xml(road), tmp_path / "a.xml"
    path.write_text(text[: text.rindex("<vehicle")])
    assert bad_and_left_out(path, "cut off") == [[0.0, 0.1, 0.2, 0.3, 0.4]] * 2
    path.write_text(text.replace('pos="53"', 'pos="x"'))
    apart = [[0.0, 0.1, 0.2], [0.4, 0.5]]
    assert sorted(bad_and_left_out(path, "pos: 'x' is no number")) == sorted(apart * 2)
    seen = [(t, *car) for t, cars in road.items() for car in cars]
    rows = [f"{t},{name},{v},{at},{lane}" for t, name, lane, at, v in seen]
    table = tmp_path / "a.csv"
    for bad in ("0.3,b,1", "0.3,b,1,x,e"):
        table.write_text("\n".join([FCD, *rows[:10], bad, *rows[11:], ""]))
        assert sorted(bad_and_left_out(table, "line 12")) == sorted(apart * 2)
    table.write_text("\n".join([FCD, *rows[:9], "x,a,1,90,e", *rows[10:], ""]))  # of 0.2 or 0.3 s
    assert sorted(bad_and_left_out(table, "line 11")) == [[0.0, 0.1]] * 2 + [[0.4, 0.5]] * 2
    table.write_text("\n".join([FCD, *rows[:-1], "0.5,c"]))
    assert bad_and_left_out(table, "line 19") == [[0.0, 0.1, 0.2, 0.3, 0.4]] * 2
    table.write_text("\n".join([FCD, *rows[:4], *rows[3:], ""]))
    whole = [k / 10 for k in range(6)]
    assert bad_and_left_out(table, "line 6: 'a' is there twice") == [whole] * 2


ACROSS = {"a": (62, 1.2), "b": (60, -1.2), "c": (50, 1.1), "d": (49, -1.3), "truck": (30, 0)}
ACROSS |= {"e": (10, 1.2)}  # along and across one lane: two files of bikes, and a truck
BEHIND = {"c behind a", "d behind b", "truck behind d", "e behind truck"}


def along_a_road(turned, along, across):
    c, s = math.cos(turned), math.sin(turned)
    return along * c - across * s, along * s + across * c


def in_degrees(x, y):
    return 13.0 + x / 111_195.0 / math.cos(math.radians(52.0)), 52.0 + y / 111_195.0


@pytest.mark.parametrize("told", [("posLat",), ("x", "y", "angle"), ("x", "y", "angle", "geo")])
@pytest.mark.parametrize("ending", ["xml", "csv"])
def test_who_is_beside_is_nobody_s_leader_in_fcd(tmp_path, told, ending):
    seen = []
    for name, (along, across) in ACROSS.items():
        x, y = along_a_road(math.radians(60.0), along, across)
        x, y = in_degrees(x, y) if "geo" in told else (x, y)
        places = {"posLat": across, "x": x, "y": y, "angle": 30.0, "geo": 1}
        kind = "truck" if name == "truck" else "bike"
        seen.append((name, "e", along, 5.0, kind, *(places[place] for place in told)))
    fields = *FIELDS, *told
    text = xml({0.0: seen, 0.1: seen}, fields)
    if ending == "csv":
        rows = [["timestep_time", *(f"vehicle_{name}" for name in fields)]]
        rows += [[time, *one] for time in (0.0, 0.1) for one in seen]
        text = "\n".join(",".join(map(str, row)) for row in rows)
    path, noted = write(tmp_path / f"a.{ending}", text), Noted()
    lengths = lengths_given(["bike=1.6x0.65", "truck=12x2.5"])
    (chunk,) = read_traces([path], LogColumns(lengths=lengths), noted)
    assert set(chunk.names) == BEHIND
    assert warnings_of(noted) == []
    (chunk,) = read_traces([path], LogColumns(lengths=lengths_given(["12x2.5"])), noted)
    assert "is it narrower than 2.5 m? --vehicle-length bike=12x0.8" in " ".join(warnings_of(noted))


@pytest.mark.parametrize("told", [(), ("posLat",), ("geo",)])
@pytest.mark.parametrize("speed", [0.5, 0.0])
def test_who_parks_beside_the_road_is_nobody_s_leader_until_it_is_back(tmp_path, told, speed):
    road = {}
    for k, y in enumerate([0.0, 3.2, 3.2, 3.2, 3.2, 0.0, 0.0]):
        x, v, places = 10.0 + 20 * k, 0.0 if k else speed, [(10.0 + 20 * k, 0.0), (100.0, y)]
        here, beside = (in_degrees(*place) if told == ("geo",) else place for place in places)
        road[k] = ("car", "e", x, 20.0, *here, 0.0), ("van", "e", 100.0, v, *beside, 0.0)
    found = episodes(write(tmp_path / "a.xml", xml(road, (*FIELDS[:4], "x", "y", *told))))
    if not speed:  # where the road is, nobody knows
        assert found[-1][2][-1] == 6.0
        return
    assert [(times.tolist(), rows[0].tolist()) for rows, _, times in found] == [
        ([0.0], [85.0, 20.0, speed]),
        ([5.0, 6.0], [5.0, 0.0, 20.0]),
    ]


@pytest.mark.parametrize("turned", [0.7, math.pi, -2.0])
def test_who_is_beside_is_nobody_s_leader_among_objects(tmp_path, turned):
    rows = [
        (name, time, *along_a_road(turned, along, across), *along_a_road(turned, 5.0, 0.0), *kind)
        for time in (0.0, 0.1)
        for name, (along, across) in ACROSS.items()
        for kind in [(12, 1, 2.5) if name == "truck" else (1.6, 1, 0.65)]
    ]
    (chunk,) = read_traces([objects(tmp_path / "a.csv", rows, OBJECTS + ",width")])
    assert set(chunk.names) == BEHIND
    first = dict(zip(chunk.names, chunk.observations[chunk.begins].tolist(), strict=True))
    assert first["c behind a"] == pytest.approx([12.0 - 1.6, 5.0, 5.0], abs=1e-3)
    rows = [row[:-1] for row in rows if row[0] in "abcd"]  # of no width, as wide as a car
    (chunk,) = read_traces([objects(tmp_path / "b.csv", rows)])
    assert set(chunk.names) == {"c behind a", "d behind b"}


def test_who_comes_towards_one_is_nobody_s_leader(tmp_path):
    ways = {"a": (50.0, 90.0), "oncoming": (35.0, 270.0), "b": (20.0, 90.0)}
    seen = [(name, "e", x, 5.0, angle) for name, (x, angle) in ways.items()]
    road = xml({0.0: seen}, (*FIELDS[:4], "angle"))
    rows = [(name, 0.0, x, 0, 180.0 - angle, 0, 4, 1) for name, (x, angle) in ways.items()]
    for path in (write(tmp_path / "a.xml", road), objects(tmp_path / "a.csv", rows)):
        (chunk,) = read_traces([path])
        assert list(chunk.names) == ["b behind a"]


@pytest.mark.parametrize(
    "header",
    [
        "timestep_time;vehicle_{};person_id;person_pos;person_speed;person_lane",
        "timestep_time;timestep_vehicle_{};timestep_person_id;a;b;c",
        "time;{};a;b;c;d",
        "timestep_time;person_{};a;b;c;d",  # it names them after what it writes first
    ],
)
@pytest.mark.parametrize("nothing", ["", "NaN", "NA", "NULL", "None"])
def test_columns_of_fcd_may_be_called_as_sumo_likes(tmp_path, header, nothing):
    first, rest = header.split("{}")
    names = ";".join(first.split(";")[-1] + name for name in ("id", "lane", "pos", "speed"))
    rows = [f"{t};{name};e;{at};5;;;;" for t in (0, 1) for name, at in (("a", 50), ("b", 20))]
    rows[2:2] = [f"0;{who};{nothing};9;{nothing};walker;3;1;" for who in "cd"]
    text = "\n".join([f"{first.split(';')[0]};{names}{rest}", *rows, ""])
    ((observations, _, _),) = episodes(write(tmp_path / "a.csv", text))
    assert observations.tolist() == [[25.0, 5.0, 5.0]] * 2


FCD = "timestep_time,vehicle_id,vehicle_speed,vehicle_pos,vehicle_lane"


def test_what_is_wrong_in_a_table_is_named(tmp_path):
    lacks = "timestep_time;vehicle_id;vehicle_speed;vehicle_pos\n0;a;1;1\n"
    assert "no 'vehicle_lane'" in refusal(write(tmp_path / "a.csv", lacks))
    empty = f"{FCD}\n0,a,1,,e_0\n"
    assert "line 2, pos: the field is empty" in refusal(write(tmp_path / "a.csv", empty))
    backward = f"{FCD}\n1,a,1,1,e_0\n0,a,1,1,e_0\n"
    assert "line 3: time goes from 1 to 0" in refusal(write(tmp_path / "a.csv", backward))


ROUTES = """<routes>
  <vType id="car" length="5" sigma="0.5"/>
  <vType id="truck" length="12" maxSpeed="20"/>
  <route id="r" edges="road"/>
  <vehicle id="a" type="car" route="r" depart="1"/>
  <vehicle id="b" type="truck" route="r" depart="3"/>
  <vehicle id="c" type="car" route="r" depart="6"/>
</routes>"""


@pytest.mark.parametrize(
    "ending", ["xml", *(pytest.param(one, marks=pytest.mark.slow) for one in ("xml.gz", "csv"))]
)
def test_pairs_are_those_that_sumo_drove(tmp_path, sumo_road, ending):
    sumo_road(tmp_path, 2000)
    (tmp_path / "routes.xml").write_text(ROUTES)
    files = "-n", tmp_path / "road.net.xml", "-r", tmp_path / "routes.xml"
    written = "--fcd-output", (path := tmp_path / f"truth.{ending}"), "--precision", 6
    libsumo.start([*map(str, ("sumo", *files, *written, "--step-length", 0.1, "--no-step-log"))])
    truth, car = [], libsumo.vehicle
    while libsumo.simulation.getTime() < 20:
        libsumo.simulationStep()
        if {"b", "c"} <= set(car.getIDList()):
            gap = car.getLanePosition("b") - car.getLength("b") - car.getLanePosition("c")
            truth.append([gap, car.getSpeed("c"), car.getSpeed("b")])
    libsumo.close()
    found = episodes(path, lengths=lengths_given(["truck=12"]))
    (mine,) = [rows for rows, _, _ in found if abs(rows[0, 0] - truth[0][0]) < 1e-5]
    assert len(mine) == len(truth) > 30
    assert mine == pytest.approx(np.array(truth), abs=2e-6)


# -- Objects --------------------------------------------------------------------------------------


def objects(path, rows, header=OBJECTS):
    return write(path, "\n".join([header, *(",".join(map(str, row)) for row in rows)]) + "\n")


def test_the_leader_is_the_nearest_one_ahead_on_the_same_lane(tmp_path):
    rows = []
    for k in range(3):
        t = 0.1 * k
        rows += [("ego", t, 2 * k, 0, 20 - k, 0, 4, 1), ("beside", t, 8, 4, 11, 0, 4, 2)]
        rows += [("far", t, 60 + k, 0, 12, 0, 4, 1), ("near", t, 30 + k, 0, 13, 0, 6, 1)]
        rows += [("off the road", t, 10, 0, 14, 0, 4, "NA"), ("sign", t, "", "nan", "", 0, 0, "")]
    path = objects(tmp_path / "a.csv", rows)
    found = sorted(episodes(path), key=lambda one: one[0][0, 1])
    assert [len(times) for _, _, times in found] == [3, 3]
    assert found[0][0].tolist() == [[25.0, 13.0, 12.0]] * 3
    assert found[1][0].tolist() == [[25.0, 20.0, 13.0], [24.0, 19.0, 13.0], [23.0, 18.0, 13.0]]
    assert found[1][1][:2] == pytest.approx([-10.0, -10.0])
    numbers = dict.fromkeys(("x", "y", "vx"), polars.Float64)
    table = polars.read_csv(path, schema_overrides=numbers)
    table = table.with_columns(polars.col("lane").cast(float, strict=False).fill_null(math.nan))
    table.write_parquet(tmp_path / "a.parquet")
    again = sorted(episodes(tmp_path / "a.parquet"), key=lambda one: one[0][0, 1])
    assert again[1][0].tolist() == found[1][0].tolist()


def test_a_name_that_is_used_again_at_once_begins_an_episode(tmp_path):
    gaps = [36, 36, 56, 36, 36], [86] * 5  # noise, and both change the lane, do not
    rows = [("b", k / 10, 2.0 * k, 0, 20, 0, 4, 1 + (k > 6)) for k in range(10)]
    ahead = zip(rows, [*gaps[0], *gaps[1]], strict=True)
    rows += [("a", t, x + gap + 4, *rest) for (_, t, x, *rest), gap in ahead]
    rows.sort(key=lambda row: row[1])
    found = episodes(objects(tmp_path / "a.csv", rows))
    assert [one[0][:, 0].round(6).tolist() for one in found] == [*gaps]


def test_who_stands_points_where_it_moved_last_or_where_it_is_said_to(tmp_path):
    rows = []
    for t, v in ((0.0, 1.0), (0.1, 0.0), (0.2, 0.0)):
        rows += [("b", t, 0, 0, -v, 0, 4, 1), ("a", t, -20, 0, 0, 0, 4, 1)]
    ((observations, _, _),) = episodes(objects(tmp_path / "a.csv", rows))
    assert observations[:, 0].tolist() == [16.0, 16.0, 16.0]
    told = [(*row[:4], 0, 0, *row[6:], math.pi) for row in rows]
    assert len(episodes(objects(tmp_path / "b.csv", told, OBJECTS + ",heading"))[0][0]) == 3


def test_who_reverses_has_a_negative_speed_where_its_heading_is_told(tmp_path):
    for speed, leader_speed in ((2, -3), (-2, 0)):
        cars = ("b", 0, speed), ("a", 40, leader_speed)
        rows = [
            (name, t, *along_a_road(2.0, x + v * t, 0), *along_a_road(2.0, v, 0), 4, 1, 2.0)
            for t in (0.0, 0.1)
            for name, x, v in cars
        ]
        ((observations, _, _),) = episodes(objects(tmp_path / "a.csv", rows, OBJECTS + ",heading"))
        assert observations[0] == pytest.approx([36.0, speed, leader_speed])


@pytest.mark.parametrize(
    ("rows", "said"),
    [
        ([("a", 0, 0, 0, 1, 0, 4, ""), ("b", 0, 9, 0, 1, 0, 4, "")], "no object is on a lane"),
        ([("a", 0, 0, 0, 1, 0, 4, 1), ("a", 0, 9, 0, 1, 0, 4, 1)], "'a' is there twice"),
        ([("a", 0, 0, 0, 1, 0, 0, 1)], "line 2: object a is 0 m long"),
        ([("a", 0, "x", 0, 1, 0, 4, 1)], "column 'x'"),
        ([("a", 0, 0, 0, 1, 0, 4, 1)], "no vehicle ever follows another one"),
    ],
)
def test_objects_that_cannot_be_right_are_refused_in_words(tmp_path, rows, said):
    assert said in refusal(objects(tmp_path / "a.csv", rows))


# -- ASAM OSI -------------------------------------------------------------------------------------


def assert_pair(path):
    (chunk,) = read_traces([str(path)])
    gaps = 46.0 - 0.2 * np.arange(5)
    expected = np.column_stack([gaps, np.full(5, 20.0), np.full(5, 18.0)])
    assert chunk.observations == pytest.approx(expected)
    assert chunk.times == pytest.approx(5.0 + 0.1 * np.arange(5))


def test_ground_truth_and_sensor_views_are_read_gzipped_or_with_logical_lanes_alone(tmp_path):
    (truth, view), lanes = osi_traces(), next(osi_traces(logical=True))
    named = {"trace.osi": truth, "view.osi": view, "trace.osi.gz": gzip.compress(truth)}
    for name, content in (named | {"lanes.osi": lanes}).items():
        (tmp_path / name).write_bytes(content)
        assert_pair(tmp_path / name)


def test_mcap_is_read_by_its_schema_and_named_where_it_holds_something_else(tmp_path):
    path = tmp_path / "trace.mcap"
    for kind, place in (("GroundTruth", 0), ("SensorView", 1)):
        path.write_bytes(osi_mcap(kind, place))
        assert_pair(path)
    path.write_bytes(osi_mcap("SensorData"))
    assert "its schemas are Log, SensorData" in refusal(path)


@pytest.mark.parametrize("lanes", [[1, 2], [2, 1]])
def test_in_osi_one_on_several_lanes_leads_on_each_and_a_trailer_follows_nobody(tmp_path, lanes):
    def moving(name, x, length, on, y=0.0, **others):
        size = osi.Dimension3d(length=length, width=2.0)
        where, speed = osi.Vector3d(x=x, y=y), osi.Vector3d(x=20.0)
        base = osi.BaseMoving(position=where, velocity=speed, dimension=size)
        ids = [osi.Identifier(value=number) for number in (name, *on)]
        return osi.MovingObject(id=ids[0], base=base, assigned_lane_id=ids[1:], **others)

    tows = {"has_trailer": True, "trailer_id": osi.Identifier(value=3)}
    truck = {"vehicle_classification": osi.MovingObject.VehicleClassification(**tows)}
    cars = [moving(1, 0.0, 4.0, [1]), moving(2, 20.0, 4.0, lanes, y=1.2)]  # which cuts in
    cars += [moving(3, 50.0, 12.0, [1]), moving(4, 57.0, 6.0, [1], **truck)]
    cars += [moving(5, 80.0, 4.0, [2], y=3.5)]
    data = osi.GroundTruth(timestamp=osi.Timestamp(seconds=1), moving_object=cars).to_binary()
    (path := tmp_path / "a.osi").write_bytes(len(data).to_bytes(4, "little") + data)
    (chunk,) = read_traces([str(path)])
    gaps = dict(zip(chunk.names, chunk.observations[:, 0].round(1).tolist(), strict=True))
    assert gaps == {"1 behind 2": 16.0, "2 behind 3": 22.0}


NO_INDEX = {"index_types": IndexType.NONE, "use_statistics": False, "use_summary_offsets": False}
LEFT_OPEN = {
    "without an index": NO_INDEX,
    "a lean summary": {"repeat_schemas": False, "repeat_channels": False},
    "without chunks": {"use_chunking": False},
}


@pytest.mark.parametrize("how", LEFT_OPEN.values(), ids=LEFT_OPEN.keys())
def test_what_mcap_leaves_open_may_be_left_out_or_there(tmp_path, how):
    path = tmp_path / "trace.mcap"
    path.write_bytes(whole := osi_mcap(enable_data_crcs=False, **how))
    assert_pair(path)
    unknown = b"\x99" + (3).to_bytes(8, "little") + b"own"
    path.write_bytes(whole[:8] + unknown + whole[8:])
    if how is NO_INDEX:  # no place is told that would have moved
        assert_pair(path)
    for end in (len(whole) - 8, len(whole) - 60):
        path.write_bytes(whole[:end])
        assert_pair(path)
        assert "it ends within a record" in refusal(path)


def test_of_a_trace_that_ends_early_the_beginning_is_read(tmp_path):
    truth, path, noted = next(osi_traces()), tmp_path / "trace.osi", Noted()
    path.write_bytes(truth[:-3])
    (chunk,) = read_traces([str(path)], noted=noted)
    assert len(chunk.times) == 4
    assert "ends within message 5" in " ".join(warnings_of(noted))
    size = int.from_bytes(truth[:4], "little") + 4
    path.write_bytes(truth[:size] + b"\2\0\0\0\x0b\0" + truth[size:])
    (chunk,) = read_traces([str(path)], noted=noted)
    assert len(chunk.times) == 5
    assert "message 2 is not ground truth" in " ".join(warnings_of(noted))


def test_osi_that_cannot_be_right_is_refused_in_words(tmp_path):
    (truth, _), path = osi_traces(), tmp_path / "trace.osi"
    for content, said in (
        (truth[:2], "ends within message 1"),
        (b"\xff\xff\xff\xff", "no trace of OSI"),
        (b"\2\0\0\0\x0b\0", "is not ground truth"),
        (next(osi_traces(length=0.0)), "object 2 is 0 m long, at (50, 0) m"),
        (next(osi_traces(x=math.nan)), "it needs a length and numbers"),
        (next(osi_traces(lane=0)), "no vehicle ever follows another one"),
        (next(osi_traces(lane=0, length=0.0, x=math.nan)), "no vehicle ever follows"),
        (b"", "no vehicle is in it (empty"),
        (b"\0\0\0\0", "such as SensorData"),
    ):
        path.write_bytes(content)
        assert said in refusal(path)
