"""`evofsm paper`."""

from __future__ import annotations

import shlex
import sys
from pathlib import Path
from typing import Annotated

import typer

from evofsm.cli.options import World, WorldOption, require
from evofsm.cli.show import print_json, progress


def paper(
    world: WorldOption = World.SUMO,
    rounds: Annotated[int, typer.Option(min=1, help="How often the four cases are driven.")] = 20,
    out: Annotated[
        Path, typer.Option(help="Folder for the page, figures, traces and the model.")
    ] = Path("evofsm-paper"),
    settings: Annotated[
        Path | None,
        typer.Option(help="TOML file with settings to use in place of the paper's."),
    ] = None,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print the claims as JSON instead of tables.")
    ] = False,
) -> int:
    """Reproduce the paper: drive its 80 runs, and hold every claim against them.

    Ends with 0 if all claims hold, with 1 if any does not.
    """
    simulator = {"libsumo": "sumo"} if world is World.SUMO else {}
    require(polars="tables", matplotlib="plot", jinja2="plot", **simulator)
    from evofsm.paper import print_page, reproduce

    with progress(f"Driving and learning ({world})") as done:
        found = reproduce(world.value, rounds, settings, done)
    command = shlex.join(["evofsm", *sys.argv[1:]])
    page = found.write(out, command)
    if as_json:
        print_json([claim._asdict() for claim in found.claims])
    else:
        print_page(found.page(command))
        print(f"\nPage with all figures: {page}")
    return 0 if found.holds else 1
