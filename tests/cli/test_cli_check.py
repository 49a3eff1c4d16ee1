"""`evofsm check`."""

import sys

import pytest

MODULE = """
from evofsm.guard import Proposal

class Confused:
    def propose(self, observation, time=0.0):
        return Proposal(float("nan"))
"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A folder with a module of one's own."""
    (tmp_path / "own_driver.py").write_text(MODULE)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    monkeypatch.delitem(sys.modules, "own_driver", raising=False)


def test_it_ends_with_1_and_says_what_is_wrong(evofsm, folder):
    result = evofsm("check", "own_driver:Confused", "--json")
    assert result.exit_code == 1
    assert '"passed": false' in result.output
    assert "it proposes nan at gap" in result.output
    result = evofsm("check", "own_driver:Confused")
    assert max(map(len, result.output.splitlines())) <= 80


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["own_driver"], "names nothing; write module:Name"),
        (["own_driver:Calm"], "has no attribute 'Calm'"),
        (["not_there:Calm"], "is it in this folder, or installed?"),
        (["own_driver:Proposal"], "has the methods of no kind"),
    ],
)
def test_what_cannot_be_checked_is_refused_in_one_line(refused, folder, arguments, message):
    assert message in refused("check", *arguments)
