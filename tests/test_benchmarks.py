"""The harness judges as it says, and what soaks for long holds for a while."""

import json

import pytest

import monitor_soak
import soak
import speed
from timing import Row, judged, worsened

pytestmark = pytest.mark.slow


def measured(ours, reference):
    return {"what": "work", "ours_s": ours, "reference": "other", "reference_s": reference}


FASTER, COST = Row(None, ">=", 10.0), Row(None, "<=", 1.25)


@pytest.mark.parametrize(
    ("row", "ours", "worse"),
    [
        (FASTER, 1.2, None),
        (FASTER, 1.3, "30%"),
        (FASTER, 0.1, None),
        (COST, 1.2, None),
        (COST, 1.3, "30%"),
        (COST, 0.1, None),
    ],
)
def test_a_ratio_may_worsen_by_the_margin_and_no_more(row, ours, worse):
    last = [judged("row", row, measured(1.0, 10.0)), judged("other", row, measured(0.01, 10.0))]
    told = worsened(judged("row", row, measured(ours, 10.0)), last)
    assert told is None if worse is None else worse in told
    assert not worsened(judged("row", row, measured(9.0, 10.0)), [{**last[0], "cores": 1_000}])


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
    last.write_text(json.dumps([judged("good", FASTER, measured(0.1, 10.0))]))
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


# -- Soaks: `make soak` takes a thousand million steps, and a monitor for a day --------------------


def test_numbers_hold_for_two_million_steps():
    found = list(soak.soak(2_000_000))
    assert [health.stream for health in found if not health.holds] == []
    sizes = {}
    for health in found:
        sizes.setdefault(health.stream, []).append(health.kilobytes)
    assert all(size[-1] == size[0] for size in sizes.values())


@pytest.mark.parametrize("learn", [True, False])
def test_no_decision_of_a_monitor_is_lost_or_wrong(learn):
    found = monitor_soak.soak(0.15, seed=1, learn=learn, episode=900)
    assert found.wrong == 0
    assert found.rows > 2000
    assert min(found.alarms, found.junk, found.restarts) > 0
