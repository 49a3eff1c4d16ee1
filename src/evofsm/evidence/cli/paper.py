"""`evofsm paper`."""

from __future__ import annotations

from contextlib import suppress
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
    from evofsm.app import console
    from evofsm.evidence.paper.files import write_data
    from evofsm.evidence.paper.plan import Plan
    from evofsm.evidence.report.chapter import write_chapters

    plan = Plan(world.value, rounds, settings)
    with progress() as bars:
        study = plan.run(counter(bars, f"{plan.doing} ({world})"))
        out.mkdir(parents=True, exist_ok=True)
        drawn = counter(bars, "Drawing figures")
        chapter = plan.chapter(study, out / "figures", command_line(), drawn)
    claims = study.frame.rows
    write_data(study, claims, chapter.tables[1:], out)
    page = write_chapters(out / "index.html", [chapter], command=command_line())
    if as_json:
        print_json(study.frame.as_dicts())
    else:
        screen = console()
        plan.say(screen, study, chapter)
        screen.print(f"Page with all figures: {page}", soft_wrap=True)
    if not all(claim.holds for claim in claims):
        raise typer.Exit(1)
