import json
import math
import tracemalloc
from dataclasses import replace

import numpy as np
import pytest

from evofsm.driving import episodes
from evofsm.driving.drivers import IDM
from evofsm.driving.measures import time_headway, time_to_collision
from evofsm.driving.naming import VARIABLES
from evofsm.driving.risk.latent import LatentRisk
from evofsm.driving.scenarios import Leader, Scenario
from evofsm.fsm.actions import IntervalActions
from evofsm.fsm.machine import EvolvingFSM
from evofsm.guard.episodes import Decision
from evofsm.guard.guard import Explain, Guard
from evofsm.guard.protocols import Intake
from evofsm.guard.reviser import ActionReviser, Mode

pytest.importorskip("mcap")

from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from evofsm.io.mcap import RunWriter, _column, read_run, recording, write_run

ACTIONS = IntervalActions(low=-4.0, high=2.5, width=0.5, outside="clip")
HASTY = IDM(2.25, 28.0, 0.8, 0.3, 2.0, lowest=-4.0, highest=2.5)
LEADER = Leader(IDM(1.2, 25.0, 1.0, 1.0, 2.5), brake_decel=9.0, brake_time=9.0)


@pytest.fixture(scope="module")
def run():
    """A machine and three episodes: one watched only, two acted in."""
    machine = EvolvingFSM(ACTIONS.n_actions, radius=0.05)
    risk = LatentRisk(lowest=-4.0)
    drives = []
    for mode in (Mode.SHADOW, Mode.ACT, Mode.ACT):
        reviser = ActionReviser(risk, ACTIONS, mode=mode)
        guard = Guard.of(reviser, machine=machine, interval=0.25, explaining=Explain.ALL)
        drives.append(episodes.drive(guard, Scenario(LEADER, 8.0, duration=14.0), controller=HASTY))
    assert [drive.collided for drive in drives] == [True, False, False]
    names = {"names": VARIABLES, "units": ("m", "m/s", "m/s")}
    return drives, machine.model(actions=ACTIONS, dt=0.25, **names)


@pytest.fixture(scope="module")
def log(run, tmp_path_factory):
    drives, model = run
    path = tmp_path_factory.mktemp("mcap") / "run.mcap"
    write_run(path, iter(drives), model=model, about={"family": "own", "seed": 3})
    return path


def messages(path):
    """All of them by topic, in the order of the log's time, by the library's own reader."""
    found = {}
    with open(path, "rb") as file:
        for _, channel, message in make_reader(file, validate_crcs=True).iter_messages():
            found.setdefault(channel.topic, []).append((message.log_time, json.loads(message.data)))
    return found


# -- What stands in it ----------------------------------------------------------------------------


def test_the_log_holds_what_the_drives_held(run, log):
    drives, model = run
    again = read_run(log)
    assert again.about["family"] == "own"
    assert again.about["seed"] == "3"
    assert again.about["library"].startswith("evofsm ")
    np.testing.assert_array_equal(again.model.transition_matrices, model.transition_matrices)
    assert again.model.names == VARIABLES
    assert len(again.episodes) == len(drives)
    for episode, drive in zip(again.episodes, drives, strict=True):
        columns = episode.columns
        situations = [decision.situation for decision in drive.decisions]
        revisions = [decision.revision for decision in drive.decisions]
        observations = np.array([situation.observation for situation in situations])
        wanted = {
            "time": [s.time for s in situations],
            **dict(zip(VARIABLES, observations.T, strict=True)),
            "intake": [int(s.intake) for s in situations],
            "state": [s.state for s in situations],
            "surprise": [s.surprise for s in situations],
            "n_states": [len(s.belief) for s in situations],
            "risk_proposed": [r.risk_proposed for r in revisions],
            "risk_executed": [r.risk_executed for r in revisions],
            "risk_low": [r.interval[0] for r in revisions],
            "risk_high": [r.interval[1] for r in revisions],
            "evidence": [r.evidence for r in revisions],
            "seen": [r.seen for r in revisions],
            "time_to_collision": time_to_collision(observations),
            "time_headway": time_headway(observations),
            "proposed": drive.proposed,
            "executed": drive.executed,
            "advised": [r.advised for r in revisions],
            "realised": [decision.realised for decision in drive.decisions],
            "reason": [r.reason for r in revisions],
            "explanation": [r.explanation for r in revisions],
        }
        assert set(columns) == {*wanted, "belief"}
        for name, values in wanted.items():
            np.testing.assert_array_equal(columns[name], values, err_msg=name)
        for row, situation in zip(columns["belief"], situations, strict=True):
            n = len(situation.belief)
            np.testing.assert_array_equal(row[:n], situation.belief)
            assert not row[n:].any()
        assert episode.collided == drive.collided
        assert episode.end_time == drive.time[-1]
        np.testing.assert_array_equal(episode.end, drive.observations[-1])
        with pytest.raises(ValueError, match="read-only"):
            columns["gap"][0] = 0.0


