"""Decisions as MCAP, and live: what Foxglove's library writes and sends."""

import json
import math
import re
import struct
import time
import tracemalloc
from contextlib import suppress
from itertools import chain, compress
from unittest.mock import patch

import pytest
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer
from websockets.sync.client import connect

from evofsm.driving import IDM, Leader, Scenario, drive, guard_for_cars
from evofsm.guard import Guard
from evofsm.guard.reviser import Mode
from evofsm.io.foxglove import FOXGLOVE_LAYOUT, FoxgloveSink, schemas_of
from evofsm.io.tables import Skips, mcap_messages

pytestmark = pytest.mark.usefixtures("compiled")

HASTY = IDM(2.25, 28.0, 0.8, 0.3, 2.0, lowest=-4.0, highest=2.5)
LEADER = Leader(IDM(1.2, 25.0, 1.0, 1.0, 2.5), brake_decel=9.0, brake_time=9.0)


@pytest.fixture(scope="module")
def driven(tmp_path_factory):
    """Three episodes, one watched only and two acted in, and the log of them."""
    path = tmp_path_factory.mktemp("mcap") / "run.mcap"
    guard, episodes = guard_for_cars(-4.0, 2.5), []
    with FoxgloveSink(None, path) as guard.audit:
        for mode in (Mode.SHADOW, Mode.ACT, Mode.ACT):
            guard.reviser.mode = mode
            episodes.append(drive(guard, Scenario(LEADER, 8.0, duration=14.0), controller=HASTY))
    assert [episode.collided for episode in episodes] == [True, False, False]
    return episodes, path


def messages(path):
    """All of them by topic, in the order of the log's time, by the library's own reader."""
    found = {}
    with open(path, "rb") as file:
        for _, channel, message in make_reader(file, validate_crcs=True).iter_messages():
            data = message.data if channel.topic == "/log" else json.loads(message.data)
            found.setdefault(channel.topic, []).append((message.log_time, data))
    return found


# -- Files ----------------------------------------------------------------------------------------


def test_another_reader_finds_every_decision_and_what_happened_in_the_order_of_time(driven):
    episodes, log = driven
    found = messages(log)
    events = [(at, message["episode"], message["kind"]) for at, message in found["/event"]]
    assert [event[1:] for event in events] == [
        *((0, kind) for kind in ("episode started", "collision", "episode ended")),
        *((k, kind) for k in (1, 2) for kind in ("episode started", "episode ended")),
    ]
    assert (events[3][0] - events[2][0], events[5][0] - events[4][0]) == (10**9, 10**9)
    decisions = [decision for episode in episodes for decision in episode.decisions]
    executed = [message["executed"] for _, message in found["/decision"]]
    assert executed == [decision.revision.executed for decision in decisions]
    for (_, message), decision in zip(found["/belief"], decisions, strict=True):
        assert message["belief"] == decision.situation.belief.tolist()
    times = [time for time, _ in found["/decision"]]
    assert times == sorted(set(times))
    assert times[-1] - events[5][0] == round(decisions[-1].situation.time * 1e9)
    entries = [data.decode(errors="ignore") for _, data in found["/log"]]
    warnings = [entry for entry in entries if ", executed" in entry]
    changed = compress(decisions, chain(*(episode.changed for episode in episodes)))
    for warning, decision in zip(warnings, changed, strict=True):
        assert f"m/s²: {decision.revision.reason}" in warning
    assert any("would advise" in entry for entry in entries)
    assert sum("collision" in entry and "m/s" not in entry for entry in entries) == 1


def test_schemas_are_such_as_foxglove_takes_and_name_what_the_messages_hold(driven):
    sent = messages(driven[1])
    with open(driven[1], "rb") as file:
        summary = make_reader(file).get_summary()
    found = {c.topic: summary.schemas[c.schema_id] for c in summary.channels.values()}
    assert found.pop("/log").name == "foxglove.Log"
    kinds = {"number": (float, int), "integer": int, "string": str, "array": list, "object": dict}
    for topic, schema in found.items():
        assert schema.encoding == "jsonschema"
        fields = json.loads(schema.data)["properties"]
        assert all(fields[name]["description"] for name in fields)
        for name, value in ((n, v) for _, message in sent[topic] for n, v in message.items()):
            assert isinstance(value, kinds[fields[name]["type"]])  # one type, so no null


def test_what_is_not_known_is_left_out(tmp_path):
    guard = guard_for_cars(low=-4.0, high=2.5)
    with FoxgloveSink(None, tmp_path / "run.mcap") as guard.audit:
        guard.decide([math.nan, 20.0, 20.0], proposal=1.0)
        guard.decide([9.0, 0.0, 3.0], proposal=1.0)
    found = messages(tmp_path / "run.mcap")
    (_, seen), _ = found["/observation"]
    assert seen == {"time": 0.0, "v_follower": 20.0, "v_leader": 20.0, "intake": 1}
    assert "state" not in found["/belief"][0][1]
    assert "time_headway" not in found["/risk"][1][1]  # it stands


