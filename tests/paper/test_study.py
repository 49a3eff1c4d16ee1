"""Every study has one shape: fields that are options, rows that are one table, a chapter."""

from dataclasses import dataclass, replace
from pathlib import Path

import pytest
from studies.__main__ import application
from studies.studies import STUDIES
from typer.testing import CliRunner

from evofsm.cli.commands.declared import option
from evofsm.paper.frame import Frame
from evofsm.paper.report.chapter import Chapter, Section
from evofsm.paper.report.drawing import Sketch
from evofsm.paper.study import Study


@dataclass(frozen=True)
class Row:
    who: str
    lead: float | None
    leads: tuple[float, ...] = ()


def test_rows_are_one_table_for_programs(tmp_path):
    polars = pytest.importorskip("polars")
    frame = Frame([Row("ours", None), Row("ttc", 1.5, (1.0, 2.0))])
    assert frame.as_dicts()[1] == {"who": "ttc", "lead": 1.5, "leads": (1.0, 2.0)}
    frame.write_parquet(tmp_path / "rows.parquet")
    read = polars.read_parquet(tmp_path / "rows.parquet")
    assert read.rows() == [("ours", None, []), ("ttc", 1.5, [1.0, 2.0])]


@pytest.mark.parametrize("study", STUDIES.values(), ids=STUDIES)
def test_a_study_says_what_it_asks_and_has_a_short_form(study):
    assert study.question.endswith("?")
    short = study.in_short(seed=3, data=None) or study.in_short(seed=3, data="drives")
    assert short.shortened() == short
    assert getattr(short, "seed", 3) == 3
    assert short.command.startswith(f"{study.program} {study.id}")


def test_the_page_of_the_evidence_names_the_command_of_every_study():
    page = (Path(__file__).parents[2] / "docs" / "evidence.md").read_text("utf-8")
    for study in STUDIES.values():
        assert f"`make {study.id}`" in page or f"`python -m studies {study.id}" in page


def test_a_study_that_lacks_what_it_needs_is_left_out():
    real = STUDIES["real"]
    assert real.in_short(seed=0, data=None) is None
    assert real.in_short(seed=0, data="drives").command == "python -m studies real --data drives"


def test_options_of_the_command_are_fields_and_their_values_arrive(monkeypatch):
    given = []
    detection = STUDIES["detection"]
    monkeypatch.setattr(
        detection, "run", lambda self, *told: given.append((self, told[1])) or _Found()
    )
    command = "detection --family rare,ncap --no-grid --seed 3 --workers 2 --json"
    assert CliRunner().invoke(application(), command.split()).exit_code == 0
    assert given == [(detection(family="rare,ncap", with_grid=False, seed=3), 2)]
    refused = CliRunner().invoke(application(), ["detection", "--seed", "-1"])
    assert refused.exit_code == 2
    assert CliRunner().invoke(application(), ["real"]).exit_code == 2


class _Found:
    frame = Frame([])


def test_figures_of_a_chapter_and_of_its_sections_are_drawn_where_they_belong(tmp_path):
    from matplotlib.figure import Figure

    one, two = (Sketch(name, name, "", "", Figure) for name in ("one", "two"))
    told = Chapter("x", "?", "", "", (), (), (), sketches=(one,))
    told = replace(told, sections=(Section("s", "S", sketches=(two,)),))
    done = []
    drawn = told.drawn(tmp_path, lambda at, of: done.append((at, of)))
    assert [each.name for each in drawn.figures] == ["one"]
    assert [each.name for each in drawn.sections[0].figures] == ["two"]
    assert drawn.sketches == drawn.sections[0].sketches == ()
    assert done == [(1, 2), (2, 2)]
    assert {path.suffix for path in drawn.figures[0].paths.values()} == {".png", ".svg"}


def test_an_option_is_a_field_with_its_default():
    @dataclass(frozen=True)
    class Small(Study[_Found]):
        rounds: int = option(7, "How often.", min=1)

        shortened = run = tell = None

    assert Small().rounds == 7
