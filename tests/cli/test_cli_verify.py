import json
import sys

import numpy as np
import pytest

pytest.importorskip("typer")

from typer.testing import CliRunner

from evofsm.__main__ import application
from evofsm.driving.revisers import Unrevised
from evofsm.fsm.actions import IntervalActions
from evofsm.fsm.machine import EvolvingFSM
from evofsm.guard import Guard

FILES = ("guard.evofsm", "machine.evofsm")
ASKED = 'Pmax=? [F<=20 "failed"]'


@pytest.fixture(autouse=True)
def _without_storm(monkeypatch, request):
    """As where stormpy is not installed, but for tests that ask for it."""
    if "with_storm" not in request.fixturenames:
        monkeypatch.setattr("evofsm.cli.commands.verify.find_spec", lambda name: None)


@pytest.fixture
def with_storm():
    pytest.importorskip("stormpy")


def evofsm(*arguments):
    return CliRunner().invoke(application(), [str(argument) for argument in arguments])


def grown(**told):
    machine = EvolvingFSM(n_actions=2, radius=0.3)
    rng = np.random.default_rng(0)
    for _ in range(30):
        Z = np.cumsum(rng.normal(0.4, 0.5, 12))[:, np.newaxis]
        machine.learn_many(Z, rng.integers(0, 2, 12), **told)
    return machine


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    """A machine, a model and a guard of the same, in files."""
    folder = tmp_path_factory.mktemp("verify")
    machine = grown(failures=[11])
    machine.save(folder / "machine.evofsm")
    machine.model().save(folder / "model.evofsm")
    actions = IntervalActions(-1.0, 1.0, 1.0, outside="clip")
    Guard.of(Unrevised(actions), interval=1.0, machine=machine).save(folder / "guard.evofsm")
    return folder


def test_a_machine_and_its_model_give_the_same_and_say_who_answered(saved):
    results = [evofsm("verify", saved / name, ASKED) for name in ("machine.evofsm", "model.evofsm")]
    for result in results:
        assert result.exit_code == 0, result.stderr
        assert "(our own computation)" in result.stdout
        assert "from #1: 0." in result.stdout
    assert results[0].stdout == results[1].stdout
    # a folder of results holds a machine
    assert evofsm("verify", saved, ASKED).stdout == results[0].stdout


def test_a_guard_is_asked_by_its_machine(saved):
    results = [evofsm("verify", saved / name, ASKED, "--json") for name in FILES]
    assert results[0].exit_code == 0, results[0].stderr
    assert results[0].stdout == results[1].stdout
    told = json.loads(results[0].stdout)
    assert 0.0 < told["probability"] < 1.0
    assert (told["engine"], told["same"], told["state"]) == ("own", None, 0)


def test_another_state_more_evidence(saved):
    file = saved / "machine.evofsm"
    most = np.sort(EvolvingFSM.load(file).model().decisions.max(axis=0))
    told = [
        json.loads(evofsm("verify", file, ASKED, "--json", *more).stdout)["probability"]
        for more in ((), ("--state", 2), ("--evidence", most[-1]))
    ]
    assert len(set(told)) == 3
    result = evofsm("verify", file, ASKED, "--evidence", most[-1])
    assert "not to be taken for safe" in result.stdout


def test_what_cannot_be_answered_is_one_line_with_the_reason(saved, tmp_path, monkeypatch):
    file = saved / "machine.evofsm"
    for asked, reason in {
        'Pmax=? [F "failed"]': "pip install '.[verify]'",
        'P=? [F<=20 "failed"]': "Pmax=? or Pmin=?",
        'Pmax=? [F<=20 "crash"]': "no label",
    }.items():
        result = evofsm("verify", file, asked)
        assert result.exit_code == 2
        assert reason in result.stderr
        assert result.stderr.count("\n") == 1
    assert "no state #999" in evofsm("verify", file, ASKED, "--state", 999).stderr
    monkeypatch.setitem(sys.modules, "stormpy", None)
    assert "needs stormpy" in evofsm("verify", file, ASKED, "--engine", "storm").stderr

    grown().save(tmp_path / "untold.evofsm")
    result = evofsm("verify", tmp_path / "untold.evofsm", ASKED)
    assert result.exit_code == 2
    assert "never told of failures" in result.stderr
    grown(failures=[]).save(tmp_path / "safe.evofsm")
    assert "would say nothing" in evofsm("verify", tmp_path / "safe.evofsm", ASKED).stderr
    EvolvingFSM(n_actions=2, radius=0.3).save(tmp_path / "empty.evofsm")
    empty = evofsm("verify", tmp_path / "empty.evofsm", 'Pmax=? [F<=20 "unknown"]')
    assert "counted no decisions" in empty.stderr
    assert evofsm("verify", tmp_path / "nowhere.evofsm", ASKED).exit_code == 2


@pytest.mark.usefixtures("with_storm")
def test_storm_answers_where_it_is_installed_and_ours_stands_beside(saved):
    file = saved / "machine.evofsm"
    result = evofsm("verify", file, ASKED)
    assert result.exit_code == 0, result.stderr
    assert "(Storm)" in result.stdout
    assert "the same" in result.stdout
    told = json.loads(evofsm("verify", file, ASKED, "--json").stdout)
    assert told["same"] is True
    alone = json.loads(evofsm("verify", file, ASKED, "--json", "--engine", "own").stdout)
    assert alone["probability"] == pytest.approx(told["probability"], abs=1e-10)
    assert evofsm("verify", file, 'Pmax=? [F "failed"]').exit_code == 0
