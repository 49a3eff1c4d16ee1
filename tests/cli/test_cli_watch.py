import signal
from contextlib import suppress
from pathlib import Path
from urllib.request import urlopen

import pytest
from tests.cli.test_cli_monitor import started
from websockets.sync.client import connect

from evofsm import EvolvingFSM

pytestmark = pytest.mark.usefixtures("compiled")


OWN = "own.py, line 3, in <lambda>: ZeroDivisionError: division by zero"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "fault", "may", "why"),
    [
        (["paper", "--learn-first", "3"], "", "steer the run", ""),
        (["log.csv"], "", "look on", ""),
        (["own.py", "--learn-first", "0"], "time.sleep(600)", "steer the run", ""),
        (["own.py", "--learn-first", "0"], "1 / 0", "", OWN),
    ],
)
def test_it_prints_an_address_that_answers_and_control_c_ends_what_goes_on_hangs_or_broke_off(
    arguments, fault, may, why
):
    rows = "".join(f"{k / 10},30,20,20,0\n" for k in range(20))
    Path("log.csv").write_text(f"time,gap,v_follower,v_leader,a_follower\n{rows}")
    Path("own.py").write_text(
        "import gymnasium, os, time\nenvironment = lambda: gymnasium.make('Pendulum-v1')\n"
        f"controller = lambda *_: [0.0 if not os.path.exists('armed') else {fault or 0.0}]\n"
    )
    with started("watch", *arguments, "--no-browser", text=True) as process:
        try:
            said, address = process.stdout.readline(), process.stdout.readline().strip()
            with urlopen(address, timeout=60) as answer:
                assert b"<!doctype html>" in answer.read()
            Path("armed").touch()
            place = f"{address.replace('http', 'ws')}socket"
            with connect(place, origin=address.rsplit("/", 2)[0], proxy=None) as client:
                with suppress(TimeoutError):
                    for _ in range(9):  # more than come of a run that does not go on
                        client.recv(timeout=1)
                process.send_signal(signal.SIGINT)
                rest, errors = process.communicate(timeout=60)
        finally:
            process.kill()
    assert (process.returncode, may in said) == (2 if why else 0, True)
    assert rest == "\nThe page is closed.\n"
    broke_off = [f"evofsm: the run broke off: {why}"] * bool(why)
    assert [line for line in errors.splitlines() if "assumed:" not in line] == broke_off


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
        (["rows.csv"], "it has t, heat (--observe names the right one). Is it no log"),
        (["rows.csv", "--learn-first", "9"], "--learn-first: only for what is driven"),
        (["empty.py"], "it defines neither environment() nor a Family called family"),
    ],
)
def test_what_cannot_be_watched_is_said_in_a_line(refused, arguments, error):
    Path("folder").mkdir()
    Path("empty.py").touch()
    Path("rows.csv").write_text("t,heat\n0,1\n1,2\n")
    EvolvingFSM(n_actions=2).save("learnt")
    assert error in refused("watch", *arguments, "--no-browser")
