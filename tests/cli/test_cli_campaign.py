import json
import os
import shutil
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import pytest

pytest.importorskip("typer")
pytest.importorskip("scipy")

from typer.testing import CliRunner

from evofsm.__main__ import application
from evofsm.cli.campaign import Campaign, drive_campaign
from evofsm.cli.driving import Setup, drive_family, make_guard
from evofsm.driving.cars import load_learnt, save_learnt
from evofsm.driving.families import load_family
from evofsm.driving.sumo import open_world
from evofsm.fleet.executors import Here, Processes
from evofsm.guard.reviser import Mode

pytestmark = pytest.mark.slow

EMERGENCY = load_family("emergency")
EPISODES = 400


def command(*arguments):
    return [sys.executable, "-m", "evofsm", "campaign", *map(str, arguments)]


def evofsm(*arguments):
    return subprocess.run(command(*arguments), capture_output=True, text=True, check=False)


def driven(out, setup, open_executor=Here, workers=1, world="kinematic"):
    risk = make_guard(setup).judge
    out.mkdir(exist_ok=True)
    return drive_campaign(Campaign(setup, risk, world), out, open_executor, workers)


def held_out(family=EMERGENCY, **options):
    return Setup(family, learn=False, **options)


def results_of(folder):
    return [(folder / name).read_bytes() for name in ("episodes.csv", "summary.json")]


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    """The folder of a campaign that nothing happened to."""
    out = tmp_path_factory.mktemp("undisturbed")
    driven(out, held_out(reviser="none", episodes=EPISODES))
    return out


def unrevised(out, *arguments):
    return ("emergency", "--reviser", "none", "--episodes", EPISODES, "--out", out, *arguments)


def lines(journal):
    return journal.read_bytes().count(b"\n") if journal.exists() else 0


def wait_for(journal, count, process):
    while lines(journal) < count:
        assert process.poll() is None, process.stderr.read()
        time.sleep(0.005)


def workers_of(process):
    children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
    return [
        int(child)
        for child in children
        if b"spawn_main" in Path(f"/proc/{child}/cmdline").read_bytes()
    ]


def wait_until(condition, seconds=60.0):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.005)


def is_alive(process):
    try:
        return "\nState:\tZ" not in Path(f"/proc/{process}/status").read_text()
    except FileNotFoundError:
        return False


# -- What comes out ----------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("world", ["kinematic", "sumo"])
def test_it_is_what_drive_makes_of_the_same_episodes(tmp_path, world):
    if world == "sumo":
        pytest.importorskip("libsumo")
    setup = held_out(load_family("rare"), reviser="aeb", episodes=6, seed=3)
    with open_world(world) as place:
        driving = drive_family(setup, make_guard(setup), place)
    # A process has one SUMO only, so that here must be closed before another one is opened.
    result = driven(tmp_path, setup, partial(Processes, 2) if world == "sumo" else Here, 2, world)
    assert result.row == driving.row
    assert result.lead_times == driving.lead_times


def test_in_shadow_it_says_how_early_the_alarms_were(tmp_path):
    setup = held_out(mode=Mode.SHADOW, episodes=4)
    result = driven(tmp_path, setup)
    assert len(result.lead_times) == result.row.collisions > 0
    assert min(result.lead_times) > 1.0


@pytest.mark.slow
def test_more_episodes_are_added_to_those_that_are_there(tmp_path, undisturbed):
    shutil.copy(undisturbed / "journal.jsonl", tmp_path)
    before = lines(tmp_path / "journal.jsonl")
    few = driven(tmp_path, held_out(reviser="none", episodes=10))
    assert few.row.episodes == 10
    assert lines(tmp_path / "journal.jsonl") == before
    driven(tmp_path, held_out(reviser="none", episodes=EPISODES + 3))
    assert lines(tmp_path / "journal.jsonl") == before + 3


# -- Whatever happens --------------------------------------------------------------------------


@pytest.mark.slow
def test_killed_workers_and_a_killed_parent_change_nothing(tmp_path, undisturbed):
    journal = tmp_path / "journal.jsonl"
    arguments = unrevised(tmp_path, "--workers", 2)
    with subprocess.Popen(
        command(*arguments), stdout=subprocess.PIPE, stderr=subprocess.PIPE
    ) as process:
        wait_for(journal, 2, process)
        os.kill(workers_of(process)[0], signal.SIGKILL)
        wait_for(journal, lines(journal) + 60, process)
        workers = workers_of(process)
        process.kill()
    assert len(workers) == 2
    assert lines(journal) <= EPISODES
    wait_until(lambda: not any(map(is_alive, workers)))
    with open(journal, "ab") as file:
        file.write(b'{"episode":5,"varia')
    again = evofsm(*arguments, "--json")
    assert again.returncode == 0, again.stderr
    assert results_of(tmp_path) == results_of(undisturbed)
    assert json.loads(again.stdout)["episodes"] == EPISODES


