"""A trial learns, is frozen, and counts what it does held out; the studies run what they name."""

import re
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from studies import benchmark, judges
from studies.judges import PARTS, Judges, Tasks, run, taken_out, trial
from studies.rivals import Rival
from studies.systems import Start, make_system

from evofsm.guard.learnt import model


class Timid(Rival):
    """Always the lowest action once it has seen a failure; it writes down what it is told."""

    told, made = "to be careful", None

    def __init__(self, **given):
        self.made.append(self)
        self.given = given
        self.frozen = self.afraid = False
        self.ended = []

    def begin(self):
        self.decisions = 0

    def action(self, observation, proposal):
        self.decisions += 1
        return self.given.get("low", 0) if self.afraid else proposal

    def end(self, failed=False, observation=None, **how):
        self.ended.append((failed, self.decisions, self.frozen))
        self.afraid = self.afraid or (failed and not self.frozen)

    def freeze(self):
        self.frozen = True


@pytest.fixture
def made(monkeypatch):
    """The timid one in place of the learnt guard."""
    monkeypatch.setattr(Timid, "made", [])
    monkeypatch.setattr(judges, "learnt_guard", Timid)
    return Timid.made


def test_failures_are_counted_while_learning_and_held_out(made):
    row = trial("acc", train=4, test=6, without="margin,lags", seed=3)
    assert (row["failures"], row["failed"], row["episodes"]) == ([1], 0, 6)
    assert (row["kept"], row["mean_change"], row["told"]) == (0.0, 2.0, "to be careful")
    (guard,) = made
    given = {"low": -2.0, "high": 2.0, "interval": 0.02, "seed": 3, "without": ("margin", "lags")}
    assert guard.given == given
    assert [frozen for *_, frozen in guard.ended] == [False] * 4 + [True] * 6
    failed, decisions, _ = guard.ended[0]
    assert failed
    assert decisions < 100


def test_proposals_that_are_kept_change_nothing_and_cars_score_mobility():
    for name in ("tanks", "reactor", "emergency"):
        row = trial(name, judge="unrevised", train=0, test=2)
        assert (row["kept"], row["mean_change"]) == (1.0, 0.0)
    assert row["measure"] == "mobility"
    assert row["score"] == pytest.approx(1.0)


# -- The studies ----------------------------------------------------------------------------------


def test_every_judge_part_and_seed_has_a_row(made):
    study = Judges(systems="acc,emergency", without="margin,states", seeds=2, train=2, test=2)
    found = study.run(workers=1)
    tried = found["rows"].select("system", "judge", "without", "seed").rows()
    assert tried[:4] == [
        ("acc", "unrevised", "", 0),
        ("acc", "learnt", "", 0),
        ("acc", "learnt", "margin", 0),
        ("acc", "learnt", "states", 0),
    ]
    assert tried.count(("emergency", "kinematic", "", 1)) == 1
    assert len(tried) == len(set(tried)) == 7 + 9
    parts = study.page(found).tables[-1]
    assert parts.cells[1][:4] == ("acc", "margin", "no margin", "0 of 4")


def test_the_benchmark_names_what_is_less_than_was_accepted():
    rows = benchmark.accepted().with_columns(without=pl.lit(""))
    assert (benchmark.compared(rows)["missed"] == "").all()
    worse = pl.when(pl.col("system") == "disc").then(pl.col("failed") + 1).otherwise("failed")
    missed = benchmark.compared(rows.with_columns(failed=worse)).filter(pl.col("missed") != "")
    assert set(missed["system"]) == {"disc"}
    assert set(missed["missed"]) == {"failed"}


@pytest.mark.slow
@pytest.mark.parametrize(("change", "draws"), [("stuck", 131), ("late", 7)])
def test_a_sensor_that_was_stuck_once_or_is_late_makes_no_guard_useless(change, draws):
    row = trial(
        "cartpole", "random", seed=4, train=30, test=5, base=draws, beside=False, change=change
    )
    assert row["failed"] == 0


def test_what_has_no_switch_is_taken_out_as_long_as_it_is_asked():
    observations = np.array([[0.0], [np.nan], [2.0]])
    with taken_out([*PARTS, "model._MAX_GAP=3"]):
        assert np.isnan(model.filled(observations, failed=False)[1])
        assert model._MAX_GAP == 3
    assert model.filled(observations, failed=False)[1] == 1.0
    assert model._MAX_GAP == 5


# -- Tasks and judges of one's own ----------------------------------------------------------------


@pytest.mark.parametrize("wrong", [np.nan, -8.0])
def test_what_a_judge_executes_is_an_action(wrong):
    judge = type("Rude", (Rival,), {"action": lambda *_: wrong})()
    words = r"^Rude executed .* in place of 2.0, which is none of Box"
    with pytest.raises(ValueError, match=words):
        run(make_system("acc"), judge, Start.held_out(0, 0))


@pytest.mark.slow
def test_the_task_and_the_judge_of_the_page_are_tried(tmp_path, monkeypatch):
    page = (Path(__file__).parents[2] / "docs" / "judges.md").read_text("utf-8")
    for name, text in re.findall(r"```python\n# (\w+\.py)\n(.*?)```", page, re.S):
        (tmp_path / name).write_text(text, encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    study = Tasks(task="my_task:Kettle", judge="my_judge:Careful", seeds=1, test=5, rounds=10)
    found = {row["judge"]: row for row in study.run(workers=1)["rows"].to_dicts()}
    assert list(found) == ["unrevised", "my_judge:Careful", "learnt", "counted"]
    assert found["unrevised"]["failed"] == 5
    careful = found["my_judge:Careful"]
    assert (careful["failed"], careful["told"], careful["trained"]) == (0, "where it boils", 30)
    assert found["learnt"]["failed"] == 0


@pytest.mark.parametrize(
    ("given", "text"),
    [
        ({"tasks": "aac"}, "there is no system 'aac'; there are acc, acc-5"),
        ({"task": "collections:Counter"}, "makes a Counter, which is no System"),
        ({"task": "nowhere:Task"}, "is it in this folder, or installed?"),
        ({"tasks": "pendulum", "judge": "barrier"}, "pendulum has no judge 'barrier'"),
        ({"tasks": "acc", "judge": "kinematic"}, "acc has no cars"),
        ({"tasks": "acc", "judge": "scene"}, "acc shows no objects"),
        ({"tasks": "acc", "controllers": "dqn"}, "acc has no controller 'dqn'; it has"),
    ],
)
def test_wrong_names_show_at_once(given, text):
    with pytest.raises((ValueError, TypeError), match=re.escape(text)):
        Tasks(**given, seeds=1, test=1).run(workers=1)
