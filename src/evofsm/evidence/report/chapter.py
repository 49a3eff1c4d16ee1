"""One study as a chapter, and a page of one chapter or of many.

A chapter says what was asked, the answer in a line, the tables and figures it rests on, and where
it loses. Each study makes its own; the page, and the terminal, show them all alike.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import count
from pathlib import Path
from typing import Any, NamedTuple

from evofsm.app import Table
from evofsm.evidence.report.drawing import Drawing, Sketch, draw_all
from evofsm.evidence.report.html import Setting, inline, versions, write_html
from evofsm.evidence.study import Progress, silent


class Source(NamedTuple):
    """Where something is written."""

    text: str  #: who wrote what, when
    name: str  #: of the address, such as ``"arXiv:1908.10823"``
    address: str


@dataclass(frozen=True)
class Section:
    """More about a study, under a title of its own."""

    id: str  #: in addresses
    title: str
    text: str = ""
    tables: tuple[Table, ...] = ()
    figures: tuple[Drawing, ...] = ()
    sketches: tuple[Sketch, ...] = ()  #: figures that `Chapter.drawn` is to draw


@dataclass(frozen=True)
class Chapter:
    """What one study found."""

    id: str  #: in addresses and of its folder, such as ``"detection"``
    title: str  #: the question it asks
    about: str  #: what was measured, and how
    headline: str  #: the answer, in a line
    answer: tuple[str, ...]  #: the same in two or three sentences with their numbers
    losses: tuple[str, ...]  #: what goes against us, a sentence with its numbers each
    tables: tuple[Table, ...]
    figures: tuple[Drawing, ...] = ()
    plan: tuple[Setting, ...] = ()  #: seeds and sizes
    command: str = ""  #: what makes these numbers
    #: What was asked for and does not hold; None where nothing was asked, or could be judged.
    fails: tuple[str, ...] | None = None
    losses_table: Table | None = None  #: all losses, where sentences would be too many
    sections: tuple[Section, ...] = ()  #: what is told where the chapter has a page to itself
    packages: tuple[str, ...] = ()  #: whose versions matter beside the usual ones
    sources: tuple[Source, ...] = ()
    sketches: tuple[Sketch, ...] = ()  #: figures that `drawn` is to draw

    def drawn(self, folder: Path, progress: Progress = silent) -> Chapter:
        """The same with its figures, and those of its sections, drawn into a folder."""
        parts: list[Chapter | Section] = [self, *self.sections]
        drawings = draw_all([one for part in parts for one in part.sketches], folder, progress)
        left = iter(drawings)
        figures = [part.figures + tuple(next(left) for _ in part.sketches) for part in parts]
        sections = (
            replace(section, figures=found, sketches=())
            for section, found in zip(self.sections, figures[1:], strict=True)
        )
        return replace(self, figures=figures[0], sketches=(), sections=tuple(sections))

    @property
    def n_losses(self) -> int:
        """How many rows go against us."""
        return len(self.losses_table.rows if self.losses_table else self.losses)

    @property
    def mark(self) -> str:
        """Whether all that was asked for holds, as a sign; empty where nothing was judged."""
        if self.fails is None:
            return ""
        return "✗" if self.fails else "✓"

    def as_dict(self) -> dict[str, Any]:
        """What it says, for JSON: all but its figures and further sections."""
        tables = [
            {
                "title": one.title,
                "header": list(one.header),
                "rows": [list(row) for row in one.rows],
            }
            for one in self.tables
        ]
        return {
            "id": self.id,
            "title": self.title,
            "headline": self.headline,
            "answer": list(self.answer),
            "fails": list(self.fails or ()),
            "losses": list(self.losses),
            "tables": tables,
            "plan": {line.name: line.value for line in self.plan},
            "command": self.command,
        }


def write_chapters(
    page: Path,
    chapters: Sequence[Chapter],
    *,
    title: str = "",
    about: str = "",
    command: str,
) -> Path:
    """Write a page that holds all it shows.

    Parameters
    ----------
    page : Path
        The file; its folder is made if it is not there.
    chapters : sequence of Chapter
        In the order in which they stand. One that is alone is told with all its sections.
    title, about : str
        Of a page of many chapters; one that is alone has its own.
    command : str
        What was typed to get it.

    Returns
    -------
    Path
        The page.
    """
    alone = len(chapters) == 1
    shown = list(_shown(chapters))
    return write_html(
        page,
        title=chapters[0].title if alone else title,
        about=about,
        shown=shown,
        summary=_summary(chapters),
        contents=list(_contents(shown)),
        versions=list(versions(dict.fromkeys(p for one in chapters for p in one.packages))),
        sources=list(dict.fromkeys(source for one in chapters for source in one.sources)),
        command=command,
    )


# -- What the template shows ----------------------------------------------------------------------


class _Figure(NamedTuple):
    number: int
    drawing: Drawing
    address: str


class _Part(NamedTuple):
    id: str
    title: str
    text: str
    tables: list[tuple[str, Table]]
    figures: list[_Figure]


class _Shown(NamedTuple):
    chapter: Chapter
    parts: list[_Part]
    plan: list[Setting]


def _shown(chapters: Sequence[Chapter]) -> Iterator[_Shown]:
    """The chapters with figures and tables numbered through the page."""
    figures, tables = count(1), count(1)
    for chapter in chapters:
        numbers = Section("numbers", "The numbers", "", chapter.tables, chapter.figures)
        sections = [numbers, *(chapter.sections if len(chapters) == 1 else ())]
        parts = [
            _Part(
                section.id,
                section.title,
                section.text,
                [(f"table-{next(tables)}", table) for table in section.tables],
                [_Figure(next(figures), one, inline(one.paths["svg"])) for one in section.figures],
            )
            for section in sections
        ]
        yield _Shown(chapter, parts, [Setting("command", chapter.command), *chapter.plan])


def _contents(shown: Sequence[_Shown]) -> Iterator[Setting]:
    """Places on the page, and what they are called."""
    if len(shown) == 1:
        yield from (Setting(part.id, part.title) for part in shown[0].parts)
    else:
        for one in shown:
            yield Setting(one.chapter.id, one.chapter.id.replace("-", " ").capitalize())
    yield Setting("loses", "Where it loses")
    yield Setting("reproduce", "Reproduce it")


def _summary(chapters: Sequence[Chapter]) -> Table:
    marks = [chapter.mark for chapter in chapters]
    return Table(
        "In a line each",
        ("question", "answer"),
        tuple((chapter.title, chapter.headline) for chapter in chapters),
        "✓: all that was asked for holds. ✗: some of it does not; the study's part says what. "
        "Without a mark nothing could be judged.",
        in_words=True,
        failing=tuple(place for place, mark in enumerate(marks) if mark == "✗"),
        holding=tuple(place for place, mark in enumerate(marks) if mark == "✓"),
    )