def test_explanations_are_in_it(run, log):
    told = [text for episode in read_run(log).episodes for text in episode.columns["explanation"]]
    assert all(str(text).startswith("#") for text in told)
    assert any("failed later on" in str(text) for text in told)


def test_a_log_that_begins_with_its_messages_is_not_read_as_empty(log, tmp_path):
    with open(log, "rb") as file, open(tmp_path / "other.mcap", "wb") as rewritten:
        reader, writer = make_reader(file), Writer(rewritten, use_chunking=False)
        writer.start()
        channels = {}
        for schema, channel, message in reader.iter_messages():
            if channel.topic not in channels:
                known = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.topic] = writer.register_channel(channel.topic, "json", known)
            times = message.log_time, message.publish_time
            writer.add_message(channels[channel.topic], times[0], message.data, times[1])
        for metadata in reader.iter_metadata():
            writer.add_metadata(metadata.name, metadata.metadata)
        writer.finish()
    with pytest.raises(ValueError, match="messages come before what it is about"):
        read_run(tmp_path / "other.mcap")


def test_another_reader_finds_every_channel_in_the_order_of_time(run, log):
    drives, _ = run
    found = messages(log)
    decisions = sum(len(drive.decisions) for drive in drives)
    for topic in ("/observation", "/belief", "/risk", "/decision"):
        assert len(found[topic]) == decisions
    events = [(message["episode"], message["kind"]) for _, message in found["/event"]]
    assert events == [
        (0, "episode started"),
        (0, "collision"),
        (0, "episode ended"),
        *((k, kind) for k in (1, 2) for kind in ("episode started", "episode ended")),
    ]
    times = [time for time, _ in found["/decision"]]
    assert times == sorted(set(times))
    start = {m["episode"]: t for t, m in found["/event"] if m["kind"] == "episode started"}
    end = {m["episode"]: t for t, m in found["/event"] if m["kind"] == "episode ended"}
    assert [start[k + 1] - end[k] for k in (0, 1)] == [10**9, 10**9]
    assert times[-1] - start[2] == round(drives[2].decisions[-1].situation.time * 1e9)


def test_the_log_panel_says_what_was_changed_and_why(run, log):
    drives, _ = run
    entries = [message for _, message in messages(log)["/log"]]
    warnings = [entry["message"] for entry in entries if entry["level"] == 3]
    changed = [
        decision.revision.reason
        for drive in drives
        for decision, change in zip(drive.decisions, drive.changed, strict=True)
        if change
    ]
    assert [warning.partition("m/s²: ")[2] for warning in warnings] == changed
    assert any("would advise" in entry["message"] for entry in entries if entry["level"] == 2)
    assert [entry["message"] for entry in entries if entry["level"] == 4] == ["collision"]


def test_schemas_are_such_as_foxglove_takes_and_name_what_the_messages_hold(log):
    with open(log, "rb") as file:
        summary = make_reader(file).get_summary()
    schemas = {c.topic: summary.schemas[c.schema_id] for c in summary.channels.values()}
    assert schemas["/log"].name == "foxglove.Log"
    kinds = {"number": float, "integer": int, "string": str, "array": list, "object": dict}
    for topic, found in messages(log).items():
        assert schemas[topic].encoding == "jsonschema"
        fields = json.loads(schemas[topic].data)["properties"]
        assert all(fields[name]["description"] for name in fields)
        for _, message in found:
            for name, value in message.items():
                if "oneOf" not in fields[name]:  # one type, so no null
                    wanted = kinds[fields[name]["type"]]
                    assert isinstance(value, (wanted, int) if wanted is float else wanted)


def test_what_is_not_known_is_left_out_and_comes_back_as_such(run, tmp_path):
    drive = run[0][0]
    first = drive.decisions[0]
    nothing = first.situation._replace(
        observation=np.array([math.nan, 20.0, 20.0]),
        belief=np.ones(1),
        state=None,
        surprise=math.nan,
        intake=Intake.PARTIAL,
    )
    still = first.situation._replace(observation=np.array([9.0, 0.0, 3.0]), time=0.25)
    unjudged = first.revision._replace(risk_proposed=math.nan, interval=(math.nan, math.nan))
    decisions = (Decision(nothing, unjudged, math.nan), Decision(still, first.revision, 0.0))
    write_run(tmp_path / "run.mcap", [replace(drive, decisions=decisions)])
    assert "gap" not in messages(tmp_path / "run.mcap")["/observation"][0][1]
    columns = read_run(tmp_path / "run.mcap").episodes[0].columns
    assert columns["state"].tolist() == [-1, first.situation.state]
    assert columns["intake"].tolist() == [int(Intake.PARTIAL), 0]
    assert columns["n_states"][0] == 0
    for name in ("gap", "surprise", "risk_proposed", "risk_low", "realised", "time_headway"):
        assert math.isnan(columns[name][0]), name
    assert columns["time_headway"][1] == math.inf  # it stands


