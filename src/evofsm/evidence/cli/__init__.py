"""The commands of the evidence: `evofsm paper`, `evofsm bench` and `evofsm evidence`."""

from __future__ import annotations

from typing import TYPE_CHECKING

from evofsm.evidence.cli.bench import bench
from evofsm.evidence.cli.evidence import Evidence
from evofsm.evidence.cli.paper import Paper

if TYPE_CHECKING:
    import typer

    from evofsm.app import Command


def commands() -> tuple[type[Command] | typer.Typer, ...]:
    """All of them."""
    return Paper, bench(), Evidence
