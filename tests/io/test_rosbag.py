"""Bags of ROS 2 that the library rosbags wrote, read as rows of one clock."""

import re
import shutil
import sqlite3
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from mcap.writer import Writer as McapWriter
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore
from tests.io.test_logs import refusal

from evofsm.cli.learning import warnings_of
from evofsm.io.logs import LogColumns, Noted, read_traces
from evofsm.io.rosbag import Field, Topics

STORE = get_typestore(Stores.LATEST)
EGO, OTHER = "/ego/odometry", "/other/odometry"
SECOND = 1_000_000_000
SQLITE, MCAP = StoragePlugin.SQLITE3, StoragePlugin.MCAP
PLAIN, COMPRESSED = CompressionMode.NONE, CompressionMode.MESSAGE
PACKED = CompressionMode.FILE
TOLD = {
    "interval": 0.1,
    "oldest": 0.5,
    "variables": {
        "gap": {
            "field": f"{OTHER}.pose.pose.position.x",
            "minus": f"{EGO}.pose.pose.position.x",
            "offset": -5.0,
        },
        "v_follower": f"{EGO}.twist.twist.linear.x",
        "v_leader": f"{OTHER}.twist.twist.linear.x",
    },
}


def odometry(x, v, at=0):
    t = STORE.types
    vector, covariance, none = t["geometry_msgs/msg/Vector3"], np.zeros(36), (0.0, 0.0, 0.0)
    stamp = t["builtin_interfaces/msg/Time"](at // SECOND, at % SECOND)
    point = t["geometry_msgs/msg/Point"](x, 0.0, 0.0)
    pose = t["geometry_msgs/msg/Pose"](point, t["geometry_msgs/msg/Quaternion"](*none, 1.0))
    twist = t["geometry_msgs/msg/Twist"](vector(v, 0.0, 0.0), vector(*none))
    return t["nav_msgs/msg/Odometry"](
        t["std_msgs/msg/Header"](stamp, "map"),
        "car",
        t["geometry_msgs/msg/PoseWithCovariance"](pose, covariance),
        t["geometry_msgs/msg/TwistWithCovariance"](twist, covariance),
    )


def write(path, messages, plugin=SQLITE, mode=PLAIN, foreign=()):
    """Messages are (time [s], topic, message); foreign topics hold what nobody understands."""
    writer = Writer(path, version=9, storage_plugin=plugin)
    writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        topics = {}
        for time, topic, message in sorted(messages, key=lambda one: one[0]):
            kind = message.__msgtype__
            if topic not in topics:
                topics[topic] = writer.add_connection(topic, kind, typestore=STORE)
            data = STORE.serialize_cdr(message, kind)
            writer.write(topics[topic], round((100.0 + time) * SECOND), data)
        for number, (kind, definition, packed) in enumerate(foreign):
            of_kind = {"msgdef": definition, "rihs01": f"RIHS01_{number:064}"}
            where = writer.add_connection(
                f"/{number}/_service_event", kind, serialization_format=packed, **of_kind
            )
            writer.write(where, 100 * SECOND, b"\xff")
    return str(path)


def drive(seconds=2.0):
    """The leader at 10 Hz, the follower at 20 Hz and a little later."""
    found = [(0.1 * k, OTHER, odometry(50.0 + 1.8 * k, 18.0)) for k in range(round(10 * seconds))]
    return found + [
        (0.05 * k + 0.01, EGO, odometry(1.0 * k, max(20.0 - 0.05 * k, 0.0)))
        for k in range(round(20 * seconds))
    ]


def read(path, told=TOLD, noted=None, **columns):
    return list(read_traces([path], LogColumns(topics=Topics.of(told), **columns), noted))


def refused(path, **variables):
    """What is said where these variables are read, and the others as usual."""
    return refusal(path, topics=Topics.of({"variables": TOLD["variables"] | variables}))


@pytest.mark.parametrize(
    ("plugin", "mode"), [(SQLITE, PLAIN), (SQLITE, COMPRESSED), (SQLITE, PACKED), (MCAP, PLAIN)]
)
def test_rows_hold_the_latest_values_before_them(tmp_path, plugin, mode):
    path = write(tmp_path / "bag", drive(), plugin, mode)
    (chunk,) = read(path)
    assert chunk.times[:3] == pytest.approx([0.1, 0.2, 0.3])  # at 0 s the follower is not known
    # At 0.1 s the follower was heard of at 0.06 s last, and the leader at 0.1 s.
    assert chunk.observations[0] == pytest.approx([50.0 + 1.8 - 1.0 - 5.0, 19.95, 18.0])
    assert chunk.actions[0] == pytest.approx(-1.0)
    assert np.isnan(chunk.actions[-1])
    assert (np.flatnonzero(chunk.begins).tolist(), chunk.dt) == ([0], pytest.approx(0.1))
    (file,) = (one for one in (tmp_path / "bag").iterdir() if one.suffix != ".yaml")
    if mode is PACKED:
        file.unlink()
        with pytest.raises(FileNotFoundError, match=re.escape(file.name)):
            read(path)
        return
    assert (read(str(file))[0].observations == chunk.observations).all()  # without its folder


@pytest.mark.parametrize("plugin", [SQLITE, MCAP])
def test_topics_that_nobody_asked_for_may_hold_anything(tmp_path, plugin):
    foreign = [
        ("own/msg/Own", "float64 x\nown/Other y\n", "cdr"),
        ("own/msg/Idl", "module own { nonsense <<< };", "cdr"),
        ("own/srv/Do_Event", "service_msgs/ServiceEventInfo info\n", "cdr"),
        ("own/msg/Empty", "", "json"),
        ("nav_msgs/msg/Odometry", "wstring what\n", "cdr"),  # of another version
    ]
    path = write(tmp_path / "bag", drive(), plugin, foreign=foreign)
    (plain,) = read(write(tmp_path / "plain", drive(), plugin))
    (file,) = (one for one in (tmp_path / "bag").iterdir() if one.suffix != ".yaml")
    for place in (path, str(file)):
        assert (read(place)[0].observations == plain.observations).all()
    assert "are packed as json, not as CDR" in refused(path, gap="/3/_service_event.x")
    bare = McapWriter(path := str(tmp_path / "bare.mcap"))
    bare.start("ros2")
    bare.add_message(bare.register_channel("/gap", "cdr", 0), 0, bytes(12), 0)
    bare.finish()
    assert "messages of '/gap' have no schema" in refused(path, gap="/gap.data")


def test_what_is_too_old_is_a_hole_in_time(tmp_path):
    silent = [one for one in drive(4.0) if one[1] == EGO or not 1.05 < one[0] < 2.95]
    (chunk,) = read(write(tmp_path / "bag", silent))
    assert chunk.times[chunk.begins] == pytest.approx([0.1, 3.0])
    assert chunk.times[:-1][chunk.begins[1:]] == pytest.approx(1.5)  # 0.5 s after the last message
    assert np.isnan(chunk.actions[:-1][chunk.begins[1:]]).all()
    assert chunk.jumps == 1
    apart = [one for one in drive(4.0) if (one[0] > 3.0 if one[1] == EGO else one[0] < 1.0)]
    assert "at no time are all variables known" in refused(write(tmp_path / "apart", apart))


def test_units_offsets_and_places_in_arrays(tmp_path):
    array = STORE.types["std_msgs/msg/Float64MultiArray"]
    layout = STORE.types["std_msgs/msg/MultiArrayLayout"]([], 0)
    messages = [(0.1 * k, "/n", array(layout, np.array([36.0, 7.2]))) for k in range(5)]
    path = write(tmp_path / "bag", messages)
    variables = {
        "v_follower": {"field": "/n.data[0]", "unit": "km/h"},
        "v_leader": {"field": "/n.data[1]", "unit": "km/h"},
        "gap": {"field": "/n.data[0]", "unit": "km/h", "offset": -8.0},
    }
    (chunk,) = read(path, {"variables": variables})
    assert chunk.observations[0] == pytest.approx([2.0, 10.0, 2.0])
    assert chunk.actions[:-1] == pytest.approx(np.zeros(len(chunk.times) - 1))
    for way, said in (
        ("/n.data[2]", "row 1, column 'gap': nan cannot be learnt"),
        ("/n.layout", "no number in message"),
        ("/m.x", "no topic '/m'; it has /n"),
    ):
        assert said in refused(path, **variables | {"gap": way})
    beyond = {"variables": variables | {"gap": "/n.data[2]"}}
    with pytest.raises(ValueError, match="no row is left; gap, v_follower"):
        read(path, beyond, no_leader="end")
    with pytest.raises(ValueError, match="have no header"):
        read(path, {"variables": variables, "stamp": "header"})


@pytest.mark.parametrize("plugin", [SQLITE, MCAP])
@pytest.mark.parametrize(("rate", "warns"), [(1.0, False), (0.5, True), (2.0, True)])
def test_two_clocks_of_different_rates_are_told(tmp_path, plugin, rate, warns):
    """As of a simulation at half the speed, or of a bag that was played at double speed."""
    messages = [
        (0.1 * k / rate, topic, odometry(x + v * 0.1 * k, v, round(0.1 * k * SECOND)))
        for k in range(60)
        for topic, x, v in ((OTHER, 50.0, 18.0), (EGO, 0.0, 20.0))
    ]
    path, noted = write(tmp_path / "bag", messages, plugin), Noted()
    read(path, noted=noted)
    told = " ".join(warnings_of(noted))
    assert (f"span 5.9 s by their headers, and {5.9 / rate:.3g} s as recorded" in told) == warns
    if warns:
        way = re.search('stamp = "(header)" in the file of --topics', told)[1]
        noted = Noted()
        (chunk,) = read(path, TOLD | {"stamp": way}, noted)
        assert np.diff(chunk.observations[:, 0]) == pytest.approx(-0.2)
        assert (chunk.dt, warnings_of(noted)) == (0.1, [])


def test_what_has_a_name_in_a_message_is_known_by_it(tmp_path):
    """Joints and frames come in any order, and not all of them each time."""
    types, none, header = STORE.types, np.zeros(0), odometry(0.0, 0.0).header
    joints, transforms = types["sensor_msgs/msg/JointState"], types["tf2_msgs/msg/TFMessage"]
    kinds = "Vector3", "Quaternion", "Transform", "TransformStamped"
    vector, turned, moved, stamped = (types[f"geometry_msgs/msg/{kind}"] for kind in kinds)
    messages = []
    for k in range(40):
        names, values = ["gap", "own"], [float(k), 100.0]
        if k % 3 == 1:
            names, values = names[::-1], values[::-1]
        if k % 3 == 2:
            names, values = ["hand"], [-1.0]
        state = joints(header, names, np.array(values), none, none)
        there = [
            stamped(header, name, moved(vector(x, 0.0, 0.0), turned(0.0, 0.0, 0.0, 1.0)))
            for name, x in zip(names, values, strict=True)
        ]
        messages += [(0.1 * k, "/joints", state), (0.1 * k, "/tf", transforms(there))]
    path = write(tmp_path / "bag", messages)
    frame = "/tf.transforms[{}].transform.translation.x".format
    for gap in ("/joints.position[0]", "/joints.position[gap]", frame("0"), frame("gap")):
        told = {"gap": gap, "v_follower": gap.replace("gap", "own").replace("[0]", "[1]")}
        (chunk,) = read(path, {"variables": told | {"v_leader": frame("own")}})
        held = [k - (k % 3 == 2) for k in range(40)]
        assert chunk.observations[:, 0].tolist() == held
        assert (chunk.observations[:, 1:] == 100.0).all()
    feet = dict.fromkeys(TOLD["variables"], "/joints.position[foot]")
    assert "no messages with /joints.position[foot]" in refused(path, **feet)


def test_of_mcap_that_ends_early_the_beginning_is_read_and_of_sqlite_nothing(tmp_path):
    (whole,) = read(write(tmp_path / "bag", drive(60.0), MCAP))
    (path,), noted = (tmp_path / "bag").glob("*.mcap"), Noted()
    path.write_bytes(path.read_bytes()[: path.stat().st_size * 9 // 10])
    (chunk,) = read(str(path), noted=noted)
    assert 5 < len(chunk.times) < len(whole.times)
    assert (chunk.observations == whole.observations[: len(chunk.times)]).all()
    assert "it ends within a record" in " ".join(warnings_of(noted))
    path.write_bytes(path.read_bytes()[:3000])
    with pytest.raises(ValueError, match=r"byte .*: it ends .* before .* it has no message"):
        read(str(path))
    (path,) = Path(write(tmp_path / "other", drive())).glob("*.db3")
    path.write_bytes(path.read_bytes()[:20_000])
    assert "cannot be read as a bag of ROS 2" in refused(str(path))


def test_an_action_may_be_mapped_and_failures_be_told_of_by_a_comparison(tmp_path):
    told = {**TOLD, "variables": {**TOLD["variables"], "a_follower": "/cmd.twist.twist.linear.x"}}
    replies = [(0.1 * k + 0.001, "/cmd", odometry(0.0, float(k))) for k in range(20)]  # to each row
    path = write(tmp_path / "bag", [*drive(), *replies])
    (chunk,) = read(path, told, failed="gap<=44")
    assert chunk.actions == pytest.approx(10.0 * chunk.times)
    assert chunk.fails.sum() == 1
    touch = 1.98, OTHER, odometry(0.0, 0.0)  # with which the recording ends
    (chunk,) = read(write(tmp_path / "touch", [*drive(), touch]), failed="gap<0")
    assert np.flatnonzero(chunk.fails).tolist() == [len(chunk.times) - 1]


@pytest.mark.parametrize("left", ["", "-shm"])
def test_what_a_recorder_that_was_killed_left_beside_its_file_is_read(tmp_path, left):
    (file,) = Path(write(tmp_path / "bag", drive())).glob("*.db3")
    with closing(sqlite3.connect(file)) as bag:  # as rosbag2's storage preset "resilient"
        bag.execute("PRAGMA journal_mode=wal")
        bag.execute("DELETE FROM messages WHERE timestamp > ?", (101 * SECOND,))
        bag.commit()
        for ending in {"", "-wal", left}:
            shutil.copy(f"{file}{ending}", tmp_path)
    there = {*tmp_path.iterdir()}
    assert read(str(tmp_path / file.name))[0].times[-1] == pytest.approx(1.0)
    assert {*tmp_path.iterdir()} == there


@pytest.mark.parametrize(
    ("told", "said"),
    [
        ({}, "missing required field `variables`"),
        ({"variables": {}}, "length >= 1"),
        ({"variables": {"gap": "/a.x"}, "rate": 3}, "unknown field `rate`"),
        ({"variables": {"gap": {"field": "/a.x", "unit": "furlong"}}}, "unit is 'furlong'"),
        ({"variables": {"gap": {"field": "/a.x", "offset": float("inf")}}}, "offset"),
        ({"variables": {"gap": "/a"}}, "variable gap: '/a' is no field"),
        ({"variables": {"gap": "/a.x"}, "interval": 0}, "interval"),
    ],
)
def test_a_map_that_says_something_else_is_refused(told, said):
    with pytest.raises(ValueError, match=re.escape(said)):
        Topics.of(told)


def test_a_file_of_topics_is_named_where_it_is_wrong(tmp_path):
    path = tmp_path / "topics.toml"
    path.write_text("interval = \n")
    with pytest.raises(ValueError, match=re.escape(str(path))):
        Topics.load(path)
    assert Field.parse("/a.b[2][0].c[x/y.z]").steps == ("b", (2,), (0,), "c", ("x/y.z",))