# -- Whole or not at all --------------------------------------------------------------------------


def test_a_log_that_was_not_finished_leaves_what_was_there(run, tmp_path):
    path = tmp_path / "run.mcap"
    path.write_bytes(b"before")

    def break_off():
        with recording(path, {}) as log:
            log.add(run[0][0])
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        break_off()
    assert path.read_bytes() == b"before"
    assert [one.name for one in tmp_path.iterdir()] == ["run.mcap"]


def test_the_same_run_gives_the_same_file(run, log, tmp_path):
    drives, model = run
    write_run(tmp_path / "run.mcap", drives, model=model, about={"family": "own", "seed": 3})
    assert (tmp_path / "run.mcap").read_bytes() == log.read_bytes()


def test_damage_anywhere_is_one_error_that_names_the_file(run, tmp_path):
    path, damaged = tmp_path / "run.mcap", tmp_path / "damaged.mcap"
    drives, model = run
    short = replace(drives[0], decisions=drives[0].decisions[:3])
    write_run(path, [short], model=model)
    whole = path.read_bytes()
    data_end = whole.rindex(b"\x0f\x04\x00\x00\x00\x00\x00\x00\x00")  # the index follows
    rng = np.random.default_rng(0)
    for place in rng.integers(0, data_end, 60).tolist():
        damaged.write_bytes(whole[:place] + bytes([whole[place] ^ 0x55]) + whole[place + 1 :])
        with pytest.raises(ValueError, match=r"damaged\.mcap.*damaged, cut off"):
            read_run(damaged)
    for length in rng.integers(0, len(whole), 20).tolist():
        damaged.write_bytes(whole[:length])
        with pytest.raises(ValueError, match=r"damaged\.mcap"):
            read_run(damaged)


def foreign(path):
    with open(path, "wb") as file:
        writer = Writer(file)
        writer.start()
        writer.finish()


@pytest.mark.parametrize(
    ("write", "says"),
    [
        (lambda path: path.write_text("time,gap\n0,1\n"), "cannot be read"),
        (foreign, "no run of evofsm"),
        (lambda path: write_other_format(path), "format is '2'"),
        (lambda path: write_unfinished(path), "within an episode"),
    ],
)
def test_what_is_no_run_is_refused(tmp_path, write, says):
    write(tmp_path / "other.mcap")
    with pytest.raises(ValueError, match=rf"other\.mcap.*{says}"):
        read_run(tmp_path / "other.mcap")


def write_other_format(path):
    with open(path, "wb") as file:
        writer = Writer(file)
        writer.start()
        writer.add_metadata("evofsm", {"format": "2"})
        writer.finish()


def write_unfinished(path):
    with open(path, "wb") as file:
        log = RunWriter(file, {})
        log._event("episode started", 0.0, np.zeros(3))
        log.finish()


def test_a_file_that_is_not_there_keeps_its_own_error(tmp_path):
    with pytest.raises(FileNotFoundError):
        read_run(tmp_path / "none.mcap")
    with pytest.raises(FileNotFoundError, match="there is no folder"):
        write_run(tmp_path / "no" / "run.mcap", [])


ZSTD, LZ4 = CompressionType.ZSTD, CompressionType.LZ4  # to 1 part in thousands, and in 255


@pytest.mark.slow
@pytest.mark.parametrize(
    ("packing", "chunks", "size"), [(ZSTD, 1, 1 << 28), (LZ4, 1, 1 << 28), (ZSTD, 20, 1 << 23)]
)
def test_a_small_log_that_unpacks_to_hundreds_of_megabytes_is_refused(
    packing, chunks, size, tmp_path
):
    path = tmp_path / "bomb.mcap"
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=size // 2, compression=packing)
        writer.start()
        channel = writer.register_channel("/other", "json", writer.register_schema("x", "", b""))
        for number in range(chunks):
            writer.add_message(channel, number, bytes(size), number)
        writer.finish()
    small = path.stat().st_size
    tracemalloc.start()
    try:
        with pytest.raises(ValueError, match=r"bomb\.mcap.*unpacks to more than was ever packed"):
            read_run(path)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < (96 << 20) + 8 * small


def test_beliefs_that_are_far_too_many_are_refused():
    rows = [{"belief": [0.0] * 20_000}, *({"belief": []} for _ in range(10_000))]
    with pytest.raises(ValueError, match="10,001 beliefs in 20,000 states"):
        _column("belief", "belief", rows)
