"""The command line: reads what was asked for, calls a study, prints what it found."""

from __future__ import annotations

import sys
from contextlib import suppress
from importlib.util import find_spec
from typing import Annotated

from evofsm._extras import install_for

# Needed once the annotations below are read; `main` says what to install where it is missing.
with suppress(ModuleNotFoundError):
    import typer


def main() -> None:
    """Run the command line."""
    if find_spec("typer") is None or find_spec("rich") is None:
        command = next((word for word in sys.argv[1:] if not word.startswith("-")), None)
        needed = install_for(command)
        print(f"evofsm: the command line needs typer and rich: {needed}", file=sys.stderr)
        sys.exit(2)
    from evofsm._compile import announce_compiling

    announce_compiling()
    application()()


def application() -> typer.Typer:
    """All commands."""
    from evofsm.cli.audit import audit
    from evofsm.cli.bench import bench
    from evofsm.cli.campaign import campaign
    from evofsm.cli.check import check
    from evofsm.cli.drive import drive
    from evofsm.cli.evidence import evidence
    from evofsm.cli.explain import explain
    from evofsm.cli.export import export
    from evofsm.cli.learn import inspect, learn
    from evofsm.cli.paper import paper
    from evofsm.cli.watch import watch

    app = typer.Typer(
        name="evofsm",
        help="Online recognition of latent risk with an evolving finite state machine.",
        add_completion=False,
        no_args_is_help=True,
        rich_markup_mode=None,
        pretty_exceptions_enable=False,
    )
    app.callback()(options)
    app.command()(paper)
    app.command()(learn)
    app.command()(inspect)
    app.command()(explain)
    app.command()(drive)
    app.command()(watch)
    app.command()(campaign)
    app.command()(export)
    app.command()(audit)
    app.command()(check)
    app.add_typer(bench())
    app.command()(evidence)
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
