"""Traces of ASAM OSI: bytes written by hand, and files that betterosi wrote."""

import gzip
import io
import math
import re
import struct
import subprocess
import sys
from importlib.util import find_spec

import numpy as np
import pytest

from evofsm.io.traces import read_traces

# A follower at 20 m/s behind a leader at 18 m/s, both 4 m long and heading west on lane 7, and a
# pedestrian between them. Written by a process of its own, as whoever has such a trace did.
WRITER = """
import math, sys
import betterosi as osi

def moving(name, x, vx, kind="VEHICLE"):
    return osi.MovingObject(
        id=osi.Identifier(value=name),
        base=osi.BaseMoving(
            dimension=osi.Dimension3d(length=4.0, width=2.0, height=1.5),
            position=osi.Vector3d(x=x, y=0.0, z=0.0),
            orientation=osi.Orientation3d(yaw=math.pi),
            velocity=osi.Vector3d(x=vx, y=0.0, z=0.0),
        ),
        type=getattr(osi.MovingObject.Type, kind, None) or osi.MovingObject.Type["TYPE_" + kind],
        moving_object_classification=osi.MovingObject.MovingObjectClassification(
            assigned_lane_id=[osi.Identifier(value=7)]
        ),
    )

with osi.Writer(sys.argv[1]) as writer:
    for k in range(30):
        t = 1_000_000_000 + 100_000_000 * k
        stamp = osi.Timestamp(seconds=t // 10**9, nanos=t % 10**9)
        truth = osi.GroundTruth(
            version=osi.InterfaceVersion(version_major=3, version_minor=8, version_patch=0),
            timestamp=stamp,
            moving_object=[
                moving(1, 100.0 - 2.0 * k, -20.0),
                moving(2, 50.0 - 1.8 * k, -18.0),
                moving(3, 80.0, 0.0, "PEDESTRIAN"),
            ],
        )
        view = osi.SensorView(timestamp=stamp, global_ground_truth=truth)
        writer.add(view if "view" in sys.argv[1] else truth)
"""


# -- By hand --------------------------------------------------------------------------------------


def varint(number):
    number &= (1 << 64) - 1
    out = b""
    while number > 0x7F:
        out += bytes([number & 0x7F | 0x80])
        number >>= 7
    return out + bytes([number])


def field(number, value):
    if isinstance(value, float):
        return varint(number << 3 | 1) + struct.pack("<d", value)
    if isinstance(value, int):
        return varint(number << 3) + varint(value)
    return varint(number << 3 | 2) + varint(len(value)) + value


def vector(x, y):
    return field(1, x) + field(2, y)


def moving(name, x, vx, *, kind=2, lane=7, yaw=None, length=4.0, old=False):
    base = field(1, field(1, length)) + field(2, vector(x, 0.0))
    base += b"" if yaw is None else field(3, field(3, yaw))
    base += field(4, vector(vx, 0.0))
    lanes = field(4, field(1, lane)) if old else field(9, field(1, field(1, lane)))
    return field(1, field(1, name)) + field(2, base) + field(3, kind) + lanes


def truth(k, objects):
    stamp = field(1, 5) + field(2, 100_000_000 * k)
    return field(2, stamp) + b"".join(field(5, one) for one in objects) + field(9, b"a boundary")


def trace(messages):
    return b"".join(struct.pack("<I", len(one)) + one for one in messages)


def pair(**told):
    return [
        truth(k, [moving(1, 2.0 * k, 20.0, **told), moving(2, 50.0 + 1.8 * k, 18.0, **told)])
        for k in range(5)
    ]


def rows(path):
    chunks = list(read_traces([str(path)]))
    return np.concatenate([chunk.observations for chunk in chunks])


def expected(n):
    return np.column_stack([46.0 - 0.2 * np.arange(n), np.full(n, 20.0), np.full(n, 18.0)])


@pytest.mark.parametrize("told", [{}, {"old": True}, {"yaw": 0.0}, {"kind": 1}])
def test_ground_truth_is_read(tmp_path, told):
    path = tmp_path / "trace.osi"
    path.write_bytes(trace(pair(**told)))
    assert rows(path) == pytest.approx(expected(5))


