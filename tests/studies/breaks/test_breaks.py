"""The study: rows that rest on both ways, cases as families, what it says where nothing failed."""

import json
import math
from dataclasses import replace
from pathlib import Path

import pytest

pytest.importorskip("scipy")
pytest.importorskip("jinja2")

from studies.__main__ import application
from studies.breaks.chapter import tell
from studies.breaks.plan import Plan
from studies.breaks.study import Breaks, run_breaks
from studies.breaks.subjects import Cars, load, needed_braking
from studies.breaks.targets import claims
from typer.testing import CliRunner

from evofsm.driving.cars import guard_for_family
from evofsm.driving.episodes import drive, unrevised_guard
from evofsm.driving.families import FAMILIES, load_family

FOUND = Path(__file__).with_name("found-seldom-none.py")


@pytest.fixture(scope="module")
def found():
    """The toy, and a family whose driver collides every time or never."""
    plan = Plan("toy,seldom,emergency", judge="none", runs=3, cases=20, moves=2, least=1e-3)
    return run_breaks(replace(plan, plain=200, keep=3), workers=1)


def test_every_row_rests_on_splitting_and_on_plain_samples(found):
    toy, seldom, emergency = found.rows
    assert (toy.known, seldom.known) == (1e-5, None)
    assert toy.agrees is None  # 200 plain samples see nothing of it
    assert emergency.agrees is True
    assert emergency.plain_failed > 180
    assert 0.9 < emergency.probability <= 1.0
    assert emergency.low <= emergency.probability <= emergency.high <= 1.0
    assert all(row.low >= 0.0 for row in found.rows)
    assert [one.claim for one in claims(found) if "emergency" in one.claim]
    assert found.frame.as_dicts()[2]["family"] == "emergency"


@pytest.mark.slow
def test_numbers_do_not_depend_on_the_processes(found):
    plan = replace(found.plan, family="toy,seldom", plain=50)
    assert run_breaks(plan, workers=1).rows == run_breaks(plan, workers=2).rows


def test_cases_are_written_as_a_family_that_fails_as_often(found, tmp_path):
    chapter = found.plan.chapter(found, tmp_path, "python -m studies break ...")
    assert (tmp_path / "break-probability.png").exists()
    assert chapter.figures
    written = tmp_path / "found-emergency-none.py"
    family = load_family(written)
    assert family.cases == len(found.cases[2]) == 3
    assert "python -m studies break ..." in family.about
    for k, (one, raw) in enumerate(zip(found.cases[2], found.raw[2], strict=True)):
        draw = family.draw(seed=7, index=k)
        assert draw[:2] == load("emergency").draw_by(raw.chance)[:2]
        assert drive(unrevised_guard(family), draw).collided
        assert draw.variant == f"found {k + 1}: {one.about}"
    numbers = {number.place: number for number in found.cases[2][0].numbers}
    gap = numbers["scenario.initial_gap"]
    assert gap.unit == "m"
    assert gap.value == pytest.approx(2.0 + 28.0 * gap.below)
    assert 0.0 < found.cases[2][0].as_far <= 1.0
    assert found.cases[2][0].as_far >= found.cases[2][-1].as_far  # the most ordinary first
    document = found.plan.document(found)
    assert document[2]["found"][0]["numbers"]


def test_where_nothing_failed_the_page_says_so_and_that_it_is_no_proof(found):
    toy = replace(found.rows[0], probability=0.0, low=0.0, high=0.0, runs=(0.0,) * 3, found=0)
    never = replace(found.rows[1], probability=0.0, runs=(0.0,) * 3, found=0, plain_failed=0)
    some = Breaks(found.plan, [toy, never], [[], []], [[], []], found.splits[:2])
    told = tell(some)
    assert told.headline == "None was found: seldom, no guard."
    assert "This is no proof" in told.answer[1]
    assert "braking were needed" in told.answer[1]
    assert "at most" in told.answer[1]
    half = replace(never, judge="kinematic", probability=0.1, runs=(0.0, 0.3, 0.0), found=2)
    losses = tell(Breaks(found.plan, [half], [[]], [[]], found.splits[:1])).losses
    assert any("the guard fails" in loss for loss in losses)
    assert any("2 of 3 runs found nothing" in loss for loss in losses)


@pytest.mark.parametrize("name", FAMILIES)
def test_who_drives_alone_drives_as_in_the_framework(name):
    subject = Cars(name, "none")
    draw = load(name).draw(seed=2, index=0)
    alone, whole = subject.play(draw), drive(unrevised_guard(load(name)), draw)
    assert alone.observations.tolist() == whole.observations.tolist()
    assert needed_braking(alone) == needed_braking(whole) > 0.0
    assert (needed_braking(alone) == math.inf) is whole.collided


def test_the_cases_that_were_found_stay_broken_alone_and_whole_under_the_guard():
    """A regression: cases that `python -m studies break` found, every number as it was."""
    family = load_family(FOUND)
    guard = guard_for_family(family, learn=False)
    assert family.cases >= 5
    for k in range(family.cases):
        draw = family.draw(seed=0, index=k)
        assert drive(unrevised_guard(family), draw).collided
        assert not drive(guard, draw).collided


def test_what_is_asked_for_wrongly_is_refused_before_anything_is_driven(tmp_path):
    for words, reason in (
        (("nowhere",), "no family 'nowhere'"),
        (("seldom", "--judge", "mine"), "no judge 'mine'"),
        (("seldom", "--judge", ","), "no judge is named"),
        ((",",), "no family is named"),
        (("seldom", "--with", "rain"), "no switch 'rain'"),
    ):
        result = CliRunner().invoke(application(), ["break", *words])
        assert result.exit_code == 2, words
        assert reason in result.stderr


def test_the_command_prints_rows_as_json():
    words = "break toy --plain 100 --runs 2 --cases 10 --moves 1 --json --workers 1"
    result = CliRunner().invoke(application(), words.split())
    assert result.exit_code == 0, result.stderr
    (row,) = json.loads(result.stdout)
    assert row["known"] == 1e-5
    assert len(row["runs"]) == 2
