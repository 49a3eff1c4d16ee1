"""The chapter shows what was measured, what each part is worth, and where the judge loses."""

import io
import re
from dataclasses import replace

import pytest
from rich.console import Console
from studies.judges.chapter import tell
from studies.judges.summary import Worth, effect, summary
from studies.judges.targets import claims
from studies.old.chapter import write_chapters
from studies.old.terminal import print_chapter


def change(found, system, without="", judge="learnt", **others):
    rows = [
        replace(row, **others)
        if (row.system, row.without, row.judge) == (system, without, judge)
        else row
        for row in found.rows
    ]
    return replace(found, rows=rows)


@pytest.mark.slow
def test_page_and_terminal_hold_no_nan(found, tmp_path):
    made = found.plan.chapter(found, tmp_path, "python -m studies judges")
    assert [one.name for one in made.figures] == ["judges-failed", "judges-kept"]
    page = write_chapters(tmp_path / "index.html", [made], command="")
    text = re.sub(r"base64,[^\"]*", "", page.read_text("utf-8"))
    assert not re.search(r"\b(nan|None)\b", text)
    out = io.StringIO()
    print_chapter(Console(file=out, width=80), made)
    assert max(map(len, out.getvalue().splitlines())) <= 80
    assert not re.search(r"\b(nan|None)\b", out.getvalue())


def test_all_that_was_asked_for_is_judged_and_met(found):
    told = tell(found)
    assert told.fails == ()
    assert len(list(claims(found))) == 17
    assert told.headline == (
        "0 of 1,500 held-out episodes fail on 4 systems, where the controllers alone fail in "
        "98.0 %."
    )
    assert told.losses == ()


def test_what_is_not_met_is_told(found):
    worse = change(found, "emergency", failed=3, score=0.9)
    fails = tell(worse).fails
    assert fails == (
        "emergency: failed, worst seed: 3.0 %, where ≤ 0.5 % was asked.",
        "emergency: mobility, median seed: 0.900, where ≥ 0.910 was asked.",
    )
    assert any("emergency, driver: 9 of 300 held-out" in loss for loss in tell(worse).losses)
    assert any("kinematic judge" in loss and "gets further" in loss for loss in tell(worse).losses)


def test_a_part_without_which_it_fails_is_needed(found):
    for part in ("stretches", "memory"):
        assert effect(found, "acc", part).worth is Worth.NEEDED
    assert effect(found, "acc", "stretches").text == "+85.0 % failed"
    answer = " ".join(tell(found).answer)
    assert "Without stretches (no disturbances at all) it does clearly worse on acc" in answer
    idle = re.search(r"What adds nothing .*: (.*)\. It has", answer)[1]
    dynamics = ("products", "lags", "doubt", "jumps", "carried", "drift", "observer")
    assert idle == f"{', '.join(dynamics)}, margin, backups, breaks and states"


def test_a_part_without_which_it_does_better_is_a_loss(found):
    bold = change(found, "tanks", "margin", kept=0.95)
    assert effect(bold, "tanks", "margin").worth is Worth.HARMS
    assert tell(bold).losses == ("tanks: without margin it does clearly better (+10.0 % kept).",)


def test_failing_more_often_outweighs_keeping_more_proposals(found):
    bold = change(found, "tanks", "stretches", kept=0.99)
    assert effect(bold, "tanks", "stretches").worth is Worth.NEEDED


def test_one_run_that_fails_leaves_it_open(found):
    rows = [
        replace(row, failed=40)
        if (row.system, row.without, row.seed) == ("acc", "lags", 1)
        else row
        for row in found.rows
    ]
    one_failed = replace(found, rows=rows)
    assert effect(one_failed, "acc", "lags").worth is Worth.UNCLEAR
    assert effect(one_failed, "acc", "jumps").worth is Worth.NOTHING
    answer = " ".join(tell(one_failed).answer)
    assert "More runs have to tell whether anything is owed to: lags." in answer


def test_a_single_run_is_not_compared(found):
    one = replace(found, rows=[row for row in found.rows if row.seed == 0])
    assert effect(one, "acc", "stretches") is None
    assert effect(one, "cartpole", "stretches").worth is Worth.NEEDED  # with two controllers


def test_controllers_and_seeds_are_pooled(found):
    of_both = summary(found.of("cartpole", without="memory"))
    assert (of_both.runs, of_both.controller, of_both.worst) == (6, "", 0.8)
    assert (of_both.failed.held, of_both.failed.tried) == (420, 600)
    assert of_both.name == "without memory"


def test_a_single_part_stands_in_the_legend(found):
    rows = [row for row in found.rows if row.system == "acc" and row.without in ("", "margin")]
    sketch = tell(replace(found, rows=rows)).sketches[0]
    (legend,) = sketch.figure().legends
    names = [text.get_text() for text in legend.get_texts()]
    assert names == ["controller alone", "learnt, whole", "without one part"]


def test_without_parts_and_cars_there_is_a_chapter_too(found, tmp_path):
    rows = [r for r in found.rows if not r.without and r.system == "acc"]
    told = tell(replace(found, rows=rows))
    assert told.sections == ()
    assert [table.title for table in told.tables] == [
        "What was asked for",
        "The judges on every system",
    ]
    for sketch in told.sketches:
        assert sketch.figure().axes
