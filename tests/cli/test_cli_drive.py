"""`evofsm drive`: in turn and learning, or many at once; whatever stops it, it goes on."""

import json
import os
import signal
import subprocess
import time
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace

import polars
import pytest
from tests.cli.test_cli_monitor import started

from evofsm import Guard
from evofsm.cli.driving import (
    DECISION_TABLE,
    Results,
    Setup,
    drive_at_once,
    drive_in_turn,
    make_guard,
)
from evofsm.driving import load_family
from evofsm.guard.audit_log import digests_of

EMERGENCY = load_family("emergency")
EPISODES = 400


def begun(folder, setup):
    return closing(Results(setup, make_guard(setup), folder))


def in_turn(folder=None, episodes=6, **options):
    setup = Setup(options.pop("family", EMERGENCY), **options)
    with begun(folder, setup) as results:
        return SimpleNamespace(row=drive_in_turn(results, episodes), guard=results.guard)


# -- In turn --------------------------------------------------------------------------------------


def test_it_learns_saves_and_drives_frozen(evofsm, tmp_path):
    learnt = tmp_path / "learnt"
    first = evofsm("drive", "emergency", "--episodes", 12, "--out", learnt)
    assert first.exit_code == 0, first.stderr
    assert "0 of 12: 0.0% (95 %, two-sided: 0.0% to 26.5%)" in first.stdout
    written = {path.name for path in learnt.iterdir()}
    assert written == {"guard.evofsm", "episodes.jsonl", "episodes.csv", "decisions.parquet"}
    table = polars.read_parquet(learnt / "decisions.parquet")
    assert table.columns == ["episode", *DECISION_TABLE]
    changed = table.filter(polars.col("proposed") != polars.col("executed"))
    assert changed["reason"].str.len_chars().min() > 10
    frozen = evofsm("drive", "emergency", "--episodes", 5, "--frozen", learnt, "--json")
    row = json.loads(frozen.stdout)
    assert (row["episodes"], row["collisions"]) == (5, 0)


@pytest.mark.slow
def test_a_judge_that_is_given_nothing_but_failures_is_driven_saved_and_gone_on_with(
    evofsm, refused, tmp_path
):
    drive, out = ("drive", "emergency", "--judge", "learnt"), tmp_path / "learnt"
    first = evofsm(*drive, "--episodes", 6, "--out", out, "--audit", tmp_path / "log")
    assert first.exit_code == 0, first.stderr
    text = " ".join(first.stdout.split())
    assert "learnt, given nothing but failures" in text
    assert "fails where gap is below" in text
    assert evofsm("audit", tmp_path / "log").exit_code == 0
    whole = json.loads(evofsm(*drive, "--episodes", 8, "--json").stdout)
    again = json.loads(evofsm(*drive, "--episodes", 8, "--json", "--out", out).stdout)
    assert again == whole
    frozen = evofsm(*drive, "--episodes", 3, "--frozen", out)
    assert "held-out episodes" in frozen.stdout, frozen.stderr
    wrong = refused("drive", "emergency", "--episodes", 3, "--frozen", out)
    assert "of the judge 'learnt', not of 'kinematic'" in wrong


# -- Whatever stops it ----------------------------------------------------------------------------


def results_of(folder):
    """What does not depend on the order in which episodes were done."""
    return (folder / "episodes.csv").read_bytes()


@pytest.mark.parametrize("every", [0.0, 1e9])
def test_learning_that_is_stopped_goes_on_bit_for_bit(tmp_path, snapshot, monkeypatch, every):
    monkeypatch.setattr("evofsm.cli.driving._EVERY", every)
    plain = in_turn(tmp_path / "plain", 5)
    folder, setup = tmp_path / "stopped", Setup(EMERGENCY)

    def show(done, **_):
        if done in stops:
            stops.remove(done)
            raise EOFError

    stops = [1, 2, 4]
    while stops:
        with begun(folder, setup) as results, pytest.raises(EOFError):
            drive_in_turn(results, 5, show)
    again = in_turn(folder, 5)
    assert results_of(folder) == results_of(tmp_path / "plain")
    assert snapshot(again.guard.machine) == snapshot(plain.guard.machine)
    assert digests_of(again.guard) == digests_of(plain.guard)
    more = in_turn(folder, 7)
    assert more.row == in_turn(episodes=7).row
    with pytest.raises(ValueError, match="has driven 7 episodes, more than 5"):
        in_turn(folder, 5)


def test_who_asks_it_to_stop_loses_nothing_and_no_episode_stands_twice(evofsm, monkeypatch):
    drive, signals = Setup.drive, {1: signal.SIGINT, 3: signal.SIGTERM}
    killed = lambda *rest: (os.kill(os.getpid(), signals.pop(rest[-1], 0)), drive(*rest))[1]  # noqa: E731
    monkeypatch.setattr(Setup, "drive", killed)
    out, log = Path("out"), Path("log")
    words = "drive", "emergency", "--episodes", 5, "--json"
    for kept in (2, 4):
        stopped = evofsm(*words, "--out", out, "--audit", log)
        assert (stopped.exit_code, f"after {kept} of 5" in stopped.stderr) == (130, True)
    with begun(out, Setup(EMERGENCY)) as results:
        results.add({"episode": 4})  # as where it is killed before it saves
    again = evofsm(*words, "--out", out, "--audit", log)
    assert again.stdout == evofsm(*words).stdout
    _, *rows = map(json.loads, (out / "episodes.jsonl").read_text().splitlines())
    assert [row["episode"] for row in rows] == [*range(5)]
    assert "3 sessions, 5 episodes" in evofsm("audit", log).stdout


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"seed": 1}, "seed was 0 and is now 1;"),
        ({"reviser": "least-risk"}, 'reviser was "none" and is now "least-risk";'),
        ({"family": EMERGENCY.with_switches(["noise"])}, "switches was [] and is now"),
        ({"learn": True}, "learn was false and is now true"),
    ],
)
def test_a_folder_of_other_settings_is_refused(tmp_path, changes, says):
    in_turn(tmp_path, 1, reviser="none", learn=False)
    with pytest.raises(ValueError, match="begun with other settings") as caught:
        in_turn(tmp_path, 1, **({"reviser": "none", "learn": False} | changes))
    assert says in str(caught.value)
    assert "or name another folder" in str(caught.value)


