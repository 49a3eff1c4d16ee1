"""Fuzz the readers of files: `python tests/fuzz/fuzz.py [TARGET ...] --seconds 60`.

A target takes bytes as a file's content. Whatever they are, a reader answers with sound numbers or
with a `ValueError` that names the file; anything else is a finding, kept as ``/tmp/found-TARGET``.
"""

import argparse
import io
import math
import os
import random
import tempfile
import time
import warnings
from pathlib import Path

import numpy as np

CORPUS = Path(__file__).parent / "corpus"
_FILE = Path(tempfile.gettempdir()) / f"evofsm-fuzz-{os.getpid()}"
#: How each kind of file begins, so that a reader comes to see what was changed.
TARGETS = {
    **{"csv": b"", "fcd": b"<", "gzipped": b"\x1f\x8b", "parquet": b"PAR1"},
    **{"osi": b"", "mcap": b"\x89MCAP0\r\n"},
}


def tried(name, data):
    """Read a file of this content; anything but sound numbers or one clear error is raised."""
    path = _FILE.with_suffix(".osi") if name == "osi" else _FILE
    path.write_bytes(TARGETS[name] + data.removeprefix(TARGETS[name]))
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            warnings.simplefilter("ignore", ResourceWarning)  # of what an error still holds
            _read(path)
    except ValueError as error:
        if str(_FILE) not in str(error) or len(str(error)) > 2000:
            raise AssertionError(f"no short message that names the file: {error!r}") from error


def _read(path):
    from evofsm.io import read_traces

    for chunk in read_traces([str(path)]):
        rows = len(chunk.times)
        assert len(chunk.observations) == len(chunk.actions) == len(chunk.begins) == rows > 0
        assert np.isfinite(chunk.observations).all()
        assert np.isfinite(chunk.times).all()
        assert not np.isinf(chunk.actions).any()
        assert math.isnan(chunk.dt) or chunk.dt > 0.0


def seeds(name):
    """The inputs that a search begins with."""
    if name in ("osi", "mcap"):
        return list(osi_traces()) if name == "osi" else [osi_mcap()]
    return [path.read_bytes() for path in sorted((CORPUS / name).iterdir())]


def osi_messages(k, *, logical=False, **leader):
    """Ground truth, and the same in a sensor view, of one car behind another one."""
    import betterosi as osi

    def moving(name, x, vx, length=4.0, kind="VEHICLE", lane=7, yaw=0.0):
        lanes = osi.Identifier(value=lane)
        where = {"assigned_lane_id": [lanes] * bool(lane)}
        if logical:
            there = osi.LogicalLaneAssignment(assigned_lane_id=lanes, s_position=x)
            where = {"logical_lane_assignment": [there]}
        return osi.MovingObject(
            id=osi.Identifier(value=name),
            base=osi.BaseMoving(
                dimension=osi.Dimension3d(length=length, width=2.0, height=1.5),
                position=osi.Vector3d(x=x, y=0.0, z=0.0),
                orientation=osi.Orientation3d(yaw=yaw),
                velocity=osi.Vector3d(x=vx, y=0.0, z=0.0),
            ),
            type=osi.MovingObject.Type[kind],
            moving_object_classification=osi.MovingObject.MovingObjectClassification(**where),
        )

    truth = osi.GroundTruth(
        timestamp=osi.Timestamp(seconds=5, nanos=100_000_000 * k),
        moving_object=[
            moving(1, 2.0 * k, 20.0),
            moving(2, **{"x": 50.0 + 1.8 * k, "vx": 18.0, **leader}),
            moving(3, 30.0, 0.0, kind="PEDESTRIAN"),
        ],
    )
    view = osi.SensorView(timestamp=truth.timestamp, global_ground_truth=truth)
    return truth.to_binary(), view.to_binary()


def osi_traces(**leader):
    """Bytes of ``.osi`` files: ground truth and sensor views."""
    for messages in zip(*(osi_messages(k, **leader) for k in range(5)), strict=True):
        yield b"".join(len(one).to_bytes(4, "little") + one for one in messages)


def osi_mcap(kind="GroundTruth", place=0, **how):
    """Bytes of such messages in MCAP, beside all that may stand there; options of its writer."""
    from mcap.writer import Writer

    file = io.BytesIO()
    writer = Writer(file, **how)
    writer.start(profile="", library="another")
    schema = writer.register_schema(f"osi3.{kind}", "protobuf", b"")
    other = writer.register_schema("foxglove.Log", "jsonschema", b"{}")
    data = writer.register_channel("data", "json", other)
    channel = writer.register_channel("truth", "protobuf", schema)
    writer.add_attachment(0, 0, "picture", "image/png", b"\xff" * 99)
    writer.add_metadata("drive", {"driver": "none"})
    for k in range(5):
        writer.add_message(data, k, b"\xff", k)
        writer.add_message(channel, k, osi_messages(k)[place], k)
    writer.finish()
    return file.getvalue()


def search(name, seconds, found):
    """Change the seeds at random until one finds something, which is kept; answers executions."""
    draw, known, done = random.Random(0), seeds(name), 0
    ends, kept = time.monotonic() + seconds, Path(found) / f"found-{name}"
    while time.monotonic() < ends:
        kept.write_bytes(data := mutated(draw, known))
        tried(name, data)
        done += 1
    for path in (kept, _FILE, _FILE.with_suffix(".osi")):
        path.unlink(missing_ok=True)
    return done


def mutated(draw, known):
    """One of the known inputs, changed in a few places; sometimes with a part of another."""
    data = bytearray(draw.choice(known))
    for _ in range(draw.randint(1, 4)):
        at, length = draw.randint(0, len(data)), draw.choice([0, 1, 1, 2, 8, 40])
        other = draw.choice(known)
        begin = draw.randint(0, len(other))
        sign = draw.choice([b",", b"\n", b'"', b"<", b"nan", b"1e308", b"-0", b"\x00", b"\xff"])
        noise = bytes(draw.choices(range(256), k=length))
        again = bytes(data[at : at + length]) * draw.choice([2, 100])
        part = other[begin : begin + draw.choice([4, 40, 400])]
        data[at : at + length] = draw.choice([b"", noise, sign, again, part])
    return bytes(data)


def main():
    """Fuzz the targets that are named, or all."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("targets", nargs="*", default=list(TARGETS), help=", ".join(TARGETS))
    parser.add_argument("--seconds", type=int, default=60, help="for each target")
    asked = parser.parse_args()
    for name in asked.targets:
        done = search(name, asked.seconds, tempfile.gettempdir())
        print(f"{name}: {done:,} executions in {asked.seconds} s find nothing")


if __name__ == "__main__":
    main()