@pytest.mark.slow
def test_a_killed_worker_of_a_cluster_changes_nothing(tmp_path, undisturbed):
    pytest.importorskip("distributed")
    where = tmp_path / "scheduler.json"
    started = []

    def start(module, *options):
        log = open(tmp_path / f"{len(started)}.log", "wb")  # noqa: SIM115
        words = [sys.executable, "-m", f"distributed.cli.{module}", "--scheduler-file", where]
        with log:
            started.append(
                subprocess.Popen([*words, "--no-dashboard", *options], stdout=log, stderr=log)
            )

    out = tmp_path / "out"
    try:
        start("dask_scheduler", "--host", "127.0.0.1", "--port", "0", "--no-show")
        for name in ("one", "two"):
            folder = tmp_path / name
            start(
                *("dask_worker", "--nthreads", "1", "--no-nanny", "--host", "127.0.0.1"),
                *("--local-directory", folder),
            )
        wait_until(lambda: where.exists() and where.stat().st_size)
        address = json.loads(where.read_text())["address"]
        arguments = unrevised(out, *("--executor", "dask", "--scheduler", address, "--workers", 2))
        with subprocess.Popen(
            command(*arguments), stdout=subprocess.PIPE, stderr=subprocess.PIPE
        ) as process:
            wait_for(out / "journal.jsonl", 2, process)
            started[1].kill()
            assert process.wait() == 0, process.stderr.read()
    finally:
        for process in started:
            process.kill()
            process.wait()
    assert results_of(out) == results_of(undisturbed)


@pytest.mark.slow
def test_an_interruption_is_quiet_and_says_how_to_go_on(tmp_path):
    arguments = unrevised(tmp_path, "--workers", 2, "--episodes", 10_000)
    with subprocess.Popen(
        command(*arguments), stderr=subprocess.PIPE, text=True, start_new_session=True
    ) as process:
        wait_for(tmp_path / "journal.jsonl", 2, process)
        os.killpg(process.pid, signal.SIGINT)
        said = process.stderr.read()
    assert process.returncode == 130
    assert "the same command goes on from there" in said
    assert len(said.strip().splitlines()) == 1
    assert lines(tmp_path / "journal.jsonl") > 1


# -- What is refused ---------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"seed": 1}, "seed was 0 and is now 1;"),
        ({"reviser": "rss"}, 'reviser was "none" and is now "rss";'),
        ({"tolerance": 0.1}, "tolerance was 0.02 and is now 0.1;"),
        ({"family": EMERGENCY.with_switches(["noise"])}, "family.switches"),
        ({"family": load_family("rare")}, 'family.name was "emergency" and is now "rare"'),
    ],
)
def test_a_folder_of_other_settings_is_refused(undisturbed, changes, message):
    family = changes.pop("family", EMERGENCY)
    with pytest.raises(ValueError, match="begun with other settings") as caught:
        driven(undisturbed, held_out(family, **{"reviser": "none", **changes}))
    assert message in str(caught.value)


def test_what_was_learnt_is_one_of_the_settings(tmp_path):
    setup = Setup(EMERGENCY, episodes=1)
    guard = make_guard(setup)

    def digest():
        return Campaign(held_out(), guard.judge).settings["learnt"]

    nothing = digest()
    assert nothing == digest()
    with open_world("kinematic") as place:
        drive_family(setup, guard, place)
    assert digest() != nothing
    save_learnt(guard, tmp_path)
    assert Campaign(held_out(), load_learnt(tmp_path)[1]).settings["learnt"] == digest()


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        (("nowhere",), "nowhere"),
        (("emergency", "--reviser", "magic"), "magic"),
        (("emergency", "--mode", "maybe"), "maybe"),
        (("emergency", "--executor", "dask"), "--scheduler"),
        (("emergency", "--scheduler", "tcp://x"), "--executor dask"),
        (("emergency", "--frozen", "nothing-here"), "nothing-here"),
    ],
)
def test_what_cannot_be_driven_is_refused_in_one_line(tmp_path, arguments, word):
    result = CliRunner().invoke(application(), ["campaign", *arguments, "--out", str(tmp_path)])
    assert result.exit_code == 2
    assert word in result.stderr
    assert len(result.stderr.splitlines()) == 1
