"""Every command has --json, and answers with one document that any program can read."""

import json
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("typer")
pytest.importorskip("scipy")

import typer.main
from typer.testing import CliRunner

from evofsm.__main__ import application
from evofsm.driving.judge import LatentRisk
from evofsm.fsm.actions import IntervalActions
from evofsm.fsm.machine import EvolvingFSM
from evofsm.guard.api import Proposal
from evofsm.guard.audit_log import AuditLog
from evofsm.guard.guard import Guard
from evofsm.guard.reviser import ActionReviser


def commands(group, path=()):
    """All commands of the application, by what is typed."""
    for name, command in group.commands.items():
        if hasattr(command, "commands"):
            yield from commands(command, (*path, name))
        else:
            yield " ".join((*path, name)), command


# These answer with a page that lives, in formats of others, and in lines of JSON whatever is asked.
ELSEWISE = ("watch", "export", "monitor")
COMMANDS = dict(commands(typer.main.get_command(application())))


@pytest.mark.parametrize("name", [name for name in COMMANDS if name not in ELSEWISE])
def test_every_command_has_it(name):
    options = {option for one in COMMANDS[name].params for option in one.opts}
    assert "--json" in options, f"evofsm {name} tells programs nothing"


def document(*arguments):
    """What a command prints for programs; fails where that is not one strict document."""

    def refuse(constant):
        raise AssertionError(f"{constant} is no JSON")

    result = CliRunner().invoke(application(), [*map(str, arguments), "--json"])
    assert result.exit_code == 0, result.stderr
    return json.loads(result.stdout, parse_constant=refuse)


def a_log(folder: Path) -> Path:
    actions = IntervalActions(low=-2.5, high=2.5, width=0.3, outside="clip")
    risk = LatentRisk(actions.low)
    with AuditLog(folder / "log.jsonl") as written:
        guard = Guard.of(ActionReviser(risk, actions), judge=risk, audit=written)
        guard.revise(guard.recognise(np.array([20.0, 15.0, 11.0]), 0.0), Proposal(1.0))
        guard.end(failed=False, observation=np.array([19.0, 15.0, 11.0]))
    return written.path


def test_audit(tmp_path):
    found = document("audit", a_log(tmp_path))
    assert found.keys() >= {"is_good", "head", "finding", "contents", "replayed"}


def test_check():
    found = document("check", "evofsm.driving.measures:TimeHeadway")
    assert found
    assert all(one["passed"] for one in found)


def test_learn_and_inspect(tmp_path):
    log = tmp_path / "log.csv"
    rows = [f"{k / 10},{20 + k % 7},15,14,{0.1 * (k % 3)}" for k in range(60)]
    log.write_text("\n".join(["time,gap,v_follower,v_leader,a_follower", *rows, ""]))
    learnt = document("learn", log, "--out", tmp_path / "m")
    inspected = document("inspect", tmp_path / "m")
    assert learnt["model"].keys() <= inspected.keys()
    assert learnt["model"]["states"] == inspected["states"]
    explained = document("inspect", tmp_path / "m", "--state", "all")["situations"]
    assert [one["visits"] for one in explained] == [one["visits"] for one in inspected["states"]]


def test_a_machine_that_has_learnt_nothing_is_told_without_nan(tmp_path):
    EvolvingFSM(3).save(tmp_path / "m")
    assert document("inspect", tmp_path / "m")["states"] == []


def test_drive():
    driven = document("drive", "emergency", "--episodes", 2)
    assert driven["episodes"] == 2
    assert [state["state"] for state in driven["states"]] == list(range(len(driven["states"])))
