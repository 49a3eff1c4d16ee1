import signal
import subprocess
import sys
from urllib.request import urlopen

import pytest

pytest.importorskip("websockets")


pytestmark = pytest.mark.usefixtures("compiled")


def watch(*arguments):
    command = [sys.executable, "-m", "evofsm", "watch", *arguments]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


@pytest.mark.slow
def test_it_prints_an_address_that_answers_and_ends_with_control_c():
    process = watch("paper", "--learn-first", "3", "--no-browser")
    with process:
        assert "steer the run" in process.stdout.readline()
        address = process.stdout.readline().strip()
        with urlopen(address, timeout=60) as answer:
            assert b"<!doctype html>" in answer.read()
        process.send_signal(signal.SIGINT)
        rest, errors = process.communicate(timeout=60)
    assert process.returncode == 0
    assert rest == "\nThe page is closed.\n"
    assert errors == ""


@pytest.mark.parametrize(
    ("arguments", "error"),
    [
        (["paper", "--case", "5"], "case is 5; paper has 1 to 4"),
        (["paper", "--unit", "v=km/h"], "options of columns are for a log, and paper is none"),
        (["CartPole-v9"], "CartPole-v9: Environment version `v9` for environment `CartPole`"),
        (["missing.mcap"], "missing.mcap: no such file or directory"),
    ],
)
def test_what_cannot_be_watched_is_said_in_a_line(refused, arguments, error):
    assert error in refused("watch", *arguments, "--no-browser", "--learn-first", "1")


@pytest.mark.slow
def test_a_log_of_others_is_watched(tmp_path):
    lines = ["id,t,x,y,vx,vy,length,lane"]
    for k in range(20):
        for name, x in (("a", 0), ("b", 30)):
            lines.append(f"{name},{0.1 * k:.1f},{x + 2.0 * k},0,20,0,4,1")
    (tmp_path / "objects.csv").write_text("\n".join(lines) + "\n")
    with watch(str(tmp_path / "objects.csv"), "--no-browser") as process:
        assert "steer the run" in process.stdout.readline()
        with urlopen(process.stdout.readline().strip(), timeout=60) as answer:
            assert b"<!doctype html>" in answer.read()
        process.send_signal(signal.SIGINT)
        process.communicate(timeout=60)
    assert process.returncode == 0
