import json

import hypothesis.strategies as st
import pytest
from hypothesis import given

from evofsm.cli.monitor.schema import LONGEST, End, Form, MessageError, Row
from evofsm.driving.cars import guard_for_cars
from evofsm.guard.guard import Guard

FORM = Form.of(guard_for_cars(-6.0, 2.5))
ROW = {"time": 1.0, "gap": 30.0, "v_follower": 20.0, "v_leader": 18.0, "proposal": 0.5}
EGO = {"s": 100.0, "lane": 0, "vx": 20.0, "length": 5.0}
TRUCK = {"id": "truck", "s": 150.0, "lane": 0, "vx": 15.0, "length": 15.0}


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
    assert FORM.read(line(schema=1, gap=None, proposal=None)) == Row(1.0, (None, 20.0, 18.0), None)


@pytest.mark.parametrize(
    ("changed", "about"),
    [
        ({"time": ...}, "time"),
        ({"time": None}, "time"),
        ({"time": True}, "time"),
        ({"gap": ...}, "gap"),
        ({"gap": "near"}, "gap"),
        ({"gap": [3.0]}, "gap"),
        ({"gap": 1e101}, "gap"),
        ({"gap": 10**400}, "gap"),
        ({"v_leader": False}, "v_leader"),
        ({"proposal": ...}, "proposal"),
        ({"proposal": "brake"}, "proposal"),
        ({"speed": 3.0}, "speed"),
        ({"schema": 2}, "schema"),
        ({"schema": 1.0}, "schema"),
        ({"schema": True}, "schema"),
        ({"end": True}, "proposal"),
        ({"objects": []}, "gap"),
    ],
)
def test_what_is_no_row_is_named(changed, about):
    assert refused(FORM, line(**changed))[0] == about


def test_another_version_says_which_is_known():
    assert refused(FORM, line(schema=2)) == ("schema", "is 2; this monitor knows version 1 alone")


@pytest.mark.parametrize(
    "junk",
    [
        b"",
        b"   ",
        b"nonsense",
        b"[1, 2]",
        b"3",
        b"null",
        b'"text"',
        b'{"time": NaN}',
        b'{"time": 1',
        b"\xff\xfe\x00",
        b'{"time": 1} {"time": 2}',
        b"[" * 50_000,
        b'{"a":' * 10_000,
        b"9" * 5000,
        b"x" * (LONGEST + 1),
    ],
)
def test_junk_is_refused_as_a_line(junk):
    assert refused(FORM, junk)[0] == "line"


def test_a_key_that_is_there_twice_is_refused():
    assert refused(FORM, b'{"time": 1, "time": 2}') == ('"time"', "is there twice")


def test_a_number_that_overflows_is_no_number():
    assert refused(FORM, line().replace(b"30.0", b"1e999"))[0] == "gap"


def test_the_time_of_what_is_refused_is_told_where_it_can_be_read():
    with pytest.raises(MessageError) as error:
        FORM.read(line(gap="near"))
    assert error.value.time == 1.0
    with pytest.raises(MessageError) as error:
        FORM.read(line(time="noon"))
    assert error.value.time is None


def test_a_proposal_may_be_taken_for_granted():
    form = Form.of(guard_for_cars(-6.0, 2.5), proposal=0.0)
    assert form.read(line(proposal=...)).proposal == 0.0
    assert form.read(line(proposal=1.0)).proposal == 1.0


def test_an_end():
    last = {name: ROW[name] for name in FORM.variables}
    ended = {"end": True, "failed": True, **last}
    assert FORM.read(json.dumps(ended).encode()) == End(True, (30.0, 20.0, 18.0))
    assert FORM.read(b'{"end": true}') == End(False)
    assert refused(FORM, b'{"end": 1}')[0] == "end"
    assert refused(FORM, b'{"end": true, "failed": 0}')[0] == "failed"
    assert refused(FORM, b'{"end": true, "gap": 3}')[0] == "v_follower"


# -- Guards of other systems ----------------------------------------------------------------------


def test_variables_without_names_come_as_a_list():
    form = Form.of(Guard(low=-1.0, high=1.0, interval=0.1))
    assert form.read(b'{"time": 0, "observation": [1, null], "proposal": 0}') == Row(
        0.0, (1.0, None), 0.0
    )
    for observation in (b"[]", b"3", b'{"x": 1}'):
        message = b'{"time": 0, "proposal": 0, "observation": ' + observation + b"}"
        assert refused(form, message)[0] == "observation"
    message = b'{"time": 0, "proposal": 0, "observation": [1, "x"]}'
    assert refused(form, message)[0] == "observation[1]"


