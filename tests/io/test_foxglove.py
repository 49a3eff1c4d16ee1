"""Runs as MCAP, and live: what Foxglove's library writes and sends, and what is read again."""

import json
import math
import re
import struct
import time
import tracemalloc
from contextlib import suppress

import numpy as np
import pytest

pytest.importorskip("foxglove")
pytest.importorskip("mcap")

from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from evofsm.driving import IDM, Leader, Scenario, drive, guard_for_cars
from evofsm.driving.naming import DECISION_COLUMNS, VARIABLES
from evofsm.driving.world import Episode
from evofsm.guard import Guard
from evofsm.guard.api import Intake
from evofsm.guard.loop import Decision
from evofsm.guard.reviser import Mode
from evofsm.io.foxglove import FOXGLOVE_LAYOUT, FoxgloveSink, RunWriter, recording
from evofsm.io.runs import read_run, schemas_of

pytestmark = pytest.mark.usefixtures("compiled")

HASTY = IDM(2.25, 28.0, 0.8, 0.3, 2.0, lowest=-4.0, highest=2.5)
LEADER = Leader(IDM(1.2, 25.0, 1.0, 1.0, 2.5), brake_decel=9.0, brake_time=9.0)
ROWS = [[30.0 - 2.0 * k, 20.0, 12.0] for k in range(8)]


@pytest.fixture(scope="module")
def driven():
    """A model and three episodes: one watched only, two acted in."""
    guard, episodes = guard_for_cars(-4.0, 2.5, explaining=True), []
    for mode in (Mode.SHADOW, Mode.ACT, Mode.ACT):
        guard.reviser.mode = mode
        episodes.append(drive(guard, Scenario(LEADER, 8.0, duration=14.0), controller=HASTY))
    assert [episode.collided for episode in episodes] == [True, False, False]
    return episodes, guard.machine.model(names=VARIABLES, units=("m", "m/s", "m/s"), dt=0.25)


def write(path, episodes, model=None, about=None):
    with recording(path, about) as log:
        for episode in episodes:
            log.add(episode)
        if model is not None:
            log.attach(model)


@pytest.fixture(scope="module")
def log(driven, tmp_path_factory):
    path = tmp_path_factory.mktemp("mcap") / "run.mcap"
    write(path, *driven, {"family": "own", "seed": 3})
    return path


def messages(path):
    """All of them by topic, in the order of the log's time, by the library's own reader."""
    found = {}
    with open(path, "rb") as file:
        for _, channel, message in make_reader(file, validate_crcs=True).iter_messages():
            data = message.data if channel.topic == "/log" else json.loads(message.data)
            found.setdefault(channel.topic, []).append((message.log_time, data))
    return found


def schemas(path):
    with open(path, "rb") as file:
        summary = make_reader(file).get_summary()
    return {c.topic: summary.schemas[c.schema_id] for c in summary.channels.values()}


# -- Runs -----------------------------------------------------------------------------------------


def test_the_log_holds_what_the_drives_held(driven, log):
    episodes, model = driven
    again = read_run(log)
    assert (again.about["family"], again.about["seed"]) == ("own", "3")
    np.testing.assert_array_equal(again.model.transition_matrices, model.transition_matrices)
    assert again.model.names == VARIABLES
    for found, episode in zip(again.episodes, episodes, strict=True):
        assert set(found.columns) == {*DECISION_COLUMNS, "belief"}
        for name, column in DECISION_COLUMNS.items():
            wanted = [column.read(decision) for decision in episode.decisions]
            np.testing.assert_array_equal(found.columns[name], wanted, err_msg=name)
        for row, decision in zip(found.columns["belief"], episode.decisions, strict=True):
            n = len(decision.situation.belief)
            np.testing.assert_array_equal(row[:n], decision.situation.belief)
            assert not row[n:].any()
        assert (found.collided, found.end_time) == (episode.collided, episode.time[-1])
        np.testing.assert_array_equal(found.end, episode.observations[-1])
        assert all(str(text).startswith("#") for text in found.columns["explanation"])
        with pytest.raises(ValueError, match="read-only"):
            found.columns["gap"][0] = 0.0


