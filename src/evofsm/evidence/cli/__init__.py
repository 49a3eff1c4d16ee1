"""The commands of the evidence: `evofsm paper`, `evofsm bench` and `evofsm evidence`."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress

from evofsm.evidence.cli.bench import bench
from evofsm.evidence.cli.evidence import evidence
from evofsm.evidence.cli.paper import paper

with suppress(ModuleNotFoundError):
    import typer


def commands() -> tuple[Callable[..., None] | typer.Typer, ...]:
    """All of them."""
    return paper, bench(), evidence
