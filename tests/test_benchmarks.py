"""The harness judges as it says, and what soaks for hours holds for seconds."""

import json

import pytest

import soak
import speed
from timing import Row, judged

pytestmark = pytest.mark.slow


def measured(ours, reference):
    return {"what": "work", "ours_s": ours, "reference": "other", "reference_s": reference}


@pytest.fixture
def harness(monkeypatch, tmp_path, capsys):
    """The harness over made-up rows: exit status, what was printed, what was written."""

    def run(rows, *arguments):
        monkeypatch.setattr(speed, "ROWS", rows)
        file = tmp_path / "bench.json"
        status = speed.main(["--json", str(file), "--against", str(tmp_path / "no"), *arguments])
        return status, capsys.readouterr().out, json.loads(file.read_text())

    return run


def made_up(better, target, ours):
    return Row(lambda repeats, short: measured(ours, 10.0), better, target)


def absent(repeats, short):
    raise ModuleNotFoundError("No module named 'river'")


def test_the_harness_writes_what_it_prints_and_says_what_is_missed_or_worse(harness, tmp_path):
    good, bad = made_up(">=", 5.0, 1.0), made_up("<=", 0.5, 6.0)
    assert harness({"good": good})[0] == 0
    status, out, written = harness({"good": good, "absent": Row(absent, ">="), "bad": bad})
    assert status == 1
    assert "No module named 'river'" in out
    found = [(result["id"], result["ratio"], result["reached"]) for result in written]
    assert found == [("good", 10.0, True), ("bad", 0.6, False)]
    assert {"id", "ours_s", "reference", "reference_s", "ratio"} <= written[0].keys()
    assert out.count("missed") == 1
    last = tmp_path / "last.json"
    last.write_text(json.dumps([judged("good", good, measured(0.1, 10.0))]))
    status, out, _ = harness({"good": good, "bad": bad}, "--only", "good", "--against", str(last))
    assert status == 1
    assert "WORSE" in out


QUICK = "batch_7,call_64,states_1024"


def test_real_rows_run_and_the_table_is_no_wider_than_100_columns(tmp_path, capsys):
    file = tmp_path / "bench.json"
    arguments = ["--short", "--repeats", "1", "--json", str(file), "--only", QUICK]
    assert speed.main(arguments) == 0
    assert max(map(len, capsys.readouterr().out.splitlines())) <= 100
    assert [result["id"] for result in json.loads(file.read_text())] == QUICK.split(",")
    for result in json.loads(file.read_text()):
        assert result["ours_s"] > 0.0 < result["reference_s"]


def test_numbers_hold_for_some_steps_of_the_thousand_million_of_make_soak():
    found = list(soak.soak(300_000))
    assert [health.stream for health in found if not health.holds] == []
    sizes = {}
    for health in found:
        sizes.setdefault(health.stream, []).append(health.kilobytes)
    assert all(size[-1] == size[0] for size in sizes.values())