def test_sensor_views_are_known_by_what_is_in_them_and_by_their_name(tmp_path):
    views = [field(2, field(1, 0)) + field(7, one) for one in pair()]
    for name in ("trace.osi", "20260101T000000Z_sv_380_300_5_x.osi"):
        (tmp_path / name).write_bytes(trace(views))
        assert rows(tmp_path / name) == pytest.approx(expected(5))


def test_a_traffic_light_is_not_taken_for_ground_truth(tmp_path):
    light = field(7, field(1, field(1, 3)) + field(2, field(1, field(1, 0.3))))
    (tmp_path / "trace.osi").write_bytes(trace([one + light for one in pair()]))
    assert rows(tmp_path / "trace.osi") == pytest.approx(expected(5))


def test_gzipped_traces_are_read_and_pedestrians_left_out(tmp_path):
    messages = [
        truth(k, [moving(3, 20.0, 0.0, kind=3), moving(1, 0.0, 20.0), moving(2, 50.0, 18.0)])
        for k in range(3)
    ]
    with gzip.open(tmp_path / "trace.osi.gz", "wb") as file:
        file.write(trace(messages))
    assert rows(tmp_path / "trace.osi.gz")[:, 0] == pytest.approx([46.0] * 3)


def test_mcap_is_read_by_its_schema(tmp_path):
    writing = pytest.importorskip("mcap.writer")
    with (tmp_path / "trace.mcap").open("wb") as file:
        writer = writing.Writer(file)
        writer.start(profile="", library="another")
        other = writer.register_schema("osi3.SensorData", "protobuf", b"")
        schema = writer.register_schema("osi3.GroundTruth", "protobuf", b"")
        data = writer.register_channel("data", "protobuf", other)
        channel = writer.register_channel("truth", "protobuf", schema)
        for k, message in enumerate(pair()):
            writer.add_message(data, k, b"\xff", k)
            writer.add_message(channel, k, message, k)
        writer.finish()
    assert rows(tmp_path / "trace.mcap") == pytest.approx(expected(5))


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (trace(pair())[:-3], "ends within message 5"),
        (trace(pair())[:2], "ends within message 1"),
        (b"\xff\xff\xff\xff", "no trace of OSI"),
        (trace([b"\x0b\x00"]), "is not ground truth"),
        (trace([field(5, 3)]), "is not ground truth"),
        (trace([field(5, field(2, field(2, field(1, b"x"))))]), "is not ground truth"),
        (trace([truth(0, [moving(1, 0.0, 1.0, length=0.0)])]), "needs a length"),
        (trace([truth(0, [moving(1, math.nan, 1.0)])]), "needs a length, and numbers"),
        (trace([truth(0, [])]), "no object is on a lane"),
        (trace([truth(1, []), truth(0, [])]), "must run forward"),
        (b"", "no object is on a lane"),
    ],
)
def test_what_cannot_be_right_is_refused_in_words(tmp_path, content, said):
    path = tmp_path / "trace.osi"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=re.escape(str(path))) as caught:
        rows(path)
    assert said in str(caught.value)


def test_any_damage_is_an_error_with_words_or_none(tmp_path):
    whole, random = trace(pair()), np.random.default_rng(0)
    path = tmp_path / "trace.osi"
    for _ in range(200):
        damaged = bytearray(whole)
        for place in random.integers(len(whole), size=3):
            damaged[place] = random.integers(256)
        path.write_bytes(damaged)
        try:
            rows(path)
        except ValueError as error:
            assert str(path) in str(error)  # noqa: PT017 (it need not be raised)


def test_mcap_of_something_else_names_what_it_holds(tmp_path):
    writing = pytest.importorskip("mcap.writer")
    file = io.BytesIO()
    writer = writing.Writer(file)
    writer.start()
    writer.register_schema("foxglove.Log", "jsonschema", b"{}")
    writer.finish()
    (tmp_path / "a.mcap").write_bytes(file.getvalue())
    with pytest.raises(ValueError, match=r"its schemas are Log"):
        rows(tmp_path / "a.mcap")


# -- By others ------------------------------------------------------------------------------------


@pytest.mark.skipif(find_spec("betterosi") is None, reason="betterosi is not installed")
@pytest.mark.parametrize("name", ["trace.osi", "view.osi", "trace.mcap", "view.mcap"])
def test_what_betterosi_wrote_is_read(tmp_path, name):
    path = tmp_path / name
    subprocess.run([sys.executable, "-c", WRITER, str(path)], check=True)
    assert rows(path) == pytest.approx(expected(30))
