"""What all commands share: errors in one line, bars, JSON."""

from __future__ import annotations

import functools
import json
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from enum import StrEnum
from importlib.util import find_spec
from typing import TYPE_CHECKING, ParamSpec

# Needed once the annotations below are read; `main` says what to install where it is missing.
with suppress(ModuleNotFoundError):
    import typer

if TYPE_CHECKING:
    from rich.progress import Progress

P = ParamSpec("P")


class WorldName(StrEnum):
    """Where to drive."""

    SUMO = "sumo"
    KINEMATIC = "kinematic"


def plain_errors(command: Callable[P, None]) -> Callable[P, None]:
    """Let a command end with one clear line instead of a traceback."""

    @functools.wraps(command)
    def run(*args: P.args, **kwargs: P.kwargs) -> None:
        try:
            command(*args, **kwargs)
        except KeyboardInterrupt:
            print("\nevofsm: stopped before the end", file=sys.stderr)
            raise typer.Exit(130) from None
        except BrokenPipeError:  # whoever read the output had enough
            raise
        except (ValueError, TypeError, OSError, ModuleNotFoundError) as error:
            print(f"evofsm: {message(error)}", file=sys.stderr)
            raise typer.Exit(2) from None

    return run


def require(**extras: str) -> None:
    """Refuse before the long work what lacks a package after it."""
    for package, extra in extras.items():
        if find_spec(package) is None:
            raise ModuleNotFoundError(f"this needs {package}: pip install 'evofsm[{extra}]'")


def message(error: Exception) -> str:
    """What an error says, in one line."""
    if isinstance(error, OSError) and error.filename is not None and error.strerror:
        return f"{error.filename}: {error.strerror.lower()}"
    return str(error)


@contextmanager
def progress() -> Iterator[Progress]:
    """Bars on standard error; none where nobody watches."""
    from rich.console import Console
    from rich.progress import Progress

    console = Console(stderr=True)
    with Progress(console=console, transient=True, disable=not sys.stderr.isatty()) as bars:
        yield bars


def counter(bars: Progress, text: str) -> Callable[[int, int], None]:
    """A bar that is told how much is done, of how much."""
    if bars.disable:
        print(f"{text} ...", file=sys.stderr)
    task = bars.add_task(text, total=None)
    return lambda done, total: bars.update(task, completed=done, total=total)


def print_json(document: object) -> None:
    """Print for programs."""
    print(json.dumps(document, indent=2, allow_nan=False))


def split_names(text: str) -> list[str]:
    """Names that were given with commas between them."""
    return [name.strip() for name in text.split(",") if name.strip()]
