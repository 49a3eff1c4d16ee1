"""One study as a chapter, and a page of one chapter or of many.

A chapter says what was asked, the answer in a line, the tables and figures it rests on, and where
it loses. Each study makes its own; the page, and the terminal, show them all alike.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from evofsm.report.drawing import Drawing
from evofsm.report.html import Setting, inline, versions, write_html
from evofsm.studies.table import Table


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
    figures: tuple[Drawing, ...]
    plan: tuple[Setting, ...]  #: seeds and sizes
    command: str  #: what makes these numbers


def write_chapters(
    page: Path,
    chapters: Sequence[Chapter],
    *,
    title: str,
    about: str,
    command: str,
    packages: Sequence[str] = (),
) -> Path:
    """Write a page that holds all it shows.

    Parameters
    ----------
    page : Path
        The file; its folder is made if it is not there.
    chapters : sequence of Chapter
        In the order in which they stand.
    title, about : str
        Of the page.
    command : str
        What was typed to get it.
    packages : sequence of str
        Whose versions are told beside the usual ones.

    Returns
    -------
    Path
        The page.
    """
    return write_html(
        page,
        "chapters.html.j2",
        title=title,
        about=about,
        chapters=[
            (chapter, [(one, inline(one.paths["svg"])) for one in chapter.figures])
            for chapter in chapters
        ],
        versions=list(versions(packages)),
        command=command,
    )
