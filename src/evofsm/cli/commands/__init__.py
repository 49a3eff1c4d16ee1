"""The command line: reads what was asked for, calls a study, prints what it found."""

from __future__ import annotations

import sys
from collections.abc import Callable
from contextlib import suppress
from importlib.util import find_spec
from typing import Annotated

from evofsm.cli.commands.declared import Command, callback
from evofsm.extras import install_for

# Needed once the annotations below are read; `main` says what to install where it is missing.
with suppress(ModuleNotFoundError):
    import typer


def main(application: Callable[[], typer.Typer]) -> None:
    """Run the command line that ``application`` makes."""
    if find_spec("typer") is None or find_spec("rich") is None:
        command = next((word for word in sys.argv[1:] if not word.startswith("-")), None)
        needed = install_for(command)
        print(f"evofsm: the command line needs typer and rich: {needed}", file=sys.stderr)
        sys.exit(2)
    if not {"--help", "--version"} & set(sys.argv):  # which should not wait for Numba
        from evofsm.fsm import announce_compiling

        announce_compiling()
    application()()


def application(*others: type[Command] | typer.Typer) -> typer.Typer:
    """The commands of this room and ``others``, in the order in which the help names them."""
    from evofsm.cli.commands.audit import Audit
    from evofsm.cli.commands.campaign import Campaign
    from evofsm.cli.commands.check import Check
    from evofsm.cli.commands.drive import Drive
    from evofsm.cli.commands.explain import Explain
    from evofsm.cli.commands.export import Export
    from evofsm.cli.commands.learn import Inspect, Learn
    from evofsm.cli.commands.monitor import Monitor
    from evofsm.cli.commands.watch import Watch

    app = group("evofsm", options.__doc__ or "")
    app.callback()(options)
    ours = (Learn, Inspect, Explain, Drive, Watch, Monitor, Campaign, Export, Audit, Check)
    for command in (*ours, *others):
        if isinstance(command, typer.Typer):
            app.add_typer(command)
        else:
            app.command()(callback(command))
    return app


def group(name: str, about: str, *commands: type[Command]) -> typer.Typer:
    """Some commands under a name."""
    app = typer.Typer(
        name=name,
        help=about,
        add_completion=False,
        no_args_is_help=True,
        rich_markup_mode=None,
        pretty_exceptions_enable=False,
    )
    app.callback()(lambda: None)
    for command in commands:
        app.command()(callback(command))
    return app


def _print_version(asked: bool) -> None:
    if asked:
        from evofsm import __version__

        print(f"evofsm {__version__}")
        raise typer.Exit


def options(
    version: Annotated[
        bool,
        typer.Option(
            "--version", is_eager=True, callback=_print_version, help="Print the version and stop."
        ),
    ] = False,
) -> None:
    """Online recognition of latent risk with an evolving finite state machine."""
