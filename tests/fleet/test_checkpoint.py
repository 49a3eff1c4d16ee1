"""Work that is stopped and goes on comes to the same result, bit for bit."""

import io
import json
import logging
import resource
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from evofsm import store
from evofsm.cli.learning import learn_traces
from evofsm.fleet.checkpoint import KIND, Checkpoint, Kept, differences, duration, fingerprints
from evofsm.fsm.actions import IntervalActions
from evofsm.fsm.machine import EvolvingFSM
from evofsm.io.logs import Chunk

ACTIONS = IntervalActions(-1.0, 1.0, 0.5, outside="clip")
SETTINGS = {"seed": 7}


class StoppedError(Exception):
    """Stands for whatever ends a process between two chunks."""


@pytest.fixture
def chunks():
    """Eight chunks of three episodes; the second begins within a chunk, the third with one."""
    random = np.random.default_rng(7)
    Z = random.normal(size=(200, 2)).cumsum(axis=0)
    actions = np.clip(random.normal(scale=0.7, size=200), -1.5, 1.5)
    actions[[36, 99, 199]] = np.nan
    starts = np.array([0, 37, 100])
    found = []
    for first in range(0, 200, 25):
        rows = slice(first, first + 25)
        inside = starts[(starts >= first) & (starts < first + 25)] - first
        times = 0.1 * np.arange(200)[rows]
        found.append(Chunk("made up", Z[rows], actions[rows], times, inside, 0.1))
    return found


def learn(chunks, path=None, settings=SETTINGS, *, live=False):
    checkpoint = None if path is None else Checkpoint(path, settings, every=0.0)
    machine = EvolvingFSM(ACTIONS.n_actions, radius=0.2, spread=0.2)
    return learn_traces(iter(chunks), machine, ACTIONS, checkpoint=checkpoint, live=live)


def everything(learning):
    file = io.BytesIO()
    learning.machine.save(file)
    numbers = [value for name, value in vars(learning).items() if name not in ("machine", "model")]
    return file.getvalue(), repr(numbers)


def stopping(chunks, after):
    yield from chunks[:after]
    raise StoppedError


# -- Learning --------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("after", range(8))
def test_learning_that_is_stopped_goes_on_bit_for_bit(after, chunks, tmp_path):
    with pytest.raises(StoppedError):
        learn(stopping(chunks, after), tmp_path / "kept")
    assert everything(learn(chunks, tmp_path / "kept")) == everything(learn(chunks))


@pytest.mark.slow
def test_learning_goes_on_however_often_it_is_stopped(chunks, tmp_path):
    for after in (2, 3, 3, 7):
        with pytest.raises(StoppedError):
            learn(stopping(chunks, after), tmp_path / "kept")
    assert everything(learn(chunks, tmp_path / "kept")) == everything(learn(chunks))


def test_what_is_finished_is_not_read_again(chunks, tmp_path):
    expected = everything(learn(chunks, tmp_path / "kept"))
    assert everything(learn(stopping(chunks, 0), tmp_path / "kept")) == expected


def test_what_was_learnt_before_is_read_but_not_learnt_again(chunks, tmp_path):
    with pytest.raises(StoppedError):
        learn(stopping(chunks, 4), tmp_path / "kept")
    others = [chunk._replace(observations=chunk.observations + 9.0) for chunk in chunks[:4]]
    again = learn([*others, *chunks[4:]], tmp_path / "kept")
    assert everything(again) == everything(learn(chunks))


def test_a_live_stream_loses_what_came_after_the_latest_checkpoint_and_no_more(chunks, tmp_path):
    with pytest.raises(StoppedError):
        learn(stopping(chunks, 3), tmp_path / "kept", live=True)
    # Of what came while nothing ran nothing is known; what comes now begins an episode.
    coming = [chunks[5]._replace(starts=np.array([0])), *chunks[6:]]
    learning = learn(coming, tmp_path / "kept", live=True)
    assert learning.rows == 150
    assert everything(learning) == everything(learn([*chunks[:3], *coming]))
    assert learn(chunks[:1], tmp_path / "kept", live=True).rows == 175


