"""The chapter says what the rows say, in words, tables and figures."""

import json
import re
from dataclasses import replace

import pytest
from studies.__main__ import application
from studies.old.chapter import write_chapters
from studies.sensitivity.plan import Plan
from studies.sensitivity.spaces import short_name
from studies.sensitivity.study import Sensitivity, run_sensitivity
from typer.testing import CliRunner

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def study():
    # One round is not the paper's study, and quick; its verdicts are as good to draw.
    return run_sensitivity(Plan(settings=8, levels=3, side=2, halvings=1, rounds=1), workers=1)


@pytest.fixture(scope="module")
def chapter(study, tmp_path_factory):
    return study.plan.chapter(study, tmp_path_factory.mktemp("chapter"), "a command")


def judged(study: Sensitivity, verdict) -> Sensitivity:
    """The same study with other verdicts: ``verdict(row, claim)``."""
    rows = [
        replace(row, verdicts={claim: verdict(row, claim) for claim in row.verdicts})
        for row in study.rows
    ]
    return replace(study, rows=tuple(rows))


@pytest.fixture
def told():
    """What the chapter says, without its figures, which take seconds."""
    return lambda study: study.plan.tell(study)


def words(chapter) -> str:
    tables = [cell for table in chapter.tables for row in table.rows for cell in row]
    notes = [table.note for table in chapter.tables]
    texts = [chapter.title, chapter.about, chapter.headline, *chapter.answer, *chapter.losses]
    return "\n".join([*texts, *notes, *tables, *(line.value for line in chapter.plan)])


@pytest.mark.slow
def test_the_page_holds_every_figure_and_no_nan(chapter, tmp_path):
    page = write_chapters(
        tmp_path / "index.html", [chapter], title=chapter.title, about="", command="a command"
    )
    text = page.read_text("utf-8")
    assert text.count("data:image/svg+xml;base64,") == len(chapter.figures) == 5
    assert not re.search(r"\bnan\b", words(chapter), re.IGNORECASE)
    for figure in chapter.figures:
        assert figure.paths["png"].stat().st_size > 5_000
        assert figure.alt
        assert figure.caption


def test_tables_fit_a_terminal_of_80_columns(chapter):
    for table in (one for one in chapter.tables if not one.in_words):  # words are folded
        columns = list(zip(*table.rows, strict=True))
        headers = [max(len(part) for part in re.split(r" \[", title)) for title in table.header]
        widths = [
            max(head, *map(len, column)) for head, column in zip(headers, columns, strict=True)
        ]
        assert sum(widths) + 2 * (len(widths) - 1) <= 80


def test_every_claim_has_a_row_and_the_last_one_is_all_of_them(study, chapter):
    rows = chapter.tables[0].rows
    assert [row[0] for row in rows[:-1]] == [short_name(claim.id) for claim in study.claims]
    assert rows[-1][0] == "all of them"


def test_shares_are_those_of_the_rows(study, told):
    chapter = told(replace(judged(study, lambda row, claim: True), reaches=()))
    assert {row[1].split(" ")[0] for row in chapter.tables[0].rows} == {"100"}
    assert "100.0 % of 4 settings" in chapter.headline
    assert "10 of them hold in more than 90 %" in chapter.headline
    assert (chapter.losses, chapter.mark) == ((), "✓")


def test_a_claim_that_breaks_everywhere_is_a_loss_by_its_name(study, told):
    broken = judged(study, lambda row, claim: claim != "states_final")
    chapter = told(replace(broken, reaches=()))
    lost = "\n".join(chapter.losses)
    assert "0.0 % of what the paper leaves open" in lost
    assert "7 states (0.0 %)" in lost
    assert chapter.mark == "✗"
    assert "in 0.0 % of 4 (95 %" in chapter.fails[0]
    assert "brake at 11 s" not in lost


def test_where_no_case_ends_as_in_the_paper_its_share_is_left_out(study, told):
    chapter = told(judged(study, lambda row, claim: claim != "collisions_by_case"))
    assert {row[2] for row in chapter.tables[0].rows} == {"–"}
    assert not re.search(r"\bnan\b", words(chapter), re.IGNORECASE)


def test_a_claim_without_a_short_name_is_called_by_its_id():
    assert short_name("brake_at_12") == "brake at 12"
    assert short_name("states_final") == "7 states"


def test_the_command_prints_a_row_for_each_setting_and_writes_nothing(study, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    asked = []
    monkeypatch.setattr(
        "studies.sensitivity.study.run_sensitivity",
        lambda plan, progress, workers: asked.append((plan, workers)) or study,
    )
    command = "sensitivity --short --seed 3 --workers 1 --json"
    done = CliRunner().invoke(application(), command.split())
    assert done.exit_code == 0, done.output
    assert asked == [(Plan(seed=3).shortened(), 1)]
    rows = json.loads(done.stdout)
    assert len(rows) == len(study.rows)
    assert {"brake_speed", "n_states", "holds", "states_final"} <= set(rows[0])
    assert list(tmp_path.iterdir()) == []
