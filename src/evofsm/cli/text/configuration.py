"""Say what came of a SUMO configuration with guards in it."""

from __future__ import annotations

from rich.console import Console

from evofsm.cli.configuration import Attached
from evofsm.cli.text.columns import print_facts


def print_attached(out: Console, came: Attached) -> None:
    """Print collisions, speed, and what guarding did."""
    what = "held back" if came.mode == "act" else "would have held back"
    share = came.revised / max(1, came.decisions)
    facts = [
        ("simulation", f"{came.configuration}, {came.seconds:,.0f} s"),
        ("guarded", f"{came.guarded:,} cars ({came.vehicles}), {came.mode}"),
        (
            "collisions",
            f"{came.collisions:,}: {came.of_guarded:,} by guarded cars, "
            f"{came.into_guarded:,} by others into them",
        ),
        ("mean speed", f"{came.speed:.2f} m/s of guarded cars"),
        ("guards", f"{what} {share:.1%} of {came.decisions:,} decisions"),
        ("overhead", f"{came.microseconds:.0f} µs a decision"),
    ]
    if not came.guarded:
        facts.insert(2, ("note", f"no car was {came.vehicles}: is it the name of a type or car?"))
    print_facts(out, "What came of the simulation", facts)
