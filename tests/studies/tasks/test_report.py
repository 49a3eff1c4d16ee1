"""The chapter shows what was measured, what each judge was told, and where ours loses."""

import io
import re
from dataclasses import replace

import pytest
from rich.console import Console
from studies.old.chapter import write_chapters
from studies.old.terminal import print_chapter
from studies.tasks.chapter import tell
from studies.tasks.summary import own_share, summaries, summary
from studies.tasks.targets import claims


def change(found, task, judge="learnt", seed=None, **others):
    rows = [
        replace(row, **others)
        if (row.task, row.judge) == (task, judge) and seed in (None, row.seed)
        else row
        for row in found.rows
    ]
    return replace(found, rows=rows)


@pytest.mark.slow
def test_page_and_terminal_hold_no_nan(found, tmp_path):
    made = found.plan.chapter(found, tmp_path, "python -m studies tasks")
    assert [one.name for one in made.figures] == ["tasks-failed"]
    page = write_chapters(tmp_path / "index.html", [made], command="")
    text = re.sub(r"base64,[^\"]*", "", page.read_text("utf-8"))
    assert not re.search(r"\b(nan|None)\b", text)
    out = io.StringIO()
    print_chapter(Console(file=out, width=80), made)
    assert max(map(len, out.getvalue().splitlines())) <= 80
    assert not re.search(r"\b(nan|None)\b", out.getvalue())
    assert "it needs masa" in out.getvalue()


def test_what_was_asked_for_is_judged_and_met(found):
    told = tell(found)
    assert told.fails == ()
    assert [(one.asked, one.measured) for one in claims(found)] == [
        ("≤ 2", "1"),
        ("≥ 19 of 20", "20"),
        ("≥ 545", "548"),
    ]
    assert told.headline == (
        "0 of 4,000 held-out episodes fail on 2 tasks of others, where the controllers alone fail "
        "in 98.0 %."
    )


def test_what_is_not_met_is_told(found):
    worse = change(found, "acc", seed=3, failed_while_learning=4, failed_late=1, failed=7)
    assert tell(worse).fails == (
        "acc: unsafe episodes while learning, worst seed: 4, where ≤ 2 was asked.",
    )
    two = change(worse, "acc", seed=4, failed_late=1)
    assert "acc: seeds without an unsafe episode after episode 50: 18" in " ".join(tell(two).fails)
    losses = " ".join(tell(worse).losses)
    assert "acc, full throttle: 7 of 2,000 held-out episodes fail, 7.0 % in the worst" in losses
    assert "barrier (told dynamics and noise) fails less often" in losses


def test_a_shortened_run_is_not_judged_and_says_so(found):
    short = replace(found, rows=[row for row in found.rows if row.seed < 3])
    told = tell(short)
    assert told.fails is None
    assert "Nothing was judged: that takes 20 learning seeds of 200 episodes" in told.answer[-1]


def test_what_is_asked_of_many_seeds_is_what_is_judged(found, make_row):
    rows = [make_row("acc", "full throttle", seed=k, failed_late=int(k < 2)) for k in range(31)]
    _, clean, _ = claims(replace(found, rows=rows))
    assert (clean.asked, clean.measured, clean.met) == ("≥ 30 of 31", "29", False)


def test_a_task_that_none_of_ours_learns_is_told_too(found):
    rows = [row for row in found.rows if row.judge != "learnt"]
    assert tell(replace(found, rows=rows)).headline.startswith("0 of 0 held-out episodes")


def test_every_row_says_what_the_judge_was_told(found):
    told = tell(found)
    by_title = {table.title: table for table in told.tables}
    for title in ("What fails", "What it costs"):
        table = by_title[title]
        assert table.header[1] == "told"
        assert {row[1] for row in table.rows} == {
            "nothing",
            "dynamics and noise",
            "nothing but failures",
        }
        assert len(table.rows) == 8


def test_a_return_is_told_as_a_share_of_the_best_that_never_failed(found):
    by_judge = {one.judge: one for one in summaries(found) if one.task == "acc"}
    assert by_judge["learnt"].of_told == pytest.approx(550.0 / 553.0)
    failing = change(found, "acc", "barrier", failed=1)
    assert next(summaries(failing)).of_told is None
    losses = tell(change(found, "acc", "barrier", score=600.0)).losses
    assert any("barrier (told dynamics and noise) returns more (600" in one for one in losses)


def test_rows_of_seeds_are_pooled(found):
    one = summary(found.of("acc", judge="counted"))
    assert (one.runs, one.failed.held, one.failed.tried, one.worst) == (5, 450, 500, 0.9)


def test_the_share_of_safety_that_is_the_policys_own(found):
    assert own_share(found, "policy: filter, no penalty") == pytest.approx(0.04)
    assert own_share(found, "policy: filter, penalty") == pytest.approx(0.9)
    assert own_share(found, "policy: no filter") is None
    assert any("90.0 % of the safety is the policy's own" in one for one in tell(found).answer)


def test_training_failures_are_listed_seed_by_seed(found):
    many = change(found, "acc", seed=0, failures=tuple(range(1, 12)))
    (section,) = tell(many).sections
    assert section.tables[0].rows[0][3] == "1, 2, 3, 4, 5, 6, 7, 8, and 3 more"
    assert section.tables[0].rows[1][3] == "1"
