import signal
from contextlib import suppress
from urllib.request import urlopen

import pytest
from tests.cli.test_cli_monitor import started
from websockets.sync.client import connect

from evofsm import EvolvingFSM

pytestmark = pytest.mark.usefixtures("compiled")

LOG = ["time,gap,v_follower,v_leader,a_follower", *(f"{k / 10},30,20,20,0" for k in range(20))]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "may"),
    [(["paper", "--learn-first", "3"], "steer the run"), (["log.csv"], "look on")],
)
def test_it_prints_an_address_that_answers_and_ends_with_control_c(tmp_path, arguments, may):
    (tmp_path / "log.csv").write_text("\n".join([*LOG, ""]))
    words = "watch", *arguments, "--no-browser"
    with started(*words, cwd=tmp_path, text=True) as process:
        try:
            said = process.stdout.readline()
            with urlopen(process.stdout.readline().strip(), timeout=60) as answer:
                assert b"<!doctype html>" in answer.read()
        finally:
            process.send_signal(signal.SIGINT)
            rest, errors = process.communicate(timeout=60)
    assert process.returncode == 0
    assert may in said
    assert rest == "\nThe page is closed.\n"
    assert [line for line in errors.splitlines() if "assumed:" not in line] == []


@pytest.mark.slow
@pytest.mark.parametrize(
    ("fault", "status", "said"),
    [
        ("time.sleep(600)", 0, ""),
        ("1 / 0", 2, "the run broke off: ZeroDivisionError: division by zero"),
    ],
)
def test_control_c_ends_what_hangs_or_broke_off(tmp_path, fault, status, said):
    (tmp_path / "own.py").write_text(
        "import gymnasium, os, time\nenvironment = lambda: gymnasium.make('Pendulum-v1')\n"
        f"controller = lambda seen, random: [0.0 if not os.path.exists('armed') else {fault}]\n"
    )
    words = "watch", "own.py", "--learn-first", "0", "--no-browser"
    with started(*words, cwd=tmp_path, text=True) as process:
        process.stdout.readline()
        address = process.stdout.readline().strip()
        (tmp_path / "armed").touch()
        place = f"{address.replace('http', 'ws')}socket"
        with connect(place, origin=address.rsplit("/", 2)[0], proxy=None) as client:
            with suppress(TimeoutError):
                while client.recv(timeout=1):
                    pass
            process.send_signal(signal.SIGINT)
            _, errors = process.communicate(timeout=60)
    assert (process.returncode, errors.strip()) == (status, said and f"evofsm: {said}")


@pytest.mark.parametrize(
    ("arguments", "error"),
    [
        (["paper", "--case", "5", "--learn-first", "1"], "case is 5; paper has 1 to 4"),
        (["paper", "--brakes", "6", "--unit", "v=km/h"], "--brakes, --unit: only for a log"),
        (["CartPole-v9"], "CartPole-v9: Environment version `v9` for environment `CartPole`"),
        (["missing.mcap"], "missing.mcap: no such file or directory"),
        (["CartPole"], "named with its version: CartPole-v1"),
        (["folder"], "folder is a folder; name the files in it"),
        (["learnt"], "learnt holds what was learnt, and is no log: evofsm inspect prints it"),
        (
            ["rows.csv"],
            "no column 'gap'; it has t, heat (--observe names the right one). Is it no log",
        ),
        (["rows.csv", "--learn-first", "9"], "--learn-first: only for what is driven"),
        (["empty.py"], "it defines neither environment() nor a Family called family"),
    ],
)
def test_what_cannot_be_watched_is_said_in_a_line(refused, tmp_path, monkeypatch, arguments, error):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "folder").mkdir()
    (tmp_path / "empty.py").touch()
    (tmp_path / "rows.csv").write_text("t,heat\n0,1\n1,2\n")
    EvolvingFSM(n_actions=2).save("learnt")
    assert error in refused("watch", *arguments, "--no-browser")
