"""`evofsm paper`."""

from __future__ import annotations

import shlex
import sys
from pathlib import Path
from typing import Annotated

from evofsm.cli.options import InWorld, Json, option, require_world


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
    from evofsm.cli.show import print_json, print_page, progress
    from evofsm.driving.sumo import open_world
    from evofsm.paper import Settings, check_claims, run_paper
    from evofsm.paper.reproduction import page_of, write

    with progress(f"Driving and learning ({world})") as move:
        study = run_paper(open_world(world), world, Settings.load(), rounds, move)
    command, claims = shlex.join(["evofsm", *sys.argv[1:]]), check_claims(study)
    page = write(study, out, command)
    if as_json:
        print_json([claim._asdict() for claim in claims])
    else:
        print_page(page_of(study, command))
        print(f"\nPage with all figures: {page}")
    return 0 if all(claim.holds for claim in claims) else 1
