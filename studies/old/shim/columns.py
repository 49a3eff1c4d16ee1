"""Tables in the terminal: they fit its width, and are plain text where nobody watches."""

from __future__ import annotations

import re
import sys
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from functools import partial
from io import TextIOBase
from itertools import chain, zip_longest
from textwrap import wrap
from typing import IO, Any, NamedTuple, cast

from rich.cells import cell_len
from rich.console import Console
from rich.padding import Padding
from rich.text import Text

from evofsm.fsm.naming import visible
from studies.old.shim.table import Table

# Narrower than this, words do not stand beside one another.
_WORDS_WIDTH = 66
# A header is broken into lines no shorter than this.
_HEADER_WIDTH = 11

Facts = Sequence[tuple[str, str]]


def console() -> Console:
    """Standard output; brackets in what is printed are no markup.

    It is as wide as the terminal or as ``COLUMNS`` says, 80 in a pipe; colours only in a terminal
    and never with ``NO_COLOR``.
    """
    return _Console(file=cast("IO[str]", _Trimmed()), markup=False, highlight=False, emoji=False)


class _Console(Console):
    """Obeys what the program says, and nothing that stands in a text from a file."""

    def render_str(self, text: str, **styles: Any) -> Text:
        return super().render_str(visible(text), **styles)


class _Trimmed(TextIOBase):
    """Standard output; in a pipe without the spaces that would fill lines up."""

    @property
    def encoding(self) -> str:  # type: ignore[override]
        return sys.stdout.encoding

    def isatty(self) -> bool:
        return sys.stdout.isatty()

    def fileno(self) -> int:
        return sys.stdout.fileno()

    def flush(self) -> None:
        sys.stdout.flush()

    def write(self, text: str) -> int:
        sys.stdout.write(text if self.isatty() else re.sub(r" +$", "", text, flags=re.MULTILINE))
        return len(text)


def print_facts(out: Console, title: str, facts: Facts) -> None:
    """Print names with a text each, which is folded below itself."""
    out.print(title, style="bold")
    width = max(cell_len(name) for name, _ in facts) + 4
    for name, text in facts:
        label = f"  {name}".ljust(width)
        room = max(out.width - width, 12)
        for place, line in enumerate(_folded(text, room)):
            out.print(f"{'' if place else label}".ljust(width) + line, soft_wrap=True)
    out.print()


def print_table(out: Console, table: Table) -> None:
    """Print a table of a study with its title and its note; rows that are ours begin with ``>``."""
    out.print(table.title, style="bold")
    names = [_marked(table, place, row[0]) for place, row in enumerate(table.rows)]
    rows = [(name, *row[1:]) for name, row in zip(names, table.rows, strict=True)]
    styles = {
        **dict.fromkeys(table.ours, "bold"),
        **dict.fromkeys(table.failing, "bold red"),
    }
    if table.in_words:
        print_words(out, table.header, rows, styles=styles)
    else:
        print_columns(out, table.header, rows, styles=styles)
    note = f"{table.note} > is ours." if table.ours else table.note
    out.print(f"\n{note}\n" if note else "")


def _marked(table: Table, place: int, name: str) -> str:
    if place in table.failing:
        return f"! {name}"
    return f"> {name}" if place in table.ours else name


def print_words(
    out: Console,
    header: Sequence[str],
    rows: Sequence[Sequence[str]],
    *,
    styles: Mapping[int, str] | None = None,
) -> None:
    """Print rows of words: folded beside one another, or below one another in a narrow terminal."""
    styles = styles or {}
    if out.width < _WORDS_WIDTH:
        for place, row in enumerate(rows):
            out.print(row[0], style=styles.get(place, ""))
            for name, text in zip(header[1:], row[1:], strict=True):
                out.print(Padding(f"{name}: {text}", (0, 0, 0, 2)))
        return
    widths = _shared(
        [max(map(len, column)) for column in zip(header, *rows, strict=True)], out.width
    )
    cells = [
        [_folded(text, width) for text, width in zip(row, widths, strict=True)] for row in rows
    ]
    every = range(len(header))
    _print_rows(out, [[name] for name in header], cells, _Part([*every], 2), widths, every, styles)


