"""`evofsm evidence`: all studies, on one page."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

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
from evofsm.evidence.cli.common import Progress, WorkersOption

with suppress(ModuleNotFoundError):
    import typer

if TYPE_CHECKING:
    from evofsm.evidence.report.chapter import Chapter


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
    with progress() as bars:
        for name, study in _studies(data, world, seed, workers).items():
            begun = time.monotonic()
            found = study.run(counter(bars, f"Study: {name}"))
            folder = out / name.replace(" ", "-")
            chapters.append(study.tell(found, folder, study.command, _silent))
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


class _Study(NamedTuple):
    """How a study is made, and told."""

    run: Callable[[Progress], Any]
    tell: Callable[[Any, Path, str, Progress], Chapter]
    command: str  #: of the long form


def _studies(
    data: Path | None, world: WorldName, seed: int, workers: int | None
) -> dict[str, _Study]:
    """All studies in their short form, by name."""
    from evofsm.driving import load_family, open_world
    from evofsm.evidence import closed_loop, detection, paper, prediction, real, sensitivity
    from evofsm.evidence.report.closed_loop import closed_loop_chapter
    from evofsm.evidence.report.detection import detection_chapter
    from evofsm.evidence.report.paper import paper_chapter
    from evofsm.evidence.report.prediction import prediction_chapter
    from evofsm.evidence.report.real import real_chapter
    from evofsm.evidence.report.sensitivity import sensitivity_chapter

    def run_paper(done: Progress) -> paper.PaperStudy:
        with open_world(world.value) as place:
            return paper.run_paper(place, world.value, paper.Settings.load(None), 20, done)

    def run_closed_loop(done: Progress) -> closed_loop.ClosedLoop:
        plan = closed_loop.Plan(seed=seed).shortened()
        return closed_loop.run_closed_loop(load_family("emergency"), plan, done, workers)

    def run_detection(done: Progress) -> detection.Detection:
        plan = detection.Plan(seed=seed).shortened()
        return detection.run_detection(detection.FAMILIES, plan, done, workers)

    def run_prediction(done: Progress) -> prediction.Prediction:
        logs = prediction.log_sources(data) if data is not None else ()
        return prediction.run_prediction(
            prediction.Plan(seed=seed).shortened(), logs, done, workers
        )

    def run_sensitivity(done: Progress) -> sensitivity.Sensitivity:
        return sensitivity.run_sensitivity(sensitivity.Plan(seed=seed).shortened(), done, workers)

    studies = {
        "paper": _Study(run_paper, paper_chapter, "evofsm paper"),
        "closed loop": _Study(run_closed_loop, closed_loop_chapter, "evofsm bench closed-loop"),
        "detection": _Study(run_detection, detection_chapter, "evofsm bench detection"),
        "prediction": _Study(run_prediction, prediction_chapter, "evofsm bench prediction"),
        "sensitivity": _Study(run_sensitivity, sensitivity_chapter, "evofsm bench sensitivity"),
    }
    if data is not None:

        def run_real(done: Progress) -> real.RealStudy:
            plan = real.Plan(seed=seed).shortened()
            cases, verified = real.read_folder(data, plan)
            return real.run_real(cases, plan, verified, done, workers)

        studies["real"] = _Study(run_real, real_chapter, f"evofsm bench real --data {data}")
    return studies


def _silent(done: int, total: int) -> None:
    """Drawing is quick beside the studies."""
