"""The command line as a whole: its help, its errors, and what it says where a package lacks."""

import json
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from evofsm.cli import options
from evofsm.extras import OF_COMMANDS


def python(code):
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)


@pytest.mark.parametrize("missing", ["typer", "rich"])
def test_without_the_extra_one_line_says_what_to_install(missing):
    result = python(
        f"import sys; sys.modules[{missing!r}] = None\n"
        "sys.argv = ['evofsm', 'paper']\nfrom evofsm.__main__ import main\nmain()"
    )
    needs = "the command line needs typer and rich: pip install 'evofsm[cli,plot,sumo,tables]'"
    assert (result.returncode, result.stderr) == (2, f"evofsm: {needs}\n")


def test_control_c_while_it_is_loaded_is_one_line():
    result = python(
        "import builtins, evofsm.__main__ as program\n"
        "def stop(*_): raise KeyboardInterrupt\n"
        "builtins.__import__ = stop\nprogram.main()"
    )
    assert (result.returncode, result.stderr) == (130, "evofsm: stopped before the end\n")


def test_all_that_a_command_lacks_is_named_at_once(evofsm, monkeypatch):
    monkeypatch.setattr(options, "find_spec", lambda name: None)
    told = evofsm("drive", "paper", "--world", "sumo").stderr
    assert told == ("evofsm: this needs scipy and libsumo: pip install 'evofsm[cli,study,sumo]'\n")


def test_extras_of_commands_exist():
    project = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text())["project"]
    needed = {one for extras in OF_COMMANDS.values() for one in extras}
    assert needed <= set(project["optional-dependencies"])


@pytest.mark.parametrize("command", ["", "drive", "monitor"])
def test_help_loads_nothing_heavy(command):
    words = [*command.split(), "--help"]
    result = python(
        "import sys\n"
        "from evofsm.cli.app import application\n"
        f"application()({words}, standalone_mode=False)\n"
        "print(sorted({'numpy', 'numba', 'polars', 'libsumo', 'rich'} & set(sys.modules)))"
    )
    assert result.stdout.splitlines()[-1] == "[]"
    assert "Options:" in result.stdout


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["nosuch"], "No such command 'nosuch'"),
        (["check"], "Missing argument 'name'"),
        (["check", "evofsm"], "names nothing; write module:Name"),
        (["check", "evofsm.fsm.rules:Calm"], "has no attribute 'Calm'"),
        (["check", "not_there:Calm"], "is it in this folder, or installed?"),
        (["check", "evofsm.guard:Proposal"], "has the methods of no kind"),
        (["inspect", "x", "--colour", "red"], "No such option: --colour"),
        (["drive", "paper", "--episodes", "0"], "Invalid value for '--episodes'"),
        (["drive", "paper", "--world", "moon"], "'moon' is not one of 'sumo', 'kinematic'"),
        (["audit", "nowhere"], "no such file"),
        (["audit", __file__, "--head", "abc"], "NUMBER:HASH"),
        (["drive", "nowhere"], "nowhere"),
        (["drive", "paper", "--reviser", "magic"], "magic"),
        (["drive", "emergency+rain"], "rain"),
        (["drive", "paper", "--frozen", "nothing-here"], "nothing-here"),
        (["drive", "paper", "--tolerance", "2"], "tolerance"),
        (["drive", "paper", "--mcap", "a", "--workers", "2"], "workers send no decisions"),
        (["drive", "paper", "--vehicles", "10%"], "--vehicles: only for a configuration"),
        (["drive", "paper", "--reviser", "none", "--mode", "act"], "--mode: only for --reviser l"),
    ],
)
def test_a_command_that_is_called_wrongly_says_so_in_one_line(refused, words, says):
    assert says in refused(*words)


def test_what_programs_are_told_is_strict_json(evofsm):
    told = evofsm("check", "evofsm.fsm.rules:Paper", "--json").stdout
    assert all(one["passed"] for one in json.loads(told, parse_constant=pytest.fail))
    told = evofsm("drive", "emergency", "--episodes", 2, "--json").stdout
    assert json.loads(told, parse_constant=pytest.fail)["episodes"] == 2


def test_check_ends_with_1_and_says_what_is_wrong(evofsm, monkeypatch):
    Path("own_driver.py").write_text(
        "from evofsm.guard import Proposal\nclass Confused:\n"
        "    def propose(self, observation, time=0.0):\n        return Proposal(float('nan'))\n"
    )
    monkeypatch.setattr(sys, "path", list(sys.path))
    monkeypatch.delitem(sys.modules, "own_driver", raising=False)
    result = evofsm("check", "own_driver:Confused", "--json")
    assert result.exit_code == 1
    assert '"passed": false' in result.output
    assert "it proposes nan at gap" in result.output
    result = evofsm("check", "own_driver:Confused")
    assert max(map(len, result.output.splitlines())) <= 80
