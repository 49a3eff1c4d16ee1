"""What a line may hold; anything else is refused by a sentence that names the key."""

import json
import math

import hypothesis.strategies as st
import pytest
from hypothesis import given

from evofsm import Guard
from evofsm.cli.monitor.messages import End, Form, MessageError, Row
from evofsm.driving import guard_for_cars
from monitor_rows import JUNK

FORM = Form(guard_for_cars(-6.0, 2.5))
ROW = {"time": 1.0, "gap": 30.0, "v_follower": 20.0, "v_leader": 18.0, "proposal": 0.5}
EGO = {"x": 100.0, "lane": 0, "vx": 20.0, "length": 5.0}
TRUCK = {"id": "truck", "x": 150.0, "lane": 0, "vx": 15.0, "length": 15.0}


def line(**changed):
    return json.dumps({name: v for name, v in (ROW | changed).items() if v is not ...}).encode()


def scene(*objects, **ego):
    told = {"time": 2.0, "ego": EGO | ego, "objects": list(objects), "proposal": 0.0}
    return json.dumps(told).encode()


def refused(form, message):
    with pytest.raises(MessageError) as error:
        form.read(message)
    return error.value.about, str(error.value)


def test_a_row_is_read_to_the_last_bit():
    assert FORM.read(line(gap=0.1 + 0.2)) == Row(1.0, (0.1 + 0.2, 20.0, 18.0), 0.5)
    assert FORM.read(b"\xef\xbb\xbf" + line(gap=0.1 + 0.2)) == FORM.read(line(gap=0.1 + 0.2))
    assert FORM.read(line(schema=1, gap=None, proposal=None)) == Row(1.0, (None, 20.0, 18.0), None)


@pytest.mark.parametrize(
    ("changed", "about", "what"),
    [
        ({"time": ...}, "time", "is missing"),
        ({"time": None}, "time", "is null; it must be float"),
        ({"gap": ...}, "gap", "is missing; a variable that was not seen is null"),
        ({"gap": "near"}, "gap", 'is "near"; it must be float or null'),
        ({"gap": 1e101}, "gap", "is 1e+101; it must be float <= 1e+100"),
        ({"gap": 10**400}, "gap", "is too large"),
        ({"gap": math.nan}, "line", "holds NaN, which is no JSON; a number that was not"),
        ({"proposal": ...}, "proposal", "is missing: what the controller wants to do"),
        ({"speed": 3.0}, "speed", "is not known; known are gap, proposal, schema, time, v_foll"),
        ({"schema": 2}, "schema", "is 2; this monitor knows version 1 alone"),
        ({"end": True}, "proposal", "is not known; known are end, failed, gap, schema, time"),
        ({"objects": []}, "gap", "is not known; known are ego, objects"),
    ],
)
def test_what_is_no_row_is_named(changed, about, what):
    key, text = refused(FORM, line(**changed))
    assert key == about
    assert what in text


@pytest.mark.parametrize(
    "junk",
    [*JUNK[:6], b"   ", b"3", b'"text"', b'{"time": 1} {"time": 2}', b"[" * 50_000, b"9" * 5000],
)
def test_junk_is_refused_as_a_line(junk):
    assert refused(FORM, junk)[0] == "line"


def test_a_key_that_is_there_twice_is_named():
    twice = line().replace(b'"gap"', b'"gap": 1, "gap"')
    assert refused(FORM, twice) == ("gap", "is there 2 times; which of them counts?")
    assert refused(FORM, scene(TRUCK).replace(b'"vx"', b'"id": 1, "vx"'))[0] == "id"


def test_the_time_of_what_is_refused_is_told_where_it_can_be_read():
    wrongs = (line(gap="near"), 1.0), (line(time="noon"), None), (scene(3), 2.0)
    in_ms = Form(guard_for_cars(-6.0, 2.5), unit="ms"), line(time=1500, gap="near"), 1.5
    for form, wrong, time in (*((FORM, *wrong) for wrong in wrongs), in_ms):
        with pytest.raises(MessageError) as error:
            form.read(wrong)
        assert error.value.time == time


def test_an_end():
    last = {name: ROW[name] for name in FORM.variables}
    ended = {"end": True, "failed": True, **last}
    assert FORM.read(json.dumps(ended).encode()) == End(True, (30.0, 20.0, 18.0))
    assert FORM.read(b'{"end": true}') == End(False)
    assert refused(FORM, b'{"end": false}') == ("end", "is false; it must be true")
    assert refused(FORM, b'{"end": 1}') == ("end", "is 1; it must be bool")
    assert refused(FORM, b'{"end": true, "failed": 0}')[0] == "failed"
    assert refused(FORM, b'{"end": true, "gap": 3}')[0] == "v_follower"


