import json
from pathlib import Path

import pytest

pytest.importorskip("typer")

from typer.testing import CliRunner

from evofsm.cli.app import application


def evofsm(*words):
    return CliRunner().invoke(application(), ["paper", *map(str, words)])


@pytest.fixture(scope="module")
def reproduced(tmp_path_factory):
    """The whole command, in SUMO."""
    pytest.importorskip("libsumo")
    folder = tmp_path_factory.mktemp("paper") / "out"
    return evofsm("--out", folder), folder


@pytest.mark.slow
def test_all_claims_hold_as_the_docs_show_them_and_the_page_is_named(reproduced):
    run, folder = reproduced
    assert run.exit_code == 0, run.stderr
    assert "10 of 10 claims of the paper hold" in run.stdout
    assert f"{folder}/index.html" in run.stdout.replace("\n", "")
    page = (Path(__file__).parents[2] / "docs" / "paper.md").read_text()
    for claim in json.loads((folder / "claims.json").read_text()):
        assert f"| {claim['claim']} | {claim['paper']} | {claim['measured']} | yes |" in page


@pytest.mark.slow
def test_a_claim_that_fails_is_shown_and_ends_with_1(tmp_path):
    settings = tmp_path / "coarse.toml"
    settings.write_text("[machine]\nradius = 30.0\n")
    told = "--world", "kinematic", "--rounds", 1, "--settings", settings
    run = evofsm(*told, "--json", "--out", tmp_path / "out")
    assert run.exit_code == 1, run.stderr
    failing = [claim["id"] for claim in json.loads(run.stdout) if not claim["holds"]]
    assert "states_final" in failing


@pytest.mark.parametrize(
    ("option", "value", "message"),
    [("--settings", "missing.toml", "missing.toml: no such file"), ("--out", "file", "file")],
)
def test_what_cannot_be_done_is_said_in_a_line_before_anything_is_driven(
    tmp_path, monkeypatch, option, value, message
):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("evofsm.paper.reproduction.run_paper", None)
    (tmp_path / "file").write_text("in the way")
    run = evofsm("--world", "kinematic", option, value)
    assert (run.exit_code, run.stdout) == (2, "")
    (line,) = run.stderr.splitlines()
    assert message in line
