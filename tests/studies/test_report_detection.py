"""The chapter on detection shows what was measured, and says where ours loses."""

from __future__ import annotations

import io
import re
from dataclasses import replace
from pathlib import Path

import pytest
from rich.console import Console
from studies.detection.calibration import Bin, Reliability
from studies.detection.chapter import claims, losses
from studies.detection.measures import Ours
from studies.detection.plan import Plan
from studies.detection.rows import Reliable, Row
from studies.detection.study import IN_GRID, Detection
from studies.detection.watch import Target
from studies.detection.worlds import GRID
from studies.old.chapter import Chapter, write_chapters
from studies.old.terminal import print_chapter
from studies.policies import Group

FAMILIES = ("paper", "emergency", "weak_brakes", "rare", "shift")
OTHERS = ("ttc", "headway", "rss-r157", "rss-matched", "rss-tuned")


def row(family: str, measure: str, target: str, auroc: float, **others: object) -> Row:
    """A line as the study has it; nothing but what is told differs."""
    values: dict[str, object] = {
        "family": family,
        "measure": measure,
        "group": Group.LEARNT if measure.startswith("evofsm") else Group.FIXED,
        "target": target,
        "auroc": auroc,
        "auroc_low": auroc - 0.001,
        "auroc_high": min(auroc + 0.001, 1.0),
        "auprc": auroc,
        "auprc_low": auroc,
        "auprc_high": auroc,
        "lead_median_1": 17.0 if measure == Ours.DEFAULT else 1.5,
        "lead_median_1_low": 1.0,
        "lead_median_1_high": 18.0,
        "lead_p10_1": 0.5,
        "lead_median_01": None,
        "lead_p10_01": None,
        "false_alarms_1": 0.7,
        "false_alarms_01": None,
        "false_time_1": 0.03,
        "warned_1": 0.9,
        "warned_01": None,
        "brier": 0.05,
        "brier_own": None,
        "missed": 0.1,
        "called": 0.2,
        "share": 0.3,
        "collisions": 50,
        "episodes": 100,
        "hours": 3.1,
        "decel": 3.0,
        "leader_decel": 6.0,
    }
    return Row(**{**values, **others})  # type: ignore[arg-type]


@pytest.fixture
def study() -> Detection:
    """Ours is best everywhere."""
    rows = [
        row(family, measure, target, 0.99 if measure == Ours.DEFAULT else 0.97)
        for family in FAMILIES
        for target in Target
        for measure in (Ours.DEFAULT, Ours.STATES, Ours.PAPER_ACTIONS, *OTHERS)
    ]
    rows += [
        row(family, Ours.PAPER, target, 0.5, missed=None, called=None)
        for family in FAMILIES
        for target in Target
    ]
    grid = [
        row(GRID, measure, Target.DEAD_END, 0.98, decel=own, leader_decel=leader)
        for measure in IN_GRID
        for own in (2.0, 4.0)
        for leader in (3.0, 6.0)
    ]
    grid[0] = replace(grid[0], auroc=float("nan"), missed=None, called=0.56)
    fit = Reliability("", (Bin(0.1, 0.2, 40), Bin(0.8, 0.7, 9)), 0.1, 0.2, 49, 12)
    reliable = [
        Reliable("emergency", Ours.DEFAULT, Target.COLLISION, True, fit),
        Reliable("emergency", Ours.COUNTS, Target.COLLISION, False, fit),
    ]
    return Detection(Plan(), FAMILIES, rows, grid, reliable)


def chapter(study: Detection, folder: Path) -> Chapter:
    return study.plan.chapter(study, folder, "python -m studies detection")


def change(
    study: Detection, family: str, measure: str, target: Target, **others: float
) -> Detection:
    rows = [
        replace(one, **others)  # type: ignore[arg-type]
        if (one.family, one.measure, one.target) == (family, measure, target)
        else one
        for one in study.rows
    ]
    return replace(study, rows=rows)


@pytest.mark.slow
def test_page_and_terminal_hold_no_nan(study: Detection, tmp_path: Path) -> None:
    made = chapter(study, tmp_path)
    assert {one.name for one in made.figures} == {
        "detection-auroc",
        "detection-lead",
        "detection-reliability",
        "detection-grid",
    }
    assert made.headline.startswith("All 8")
    assert ("AUROC on rare", "≥ 0.9000", "0.9900", "yes") in made.tables[0].rows
    assert all(path.stat().st_size > 1000 for one in made.figures for path in one.paths.values())
    page = write_chapters(tmp_path / "index.html", [made], title="", about="", command="")
    text = re.sub(r"base64,[^\"]*", "", page.read_text("utf-8"))
    assert not re.search(r"\b(nan|None)\b", text)
    out = io.StringIO()
    print_chapter(Console(file=out, width=80), made)
    assert max(map(len, out.getvalue().splitlines())) <= 80
    assert not re.search(r"\b(nan|None)\b", out.getvalue())


def test_all_targets_are_judged_and_met(study: Detection) -> None:
    found = list(claims(study))
    assert len(found) == 8
    assert all(claim.met for claim in found)


@pytest.mark.slow
def test_a_missed_target_does_not_hold_and_is_no_loss(study: Detection, tmp_path: Path) -> None:
    worse = change(study, "rare", Ours.DEFAULT, Target.DEAD_END, auroc=0.6)
    assert sum(claim.met for claim in claims(worse)) == 6
    told = chapter(worse, tmp_path)
    assert told.fails[0].startswith("AUROC on rare: 0.6000")
    assert not any("was asked" in loss for loss in told.losses)


def test_other_readings_of_ours_are_no_rivals(study: Detection) -> None:
    for better in (Ours.STATES, Ours.PAPER_ACTIONS):
        odd = change(study, "shift", better, Target.COLLISION, auroc=1.0, auroc_low=0.999)
        odd = change(odd, "paper", better, Target.DEAD_END, lead_median_1=30.0)
        assert list(losses(odd)) == list(losses(study))


def test_whoever_is_better_is_named_with_numbers(study: Detection) -> None:
    beaten = change(study, "shift", "rss-matched", Target.COLLISION, auroc=0.999, auroc_low=0.998)
    assert any("shift (rss-matched 0.9990, ours 0.9900)" in loss for loss in losses(beaten))
    earlier = change(study, "paper", "headway", Target.DEAD_END, lead_median_1=21.0)
    assert any("paper (headway 21.0 s" in loss for loss in losses(earlier))
    assert not any("headway 21.0 s" in loss for loss in losses(study))


def test_caution_without_need_is_told(study: Detection) -> None:
    assert any("56.0 % of the decisions" in loss for loss in losses(study))


def test_a_part_of_the_study_is_a_chapter_too(study: Detection, tmp_path: Path) -> None:
    one = replace(
        study,
        families=("rare",),
        rows=[
            replace(each, lead_median_1=None, false_alarms_1=None)
            for each in study.rows
            if each.family == "rare" and each.measure != Ours.PAPER
        ],
        grid=[],
        reliable=[],
    )
    made = chapter(one, tmp_path)
    assert [figure.name for figure in made.figures] == ["detection-auroc"]
    assert len(list(claims(one))) == 1