def test_variables_without_names_come_as_a_list():
    form = Form(Guard(low=-1.0, high=1.0, interval=0.1))
    row = form.read(b'{"time": 0, "observation": [1, null], "proposal": 0}')
    assert row == Row(0.0, (1.0, None), 0.0)
    for wrong, place in (([], ""), (3, ""), ({"x": 1}, ""), ([1, "x"], "[1]")):
        message = json.dumps({"time": 0, "proposal": 0, "observation": wrong}).encode()
        assert refused(form, message)[0] == f"observation{place}"


def test_actions_that_are_vectors_or_indices():
    box = Form(Guard(low=[-1.0, 0.0], high=[1.0, 2.0], interval=0.1))
    few = Form(Guard(n_actions=3, interval=0.1))

    def sent(proposal):
        return b'{"time": 0, "observation": [1], "proposal": ' + proposal + b"}"

    assert box.read(sent(b"[1, 2]")).proposal == (1.0, 2.0)
    assert refused(box, sent(b"1")) == ("proposal", "is 1; it must be array or null")
    assert refused(box, sent(b"[1]")) == ("proposal", "is [1]; it must be array of length >= 2")
    assert refused(box, sent(b"[1, null]"))[0] == "proposal[1]"
    assert few.read(sent(b"2")).proposal == few.read(sent(b"[2]")).proposal == 2
    assert refused(few, sent(b"3")) == ("proposal", "is 3; it must be int <= 2")
    for wrong in (b"-1", b"1.0", b"true"):
        assert refused(few, sent(wrong))[0] == "proposal"


def test_a_scene_is_the_nearest_object_ahead_in_the_lane():
    beside = TRUCK | {"id": 2, "x": 120.0, "lane": 1}
    behind = TRUCK | {"id": 3, "x": 80.0}
    further = TRUCK | {"id": 4, "x": 190.0}
    row = FORM.read(scene(beside, behind, further, TRUCK))
    assert row == Row(2.0, (40.0, 20.0, 15.0), 0.0, "truck")
    for lane in (str(EGO["lane"]), float(EGO["lane"])):
        assert FORM.read(scene(beside, TRUCK, lane=lane)) == row
    assert FORM.read(scene()) == Row(2.0, None, 0.0)
    ego = {"x": 0.0, "y": 0.0, "vx": 20.0, "length": 5.0}
    one = {"id": 1, "x": 30.0, "y": 1.0, "vx": 15.0, "length": 5.0, "width": 2.0}
    told = {"time": 0, "ego": ego, "objects": [one, one | {"id": 2, "x": 20.0, "y": 3.5}]}
    assert FORM.read(json.dumps(told | {"proposal": 0}).encode()).ahead == 1


@pytest.mark.parametrize(
    ("changed", "about"),
    [
        ({"x": ...}, "objects[1].x"),
        ({"id": [1]}, "objects[1].id"),
        ({"id": "x" * 99}, "objects[1].id"),
        ({"vx": "fast"}, "objects[1].vx"),
        ({"length": -4.0}, "objects[1].length"),
        ({"vx": 1e18}, "objects[1].vx"),
        ({"lane": ...}, "objects[1].y"),
        ({"colour": "red"}, "objects[1].colour"),
    ],
)
def test_what_is_wrong_with_an_object_is_named(changed, about):
    wrong = {name: value for name, value in (TRUCK | changed).items() if value is not ...}
    assert refused(FORM, scene(TRUCK, wrong))[0] == about


def test_what_is_wrong_with_a_scene_is_named():
    assert refused(FORM, b'{"time": 0, "objects": [], "proposal": 0}')[0] == "ego"
    assert refused(FORM, b'{"time": 0, "ego": {}, "objects": {}, "proposal": 0}')[0] == "ego.x"
    assert refused(FORM, scene(TRUCK, vx=-20.0))[0] == "ego.vx"
    assert refused(FORM, scene(TRUCK).replace(b": 2.0", b": 2e12", 1))[0] == "time"  # in ms
    assert refused(FORM, scene(3)) == ("objects[0]", "is 3; it must be object")
    assert refused(Form(Guard(low=-1.0, high=1.0, interval=0.1)), scene(TRUCK))[0] == "objects"


SOME = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=3), inner),
    max_leaves=5,
)
KEYS = st.sampled_from([*ROW, "schema", "ego", "objects", "end", "failed", "x", "lane", "id"])


def understood(message):
    try:
        return isinstance(FORM.read(message), Row | End)
    except MessageError as error:
        return bool(error.about) and "\n" not in str(error)


@given(st.binary(max_size=60), st.dictionaries(KEYS, SOME))
def test_any_bytes_and_any_json_are_refused_or_understood(junk, changed):
    assert understood(junk)
    assert understood(json.dumps(ROW | changed).encode())
    assert understood(json.dumps(changed).encode())
    told = {"time": 0, "proposal": 0, "ego": EGO | changed, "objects": [TRUCK, TRUCK | changed]}
    assert understood(json.dumps(told).encode())