def test_checkpoints_keep_to_their_interval(chunks, tmp_path):
    checkpoint = Checkpoint(tmp_path / "kept", SETTINGS, every=3600.0)
    checkpoint.begin(Kept({"n": 0}, {}))
    checkpoint.offer(lambda: pytest.fail("it was too early to keep anything"))
    assert not checkpoint.is_due


# -- What is refused -------------------------------------------------------------------------------


def test_other_settings_are_named(chunks, tmp_path):
    with pytest.raises(StoppedError):
        learn(stopping(chunks, 2), tmp_path / "kept")
    with pytest.raises(ValueError, match=r"kept is .* other work: seed was 7 and is now 8; run"):
        learn(chunks, tmp_path / "kept", {"seed": 8})


def test_fewer_rows_than_were_learnt_are_refused(chunks, tmp_path):
    with pytest.raises(StoppedError):
        learn(stopping(chunks, 4), tmp_path / "kept")
    with pytest.raises(ValueError, match="has learnt 100 rows, where there are 75 now"):
        learn(chunks[:3], tmp_path / "kept")


def test_a_file_of_another_kind_is_left_alone(chunks, tmp_path):
    for data, words in (
        (b"gap,speed\n1,2\n", "another program"),
        (None, "holds a machine, not a check"),
    ):
        path = tmp_path / "kept"
        path.write_bytes(data) if data else EvolvingFSM(2).save(path)
        before = path.read_bytes()
        with pytest.raises(ValueError, match=words):
            learn(chunks, path)
        assert path.read_bytes() == before


def test_a_checkpoint_that_lacks_something_is_refused(chunks, tmp_path):
    path = tmp_path / "kept"
    learn(chunks, path)
    content, arrays = store.read(path, KIND)
    for name in arrays:
        damaged = {key: value for key, value in arrays.items() if key != name}
        store.write(path, KIND, content, damaged)
        with pytest.raises(ValueError, match=f"{path} cannot be read"):
            learn(chunks, path)
    for name in ("forecasts", "age", "one_step"):
        store.write(path, KIND, content, {**arrays, name: np.zeros((7, 7))})
        with pytest.raises(ValueError, match=f"{name} has shape"):
            learn(chunks, path)


def test_a_log_that_grew_is_another_one(tmp_path):
    path = tmp_path / "log"
    path.write_bytes(bytes(200_000))
    (before,) = fingerprints([path])
    path.write_bytes(bytes(200_000) + b"\n")
    (after,) = fingerprints([path])
    assert (before["bytes"], after["bytes"]) == (200_000, 200_001)
    assert before["sha256_of_ends"] != after["sha256_of_ends"]


def test_many_differences_are_counted():
    before = {"files": [{"name": f"{k}.csv"} for k in range(9)]}
    assert differences(before, before) == ""
    assert differences(before, {"files": []}).endswith("and 5 more")
    assert differences({"a": float("nan")}, {"a": float("nan")}) == ""


@pytest.mark.parametrize("text", ["", "soon", "-1s", "5 minutes", "nan", "1e3s"])
def test_what_is_no_duration_is_refused(text):
    with pytest.raises(ValueError, match="write 10s, 5m or 1h"):
        duration(text)


# -- Disks that are full ---------------------------------------------------------------------------


