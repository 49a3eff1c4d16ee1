"""One study as a chapter, and a page of one chapter or of many.

A chapter says what was asked, the answer in a line, the tables and figures it rests on, and where
it loses. Each study makes its own; the page, and the terminal, show them all alike.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

from studies.old.drawing import Drawing, Sketch, draw_all
from studies.old.frame import Progress, silent
from studies.old.html import Setting, versions, write_html
from studies.old.shim import Column, Table


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
    def parts(self) -> tuple[Section, ...]:
        """Its numbers, and all that is told where it has a page to itself."""
        numbers = Section("numbers", "The numbers", "", self.tables, self.figures)
        return numbers, *self.sections

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
    return write_html(
        page,
        title=chapters[0].title if len(chapters) == 1 else title,
        about=about,
        chapters=chapters,
        summary=_summary(chapters),
        versions=list(versions(dict.fromkeys(p for one in chapters for p in one.packages))),
        sources=list(dict.fromkeys(source for one in chapters for source in one.sources)),
        command=command,
    )


def _summary(chapters: Sequence[Chapter]) -> Table:
    columns: tuple[Column[Chapter], ...] = Column("question", "title"), Column("answer", "headline")
    return Table.of(
        "In a line each",
        columns,
        chapters,
        "✓: all that was asked for holds. ✗: some of it does not; the study's part says what. "
        "Without a mark nothing could be judged.",
        in_words=True,
        failing=lambda one: one.mark == "✗",
        holding=lambda one: one.mark == "✓",
    )
