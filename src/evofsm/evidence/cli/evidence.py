"""`evofsm evidence`: all studies, on one page."""

from __future__ import annotations

import sys
import time
from contextlib import suppress
from pathlib import Path
from typing import Annotated

from evofsm.app import (
    PAGE,
    WorldName,
    WorldOption,
    command_line,
    counter,
    of_world,
    plain_errors,
    print_json,
    progress,
    require,
)
from evofsm.evidence.cli.leaders import WorkersOption
from evofsm.evidence.studies import STUDIES

with suppress(ModuleNotFoundError):
    import typer


@plain_errors
def evidence(
    data: Annotated[
        Path | None,
        typer.Option(
            help="Folder of real drives, as `evofsm bench real` takes it; without it "
            "that study is left out.",
            show_default=False,
        ),
    ] = None,
    world: WorldOption = WorldName.SUMO,
    seed: Annotated[int, typer.Option(min=0, help="Of every study.")] = 0,
    workers: WorkersOption = None,
    out: Annotated[Path, typer.Option(help="Folder for the page and its figures.")] = Path(
        "evofsm-evidence"
    ),
    as_json: Annotated[
        bool, typer.Option("--json", help="Print what was found as JSON instead of a summary.")
    ] = False,
) -> None:
    """All studies in their short form, on one page: what holds, and where it loses.

    The page names the command of each study's long form.
    """
    require(scipy="study", deeptime="dev", **PAGE, **of_world(world))
    from evofsm import app
    from evofsm.evidence import terminal
    from evofsm.evidence.report.chapter import write_chapters

    out.mkdir(parents=True, exist_ok=True)
    chapters = []
    given = {"data": data, "seed": seed, "world": world.value}
    studies = [made for study in STUDIES.values() if (made := study.in_short(**given)) is not None]
    with progress() as bars:
        for study in studies:
            begun, name = time.monotonic(), study.id.replace("-", " ")
            found = study.run(counter(bars, f"Study: {name}"), workers)
            chapters.append(study.chapter(found, out / study.id, study.command))
            print(f"{name}: {time.monotonic() - begun:.0f} s", file=sys.stderr)
    page = write_chapters(
        out / "index.html",
        chapters,
        title="Does it see danger earlier, and does that help?",
        about="Each study asks one question, says what came of it in a line, and shows the numbers "
        "that this rests on. These are the short forms, which fit a coffee break: the command "
        "beside each study makes the long one. What goes against us is gathered at the end.",
        command=command_line(),
    )
    if as_json:
        print_json({"page": str(page), "chapters": [chapter.as_dict() for chapter in chapters]})
        return
    console = app.console()
    terminal.print_headlines(console, chapters)
    console.print(f"Page with all tables and figures: {page}", soft_wrap=True)
