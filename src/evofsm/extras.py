"""What to say where a package of an extra is not installed."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

#: Extras that each command needs as it stands, beside ``cli``; options may need others.
OF_COMMANDS = {
    "paper": ("plot", "sumo", "tables"),
    "drive": ("study",),
    "watch": ("study", "watch"),
    "campaign": ("study",),
}


@contextmanager
def needs(package: str, extra: str, purpose: str) -> Iterator[None]:
    """Let an import that fails for want of an extra name the command that installs it."""
    try:
        yield
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(f"{purpose} needs {package}: {install(extra)}") from error


def install(*extras: str) -> str:
    """The command that installs extras; evofsm is in no package index.

    Examples
    --------
    >>> install("cli", "plot")
    "pip install '.[cli,plot]' in a clone of evofsm"
    """
    return f"pip install '.[{','.join(extras)}]' in a clone of evofsm"


def install_for(command: str | None) -> str:
    """The same for all that a command of the command line needs."""
    return install("cli", *OF_COMMANDS.get(command or "", ()))
