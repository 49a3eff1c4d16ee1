"""What to say where a package of an extra is not installed."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec

#: Extras that each command needs as it stands, beside ``cli``; options may need others.
OF_COMMANDS = {
    "learn": ("tables",),
    "paper": ("plot", "sumo", "tables"),
    "drive": ("study",),
    "watch": ("study", "watch"),
}


@contextmanager
def needs(package: str, extra: str, purpose: str) -> Iterator[None]:
    """Let an import that fails for want of an extra name the command that installs it."""
    try:
        yield
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(f"{purpose} needs {package}: {install(extra)}") from error
    except ImportError as error:  # it is there, and a library of the system that it needs is not
        message = f"{purpose} needs {package}, which is installed but cannot be loaded: {error}"
        raise ImportError(message) from error


def install(*extras: str) -> str:
    """The command that installs extras, of what is installed; it asks no index for evofsm.

    Examples
    --------
    >>> install("cli", "plot")
    "pip install 'evofsm[cli,plot]'"
    """
    return f"pip install 'evofsm[{','.join(extras)}]'"


def refuse_without_command_line() -> None:
    """End with one line where the packages of the command line are not installed."""
    if find_spec("typer") is None or find_spec("rich") is None:
        command = next((word for word in sys.argv[1:] if not word.startswith("-")), "")
        needed = install("cli", *OF_COMMANDS.get(command, ()))
        print(f"evofsm: the command line needs typer and rich: {needed}", file=sys.stderr)
        sys.exit(2)
