"""A page of chapters: all that was found, and where it loses, in one file that loads nothing."""

import re

import pytest

from evofsm.report import terminal
from evofsm.report.chapter import Chapter, write_chapters
from evofsm.report.drawing import Sketch, draw_all
from evofsm.report.html import Setting
from evofsm.studies.table import Table


@pytest.fixture
def chapter(tmp_path):
    from matplotlib.figure import Figure

    figure = Figure(figsize=(2, 1))
    figure.add_subplot().plot([0, 1])
    sketch = Sketch("lines", "Two lines", "What they say.", "A line that rises.", figure)
    return Chapter(
        id="detection",
        title="Who sees it coming?",
        about="Asked of <everyone> & of us.",
        headline="We do, 3 s before",
        answer=("In 90 % of episodes.",),
        losses=("rss is better by 0.1",),
        tables=(Table("Areas", ("who", "area"), (("ours", "0.9"), ("rss", "1.0")), ours=(0,)),),
        figures=tuple(draw_all([lambda: sketch], tmp_path / "figures")),
        plan=(Setting("seed", "0"),),
        command="evofsm bench detection",
    )


def page_of(tmp_path, *chapters):
    page = write_chapters(
        tmp_path / "index.html", chapters, title="Evidence", about="", command="make evidence"
    )
    return page.read_text("utf-8")


def test_a_page_holds_all_of_a_chapter(chapter, tmp_path):
    text = page_of(tmp_path, chapter)
    for said in (chapter.title, chapter.headline, *chapter.answer, *chapter.losses, "Two lines"):
        assert said in text
    assert "&lt;everyone&gt; &amp; of us" in text
    assert re.search(r'<tr class="ours"><th scope="row">ours</th><td>0.9</td>', text)
    assert '<tr><th scope="row">rss</th>' in text


def test_a_page_loads_nothing(chapter, tmp_path):
    text = page_of(tmp_path, chapter)
    assert not re.findall(r'(?:src|href)="(?!data:|#)', text)
    assert "<script" not in text


def test_figures_are_numbered_through_all_chapters(chapter, tmp_path):
    other = Chapter(**{**vars(chapter), "id": "real", "title": "And really?"})
    text = page_of(tmp_path, chapter, other)
    assert re.findall(r"<h3>Figure (\d+)", text) == ["1", "2"]
    assert text.index("And really?") < text.index('id="detection"')  # told at the top
    assert 'id="loses-real"' in text


def test_a_study_without_losses_says_so(chapter, tmp_path):
    text = page_of(tmp_path, Chapter(**{**vars(chapter), "losses": ()}))
    assert "In none of the rows of this study." in text


def test_the_terminal_says_the_same(chapter, capsys):
    terminal.print_chapter(terminal.console(), chapter)
    said = capsys.readouterr().out
    for words in (chapter.headline, *chapter.losses, "Areas", "0.9"):
        assert words in said
