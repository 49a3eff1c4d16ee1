"""The command line of studies that do not stand on `lib` yet."""

from __future__ import annotations

from collections.abc import Callable

import typer

from evofsm.cli.app import group as group_of
from evofsm.cli.app import run
from studies.old.shim.declared import Command, callback


def main(application: Callable[[], typer.Typer]) -> None:
    """Run the command line that ``application`` makes."""
    run(application)


def group(name: str, about: str, *commands: type[Command]) -> typer.Typer:
    """Some commands under a name."""
    app = group_of(about, *map(callback, commands))
    app.callback()(lambda: None)
    return app
