"""The commands of before, until all are plain functions."""

from __future__ import annotations

from collections.abc import Callable

import typer

from evofsm.cli.app import group as group_of
from evofsm.cli.commands.declared import Command, callback


def main(application: Callable[[], typer.Typer]) -> None:
    """Run the command line that ``application`` makes."""
    from evofsm.cli.app import run

    run(application)


def group(name: str, about: str, *commands: type[Command]) -> typer.Typer:
    """Some commands under a name."""
    app = group_of(about, *map(callback, commands))
    app.callback()(lambda: None)
    return app
