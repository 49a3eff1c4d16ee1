"""`evofsm paper`."""

from __future__ import annotations

import sys
from contextlib import suppress
from pathlib import Path
from typing import Annotated

from evofsm.cli.common import WorldName, counter, plain_errors, progress, require

with suppress(ModuleNotFoundError):
    import typer


@plain_errors
def paper(
    world: Annotated[
        WorldName, typer.Option(help="SUMO itself, or the same motion in closed form.")
    ] = WorldName.SUMO,
    rounds: Annotated[int, typer.Option(min=1, help="How often the four cases are driven.")] = 20,
    out: Annotated[
        Path, typer.Option(help="Folder for the page, figures, traces and the model.")
    ] = Path("evofsm-paper"),
    settings: Annotated[
        Path | None,
        typer.Option(
            help="TOML file with settings to use in place of the paper's.", show_default=False
        ),
    ] = None,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print the claims as JSON instead of tables.")
    ] = False,
) -> None:
    """Reproduce the paper: drive its 80 runs, and hold every claim against them.

    Ends with 0 if all claims hold, with 1 if any does not.
    """
    require(matplotlib="plot", jinja2="plot", polars="tables")
    from evofsm.report import terminal
    from evofsm.report.figures import paper_figures
    from evofsm.report.page import write_page
    from evofsm.studies.paper import (
        Settings,
        check_claims,
        context_tables,
        run_paper,
        write_data,
    )
    from evofsm.worlds import open_world

    chosen = Settings.load(settings)
    out.mkdir(parents=True, exist_ok=True)
    with progress() as bars, open_world(world.value) as place:
        study = run_paper(
            place, world.value, chosen, rounds, counter(bars, f"Driving and learning ({world})")
        )
        claims, context = check_claims(study), context_tables(study)
        write_data(study, claims, context, out)
        drawings = paper_figures(study, out / "figures", counter(bars, "Drawing figures"))
        page = write_page(
            study, claims, context, drawings, out, " ".join(["evofsm", *sys.argv[1:]])
        )
    if as_json:
        print((out / "claims.json").read_text(encoding="utf-8"), end="")
    else:
        terminal.print_claims(terminal.console(), claims, context)
        terminal.console().print(f"Page with all figures: {page}", soft_wrap=True)
    if not all(claim.holds for claim in claims):
        raise typer.Exit(1)
