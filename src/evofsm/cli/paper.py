"""`evofsm paper`."""

from __future__ import annotations

import shlex
import sys
from pathlib import Path
from typing import Annotated

from evofsm.cli.options import InWorld, Json, option, require_world
from evofsm.cli.show import print_json, progress


def paper(
    world: InWorld = "sumo",
    rounds: Annotated[int, option("How often the four cases are driven.", min=1)] = 20,
    out: Annotated[Path, option("Folder for the page and the model.")] = Path("evofsm-paper"),
    as_json: Json = False,
) -> int:
    """Reproduce the paper: drive its 80 runs, and hold every claim against them.

    Ends with 0 if all claims hold, with 1 if any does not.
    """
    require_world(world, polars="tables", matplotlib="plot", jinja2="plot")
    out.mkdir(parents=True, exist_ok=True)  # where that fails nothing is driven first
    from evofsm.paper import print_page
    from evofsm.paper.reproduction import reproduce

    with progress(f"Driving and learning ({world})") as move:
        reproduction = reproduce(world, rounds, move)
    command = shlex.join(["evofsm", *sys.argv[1:]])
    page = reproduction.write(out, command)
    if as_json:
        print_json([claim._asdict() for claim in reproduction.claims])
    else:
        print_page(reproduction.page(command))
        print(f"\nPage with all figures: {page}")
    return 0 if reproduction.holds else 1
