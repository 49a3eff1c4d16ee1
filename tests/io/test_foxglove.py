"""A guard shown in Foxglove: what the file and the socket of Foxglove's own library carry."""

import json
import re
import struct
import threading
import time

import numpy as np
import pytest

pytest.importorskip("foxglove")
pytest.importorskip("mcap")

from mcap.reader import make_reader

from evofsm.driving import DECISION_COLUMNS, guard_for_cars
from evofsm.guard import Guard
from evofsm.io import channels, read_run, write_run
from evofsm.io.foxglove import FOXGLOVE_LAYOUT, FoxgloveSink

pytestmark = pytest.mark.usefixtures("compiled")

ROWS = [[30.0 - 2.0 * k, 20.0, 12.0] for k in range(8)]


def drive(guard):
    for observation in ROWS:
        guard.decide(observation, proposal=1.0)
    guard.end(failed=True, observation=[-0.1, 20.0, 12.0])


def messages(path):
    found = {}
    with path.open("rb") as file:
        for _, channel, message in make_reader(file).iter_messages():
            found.setdefault(channel.topic, []).append((message.log_time, json.loads(message.data)))
    return found


def test_a_file_holds_every_decision_and_what_happened(tmp_path):
    guard = guard_for_cars(low=-4.0, high=2.5)
    with FoxgloveSink(None, tmp_path / "run.mcap") as guard.audit:
        drive(guard)
        drive(guard)
    found = messages(tmp_path / "run.mcap")
    assert len(found["/risk"]) == len(found["/decision"]) == len(found["/belief"]) == 16
    assert [one["gap"] for _, one in found["/observation"][:2]] == [30.0, 28.0]
    assert found["/observation"][1][0] - found["/observation"][0][0] == 250_000_000
    kinds = [one["kind"] for _, one in found["/event"]]
    assert kinds == ["episode started", "collision", "episode ended"] * 2
    assert "executed -4.00 m/s²" in found["/log"][0][1]["message"]
    times = [at for at, _ in found["/risk"]]
    assert (np.diff(times) > 0).all()


def test_the_channels_are_those_of_a_run(tmp_path):
    guard = guard_for_cars(low=-4.0, high=2.5)
    with FoxgloveSink(None, tmp_path / "sink.mcap") as guard.audit:
        drive(guard)
    write_run(tmp_path / "run.mcap", [])
    assert read_run(tmp_path / "run.mcap").episodes == ()

    def schemas(path):
        with path.open("rb") as file:
            summary = make_reader(file).get_summary()
        return {
            channel.topic: json.loads(summary.schemas[channel.schema_id].data)
            for channel in summary.channels.values()
        }

    assert schemas(tmp_path / "sink.mcap") == schemas(tmp_path / "run.mcap")


def test_any_system_is_shown_by_its_own_names(tmp_path):
    guard = Guard(low=-1.0, high=1.0, interval=0.1)
    with FoxgloveSink(None, tmp_path / "a.mcap", names=["angle"], units=["rad"]) as guard.audit:
        guard.decide([0.1], proposal=0.5)
        guard.end(failed=True)
    found = messages(tmp_path / "a.mcap")
    assert found["/observation"][0][1] == {"time": 0.0, "angle": 0.1, "intake": 0}
    assert [one["kind"] for _, one in found["/event"]][1] == "failure"
    assert "time_to_collision" not in channels.schemas_of(["angle"])["/risk"]["properties"]


def test_whoever_connects_sees_the_decisions_as_they_are_made():
    connect = pytest.importorskip("websockets.sync.client").connect
    guard = guard_for_cars(low=-4.0, high=2.5)
    with FoxgloveSink(0) as sink:
        guard.audit = sink
        assert not sink.await_someone(0.01)
        with connect(sink.address, subprotocols=["foxglove.sdk.v1"], proxy=None) as client:
            channel = None
            while channel is None:
                told = json.loads(client.recv(timeout=60))
                for one in told.get("channels", []):
                    channel = one["id"] if one["topic"] == "/decision" else channel
            asked = {"op": "subscribe", "subscriptions": [{"id": 7, "channelId": channel}]}
            client.send(json.dumps(asked))
            assert sink.await_someone(10.0)
            threading.Thread(target=drive, args=[guard]).start()
            data = client.recv(timeout=60)
            while not isinstance(data, bytes):
                data = client.recv(timeout=60)
    opcode, subscription, at = struct.unpack("<BIQ", data[:13])
    assert (opcode, subscription) == (1, 7)
    assert abs(at - time.time_ns()) < 60e9
    assert json.loads(data[13:])["proposed"] == 1.0


def test_the_layout_names_only_what_there_is():
    layout = json.loads(FOXGLOVE_LAYOUT.read_text())
    schemas = channels.schemas_of()
    text = json.dumps(layout)
    paths = re.findall(r'"value": "(/\w+)\.(\w+)"', text)
    assert len(paths) > 10
    for topic, field in paths:
        assert field in schemas[topic]["properties"]
    assert layout["configById"]["RosOut!log"]["topicToRender"] in schemas
    panels = set(re.findall(r'"(?:first|second)": "([^"]+)"', text))
    assert panels == set(layout["configById"])


def test_a_run_is_held_back_to_real_time():
    guard = guard_for_cars(low=-4.0, high=2.5)
    with FoxgloveSink(0, speed=10.0) as guard.audit:
        began = time.monotonic()
        drive(guard)
        taken = time.monotonic() - began
    assert taken >= 0.25 * (len(ROWS) - 1) / 10.0


def test_what_cannot_be_is_refused(tmp_path):
    (tmp_path / "there.mcap").write_text("mine")
    with pytest.raises(ValueError, match="needs a port, a file, or both"):
        FoxgloveSink(None)
    with pytest.raises(FileExistsError, match="it was left alone"):
        FoxgloveSink(None, tmp_path / "there.mcap")
    with pytest.raises(ValueError, match="speed"):
        FoxgloveSink(0, speed=0.0)
    with FoxgloveSink(0) as sink, pytest.raises(RuntimeError):
        FoxgloveSink(int(sink.address.rpartition(":")[2]))


def test_actions_of_several_dimensions_are_left_to_the_log(tmp_path):
    guard = Guard(low=[-1.0, -1.0], high=[1.0, 1.0], interval=0.1)
    with FoxgloveSink(None, tmp_path / "a.mcap", names=["x"], units=["m"]) as guard.audit:
        guard.decide([0.1], proposal=[0.5, 0.5])
        guard.end()
    assert "executed" not in messages(tmp_path / "a.mcap")["/decision"][0][1]


def test_every_column_of_a_decision_has_a_field():
    fields = {name for names in channels.OF_DECISIONS.values() for name in names}
    assert fields - {"belief"} <= set(DECISION_COLUMNS)
