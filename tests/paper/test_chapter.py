"""A page of chapters: all that was found, and where it loses, in one file that loads nothing."""

import json
import re
from dataclasses import replace

import pytest

from evofsm.cli import console
from evofsm.cli.text.documents import to_json
from evofsm.cli.text.table import Table
from evofsm.paper import terminal
from evofsm.paper.report.chapter import Chapter, Section, write_chapters
from evofsm.paper.report.drawing import Sketch, draw_all
from evofsm.paper.report.html import Setting


@pytest.fixture
def chapter(tmp_path):
    from matplotlib.figure import Figure

    figure = Figure(figsize=(2, 1))
    figure.add_subplot().plot([0, 1])
    sketch = Sketch("lines", "Two lines", "What they say.", "A line that rises.", lambda: figure)
    return Chapter(
        id="detection",
        title="Who sees it coming?",
        about="Asked of <everyone> & of us.",
        headline="We do, 3 s before",
        answer=("In 90 % of episodes.",),
        losses=("rss is better by 0.1",),
        tables=(Table("Areas", ("who", "area"), (("ours", "0.9"), ("rss", "1.0")), ours=(0,)),),
        figures=tuple(draw_all([sketch], tmp_path / "figures")),
        plan=(Setting("seed", "0"),),
        command="python -m studies detection",
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
    assert re.search(r'<tr class="ours"><th scope="row"><span data-mark>▸ .*ours</th><td>0.9', text)
    assert '<tr><th scope="row">rss</th>' in text


def test_pages_of_one_and_of_many_are_sound(chapter, tmp_path, read_page):
    other = replace(chapter, id="real", figures=())
    for page in (page_of(tmp_path, chapter), page_of(tmp_path, chapter, other)):
        read_page(page).is_sound()


def test_sections_are_told_where_a_chapter_is_alone(chapter, tmp_path, read_page):
    more = Section("more", "More of it", "Said beside.", (Table("T", ("a", "b"), (("1", "2"),)),))
    told = replace(chapter, sections=(more,))
    alone = read_page(page_of(tmp_path, told))
    assert "#more" in alone.links
    assert "Said beside." in alone.text
    assert "Said beside." not in page_of(tmp_path, told, replace(chapter, id="real"))


def test_what_fails_is_in_the_answer_and_losses_may_be_a_table(chapter, tmp_path, read_page):
    lost = Table(
        "All losses", ("what", "to whom"), (("speed", "rss"), ("cost", "aeb")), failing=(1,)
    )
    page = read_page(page_of(tmp_path, replace(chapter, fails=("it broke",), losses_table=lost)))
    assert "it broke" in page.verdict
    assert "2 rows go against us" in page.verdict
    assert "rss is better by 0.1" not in page.text
    assert re.search(r'<tr class="fails"><th scope="row"><span data-mark>✗ </span>cost', page.html)


def test_only_what_had_to_hold_is_said_to_hold(chapter, tmp_path, read_page):
    for fails, kind in ((None, "verdict"), ((), "verdict holds"), (("x",), "verdict fails")):
        page = read_page(page_of(tmp_path, replace(chapter, fails=fails)))
        assert f'<div class="{kind}">' in page.verdict


def test_marks_of_the_summary_say_whether_what_was_asked_holds(chapter, tmp_path, capsys):
    chapters = [
        replace(chapter, id=name, title=name, fails=fails)
        for name, fails in (("good", ()), ("bad", ("x",)), ("open", None))
    ]
    text = page_of(tmp_path, *chapters)
    assert re.search(r'<tr class="holds"><th scope="row"><span data-mark>✓ </span>good', text)
    assert re.search(r'<tr class="fails"><th scope="row"><span data-mark>✗ </span>bad', text)
    assert '<tr><th scope="row">open' in text
    terminal.print_headlines(console(), chapters)
    lines = capsys.readouterr().out.split("\n")
    marks = ["✓", "✗", ""]
    assert lines[1:6:2] == [f"  {mark} {chapter.headline}".replace("   ", "  ") for mark in marks]


def test_minus_signs_are_set_before_numbers_and_not_in_names(chapter, tmp_path):
    table = Table("T", ("who", "skill"), (("rss-r157", "-1.5--0.5"), ("aeb", "4e-03")))
    page = page_of(tmp_path, replace(chapter, tables=(table,)))
    for cell in ("rss-r157", "<td>−1.5-−0.5</td>", "<td>4e-03</td>"):
        assert cell in page


def test_cells_may_have_a_second_line(chapter, tmp_path):
    table = Table("T", ("who", "rate"), (("rss", "3 %\n3 of <100>"),))
    page = page_of(tmp_path, replace(chapter, tables=(table,)))
    assert "<td>3 %<small>3 of &lt;100&gt;</small></td>" in page


def test_figures_are_numbered_through_all_chapters(chapter, tmp_path):
    other = replace(chapter, id="real", title="And really?")
    text = page_of(tmp_path, chapter, other)
    assert re.findall(r"<h3>Figure (\d+)", text) == ["1", "2"]
    assert text.index("And really?") < text.index('id="detection"')  # told at the top
    assert 'id="loses-real"' in text


def test_a_study_without_losses_says_so(chapter, tmp_path):
    text = page_of(tmp_path, replace(chapter, losses=()))
    assert "In none of the rows of this study." in text


def test_the_terminal_says_the_same(chapter, capsys):
    terminal.print_chapter(console(), chapter)
    said = capsys.readouterr().out
    for words in (chapter.headline, *chapter.losses, "Areas", "0.9"):
        assert words in said


def test_programs_are_told_the_same(chapter):
    document = json.loads(to_json(chapter.as_dict()))
    assert document["tables"][0]["rows"] == [["ours", "0.9"], ["rss", "1.0"]]
    assert document["losses"] == list(chapter.losses)
    assert document["plan"] == {"seed": "0"}