def test_another_reader_finds_what_happened_in_the_order_of_time(driven, log):
    found = messages(log)
    events = [(at, message["episode"], message["kind"]) for at, message in found["/event"]]
    assert [event[1:] for event in events] == [
        *((0, kind) for kind in ("episode started", "collision", "episode ended")),
        *((k, kind) for k in (1, 2) for kind in ("episode started", "episode ended")),
    ]
    assert (events[3][0] - events[2][0], events[5][0] - events[4][0]) == (10**9, 10**9)
    times = [time for time, _ in found["/decision"]]
    assert times == sorted(set(times))
    assert times[-1] - events[5][0] == round(driven[0][2].decisions[-1].situation.time * 1e9)
    entries = [data.decode(errors="ignore") for _, data in found["/log"]]
    warnings = [entry for entry in entries if ", executed" in entry]
    changed = [
        decision.revision.reason
        for episode in driven[0]
        for decision, change in zip(episode.decisions, episode.changed, strict=True)
        if change
    ]
    for warning, reason in zip(warnings, changed, strict=True):
        assert f"m/s²: {reason}" in warning
    assert any("would advise" in entry for entry in entries)
    assert sum("collision" in entry and "evofsm" in entry for entry in entries) == 1


def test_schemas_are_such_as_foxglove_takes_and_name_what_the_messages_hold(log):
    found, sent = schemas(log), messages(log)
    assert found.pop("/log").name == "foxglove.Log"
    kinds = {"number": (float, int), "integer": int, "string": str, "array": list, "object": dict}
    for topic, schema in found.items():
        assert schema.encoding == "jsonschema"
        fields = json.loads(schema.data)["properties"]
        assert all(fields[name]["description"] for name in fields)
        for name, value in ((n, v) for _, message in sent[topic] for n, v in message.items()):
            assert isinstance(value, kinds[fields[name]["type"]])  # one type, so no null


def test_what_is_not_known_is_left_out_and_comes_back_as_such(driven, tmp_path):
    episode, path = driven[0][0], tmp_path / "run.mcap"
    first = episode.decisions[0]
    nothing = first.situation._replace(
        observation=np.array([math.nan, 20.0, 20.0]),
        belief=np.ones(1),
        state=None,
        surprise=math.nan,
        intake=Intake.PARTIAL,
    )
    still = first.situation._replace(observation=np.array([9.0, 0.0, 3.0]), time=0.25)
    unjudged = first.revision._replace(risk_proposed=math.nan, interval=(math.nan, math.nan))
    decisions = (Decision(nothing, unjudged), Decision(still, first.revision, 0.0))
    write(path, [Episode(episode.time, episode.record, decisions)])
    assert "gap" not in messages(path)["/observation"][0][1]
    columns = read_run(path).episodes[0].columns
    assert columns["state"].tolist() == [-1, first.situation.state]
    assert columns["intake"].tolist() == [int(Intake.PARTIAL), 0]
    assert columns["n_states"][0] == 0
    for name in ("gap", "surprise", "risk_proposed", "risk_low", "realised", "time_headway"):
        assert math.isnan(columns[name][0]), name
    assert columns["time_headway"][1] == math.inf  # it stands


# -- Whole or not at all --------------------------------------------------------------------------


def test_a_log_that_was_not_finished_or_not_written_leaves_what_was_there(driven, tmp_path):
    path = tmp_path / "run.mcap"
    path.write_bytes(b"before")

    def broken_off():
        with recording(path, {}) as unfinished:
            unfinished.add(driven[0][0])
            raise KeyboardInterrupt

    def full():
        with open("/dev/full", "wb", buffering=0) as file:
            log = RunWriter(file, {})
            log.add(driven[0][0])
            log.finish()

    with pytest.raises(KeyboardInterrupt):
        broken_off()
    assert path.read_bytes() == b"before"
    assert [one.name for one in tmp_path.iterdir()] == ["run.mcap"]
    with pytest.raises(OSError, match="No space"):
        full()


def test_damage_anywhere_is_one_error_that_names_the_file(driven, tmp_path):
    path, damaged = tmp_path / "run.mcap", tmp_path / "damaged.mcap"
    (episode, *_), model = driven
    write(path, [Episode(episode.time, episode.record, episode.decisions[:3])], model)
    whole = path.read_bytes()
    data_end = whole.rindex(b"\x0f\x04\x00\x00\x00\x00\x00\x00\x00")  # the index follows
    rng = np.random.default_rng(0)
    for place in rng.integers(80, data_end, 60).tolist():
        damaged.write_bytes(whole[:place] + bytes([whole[place] ^ 0x55]) + whole[place + 1 :])
        with pytest.raises(ValueError, match=r"damaged\.mcap.*damaged, cut off"):
            read_run(damaged)
    for length in rng.integers(0, len(whole), 20).tolist():
        damaged.write_bytes(whole[:length])
        with pytest.raises(ValueError, match=r"damaged\.mcap"):
            read_run(damaged)


OURS, STARTED = {"format": "1"}, ("/event", {"kind": "episode started"})


