"""The chapter of alarms: what is held, its price, and where it loses."""

import io
import re
from dataclasses import replace

import pytest

pytest.importorskip("scipy")

from rich.console import Console
from studies.alarms.chapter import tell
from studies.alarms.plan import Plan
from studies.alarms.study import Found, Row
from studies.old.terminal import print_chapter

RATES = {"false alarms": 0.05, "misses": 0.1}


def row(world, alarm, of, realised, **others):
    values = {
        "changed": "after" in world,
        "score": "evofsm",
        "stated": RATES[of],
        "low": realised - 0.01,
        "high": realised + 0.01,
        "farthest": realised,
        "most": 0.12 if alarm == "adaptive" else None,
        "errors": 50,
        "windows": 1000,
        "other": 0.2,
        "episodes": 300,
        "seeds": 3,
    }
    return Row(world=world, alarm=alarm, of=of, realised=realised, **{**values, **others})


@pytest.fixture
def found():
    """The adaptive alarm holds its rates; after the change the fixed one does not."""
    rows = []
    for world in ("cut_in", "shift, after"):
        for of, rate in RATES.items():
            rows.append(row(world, "adaptive", of, rate))
            rows.append(row(world, "fixed", of, 0.0 if "after" in world else rate, other=0.3))
    return Found(Plan(), rows)


def test_all_that_was_asked_for_is_met(found):
    told = tell(found)
    assert told.fails == ()
    assert "kept in 2 of 2 cases by the alarm that adapts, and in 0 of 2" in told.headline
    assert not any("stated." in loss for loss in told.losses)


def test_a_rate_that_is_lost_is_told(found):
    rows = [
        replace(one, realised=0.2, low=0.18, high=0.22)
        if one.alarm == "adaptive" and one.changed and one.of == "misses"
        else one
        for one in found.rows
    ]
    told = tell(replace(found, rows=rows))
    assert told.fails == (
        "Adaptive, misses, after the change: the stated rate is in the interval: in 0 of 1, where "
        "in every case was asked.",
    )
    assert told.losses[0] == (
        "shift, after, evofsm, misses: 20.0 % realised (18.0–22.0), 10.0 % stated."
    )


def test_a_fixed_threshold_that_is_cheaper_is_a_loss(found):
    rows = [
        replace(one, other=0.1) if one.alarm == "fixed" and not one.changed else one
        for one in found.rows
    ]
    assert any(
        "at fewer other errors: cut_in" in loss for loss in tell(replace(found, rows=rows)).losses
    )


@pytest.mark.slow
def test_page_and_terminal_hold_no_nan(found, tmp_path):
    made = found.plan.chapter(found, tmp_path, "python -m studies alarms")
    assert [one.name for one in made.figures] == ["alarms-held"]
    out = io.StringIO()
    print_chapter(Console(file=out, width=80), made)
    assert max(map(len, out.getvalue().splitlines())) <= 80
    assert not re.search(r"\b(nan|None)\b", out.getvalue())
