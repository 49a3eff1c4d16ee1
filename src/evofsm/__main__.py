"""The command ``evofsm``, also as ``python -m evofsm``."""

from __future__ import annotations

from typing import TYPE_CHECKING

from evofsm.app import cli
from evofsm.evidence import commands

if TYPE_CHECKING:
    import typer


def main() -> None:
    """Run the command line."""
    cli.main(application)


def application() -> typer.Typer:
    """All commands: those of the app, and those of the evidence."""
    return cli.application(*commands())


if __name__ == "__main__":
    main()
