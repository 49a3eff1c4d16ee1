"""What every command prints with: facts, tables, bars, JSON, and errors in one line."""

from __future__ import annotations

import dataclasses
import json
import math
import sys
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from enum import Enum
from pathlib import PurePath
from typing import TYPE_CHECKING, Any

from rich import box
from rich.console import Console, RenderableType
from rich.measure import Measurement
from rich.progress import Progress
from rich.table import Table
from rich.text import Text

from evofsm.fsm.naming import visible

if TYPE_CHECKING:
    from evofsm import paper


def show(*parts: RenderableType) -> None:
    """Print texts and tables; no number is cut in two, and no text from a file is markup."""
    for part in parts:
        out = Console(markup=False, highlight=False, emoji=False)
        any_width = out.options.update(max_width=10_000)
        out.width = max(out.width, Measurement.get(out, any_width, part).minimum)
        with out.capture() as capture:
            out.print(part, crop=False)
        print("\n".join(line.rstrip() for line in capture.get().splitlines()))


def say(text: object) -> None:
    """Print a line, however long, that may hold texts from files."""
    print(visible(str(text)))


def warn(text: object) -> None:
    """Print a line on standard error; where that cannot be, as on a full disk, all else goes on."""
    with suppress(OSError, ValueError):
        print(f"evofsm: {visible(str(text))}", file=sys.stderr, flush=True)


def facts(title: str, pairs: Iterable[tuple[str, str]]) -> RenderableType:
    """Names with a text each, which is folded below itself."""
    grid = Table.grid(padding=(0, 2))
    grid.title, grid.title_justify, grid.title_style = Text(title, "bold"), "left", ""
    grid.add_column(no_wrap=True)
    grid.add_column(overflow="fold")
    for name, text in pairs:
        grid.add_row(f"  {visible(name)}", visible(text))
    return grid


def table(
    title: str,
    header: Sequence[str],
    rows: Sequence[Sequence[str]],
    *,
    left: Collection[int] = (0,),
    bold: Collection[int] = (),
    whole: bool = False,
) -> RenderableType:
    """Cells below one another; ``left`` are columns to the left, which alone fold if ``whole``."""
    grid = Table(box=box.SIMPLE_HEAD, pad_edge=False, show_edge=False, padding=(0, 1, 0, 0))
    grid.title, grid.title_justify, grid.title_style = Text(title, "bold"), "left", ""
    for place, name in enumerate(header):
        cells = [row[place] for row in rows]
        parts = cells if whole and place not in left else " ".join(cells).split()
        grid.add_column(
            visible(name),
            justify="left" if place in left else "right",
            min_width=max(map(len, [*name.split(), *parts]), default=0),
        )
    for place, row in enumerate(rows):
        grid.add_row(*map(visible, row), style="bold" if place in bold else "")
    return grid


def print_page(*pages: paper.Page) -> None:
    """Print what a page says: its targets, tables, and where it loses; many in a line each.

    Rows that are ours begin with ``>``, those that fail with ``!``.
    """
    from evofsm.paper.page import summary

    if len(pages) != 1:
        _show_table(summary(pages))
        return
    (page,) = pages
    say(f"{page.title}\n{page.answer}".strip())
    for item in page.tables:
        _show_table(item)
    titles = "; ".join(item.title for item in page.lost) or "nothing"
    say(f"\nWhere it loses{'' if page.losses else f': looked for, and not found: {titles}.'}")
    for item in page.losses:
        _show_table(item)


def _show_table(item: paper.Table) -> None:
    signs = {"ours": "> ", "fails": "! "}
    marks = [signs.get(mark or "", "") for mark in item.marks]
    rows = [(mark + row[0], *row[1:]) for mark, row in zip(marks, item.cells, strict=True)]
    texts = [place for place, is_number in enumerate(item.numeric) if not is_number]
    bold = [place for place, mark in enumerate(marks) if mark]
    say(f"\n{item.title}")
    show(table("", item.header, rows, left=texts, bold=bold, whole=True))
    if item.note:
        say(item.note)


def print_json(document: object) -> None:
    """Print one document for programs, with null for NaN and the infinite."""
    text = json.dumps(plain(document), allow_nan=False, ensure_ascii=False, indent=2)
    print(visible(text))


def plain(value: Any, digits: int = 400) -> Any:
    """A value as JSON knows it, with so many digits behind the point, by default all.

    >>> plain({"lead": (1.5, math.inf)})
    {'lead': [1.5, None]}
    """
    if isinstance(value, Enum):
        return value.value
    if isinstance(value, PurePath):
        return str(value)
    if hasattr(value, "_asdict"):
        value = value._asdict()
    elif dataclasses.is_dataclass(value) and not isinstance(value, type):
        value = {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
    elif hasattr(value, "tolist"):
        value = value.tolist()
    if isinstance(value, dict):
        return {key: plain(item, digits) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item, digits) for item in value]
    if isinstance(value, float):
        return round(value, digits) if math.isfinite(value) else None
    return value


Advance = Callable[..., None]


@contextmanager
def progress(text: str, total: float | None = None) -> Iterator[Advance]:
    """A bar on standard error, if somebody watches; yields what moves it: done, or `advance=`."""
    is_unwatched = not sys.stderr.isatty()
    with Progress(console=Console(stderr=True), transient=True, disable=is_unwatched) as bars:
        task = bars.add_task(text, total=total)
        yield lambda done=None, total=None, **more: bars.update(
            task, completed=done, total=total, **more
        )
