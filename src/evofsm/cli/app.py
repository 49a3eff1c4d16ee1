"""The command ``evofsm``: its commands, and one way in which every error is told."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Callable
from io import TextIOWrapper, UnsupportedOperation
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from evofsm.cli.audit import audit, check
from evofsm.cli.drive import drive, paper
from evofsm.cli.inspect import explain, export, inspect
from evofsm.cli.learn import learn
from evofsm.cli.monitor import monitor
from evofsm.cli.watch import watch

# What Typer raises where a command is called wrongly, whoever it takes it from.
_CalledWrongly: type[Any] = typer.BadParameter.__mro__[2]


class Commands(TyperGroup):
    """Commands whose errors are one line on standard error, and exit status 2."""

    def invoke(self, ctx: Any) -> None:
        """Run a command; the number that it returns is the exit status."""
        fault = ""
        try:
            status = super().invoke(ctx)
        except KeyboardInterrupt:
            status, fault = 130, "stopped before the end"
        except BrokenPipeError:  # whoever read the output had enough
            raise
        except _CalledWrongly as error:
            command = error.ctx.command_path if getattr(error, "ctx", None) else "evofsm"
            status, fault = 2, f"{error.format_message()} ({command} --help)"
        except (ValueError, TypeError, OSError, ImportError) as error:
            status, fault = 2, _message(error)
        if fault:
            from evofsm.cli.show import warn

            warn(fault)
        if status:
            raise typer.Exit(status) from None


def _message(error: BaseException) -> str:
    """What an error says, in one line, and what it happened in."""
    text = str(error) or type(error).__name__
    if isinstance(error, OSError) and error.filename is not None and error.strerror:
        folder = "; name a folder" * isinstance(error, FileExistsError)  # that was to be made
        text = f"{error.filename}: {error.strerror.lower()}{folder}"
    elif isinstance(error, FileNotFoundError) and error.errno:
        text = "the folder that this runs in is not there any more"
    elif isinstance(error, UnsupportedOperation):
        text = "standard output is closed"
    return " ".join(", ".join([text, *getattr(error, "__notes__", ())]).split())


def group(about: str, *commands: Any) -> typer.Typer:
    """Functions as commands."""
    app = typer.Typer(
        cls=Commands,
        help=about,
        add_completion=False,
        no_args_is_help=True,
        rich_markup_mode=None,
        pretty_exceptions_enable=False,
    )
    for command in commands:
        app.command()(command)
    return app


def _print_version(asked: bool) -> None:
    if asked:
        from evofsm import __version__

        print(f"evofsm {__version__}", flush=True)
        raise typer.Exit


def _options(
    version: Annotated[
        bool,
        typer.Option(
            "--version", is_eager=True, callback=_print_version, help="Print the version and stop."
        ),
    ] = False,
) -> None:
    """A safety filter that learns, from an evolving finite state machine."""


def application() -> typer.Typer:
    """All commands, in the order in which the help names them."""
    about = _options.__doc__ or ""
    app = group(about, paper, learn, inspect, explain, drive, watch, monitor, audit, export, check)
    app.callback()(_options)
    return app


def _say(message: Warning | str, *_: Any, **__: Any) -> None:
    """Print a warning as a message: of which line of Python it is nobody asks."""
    from evofsm.cli.show import warn

    warn(f"warning: {message}")


def run(make: Callable[[], typer.Typer]) -> None:
    """Run the command line that ``make`` makes."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):  # no letter that a terminal lacks ends a command
            stream.reconfigure(errors="replace")
    if not {"--help", "--version"} & set(sys.argv):  # which should not wait for Numba
        from evofsm.fsm.kernels import announce_compiling

        announce_compiling()
    warnings.showwarning = _say
    try:
        make()()
    except OSError as error:  # of --help and --version; commands say so themselves
        print(f"evofsm: {_message(error)}", file=sys.stderr)
        sys.exit(2)
