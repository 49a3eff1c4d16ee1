"""What all commands share: errors in one line, bars, JSON."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from typing import TYPE_CHECKING

from evofsm.extras import install

if TYPE_CHECKING:
    from rich.progress import Progress, ProgressColumn, Task

    from evofsm.guard import Mode


def chosen_mode(name: str) -> Mode:
    """How far the reviser goes, by its name."""
    from evofsm.guard import Mode

    if name not in (names := [one.value for one in Mode]):
        raise ValueError(f"--mode is {name!r}; it must be one of {', '.join(names)}")
    return Mode(name)


#: What a page with figures needs, and the extra that brings it.
PAGE = {"matplotlib": "plot", "jinja2": "plot"}


def require(**extras: str) -> None:
    """Refuse before the long work what lacks a package after it: all at once."""
    if lacking := [package for package in extras if find_spec(package) is None]:
        all_extras = install(*dict.fromkeys(["cli", *extras.values()]))
        raise ModuleNotFoundError(f"this needs {' and '.join(lacking)}: {all_extras}")


@contextmanager
def progress(unit: str | None = None) -> Iterator[Progress]:
    """Bars on standard error; none where nobody watches. With a unit, with the rate as well."""
    from rich.console import Console
    from rich.progress import Progress

    columns = _columns_with_rate(unit) if unit else Progress.get_default_columns()
    console = Console(stderr=True)
    with Progress(
        *columns, console=console, transient=True, disable=not sys.stderr.isatty()
    ) as bars:
        yield bars


def _columns_with_rate(unit: str) -> tuple[ProgressColumn, ...]:
    """How much of it is done, how many a second, and how long it will take: in 80 columns."""
    from rich.progress import BarColumn, ProgressColumn, TextColumn, TimeRemainingColumn
    from rich.text import Text

    class Rate(ProgressColumn):
        """Of what is done since the bar was made."""

        def render(self, task: Task) -> Text:
            return Text("" if task.speed is None else f"{task.speed:,.1f} {unit}/s")

    done = TextColumn("{task.completed:,} of {task.total:,}")
    return TextColumn("{task.description}"), BarColumn(20), done, Rate(), TimeRemainingColumn()


def counter(bars: Progress, text: str) -> Callable[[int, int], None]:
    """Add a bar; returns a function of how much is done, and of how much."""
    if bars.disable:
        print(f"{text} ...", file=sys.stderr)
    task = bars.add_task(text, total=None)
    return lambda done, total: bars.update(task, completed=done, total=total)


def say(text: object) -> None:
    """Print what may hold texts from files."""
    from evofsm.fsm.naming import visible

    print(visible(str(text)))


def command_line() -> str:
    """What was typed."""
    return shlex.join(["evofsm", *sys.argv[1:]])


#: What an option may take in place of names with commas: all there are, or the first one.
ALL, FIRST = "all", "first"


def split_names(text: str) -> list[str]:
    """Names that were given with commas between them."""
    return [name.strip() for name in text.split(",") if name.strip()]
