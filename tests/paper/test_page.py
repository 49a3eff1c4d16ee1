"""A page: all that was found, and where it loses, in one file that loads nothing."""

import base64
import re
from dataclasses import replace

import polars as pl
import pytest
from matplotlib.figure import Figure as Drawn

from evofsm.cli import print_page
from evofsm.paper import Figure, Page, Table, write_page
from evofsm.paper.page import cell

EVIL = '<script>alert("1 & 2")</script>'


def drawn():
    figure = Drawn(figsize=(2, 1))
    figure.add_subplot().plot([0, 1])
    return figure


AREAS = pl.DataFrame({"who": ["ours", "rss"], "area": [0.9, -0.25]})
PAGE = Page(
    "detection",
    "Who sees\nit coming?\n\nAsked of <everyone> & of us.\n\nAnd then\nagain.",
    [
        Table("Areas", AREAS, mark=pl.when(pl.col("who") == "ours").then(pl.lit("ours"))),
        Figure("lines", "Two lines", "What they say.", drawn),
    ],
    "python -m studies detection",
    lost=[Table("Better", AREAS.filter(pl.col("area") > 1.0)), Table("Worse", AREAS[1:])],
    facts={"seed": "0"},
    sources={"Somebody 2019": "https://example.org/x"},
)
TARGETS = pl.DataFrame({"target": ["a", "b"], "asked": ["≤ 1"] * 2, "measured": ["0", "9"]})


@pytest.fixture
def written(tmp_path, read_page):
    def write(*pages, **others):
        return read_page(write_page(tmp_path / "new" / "index.html", pages, **others))

    return write


def test_a_page_holds_all_that_it_shows(written, tmp_path):
    read = written(PAGE)
    read.is_sound()
    for said in ("Who sees it coming?", "And then again.", "Areas", "Two lines", "−0.25", "numba"):
        assert said in read.text
    assert "&lt;everyone&gt; &amp; of us" in read.html
    assert read.alts == ["Two lines"]
    svg = tmp_path / "new" / "figures" / "lines.svg"
    assert base64.b64decode(read.loads[0].split(",")[1]) == svg.read_bytes()
    assert svg.with_suffix(".png").exists()
    assert [link for link in read.links if link[0] != "#"] == ["https://example.org/x"]
    assert '<tr class="ours"><th scope="row"><span data-mark>▸ </span>ours' in read.html


def test_a_figure_that_is_the_first_is_shown_first(written):
    html = written(replace(PAGE, parts=PAGE.parts[::-1])).html
    assert html.index("<img") < html.index("Asked of") < html.index("<table")


def test_many_pages_on_one_are_summed_up_and_numbered_through(written):
    good, bad = TARGETS.with_columns(met=True), TARGETS.with_columns(met=pl.Series([True, False]))
    pages = [
        replace(PAGE, targets=good),
        replace(PAGE, name="real", about="And really?", targets=bad, parts=[PAGE.parts[0]]),
        replace(PAGE, name="open", about="Open?", lost=[]),
    ]
    read = written(*pages, title="Evidence", about="All of it.")
    read.is_sound()
    marks = re.findall(r'class="(\w+)"><th scope="row"><span data-mark>(.)', read.html)
    assert marks[:2] == [("holds", "✓"), ("fails", "✗")]
    assert "2 of 2 targets are met" in read.text
    assert "1 of 2 targets are met" in read.text
    assert read.html.count('class="verdict') == 2  # nothing was asked of the third
    assert "Looked for, and not found: nothing." in read.text


def test_what_is_told_is_text_and_never_markup(written):
    frame = pl.DataFrame({EVIL: [EVIL]})
    parts = [Table(EVIL, frame, note=EVIL)]
    read = written(replace(PAGE, about=f"{EVIL}?\n\n{EVIL}", command=EVIL, parts=parts))
    read.is_sound()
    assert EVIL not in read.html
    assert read.text.count(EVIL) >= 6


@pytest.mark.parametrize("width", [40, 80, 200])
def test_the_terminal_says_the_same_and_cuts_no_number(width, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", str(width))
    wide = pl.DataFrame({"name": ["[bold]row"], **{f"column {k}": [12345.25] for k in range(20)}})
    parts = [Table("Wide", wide), Table("Empty", AREAS[:0], {"who": "{who}"})]
    page = replace(PAGE, parts=parts, targets=TARGETS.with_columns(met=False))
    print_page(page)
    said = capsys.readouterr().out
    assert said.count("12345.2") == 20
    assert "[bold]row" in said
    assert "! a" in said
    assert "Empty" in said
    assert "Where it loses" in said


@pytest.mark.parametrize(
    ("template", "row", "text"),
    [
        ("{x:%}", {"x": 0.0001}, "0.01 %"),
        ("{x} of {n}", {"x": 3, "n": 1200}, "3 of 1,200"),
        ("{x:.2f} ({l}–{h})", {"x": None, "l": None, "h": float("nan")}, "–"),
        ("{x}", {"x": [True, 2]}, "yes, 2"),
        ("{x}", {"x": float("inf")}, "∞"),
        ("{x:.1e}", {"x": -4e-3}, "-4.0e-03"),
        ("{x:.3f}", {"x": -4e-6}, "> −0.001"),
    ],
)
def test_cells_are_written_as_people_read_them(template, row, text):
    assert cell(template, row) == text