def print_columns(
    out: Console,
    header: Sequence[str],
    rows: Sequence[Sequence[str]],
    *,
    left: Collection[int] = (0,),
    styles: Mapping[int, str] | None = None,
    headings: Mapping[int, str] | None = None,
) -> None:
    """Print cells below one another; no number is ever cut in two.

    Where the terminal is too narrow for all columns, they come in several parts, one below the
    other, each with the names of the rows.

    Parameters
    ----------
    out : Console
    header : sequence of str
        A name for each column; units in brackets go on a line of their own.
    rows : sequence of sequence of str
        The first cell is the row's name. Of cells with several lines all are printed.
    left : collection of int
        Columns that are set to the left, the others to the right.
    styles : mapping of int to str, optional
        Of rich, by row.
    headings : mapping of int to str, optional
        What stands above a row, by row.
    """
    styles, headings = styles or {}, headings or {}
    cells = [[cell.split("\n") for cell in row] for row in rows]
    heads, widths = _header_over(header, cells)
    parts = list(_parts(widths, out.width))
    if len(parts) > 1:  # names that are folded leave room for more columns
        cells = [
            [_folded(row[0], out.width // 2), *cell[1:]]
            for row, cell in zip(rows, cells, strict=True)
        ]
        heads, widths = _header_over(header, cells)
        parts = list(_parts(widths, out.width))
    for number, part in enumerate(parts):
        if number:
            out.print()
        _print_rows(out, heads, cells, part, widths, left, styles, headings)


# -- Cells as lists of lines ----------------------------------------------------------------------

_Cells = Sequence[Sequence[str]]


class _Part(NamedTuple):
    """Columns that stand beside one another."""

    columns: list[int]
    gap: int


def _print_rows(
    out: Console,
    heads: _Cells,
    rows: Sequence[_Cells],
    part: _Part,
    widths: Sequence[int],
    left: Collection[int],
    styles: Mapping[int, str],
    headings: Mapping[int, str] | None = None,
) -> None:
    """Print some columns of all rows under their header."""
    beside = partial(_beside, part, widths, left)
    width = sum(widths[column] for column in part.columns) + part.gap * (len(part.columns) - 1)
    _print_lines(out, beside(heads), "bold")
    _print_lines(out, [("─" if out.is_terminal else "-") * width], "dim")
    for place, row in enumerate(rows):
        if headings and place in headings:
            _print_lines(out, [headings[place]], "italic")
        _print_lines(out, beside(row), styles.get(place, ""))


def _beside(
    part: _Part, widths: Sequence[int], left: Collection[int], row: _Cells
) -> Iterator[str]:
    """The lines of a row's cells, beside one another."""
    for line in zip_longest(*(row[column] for column in part.columns), fillvalue=""):
        placed = [
            text.ljust(widths[column]) if column in left else text.rjust(widths[column])
            for column, text in zip(part.columns, line, strict=True)
        ]
        yield (" " * part.gap).join(placed).rstrip()


def _print_lines(out: Console, lines: Iterable[str], style: str) -> None:
    for line in lines:
        out.print(line, style=style, soft_wrap=True)


def _parts(widths: Sequence[int], room: int) -> Iterator[_Part]:
    """As few parts as there is room for, each with the first column."""
    for gap in (2, 1):
        if sum(widths) + gap * (len(widths) - 1) <= room:
            yield _Part([*range(len(widths))], gap)
            return
    columns = [0]
    for column in range(1, len(widths)):
        taken = sum(widths[one] + 2 for one in columns)
        if len(columns) > 1 and taken + widths[column] > room:
            yield _Part(columns, 2)
            columns = [0]
        columns.append(column)
    yield _Part(columns, 2)


def _shared(wanted: Sequence[int], room: int) -> list[int]:
    """Widths that share a room: those who want little get it, the others the same each."""
    left = room - 2 * (len(wanted) - 1)
    given = dict.fromkeys(range(len(wanted)), 0)
    waiting = sorted(given, key=lambda column: wanted[column])
    for place, column in enumerate(waiting):
        given[column] = min(wanted[column], left // (len(waiting) - place))
        left -= given[column]
    return [given[column] for column in range(len(wanted))]


def _header_over(header: Sequence[str], rows: Sequence[_Cells]) -> tuple[_Cells, list[int]]:
    """The header in lines, its words and units below one another; and the columns' widths."""
    widths, heads = [], []
    for column, name in enumerate(header):
        widest = max((_width(row[column]) for row in rows), default=0)
        room = max(widest, _HEADER_WIDTH)
        lines = name.replace(" [", "\n[").split("\n")
        head = [part for line in lines for part in _folded(line, room)]
        heads.append(head)
        widths.append(max(widest, _width(head)))
    depth = max(map(len, heads))
    return [[*[""] * (depth - len(head)), *head] for head in heads], widths


def _folded(text: str, width: int) -> list[str]:
    """Lines no longer than a width, but for words that are longer by themselves."""
    lines = (
        wrap(line, width, break_long_words=False, break_on_hyphens=False)
        for line in text.split("\n")
    )
    return [*chain.from_iterable(lines)] or [""]


def _width(lines: Sequence[str]) -> int:
    return max(map(cell_len, lines), default=0)
