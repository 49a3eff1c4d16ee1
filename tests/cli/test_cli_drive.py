import json
import subprocess
import sys

import pytest

from evofsm.cli.driving import DECISION_TABLE

pytest.importorskip("typer")
pytest.importorskip("scipy")


def evofsm(*arguments):
    command = [sys.executable, "-m", "evofsm", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=False)


@pytest.mark.slow
def test_drive_learns_saves_and_drives_frozen(tmp_path):
    learnt = tmp_path / "learnt"
    first = evofsm("drive", "emergency", "--episodes", 12, "--out", learnt)
    assert first.returncode == 0, first.stderr
    assert "0 of 12" in first.stdout
    assert {path.name for path in learnt.iterdir()} == {
        *("machine.evofsm", "risk.evofsm", "summary.json", "decisions.parquet"),
    }
    frozen = evofsm("drive", "emergency", "--episodes", 5, "--frozen", learnt, "--json")
    row = json.loads(frozen.stdout)
    assert row["episodes"] == 5
    assert row["collisions"] == 0
    further = tmp_path / "further"
    again = evofsm("drive", "emergency", "--episodes", 2, "--learn", learnt, "--out", further)
    assert again.returncode == 0, again.stderr
    assert json.loads((further / "summary.json").read_text())["episodes_learnt"] == 14


@pytest.mark.slow
def test_a_judge_that_is_told_nothing_but_failures_is_driven_kept_and_gone_on_with(tmp_path):
    polars = pytest.importorskip("polars")
    drive, out = ("drive", "emergency", "--judge", "learnt"), tmp_path / "learnt"
    keeping = ("--checkpoint", tmp_path / "checkpoint", "--every", "0s")
    first = evofsm(*drive, "--episodes", 6, "--out", out, "--audit", tmp_path / "log", *keeping)
    assert first.returncode == 0, first.stderr
    assert "learnt, told nothing but failures" in first.stdout
    assert "fails where gap is below" in first.stdout
    assert "disturbances remembered" in " ".join(first.stdout.split())
    reasons = polars.read_parquet(out / "decisions.parquet")["reason"]
    assert reasons[0].endswith("nothing was learnt yet")
    assert reasons.str.contains("no backup survives").any()
    assert evofsm("audit", tmp_path / "log").returncode == 0
    whole = json.loads(evofsm(*drive, "--episodes", 8, "--json").stdout)
    again = json.loads(evofsm(*drive, "--episodes", 8, "--json", *keeping).stdout)
    assert again == whole
    frozen = evofsm(*drive, "--episodes", 3, "--frozen", out)
    assert "held-out episodes" in frozen.stdout, frozen.stderr
    wrong = evofsm("drive", "emergency", "--episodes", 3, "--frozen", out)
    assert "of the judge 'learnt', not of 'kinematic'" in wrong.stderr
    graph = evofsm("export", out, "--to", "dot")
    assert graph.returncode == 0, graph.stderr


def test_the_table_of_decisions_has_its_columns_in_their_order():
    assert DECISION_TABLE == (
        *("episode", "time", "gap", "v_follower", "v_leader", "intake", "state", "n_states"),
        *("surprise", "proposed", "executed", "advised", "risk_proposed", "risk_executed"),
        *("risk_low", "risk_high", "evidence", "seen", "realised", "reason"),
    )


@pytest.mark.slow
def test_decisions_are_recorded_with_their_reasons(tmp_path):
    polars = pytest.importorskip("polars")
    evofsm("drive", "emergency", "--episodes", 2, "--out", tmp_path / "out")
    table = polars.read_parquet(tmp_path / "out" / "decisions.parquet")
    assert {"proposed", "executed", "realised", "reason", "risk_proposed"} <= set(table.columns)
    changed = table.filter(polars.col("proposed") != polars.col("executed"))
    assert len(changed) > 0
    assert changed["reason"].str.len_chars().min() > 10


@pytest.mark.slow
def test_left_to_itself_the_driver_collides_and_in_shadow_there_was_an_alarm():
    row = json.loads(
        evofsm("drive", "emergency", "--reviser", "none", "--episodes", 5, "--json").stdout
    )
    assert row["collision_rate"] > 0.5
    shadow = evofsm("drive", "emergency", "--mode", "shadow", "--episodes", 5, "--json")
    row = json.loads(shadow.stdout)
    assert row["intervention_rate"] == 0.0
    assert len(row["lead_times"]) == row["collisions"]
    assert min(row["lead_times"]) > 1.0


@pytest.mark.slow
@pytest.mark.parametrize("controller", ["aggressive", "normal", "acc"])
def test_any_controller_is_revised(controller):
    result = evofsm("drive", "emergency", "--controller", controller, "--episodes", 3, "--json")
    assert json.loads(result.stdout)["collisions"] == 0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        (("nowhere",), "nowhere"),
        (("emergency", "--reviser", "magic"), "magic"),
        (("emergency", "--controller", "magic"), "magic"),
        (("emergency", "--controller", "sumo"), "sumo"),
        (("emergency", "--mode", "maybe"), "maybe"),
        (("emergency", "--mode", "shadow", "--reviser", "rss"), "rss"),
        (("emergency", "--with", "rain"), "rain"),
        (("emergency", "--frozen", "nothing-here"), "nothing-here"),
        (("emergency", "--tolerance", "2"), "tolerance"),
    ],
)
def test_what_cannot_be_driven_is_refused_in_one_line(arguments, word):
    result = evofsm("drive", *arguments, "--episodes", 1)
    assert result.returncode == 2
    assert word in result.stderr
    assert len(result.stderr.splitlines()) == 1


@pytest.mark.slow
def test_a_run_waits_for_whoever_looks_on_in_foxglove():
    pytest.importorskip("foxglove")
    connect = pytest.importorskip("websockets.sync.client").connect
    refused = evofsm("drive", "emergency", "--foxglove", 0, "--audit", "log")
    assert "exclude each other" in refused.stderr
    command = ("drive", "emergency", "--episodes", "1", "--foxglove", "0", "--json")
    process = subprocess.Popen(
        [sys.executable, "-m", "evofsm", *command],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    line = ""
    while "Open ws://" not in line:  # it may say first that it compiles
        line = process.stderr.readline()
    address = line.split()[1]
    with connect(address, subprotocols=["foxglove.sdk.v1"], proxy=None) as client:
        topics = {}
        while "/risk" not in topics:
            told = json.loads(client.recv(timeout=60))
            topics |= {one["topic"]: one["id"] for one in told.get("channels", [])}
        asked = {"op": "subscribe", "subscriptions": [{"id": 1, "channelId": topics["/risk"]}]}
        client.send(json.dumps(asked))
        while not isinstance(data := client.recv(timeout=60), bytes):
            pass
    process.terminate()
    process.communicate(timeout=60)
    assert "proposed" in json.loads(data[13:])
