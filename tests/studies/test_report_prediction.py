"""The prediction study's chapter: its numbers, its figure, and where it loses."""

import re
from html import unescape

import pytest
from studies.old.chapter import write_chapters
from studies.prediction.forecasters import Method, Variant
from studies.prediction.plan import Plan
from studies.prediction.scoring import Row
from studies.prediction.study import Prediction


def row(source, horizon, method, skill, **others):
    values = {
        "jsd": 0.2 * (1.0 - skill),
        "log_score": 3.0 - skill,
        "skill_persistence": skill,
        "low": skill - 0.05,
        "high": skill + 0.05,
        "skill_batch": 0.1,
        "log_skill_persistence": skill,
        "log_low": skill - 0.05,
        "log_high": skill + 0.05,
        "log_skill_batch": 0.1,
        "worst": skill - 0.1,
        "forecasts": 1000,
        "episodes": 20,
        "states": 50,
    }
    return Row(source, horizon, method, **{**values, **others})


SKILLS = {
    Method.EVOFSM: 0.5, Method.BLEND: 0.1, Method.BATCH: 0.2, Method.PERSISTENCE: 0.0,
    Method.PAPER: -2000.0, Method.PAPER_BATCH: -3.0, Method.PAPER_PERSISTENCE: 0.0,
}  # fmt: skip


def study(**changed):
    rows = [
        row(source, horizon, method, changed.get(method.name, skill))
        for source in ("stop_and_go", "track")
        for horizon in (0.1, 0.5, 5.0)
        for method, skill in SKILLS.items()
    ]
    ablation = [row("stop_and_go", h, v, 0.3) for h in (0.5, 1.0) for v in Variant]
    return Prediction(Plan(), rows, ablation)


@pytest.fixture(scope="module")
def chapter(tmp_path_factory):
    folder = tmp_path_factory.mktemp("figures")
    return Plan().chapter(study(), folder, "python -m studies prediction")


def test_figures_and_page_exist_without_nan(chapter, tmp_path):
    for drawing in chapter.figures:
        assert all(path.stat().st_size > 5000 for path in drawing.paths.values())
    page = write_chapters(
        tmp_path / "index.html", [chapter], title=chapter.title, about="", command="x"
    )
    text = unescape(re.sub(r"<[^>]*>", " ", page.read_text("utf-8")))
    assert not re.search(r"\bnan\b", text, re.IGNORECASE)
    assert "+0.50" in text


def test_the_headline_counts_what_is_won(chapter):
    assert "in 4 of 4 cases by divergence and in 4 by log score" in chapter.headline


def test_skills_that_are_far_below_are_not_spelt_out(chapter):
    table = chapter.tables[0]
    assert {line[table.header.index("paper")] for line in table.rows} == {"< -99"}


def test_tables_have_a_row_for_each_source_and_horizon_and_variant(chapter):
    skills, scores, ablation, _asked = chapter.tables
    assert len(skills.rows) == len(scores.rows) == 6
    assert [line[0] for line in ablation.rows] == [str(v) for v in Variant]
    assert ablation.rows[ablation.ours[0]][0] == str(Variant.ACTIONS)


def test_what_goes_against_us_is_said(tmp_path):
    lost = " ".join(Plan().tell(study(EVOFSM=-0.2)).losses)
    assert "stop and go, 5 s: no safe gain over persistence in divergence, skill -0.20" in lost
    assert "deeptime's batch has the smaller divergence" in lost
    assert "the blend has the better log score" in lost
    assert "Below 0.5 s" in lost


def test_where_all_is_won_nothing_is_lost_and_all_that_was_asked_holds(chapter, tmp_path):
    assert (chapter.losses, chapter.fails) == ((), ())
    assert "how useful a forecast is depends on how fine the states are" in chapter.about
    lost = Plan().tell(study(EVOFSM=-0.2)).fails
    assert any("by divergence: in 0 of 4 cases" in failure for failure in lost)