def test_a_full_disk_is_told(tmp_path, full_at):
    guard, path = guard_for_cars(low=-4.0, high=2.5), tmp_path / "run.mcap"
    with full_at(1), pytest.raises(OSError, match="large"), FoxgloveSink(None, path) as guard.audit:
        drive(guard, Scenario(LEADER, 8.0, duration=60.0), controller=HASTY)


@pytest.mark.slow
@pytest.mark.parametrize("packing", [CompressionType.ZSTD, CompressionType.LZ4])
def test_a_small_log_that_unpacks_to_hundreds_of_megabytes_is_refused(packing, tmp_path):
    path = tmp_path / "bomb.mcap"
    with path.open("wb") as file:
        writer = Writer(file, compression=packing)
        writer.start()
        channel = writer.register_channel("/other", "json", writer.register_schema("x", "", b""))
        writer.add_message(channel, 0, bytes(1 << 28), 0)
        writer.finish()
    tracemalloc.start()
    with pytest.raises(ValueError, match=r"bomb\.mcap.*a chunk unpacks to more than"):
        list(mcap_messages(path, 1 << 24, Skips()))
    assert tracemalloc.get_traced_memory()[1] < (96 << 20) + 8 * path.stat().st_size
    tracemalloc.stop()


# -- Live -----------------------------------------------------------------------------------------


def test_any_system_is_shown_by_its_own_names_and_vectors_are_left_to_the_log(tmp_path):
    guard = Guard(low=[-1.0, -1.0], high=[1.0, 1.0], interval=0.1)
    with FoxgloveSink(None, tmp_path / "a.mcap", names=["belief"], units=["rad"]) as guard.audit:
        guard.decide([0.1], proposal=[0.5, 0.5])
        guard.end(failed=True)
    found = messages(tmp_path / "a.mcap")
    assert found["/observation"][0][1] == {"time": 0.0, "belief": 0.1, "intake": 0}
    assert [one["kind"] for _, one in found["/event"]][1] == "failure"
    assert "executed" not in found["/decision"][0][1]
    fields = schemas_of(["belief"], ["rad"])  # a channel has such a column, too
    assert "as observed [rad]" in fields["/observation"]["properties"]["belief"]["description"]
    assert fields["/belief"]["properties"]["belief"]["type"] == "array"
    assert "time_to_collision" not in fields["/risk"]["properties"]


def test_whoever_connects_sees_the_decisions_as_they_are_made():
    guard = guard_for_cars(low=-4.0, high=2.5)
    with FoxgloveSink(0) as sink:
        guard.audit = sink
        with connect(sink.address, subprotocols=["foxglove.sdk.v1"], proxy=None) as client:
            found = {}
            while "/decision" not in found:
                channels = json.loads(client.recv(timeout=60)).get("channels", [])
                found |= {one["topic"]: one["id"] for one in channels}
            asked = {"id": 7, "channelId": found["/decision"]}
            client.send(json.dumps({"op": "subscribe", "subscriptions": [asked]}))
            data, tries = "", 0
            while not isinstance(data, bytes):  # until the server has heard that somebody listens
                tries += 1
                assert tries < 600
                for k in range(8):
                    guard.decide([30.0 - 2.0 * k, 20.0, 12.0], proposal=1.0)
                guard.end(failed=True, observation=[-0.1, 20.0, 12.0])
                with suppress(TimeoutError):
                    data = client.recv(timeout=0.1)
    opcode, subscription, at = struct.unpack("<BIQ", data[:13])
    assert (opcode, subscription) == (1, 7)
    assert abs(at - time.time_ns()) < 60e9
    assert json.loads(data[13:])["proposed"] == 1.0


def test_the_layout_names_only_what_there_is():
    layout, found = json.loads(FOXGLOVE_LAYOUT.read_text()), schemas_of()
    text = json.dumps(layout)
    paths = re.findall(r'"value": "(/\w+)\.(\w+)"', text)
    assert len(paths) > 10
    for topic, field in paths:
        assert field in found[topic]["properties"]
    assert layout["configById"]["RosOut!log"]["topicToRender"] == "/log"


def test_what_cannot_be_shown_is_refused(tmp_path):
    guard = Guard(-1.0, 1.0, interval=0.1, audit=FoxgloveSink(None, tmp_path / "run.mcap"))
    with guard.audit, pytest.raises(ValueError, match="is for 3 variables"):
        guard.decide([1.0, 2.0], proposal=0.0)
    with pytest.raises(ValueError, match="needs a port, a file, or both"):
        FoxgloveSink(None)
    for names in (["x", "x"], ["time", "x"], ["episode"]):
        with pytest.raises(ValueError, match=f"two fields '{names[0]}'; name others in names="):
            FoxgloveSink(None, tmp_path / "other.mcap", names=names)
    with patch("foxglove.start_server") as start, FoxgloveSink(0, host="::1") as sink:
        assert sink.address == f"ws://[::1]:{start.return_value.port}"
    with FoxgloveSink(0) as sink, pytest.raises(RuntimeError):
        FoxgloveSink(int(sink.address.rpartition(":")[2]))
