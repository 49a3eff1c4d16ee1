"""Tables in the terminal fit its width, and a pipe gets plain text."""

import io
import math
import sys

import pytest
from rich.console import Console

from evofsm.cli.text.columns import console, print_columns, print_facts, print_table, print_words
from evofsm.cli.text.numbers import count, percent, span
from evofsm.cli.text.table import Column, Table

HEADER = ("name", "gap [m]", "a long header of many words", *(f"column {c}" for c in range(6)))
ROWS = [[f"row {r}", *(f"{r}.{c}5" for c in range(8))] for r in range(3)]
WORDS = (("claim", "measured", "holds"), [("words and words " * 4, "more of them " * 5, "yes")])


def printed(width, print_something, *given, **options):
    out = io.StringIO()
    print_something(
        Console(file=out, width=width, markup=False, highlight=False), *given, **options
    )
    return out.getvalue().splitlines()


@pytest.mark.parametrize("width", [20, 30, 50, 80])
def test_every_number_is_whole_and_every_line_fits(width):
    lines = printed(width, print_columns, HEADER, ROWS)
    assert max(map(len, lines)) <= width
    found = [line.split() for line in lines if line.startswith("row 1 ")]
    assert [cell for row in found for cell in row[2:]] == ROWS[1][1:]
    assert (len(found) == 1) == (width == 80)


def test_units_and_words_of_a_header_stand_below_one_another():
    lines = printed(80, print_columns, HEADER, ROWS)
    assert "[m]" in lines[2]
    assert "gap" in lines[1]
    assert "a long header of many words" not in "\n".join(lines)
    assert "-" * 20 in lines[3]


def test_headings_stand_above_their_rows_in_every_part():
    lines = printed(30, print_columns, HEADER, ROWS, headings={1: "from here on"})
    places = [place for place, line in enumerate(lines) if line == "from here on"]
    assert len(places) > 1
    assert all(lines[place + 1].startswith("row 1") for place in places)


@pytest.mark.parametrize("width", [40, 80])
def test_words_are_folded_and_none_is_lost(width):
    lines = printed(width, print_words, *WORDS)
    assert max(map(len, lines)) <= width
    text = " ".join(lines).split()
    assert (text.count("words"), text.count("them")) == (8, 5)
    assert ("holds: yes" in "\n".join(lines)) == (width == 40)


def test_facts_are_folded_below_themselves():
    lines = printed(30, print_facts, "About", [("file", "short"), ("settings", "one two " * 6)])
    assert lines[1] == "  file      short"
    assert all(line.startswith(" " * 12) for line in lines[3:5])


def test_ours_and_failures_are_marked_without_colour():
    table = Table("T", ("who", "n"), (("rss", "1"), ("us", "2"), ("bad", "3")), "Note.", ours=(1,))
    lines = printed(80, print_table, table)
    assert any(line.startswith("> us") for line in lines)
    assert "Note. > is ours." in lines
    failing = Table("T", ("who", "n"), table.rows, failing=(2,))
    assert any(line.startswith("! bad") for line in printed(80, print_table, failing))


def test_a_pipe_gets_plain_text(capsys):
    print_table(console(), Table("T", *WORDS, "A note of words " * 9, in_words=True, failing=(0,)))
    print_columns(console(), HEADER, ROWS, styles={0: "bold red"})
    text = capsys.readouterr().out
    assert text.isascii()
    assert "\x1b" not in text
    assert all(line == line.rstrip() for line in text.splitlines())


@pytest.mark.parametrize("plain", [True, False])
def test_a_terminal_gets_colours_unless_it_wants_none(plain, capsys, monkeypatch):
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True, raising=False)
    monkeypatch.setenv("TERM", "xterm-256color")
    monkeypatch.setenv("NO_COLOR", "1") if plain else monkeypatch.delenv("NO_COLOR", raising=False)
    print_columns(console(), ("a", "b"), [("1", "2")], styles={0: "red"})
    assert ("\x1b[31m" in capsys.readouterr().out) == (not plain)


def test_a_table_of_typed_columns_says_what_its_rows_hold():
    rows = [("ours", 0.25, (1.0, 2.0), 1), ("ttc", None, (math.nan, 2.0), 1234)]
    columns = (
        Column("who", lambda row: row[0]),
        Column("rate", lambda row: row[1], percent),
        Column("lead", lambda row: row[2], span(1), "s"),
        Column("cases", lambda row: row[3], count),
    )
    table = Table.of("T", columns, rows, "Note.", ours=lambda row: row[0] == "ours")
    assert table.header == ("who", "rate", "lead [s]", "cases")
    assert table.rows == (("ours", "25.0 %", "1.0–2.0", "1"), ("ttc", "–", "–", "1,234"))
    assert (table.ours, table.failing, table.note) == ((0,), (), "Note.")


def test_a_column_may_name_attributes_of_its_rows():
    interval = Column("95 %", "real imag", span(1))
    assert interval.cell(complex(1.0, 2.5)) == "1.0–2.5"
