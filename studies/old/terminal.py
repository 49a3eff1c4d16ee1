"""Say in the terminal what studies found."""

from __future__ import annotations

from collections.abc import Sequence

from rich.console import Console
from rich.padding import Padding

from studies.old.chapter import Chapter
from studies.old.shim import print_table


def print_chapter(out: Console, chapter: Chapter) -> None:
    """Print what a study found, its tables, and where it loses."""
    out.print(chapter.title, style="bold")
    out.print(chapter.headline)
    for sentence in chapter.answer:
        out.print(sentence)
    out.print()
    for one in chapter.tables:
        print_table(out, one)
    out.print("Where it loses", style="bold")
    loud = chapter.losses_table.failing if chapter.losses_table else ()
    for place, loss in enumerate(chapter.losses or ("nowhere in these tables",)):
        if place in loud:
            _print_indented(out, f"! {loss}", "bold red")
        else:
            _print_indented(out, loss)
    out.print()


def print_headlines(out: Console, chapters: Sequence[Chapter]) -> None:
    """Print of each study what it asks, and the answer in a line."""
    for chapter in chapters:
        out.print(chapter.title, style="bold")
        text = f"{chapter.mark} {chapter.headline}".strip()
        _print_indented(out, text, "bold red" if chapter.fails else "")
    out.print()


def _print_indented(out: Console, text: str, style: str = "") -> None:
    out.print(Padding(text, (0, 0, 0, 2)), style=style)
