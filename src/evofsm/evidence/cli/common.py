"""How a study's command ends: with rows for programs, or a page and a word in the terminal."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from evofsm.app import command_line, counter, print_json, progress

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
    from rich.console import Console

    from evofsm.evidence.report.chapter import Chapter

Progress = Callable[[int, int], None]


def finish(
    rows: Sequence[Mapping[str, Any]],
    make_chapter: Callable[[Path, str, Progress], Chapter],
    out: Path,
    *,
    as_json: bool,
    document: object = None,
    say: Callable[[Console], None] | None = None,
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
    document : object, optional
        Written beside the page in place of the rows.
    say : callable, optional
        Prints the study in the terminal in place of the chapter.
    """
    if as_json:
        print_json(rows)
        return
    from evofsm import app
    from evofsm.app import to_json
    from evofsm.evidence import terminal
    from evofsm.evidence.report.chapter import write_chapters

    out.mkdir(parents=True, exist_ok=True)
    with progress() as bars:
        chapter = make_chapter(out, command_line(), counter(bars, "Drawing figures"))
    data = to_json(rows if document is None else document)
    (out / f"{chapter.id}.json").write_text(f"{data}\n", encoding="utf-8")
    page = write_chapters(out / "index.html", [chapter], command=command_line())
    console = app.console()
    if say is None:
        terminal.print_chapter(console, chapter)
    else:
        say(console)
    console.print(f"Page with all figures: {page}", soft_wrap=True)
