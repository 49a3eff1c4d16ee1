"""`evofsm bench`: the studies that hold ours against others."""

from __future__ import annotations

from contextlib import suppress

from evofsm.cli.bench.closed_loop import closed_loop
from evofsm.cli.bench.detection import detection
from evofsm.cli.bench.leaders import leaders
from evofsm.cli.bench.prediction import prediction
from evofsm.cli.bench.real import real
from evofsm.cli.bench.sensitivity import sensitivity

with suppress(ModuleNotFoundError):
    import typer


def bench() -> typer.Typer:
    """The group of commands."""
    app = typer.Typer(
        name="bench",
        help="Studies: ours against the baselines, on held-out scenarios.",
        no_args_is_help=True,
        rich_markup_mode=None,
        pretty_exceptions_enable=False,
    )
    app.callback()(lambda: None)
    app.command(name="closed-loop")(closed_loop)
    app.command(name="detection")(detection)
    app.command(name="prediction")(prediction)
    app.command(name="sensitivity")(sensitivity)
    app.command(name="real")(real)
    app.command(name="leaders")(leaders)
    return app
