"""`evofsm paper`."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

from evofsm.app import (
    PAGE,
    WorldName,
    command_line,
    counter,
    of_world,
    plain_errors,
    print_json,
    progress,
    require,
)

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
    require(polars="tables", **PAGE, **of_world(world))
    from evofsm import app
    from evofsm.driving import open_world
    from evofsm.evidence import terminal
    from evofsm.evidence.paper.claims import check_claims
    from evofsm.evidence.paper.context import context_tables
    from evofsm.evidence.paper.files import write_data
    from evofsm.evidence.paper.runs import run_paper
    from evofsm.evidence.paper.settings import Settings
    from evofsm.evidence.report.chapter import write_chapters
    from evofsm.evidence.report.paper import paper_chapter

    chosen = Settings.load(settings)
    out.mkdir(parents=True, exist_ok=True)
    with progress() as bars, open_world(world.value) as place:
        study = run_paper(
            place, world.value, chosen, rounds, counter(bars, f"Driving and learning ({world})")
        )
        claims, context = check_claims(study), context_tables(study)
        write_data(study, claims, context, out)
        chapter = paper_chapter(
            study,
            out / "figures",
            command_line(),
            counter(bars, "Drawing figures"),
            claims=claims,
        )
    page = write_chapters(out / "index.html", [chapter], command=command_line())
    if as_json:
        print_json([asdict(claim) for claim in claims])
    else:
        console = app.console()
        terminal.print_claims(console, claims, context)
        console.print(f"Page with all figures: {page}", soft_wrap=True)
    if not all(claim.holds for claim in claims):
        raise typer.Exit(1)
