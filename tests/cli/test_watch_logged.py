"""Logs of others, watched in shadow mode, and learnt from by the command."""

import json
import subprocess
import sys
from importlib.util import find_spec

import numpy as np
import pytest

pytest.importorskip("typer")
pytest.importorskip("mcap")

from evofsm.cli.watch.logged import record_log
from evofsm.cli.watch.recording import Recording
from evofsm.io import Topics, read_run

pytestmark = pytest.mark.usefixtures("compiled")

HEADER = "id,t,x,y,vx,vy,length,lane\n"


def objects(path, rows=80):
    """Two cars at 20 m/s, of which the one ahead brakes with 5 m/s² after 4 s."""
    lines, x, v = [], 40.0, 20.0
    for k in range(rows):
        lines.append(f"ego,{0.1 * k:.1f},{2.0 * k:.2f},0,20,0,4,1")
        lines.append(f"other,{0.1 * k:.1f},{x:.3f},0,{v:.2f},0,4,1")
        x, v = x + 0.1 * v, max(0.0, v - (0.5 if k >= 40 else 0.0))
    path.write_text(HEADER + "\n".join(lines) + "\n")
    return str(path)


def bag(path):
    pytest.importorskip("rosbags")
    from rosbags.rosbag2 import Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.LATEST)
    kind = "std_msgs/msg/Float64MultiArray"
    layout = store.types["std_msgs/msg/MultiArrayLayout"]([], 0)
    with Writer(path, version=9) as writer:
        topic = writer.add_connection("/scene", kind, typestore=store)
        for k in range(60):
            values = np.array([40.0 - 0.2 * k, 72.0, 64.8])  # [m], [km/h]
            message = store.types[kind](layout, values)
            writer.write(topic, k * 100_000_000, store.serialize_cdr(message, kind))
    told = path.with_suffix(".toml")
    told.write_text(
        'interval = 0.1\n[variables]\ngap = "/scene.data[0]"\n'
        'v_follower = {field = "/scene.data[1]", unit = "km/h"}\n'
        'v_leader = {field = "/scene.data[2]", unit = "km/h"}\n'
    )
    return str(path), str(told)


# Two cars on lane 7 of OSI's ground truth, the one behind 2 m/s faster.
OSI_WRITER = """
import sys
import betterosi as osi

def moving(name, x, v):
    return osi.MovingObject(
        id=osi.Identifier(value=name),
        base=osi.BaseMoving(
            dimension=osi.Dimension3d(length=4.0, width=2.0, height=1.5),
            position=osi.Vector3d(x=x, y=0.0, z=0.0),
            orientation=osi.Orientation3d(yaw=0.0),
            velocity=osi.Vector3d(x=v, y=0.0, z=0.0),
        ),
        assigned_lane_id=[osi.Identifier(value=7)],
    )

with osi.Writer(sys.argv[1]) as writer:
    for k in range(50):
        writer.add(osi.GroundTruth(
            version=osi.InterfaceVersion(version_major=3, version_minor=8, version_patch=0),
            timestamp=osi.Timestamp(seconds=k // 10, nanos=k % 10 * 100_000_000),
            moving_object=[moving(1, 2.0 * k, 20.0), moving(2, 50.0 + 1.8 * k, 18.0)],
        ))
"""


def learn(*arguments):
    command = [sys.executable, "-m", "evofsm", "learn", *arguments, "--json"]
    done = subprocess.run(command, capture_output=True, text=True)
    return done.returncode, done.stdout, done.stderr


def test_a_guard_decides_on_each_row_and_changes_nothing(tmp_path):
    out = tmp_path / "run.mcap"
    assert not record_log(objects(tmp_path / "objects.csv"), out)
    (episode,) = read_run(out).episodes
    columns = episode.columns
    assert (columns["executed"] == columns["proposed"]).all()
    assert columns["gap"][0] == pytest.approx(36.0)
    # The leader brakes, nobody else does: in the end the guard would have.
    assert columns["advised"][60] < -2.0
    assert columns["risk_proposed"][60] > columns["risk_proposed"][0]


def test_it_is_shown_as_a_run_is(tmp_path):
    out = tmp_path / "run.mcap"
    path, topics = bag(tmp_path / "bag")
    record_log(path, out, topics=Topics.load(topics))
    recording = Recording(out)
    assert recording.start.about == "recorded in bag"
    assert not recording.revising
    frame = recording.step()
    assert frame.gap == pytest.approx(40.0)
    assert frame.v_follower == pytest.approx(20.0)
    while not frame.over:
        frame = recording.step()
    assert not frame.collided


def test_a_log_too_long_is_cut_and_one_too_short_refused(tmp_path, monkeypatch):
    path = objects(tmp_path / "objects.csv")
    monkeypatch.setattr("evofsm.cli.watch.logged.MOST_ROWS", 50)
    assert record_log(path, tmp_path / "run.mcap")
    (episode,) = read_run(tmp_path / "run.mcap").episodes
    assert len(episode.columns["time"]) == 49
    short = objects(tmp_path / "short.csv", rows=4)
    with pytest.raises(ValueError, match="nobody follows anybody for 10 rows"):
        record_log(short, tmp_path / "other.mcap")
    assert not (tmp_path / "other.mcap").exists()


@pytest.mark.slow
def test_the_command_learns_a_bag_and_a_table_of_objects(tmp_path):
    path, topics = bag(tmp_path / "bag")
    code, printed, errors = learn(path, "--topics", topics, "--checkpoint", str(tmp_path / "kept"))
    assert code == 0, errors
    assert json.loads(printed)["rows"] == 60
    # With other topics it is other work.
    (tmp_path / "bag.toml").write_text((tmp_path / "bag.toml").read_text().replace("0.1", "0.2"))
    code, _, errors = learn(path, "--topics", topics, "--checkpoint", str(tmp_path / "kept"))
    assert code == 2
    assert "is the checkpoint of other work: topics was" in errors
    code, printed, errors = learn(objects(tmp_path / "objects.csv"))
    assert code == 0, errors
    assert json.loads(printed)["episodes"] == 1


@pytest.mark.slow
@pytest.mark.skipif(find_spec("betterosi") is None, reason="betterosi is not installed")
@pytest.mark.parametrize("name", ["trace.osi", "trace.mcap"])
def test_a_trace_of_osi_that_its_library_wrote_is_learnt_from_and_watched(tmp_path, name):
    path = str(tmp_path / name)
    subprocess.run([sys.executable, "-c", OSI_WRITER, path], check=True)
    code, printed, errors = learn(path)
    assert code == 0, errors
    assert json.loads(printed)["rows"] == 50
    record_log(path, tmp_path / "run.mcap")
    recording = Recording(tmp_path / "run.mcap")
    assert recording.step().gap == pytest.approx(46.0)
