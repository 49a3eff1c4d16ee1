"""How a study's command ends: with rows for programs, or a page and a word in the terminal."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from evofsm.cli.common import counter, print_json, progress

with suppress(ModuleNotFoundError):
    import typer

    # What all of them are told.
    WorkersOption = Annotated[
        int | None, typer.Option(min=1, help="Processes. [default: one per core]")
    ]
    PageFolder = Annotated[
        Path, typer.Option(help="Folder for the page, its figures and the data.")
    ]

if TYPE_CHECKING:
    from evofsm.report.chapter import Chapter

Progress = Callable[[int, int], None]


def finish(
    rows: Sequence[Mapping[str, Any]],
    make_chapter: Callable[[Path, str, Progress], Chapter],
    out: Path,
    *,
    as_json: bool,
    packages: Sequence[str] = (),
) -> None:
    """Print the rows as JSON, or write the page with its figures and print what it says.

    Parameters
    ----------
    rows : sequence of mapping
        All numbers of the study; written as JSON beside the page.
    make_chapter : callable
        Is given a folder for the figures, the command that was typed, and a progress counter.
    out : Path
        Folder of the page.
    as_json : bool
        Print the rows and write nothing.
    packages : sequence of str
        Whose versions the page tells beside the usual ones.
    """
    from evofsm.report.documents import without_nan

    documents = [without_nan(dict(row)) for row in rows]
    if as_json:
        print_json(documents)
        return
    from evofsm.report import terminal
    from evofsm.report.chapter import write_chapters

    out.mkdir(parents=True, exist_ok=True)
    command = " ".join(["evofsm", *sys.argv[1:]])
    with progress() as bars:
        chapter = make_chapter(out, command, counter(bars, "Drawing figures"))
    data = json.dumps(documents, allow_nan=False, indent=1)
    (out / f"{chapter.id}.json").write_text(f"{data}\n", encoding="utf-8")
    page = write_chapters(
        out / "index.html",
        [chapter],
        title=chapter.title,
        about="",
        command=command,
        packages=packages,
    )
    console = terminal.console()
    terminal.print_chapter(console, chapter)
    console.print(f"Page with all figures: {page}", soft_wrap=True)
