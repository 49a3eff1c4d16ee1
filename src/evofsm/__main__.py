"""The command ``evofsm``, also as ``python -m evofsm``."""

from __future__ import annotations

from typing import TYPE_CHECKING

from evofsm.cli import commands
from evofsm.paper import Paper

if TYPE_CHECKING:
    import typer


def main() -> None:
    """Run the command line."""
    commands.main(application)


def application() -> typer.Typer:
    """All commands: those of the app, and the paper's."""
    return commands.application(Paper)


if __name__ == "__main__":
    main()