@pytest.mark.parametrize(
    ("about", "sent", "says"),
    [
        (None, [], "no run of evofsm"),
        ({"format": "2"}, [], "its format is '2'"),
        (OURS, [STARTED], "within an episode"),
        (OURS, [STARTED] * 2, "no end, or no beginning"),
        (OURS, [("/decision", {})], "outside of every episode"),
    ],
)
def test_what_is_no_run_is_refused(tmp_path, about, sent, says):
    path = tmp_path / "other.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema("x", "jsonschema", b"{}")
        if about is not None:
            writer.add_metadata("evofsm", about)
        for topic, message in sent:
            channel = writer.register_channel(topic, "json", schema)
            writer.add_message(channel, 0, json.dumps(message).encode(), 0)
        writer.finish()
    with pytest.raises(ValueError, match=rf"other\.mcap.*{says}"):
        read_run(path)


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
    try:
        with pytest.raises(ValueError, match=r"bomb\.mcap.*a chunk unpacks to more than"):
            read_run(path)
        assert tracemalloc.get_traced_memory()[1] < (96 << 20) + 8 * path.stat().st_size
    finally:
        tracemalloc.stop()


# -- Live -----------------------------------------------------------------------------------------


def decide(guard):
    for observation in ROWS:
        guard.decide(observation, proposal=1.0)
    guard.end(failed=True, observation=[-0.1, 20.0, 12.0])


def test_a_file_holds_every_decision_and_what_happened_with_the_channels_of_a_run(tmp_path, log):
    guard = guard_for_cars(low=-4.0, high=2.5)
    with FoxgloveSink(None, tmp_path / "run.mcap") as guard.audit:
        decide(guard)
        decide(guard)
    found = messages(tmp_path / "run.mcap")
    assert len(found["/risk"]) == len(found["/decision"]) == len(found["/belief"]) == 16
    assert [one["gap"] for _, one in found["/observation"][:2]] == [30.0, 28.0]
    assert found["/observation"][1][0] - found["/observation"][0][0] == 250_000_000
    kinds = [one["kind"] for _, one in found["/event"]]
    assert kinds == ["episode started", "collision", "episode ended"] * 2
    assert "executed -4.00 m/s²" in found["/log"][0][1].decode(errors="ignore")
    times = [at for at, _ in found["/risk"]]
    assert (np.diff(times) > 0).all()
    assert {t: s.data for t, s in schemas(tmp_path / "run.mcap").items()} == {
        t: s.data for t, s in schemas(log).items()
    }


def test_any_system_is_shown_by_its_own_names_and_vectors_are_left_to_the_log(tmp_path):
    guard = Guard(low=[-1.0, -1.0], high=[1.0, 1.0], interval=0.1)
    with FoxgloveSink(None, tmp_path / "a.mcap", names=["angle"], units=["rad"]) as guard.audit:
        guard.decide([0.1], proposal=[0.5, 0.5])
        guard.end(failed=True)
    found = messages(tmp_path / "a.mcap")
    assert found["/observation"][0][1] == {"time": 0.0, "angle": 0.1, "intake": 0}
    assert [one["kind"] for _, one in found["/event"]][1] == "failure"
    assert "executed" not in found["/decision"][0][1]
    fields = schemas_of(["angle"], ["rad"])
    assert "as observed [rad]" in fields["/observation"]["properties"]["angle"]["description"]
    assert "time_to_collision" not in fields["/risk"]["properties"]


def test_whoever_connects_sees_the_decisions_as_they_are_made():
    connect = pytest.importorskip("websockets.sync.client").connect
    guard = guard_for_cars(low=-4.0, high=2.5)
    with FoxgloveSink(0) as sink:
        guard.audit = sink
        with connect(sink.address, subprotocols=["foxglove.sdk.v1"], proxy=None) as client:
            channel = None
            while channel is None:
                told = json.loads(client.recv(timeout=60))
                for one in told.get("channels", []):
                    channel = one["id"] if one["topic"] == "/decision" else channel
            asked = {"op": "subscribe", "subscriptions": [{"id": 7, "channelId": channel}]}
            client.send(json.dumps(asked))
            data, tries = "", 0
            while not isinstance(data, bytes):  # until the server has heard that somebody listens
                tries += 1
                assert tries < 600
                decide(guard)
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
    (tmp_path / "there.mcap").write_text("mine")
    with pytest.raises(ValueError, match="needs a port, a file, or both"):
        FoxgloveSink(None)
    with pytest.raises(FileExistsError, match="it was left alone"):
        FoxgloveSink(None, tmp_path / "there.mcap")
    with FoxgloveSink(0) as sink, pytest.raises(RuntimeError):
        FoxgloveSink(int(sink.address.rpartition(":")[2]))
