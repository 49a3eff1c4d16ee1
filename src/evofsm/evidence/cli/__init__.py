"""The commands of the evidence: `evofsm paper`, `evofsm bench` and `evofsm evidence`."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress

from evofsm.evidence.cli.closed_loop import closed_loop
from evofsm.evidence.cli.detection import detection
from evofsm.evidence.cli.evidence import evidence
from evofsm.evidence.cli.leaders import leaders
from evofsm.evidence.cli.paper import paper
from evofsm.evidence.cli.prediction import prediction
from evofsm.evidence.cli.real import real
from evofsm.evidence.cli.sensitivity import sensitivity

with suppress(ModuleNotFoundError):
    import typer


def commands() -> tuple[Callable[..., None] | typer.Typer, ...]:
    """All of them."""
    return paper, bench(), evidence


def bench() -> typer.Typer:
    """The studies that hold ours against others."""
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