@pytest.fixture
def full_disk():
    """Lets no file grow beyond some bytes, which the system reports like a full disk."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    yield lambda room: resource.setrlimit(
        resource.RLIMIT_FSIZE, (soft if room is None else room, hard)
    )
    resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    signal.signal(signal.SIGXFSZ, handler)


def test_a_disk_that_gets_full_keeps_the_checkpoint_of_before_and_the_result(
    chunks, full_disk, tmp_path, caplog
):
    path = tmp_path / "kept"
    with pytest.raises(StoppedError):
        learn(stopping(chunks, 2), path)
    before = path.read_bytes()
    full_disk(100)
    with caplog.at_level(logging.WARNING):
        learning = learn(chunks, path)
    full_disk(None)
    assert everything(learning) == everything(learn(chunks))
    assert [file.read_bytes() for file in tmp_path.iterdir()] == [before]
    assert "the one before is kept and the work goes on. Make room" in caplog.messages[0]


def test_where_nothing_can_be_kept_nothing_is_begun(chunks, full_disk, tmp_path):
    full_disk(100)
    with pytest.raises(OSError, match="File too large"):
        learn(stopping(chunks, 0), tmp_path / "kept")
    full_disk(None)
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(FileNotFoundError, match="there is no folder"):
        learn(stopping(chunks, 0), tmp_path / "missing" / "kept")


# -- Driving ---------------------------------------------------------------------------------------


def drive(path=None, episodes=5, stop_after=None):
    pytest.importorskip("scipy")
    from evofsm.cli.driving import Setup, drive_family, make_guard
    from evofsm.driving.cars import learnt_by
    from evofsm.driving.families import load_family
    from evofsm.driving.world import KinematicWorld

    def progress(done, collisions):
        if done == stop_after:
            raise StoppedError

    setup = Setup(load_family("emergency"), tolerance=0.3, episodes=episodes)
    guard = make_guard(setup)
    checkpoint = path and Checkpoint(path, setup.settings("kinematic", guard), every=0.0)
    driving = drive_family(setup, guard, KinematicWorld(), progress, checkpoint)
    files = io.BytesIO(), io.BytesIO()
    machine, risk = learnt_by(driving.guard)
    machine.save(files[0])
    risk.save(files[1])
    brakes = risk.brakes
    told = [driving.row.as_dict(), driving.lead_times, dict(driving.decisions), driving.states]
    told += [brakes.shortfalls.rows.tolist(), brakes.brought.rows.tolist()]
    return [file.getvalue() for file in files], repr(told)


def test_driving_that_is_stopped_goes_on_bit_for_bit(tmp_path):
    expected = drive()
    for after in (1, 3):
        with pytest.raises(StoppedError):
            drive(tmp_path / "kept", stop_after=after)
    assert drive(tmp_path / "kept") == expected
    assert drive(tmp_path / "kept", stop_after=1) == expected  # nothing is driven again


def test_driving_goes_on_to_more_episodes_but_not_back_to_fewer(tmp_path):
    drive(tmp_path / "kept", episodes=2)
    assert drive(tmp_path / "kept", episodes=4) == drive(episodes=4)
    with pytest.raises(ValueError, match="has driven 4 episodes, more than 3"):
        drive(tmp_path / "kept", episodes=3)


# -- The commands ----------------------------------------------------------------------------------


@pytest.fixture
def evofsm():
    pytest.importorskip("typer")
    pytest.importorskip("rich")
    import typer.testing

    def run(*arguments):
        from evofsm.__main__ import application

        return typer.testing.CliRunner().invoke(application(), [str(a) for a in arguments])

    return run


@pytest.fixture
def logs(tmp_path):
    random = np.random.default_rng(3)
    paths = []
    for name in ("a.csv", "b.csv"):
        rows = [
            f"{k / 10},{g:.3f},{v:.3f},15,{a:.3f}"
            for k, (g, v, a) in enumerate(
                np.column_stack(
                    [random.uniform(5, 30, 80), random.uniform(9, 20, 80), random.normal(size=80)]
                )
            )
        ]
        paths.append(tmp_path / name)
        paths[-1].write_text("\n".join(["time,gap,v_follower,v_leader,a_follower", *rows, ""]))
    return paths


def test_learn_goes_on_from_its_checkpoint_and_prints_a_finished_one_at_once(
    evofsm, logs, tmp_path, monkeypatch
):
    options = ("--checkpoint", tmp_path / "kept", "--every", "0s")
    plain = evofsm("learn", *logs, "--out", tmp_path / "model")
    expected = (tmp_path / "model").read_bytes()
    good = logs[1].read_text()
    kept = evofsm("learn", *logs, "--out", tmp_path / "model", *options)
    assert kept.stdout == plain.stdout, kept.stderr
    monkeypatch.setattr("evofsm.io.logs._open", lambda *_: pytest.fail("it was read"))
    (tmp_path / "model").unlink()
    again = evofsm("learn", *logs, "--out", tmp_path / "model", *options)
    assert again.stdout == plain.stdout, again.stderr
    assert (tmp_path / "model").read_bytes() == expected
    logs[1].write_text(good + "8.0,9,9,9,0\n")
    grown = evofsm("learn", *logs, *options)
    assert grown.exit_code == 2
    assert "other work: files.1.bytes was" in grown.stderr
    assert (
        "radius was 0.3 and is now 0.4" in evofsm("learn", *logs, *options, "--radius", 0.4).stderr
    )


def test_a_model_says_which_files_it_learnt_from(evofsm, logs, tmp_path):
    learnt = evofsm("learn", *logs, "--out", tmp_path / "model", "--json")
    provenance = json.loads(learnt.stdout)["model"]["provenance"]
    assert [Path(file["name"]) for file in provenance["files"]] == logs
    assert (provenance["rows"], provenance["episodes"]) == (160, 2)
    text = " ".join(evofsm("inspect", tmp_path / "model").stdout.split())
    assert "written by evofsm 0.1.0" in text
    assert "learnt from rows 160" in text


def test_a_result_that_finds_no_room_says_where_it_is_kept(evofsm, logs, tmp_path, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device", str(tmp_path / "model"))

    monkeypatch.setattr("evofsm.fsm.model.FSMModel.save", full)
    out = ("--out", tmp_path / "model")
    without = evofsm("learn", *logs, *out)
    assert without.exit_code == 2
    assert "no space left on device, the result is lost with it; --checkpoint" in without.stderr
    kept = evofsm("learn", *logs, *out, "--checkpoint", tmp_path / "kept")
    assert f"kept, whole, in {tmp_path / 'kept'}: make room, and run the same" in kept.stderr


def test_a_checkpoint_takes_the_place_of_nothing_else(evofsm, logs, tmp_path):
    for options in ((logs[0],), (tmp_path / "model", "--out", tmp_path / "model")):
        result = evofsm("learn", *logs, "--checkpoint", *options)
        assert result.exit_code == 2
        assert "is named twice" in result.stderr
    assert "--every is 'soon'" in evofsm("learn", *logs, "--every", "soon").stderr


def test_drive_writes_the_same_files_with_a_checkpoint(evofsm, tmp_path):
    pytest.importorskip("scipy")
    pytest.importorskip("polars")
    plain, kept, again = (tmp_path / name for name in ("plain", "kept", "again"))
    options = ("--checkpoint", tmp_path / "checkpoint", "--every", "0s")
    for out, episodes, more in ((plain, 3, ()), (kept, 2, options), (again, 3, options)):
        result = evofsm("drive", "emergency", "--episodes", episodes, "--out", out, *more)
        assert result.exit_code == 0, result.stderr
    for path in plain.iterdir():
        assert (again / path.name).read_bytes() == path.read_bytes()


# -- Torture ---------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="it forks")
def test_a_little_torture_harms_nothing():
    script = Path(__file__).parents[2] / "benchmarks" / "torture.py"
    result = subprocess.run([sys.executable, script, "--short"], capture_output=True, text=True)
    assert result.returncode == 0, result.stdout + result.stderr
    assert "15 kills" in result.stdout
    assert "200 damaged files" in result.stdout
    assert "36 forged logs" in result.stdout


def test_a_folder_is_known_by_its_files(tmp_path):
    folder = tmp_path / "bag"
    folder.mkdir()
    (folder / "metadata.yaml").write_text("version: 9")
    (folder / "bag.db3").write_text("1234")
    (before,) = fingerprints([folder])
    assert before["bytes"] == 14
    assert [Path(one["name"]).name for one in before["files"]] == ["bag.db3", "metadata.yaml"]
    (folder / "bag.db3").write_text("1235")
    assert fingerprints([folder]) != [before]
