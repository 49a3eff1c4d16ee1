"""The chapter of foresight: who is better is found by code and printed."""

import io
import re
from dataclasses import replace

import pytest

pytest.importorskip("scipy")
pytest.importorskip("gymnasium")

from rich.console import Console
from studies.foresight.chapter import tell
from studies.foresight.plan import Plan
from studies.foresight.study import OURS, RIVALS, Foresight, Row, run_foresight
from studies.old.terminal import print_chapter


def row(task, method, steps, brier, **others):
    numbers = {"brier": brier, "ece": brier, "f1": 0.9 - brier, "false_95": brier, "lead": 1.0}
    values = {
        name: value
        for what, number in numbers.items()
        for name, value in (
            (what, number),
            (f"{what}_low", number - 0.01),
            (f"{what}_high", number + 0.01),
        )
    }
    values |= {"ece_own": 0.1, "auroc": 0.9, "base": 0.2, "share": 0.3, "cases": 500}
    values |= {"episodes": 80, "failed": 40, "seeds": 5}
    return Row(task=task, method=method, steps=steps, **{**values, **others})


@pytest.fixture
def found():
    """Replays are clearly the best everywhere."""
    return Foresight(
        Plan(),
        [
            row(task, method, steps, 0.02 if method == OURS[0] else 0.1)
            for task in ("acc", "pendulum")
            for steps in (10, 25, 50)
            for method in (*OURS, *RIVALS)
        ],
    )


def change(found, task, method, steps, **others):
    rows = [
        replace(one, **others)
        if (one.task, one.method, one.steps) == (task, method, steps)
        else one
        for one in found.rows
    ]
    return replace(found, rows=rows)


def test_where_nobody_is_better_nothing_is_lost(found):
    told = tell(found)
    assert "best in 6 of 6 cases, a rival in 0, clearly so in 0" in told.headline
    assert told.losses == ()


def test_a_rival_that_is_better_is_printed_and_told_apart_from_chance(found):
    clear = change(found, "acc", "logistic", 25, brier=0.001, brier_low=0.0, brier_high=0.002)
    assert tell(clear).losses == (
        "Brier score: a rival is clearly better, on acc in 25 (logistic 0.001, evofsm-replay "
        "0.020).",
    )
    near = change(found, "acc", "taylor", 10, brier=0.019, brier_low=0.0, brier_high=0.03)
    assert "better, intervals overlap, on acc in 10 (taylor 0.019" in tell(near).losses[0]


def test_where_all_cases_are_alike_there_is_nothing_to_foresee(found):
    rows = [replace(one, base=0.0) if one.steps == 50 else one for one in found.rows]
    assert "in 4 of 4 cases" in tell(replace(found, rows=rows)).headline


def test_matrices_that_foresee_nothing_are_told(found):
    weak = change(found, "acc", "evofsm-chain", 50, brier=0.25)
    assert "no more than who always says the share" in tell(weak).losses[-1]


@pytest.mark.slow
def test_page_and_terminal_hold_no_nan(found, tmp_path):
    made = found.plan.chapter(found, tmp_path, "python -m studies foresight")
    assert [one.name for one in made.figures] == ["foresight-brier"]
    out = io.StringIO()
    print_chapter(Console(file=out, width=80), made)
    assert max(map(len, out.getvalue().splitlines())) <= 80
    assert not re.search(r"\b(nan|None)\b", out.getvalue())


@pytest.mark.slow
def test_the_study_gives_a_row_for_each_and_the_same_ones_again():
    plan = Plan(tasks="acc", train=6, test=6, seeds=1, calibration=6, every=10, rounds=5)
    found = run_foresight(plan, workers=1)
    assert len(found.rows) == 3 * 6
    assert {row.method for row in found.rows} == {*OURS, *RIVALS}
    assert repr(run_foresight(plan, workers=1).rows) == repr(found.rows)