def test_what_was_learnt_is_one_of_the_settings_and_two_at_once_are_refused(evofsm, refused):
    for name in ("a", "b"):
        in_turn(Path(name), 1, seed=ord(name))
    out = ("--episodes", 1, "--out", "out")
    assert evofsm("drive", "emergency", "--frozen", "a", *out).exit_code == 0
    assert "digest was" in refused("drive", "emergency", "--frozen", "b", *out)
    with begun(Path(), Setup(EMERGENCY)), pytest.raises(ValueError, match="another process"):
        in_turn(Path(), 1)


def test_a_full_disk_is_named_and_what_was_driven_is_kept(tmp_path, monkeypatch):
    in_turn(tmp_path, 2)
    with monkeypatch.context() as patched:
        patched.setattr(Guard, "save", lambda *_: (_ for _ in ()).throw(OSError(28, "No space")))
        with pytest.raises(OSError, match="No space") as caught:
            in_turn(tmp_path, 3)
    assert "what was saved is kept" in caught.value.__notes__[0]
    assert in_turn(tmp_path, 3).row.episodes == 3


# -- At once --------------------------------------------------------------------------------------


def test_workers_without_what_was_learnt_are_told_of(evofsm, tmp_path):
    (tmp_path / "guard.evofsm").touch()  # so that it ends before it begins
    result = evofsm("drive", "emergency", "--workers", 2, "--out", tmp_path)
    assert "--workers learn nothing" in result.stderr


def unrevised(out, *words):
    return ("emergency", "--reviser", "none", "--episodes", EPISODES, "--out", out, *words)


def lines(journal):
    return journal.read_bytes().count(b"\n") if journal.exists() else 0


def wait_for(journal, count, process):
    while lines(journal) < count:
        assert process.poll() is None, process.stderr.read()
        time.sleep(0.005)


def workers_of(process):
    children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
    of_each = {int(child): Path(f"/proc/{child}/cmdline").read_bytes() for child in children}
    return [child for child, command in of_each.items() if b"spawn_main" in command]


def is_alive(process):
    try:
        return "\nState:\tZ" not in Path(f"/proc/{process}/status").read_text()
    except FileNotFoundError:
        return False


@pytest.mark.slow
@pytest.mark.parametrize("world", ["kinematic", "sumo"])
def test_it_is_what_driving_in_turn_makes_of_the_same_episodes(tmp_path, world):
    asked = {"family": load_family("rare"), "seed": 3, "world": world, "learn": False}
    for episodes in (6, 3):  # of so few, the first ones are summed up
        with begun(tmp_path, Setup(**asked)) as results:
            assert drive_at_once(results, episodes, 2) == in_turn(episodes=episodes, **asked).row


@pytest.mark.slow
def test_killed_workers_and_a_killed_parent_change_nothing(evofsm, tmp_path):
    journal, words = tmp_path / "episodes.jsonl", unrevised(tmp_path, "--workers", 2)
    with started("drive", *words, stdout=subprocess.DEVNULL) as process:
        wait_for(journal, 2, process)
        os.kill(workers_of(process)[0], signal.SIGKILL)
        assert process.wait() == 2
        assert b"a worker died (out of memory?" in process.stderr.read()
    done = lines(journal)
    assert done <= EPISODES
    with started("drive", *words, stdout=subprocess.DEVNULL) as process:
        wait_for(journal, done + 60, process)
        workers = workers_of(process)
        process.kill()
    assert workers
    assert lines(journal) <= EPISODES
    end = time.monotonic() + 60.0
    while any(map(is_alive, workers)):
        assert time.monotonic() < end
        time.sleep(0.005)
    with open(journal, "ab") as file:
        file.write(b'{"episode":5,"varia')
    again = evofsm("drive", *unrevised(tmp_path, "--workers", 1), "--json")
    assert again.exit_code == 0, again.stderr
    in_turn(tmp_path / "undisturbed", EPISODES, reviser="none", learn=False)
    assert results_of(tmp_path) == results_of(tmp_path / "undisturbed")
    assert json.loads(again.stdout)["episodes"] == EPISODES


@pytest.mark.slow
def test_an_interruption_is_quiet_and_says_how_to_go_on(tmp_path):
    words = unrevised(tmp_path, "--workers", 2, "--episodes", 10_000)
    with started("drive", *words, text=True, start_new_session=True) as process:
        wait_for(tmp_path / "episodes.jsonl", 2, process)
        os.killpg(process.pid, signal.SIGINT)
        said = process.stderr.read()
    assert process.returncode == 130
    assert "the same command goes on from there" in said
    assert len(said.strip().splitlines()) == 1
    assert lines(tmp_path / "episodes.jsonl") > 1
