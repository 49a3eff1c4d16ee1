"""`evofsm paper`."""

import json
from pathlib import Path

import pytest

from evofsm import FSMModel
from evofsm.paper import Settings


@pytest.mark.slow
def test_all_claims_hold_in_sumo_as_the_docs_show_them_and_all_of_it_is_written(
    evofsm, read_page, tmp_path, monkeypatch
):
    monkeypatch.setattr("sys.argv", ["evofsm", "paper"])
    folder = tmp_path / "new" / "out"
    run = evofsm("paper", "--out", folder)
    assert run.exit_code == 0, run.stderr
    assert "10 of 10 claims of the paper hold" in run.stdout
    assert f"{folder}/index.html" in run.stdout.replace("\n", "")
    read = read_page(folder / "index.html")
    read.is_sound()
    for said in ("Does the paper's machine", "evofsm paper", "#4 at 15 s"):
        assert said in read.text
    assert len(list((folder / "figures").iterdir())) == 12
    assert FSMModel.load(folder / "model.evofsm").n_states == 7
    page = (Path(__file__).parents[2] / "docs" / "paper.md").read_text()
    for claim in json.loads((folder / "claims.json").read_text()):
        assert f"| {claim['claim']} | {claim['paper']} | {claim['measured']} | yes |" in page


@pytest.mark.slow
def test_a_claim_that_fails_is_shown_and_ends_with_1(evofsm, refused, tmp_path, monkeypatch):
    coarse = Settings.load({"machine": {"radius": 30.0}})
    monkeypatch.setattr(Settings, "load", lambda: coarse)
    told = "paper", "--world", "kinematic", "--rounds", 1, "--json", "--out", tmp_path / "out"
    for _ in range(2):  # anew, too
        run = evofsm(*told)
        assert run.exit_code == 1, run.stderr
    failing = [claim["id"] for claim in json.loads(run.stdout) if not claim["holds"]]
    assert "states_final" in failing
    (tmp_path / "out" / "model.evofsm").write_text("mine")
    assert "it was left alone" in refused(*told)


def test_a_folder_that_cannot_be_is_said_before_anything_is_driven(refused, tmp_path, monkeypatch):
    monkeypatch.setattr("evofsm.paper.run_paper", None)
    (tmp_path / "file").write_text("in the way")
    said = refused("paper", "--world", "kinematic", "--out", tmp_path / "file")
    assert "file: file exists; name a folder" in said