def test_actions_that_are_vectors_or_indices():
    box = Form(("x",), 1, components=2)
    assert box.read(b'{"time": 0, "x": 1, "proposal": [1, 2]}').proposal == (1.0, 2.0)
    assert refused(box, b'{"time": 0, "x": 1, "proposal": 1}')[0] == "proposal"
    assert refused(box, b'{"time": 0, "x": 1, "proposal": [1, null]}')[0] == "proposal[1]"
    few = Form(("x",), 1, n_actions=3)
    assert few.read(b'{"time": 0, "x": 1, "proposal": 2}').proposal == 2
    for wrong in (b"3", b"-1", b"1.0", b"true"):
        message = b'{"time": 0, "x": 1, "proposal": ' + wrong + b"}"
        assert refused(few, message)[0] == "proposal"


# -- Scenes ---------------------------------------------------------------------------------------


def test_a_scene_is_the_nearest_object_ahead_in_the_lane():
    beside = TRUCK | {"id": 2, "s": 120.0, "lane": 1}
    behind = TRUCK | {"id": 3, "s": 80.0}
    further = TRUCK | {"id": 4, "s": 190.0}
    row = FORM.read(scene(beside, behind, further, TRUCK))
    assert row == Row(2.0, (40.0, 20.0, 15.0), 0.0, "truck")


def test_nothing_ahead_is_no_observation():
    assert FORM.read(scene()) == Row(2.0, None, 0.0)


def test_lanes_may_be_told_by_where_they_are():
    ego = {"x": 0.0, "y": 0.0, "vx": 20.0, "length": 5.0}
    one = {"id": 1, "x": 30.0, "y": 1.0, "vx": 15.0, "length": 5.0, "width": 2.0}
    told = {"time": 0, "ego": ego, "objects": [one, one | {"id": 2, "x": 20.0, "y": 3.5}]}
    assert FORM.read(json.dumps(told | {"proposal": 0}).encode()).ahead == 1


@pytest.mark.parametrize(
    ("changed", "about"),
    [
        ({"s": ...}, "objects[1].s"),
        ({"id": ...}, "objects[1].id"),
        ({"id": [1]}, "objects[1].id"),
        ({"id": "x" * 99}, "objects[1].id"),
        ({"vx": "fast"}, "objects[1].vx"),
        ({"length": ...}, "objects[1].length"),
        ({"lane": ...}, "objects[1].lane"),
        ({"colour": "red"}, "objects[1].colour"),
    ],
)
def test_what_is_wrong_with_an_object_is_named(changed, about):
    wrong = {name: value for name, value in (TRUCK | changed).items() if value is not ...}
    assert refused(FORM, scene(TRUCK, wrong))[0] == about


def test_what_is_wrong_with_a_scene_is_named():
    assert refused(FORM, b'{"time": 0, "objects": [], "proposal": 0}')[0] == "ego"
    assert refused(FORM, b'{"time": 0, "ego": {}, "objects": {}, "proposal": 0}')[0] == "objects"
    assert refused(FORM, scene(3))[0] == "objects[0]"
    other = Form(("temperature",), 1)
    assert refused(other, scene(TRUCK))[0] == "objects"


def test_fifty_objects_fit_on_a_line():
    objects = [
        TRUCK | {"id": f"vehicle {k:03}", "s": 123.456789 + k, "vy": 0.123456789, "width": 2.55}
        for k in range(50)
    ]
    assert len(scene(*objects)) < LONGEST / 4


# -- Anything at all ------------------------------------------------------------------------------

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


@given(st.binary(max_size=60))
def test_any_bytes_are_refused_or_understood(junk):
    assert understood(junk)


@given(st.dictionaries(KEYS, SOME))
def test_any_json_is_refused_or_understood(changed):
    assert understood(json.dumps(ROW | changed).encode())
    assert understood(json.dumps(changed).encode())
    told = {"time": 0, "proposal": 0, "ego": EGO | changed, "objects": [TRUCK, TRUCK | changed]}
    assert understood(json.dumps(told).encode())
