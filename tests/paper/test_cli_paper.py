import json
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow

pytest.importorskip("typer")


def evofsm(*arguments, folder):
    command = [sys.executable, "-m", "evofsm", *map(str, arguments)]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)


@pytest.fixture(scope="module")
def reproduced(tmp_path_factory):
    """The whole command, in SUMO, as a stranger runs it."""
    pytest.importorskip("libsumo")
    folder = tmp_path_factory.mktemp("paper")
    return evofsm("paper", "--out", "out", folder=folder), folder / "out"


def test_all_claims_hold_and_the_page_is_named(reproduced):
    run, _ = reproduced
    assert run.returncode == 0, run.stderr
    assert "10 of 10 claims of the paper hold" in run.stdout
    assert "out/index.html" in run.stdout


def test_a_claim_that_fails_is_shown_and_ends_with_1(tmp_path):
    settings = tmp_path / "coarse.toml"
    settings.write_text("[machine]\nradius = 30.0\n")
    run = evofsm(
        *("paper", "--world", "kinematic", "--rounds", 1, "--settings", settings, "--json"),
        *("--out", tmp_path / "out"),
        folder=tmp_path,
    )
    assert run.returncode == 1, run.stderr
    failing = [claim["id"] for claim in json.loads(run.stdout) if not claim["holds"]]
    assert "states_final" in failing


@pytest.mark.parametrize(
    ("option", "value", "message"),
    [("--settings", "missing.toml", "missing.toml: no such file"), ("--out", "file", "file")],
)
def test_what_cannot_be_done_is_said_in_a_line_and_ends_with_2(tmp_path, option, value, message):
    (tmp_path / "file").write_text("in the way")
    run = evofsm("paper", "--world", "kinematic", option, value, folder=tmp_path)
    assert run.returncode == 2
    assert message in run.stderr
    assert "Traceback" not in run.stderr


def test_the_docs_show_what_the_command_measures(reproduced):
    _, folder = reproduced
    page = (Path(__file__).parents[2] / "docs" / "paper.md").read_text()
    for claim in json.loads((folder / "claims.json").read_text()):
        cells = (claim["claim"], claim["paper"], claim["measured"])
        assert f"| {' | '.join(cells)} | {'yes' if claim['holds'] else 'no'} |" in page
