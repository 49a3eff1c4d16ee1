"""`evofsm evidence`: all studies, on one page."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from evofsm.cli.common import WorldName, WorldOption, counter, plain_errors, progress, require

with suppress(ModuleNotFoundError):
    import typer

if TYPE_CHECKING:
    from evofsm.report.chapter import Chapter

Progress = Callable[[int, int], None]
Maker = Callable[[Path, Progress], "Chapter"]


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
    workers: Annotated[
        int | None, typer.Option(min=1, help="Processes. [default: one per core]")
    ] = None,
    out: Annotated[Path, typer.Option(help="Folder for the page and its figures.")] = Path(
        "evofsm-evidence"
    ),
) -> None:
    """All studies in their short form, on one page: what holds, and where it loses.

    The page names the command of each study's long form.
    """
    require(scipy="study", matplotlib="plot", jinja2="plot")
    from evofsm.report import terminal
    from evofsm.report.chapter import write_chapters

    makers: dict[str, Maker] = {
        "paper": _paper(world),
        "closed loop": _closed_loop(seed, workers),
        "detection": _detection(seed, workers),
        "prediction": _prediction(data, seed, workers),
        "sensitivity": _sensitivity(seed, workers),
    }
    if data is not None:
        makers["real"] = _real(data, seed, workers)
    out.mkdir(parents=True, exist_ok=True)
    chapters = []
    with progress() as bars:
        for name, make in makers.items():
            begun = time.monotonic()
            chapters.append(make(out / name.replace(" ", "-"), counter(bars, f"Study: {name}")))
            print(f"{name}: {time.monotonic() - begun:.0f} s", file=sys.stderr)
    page = write_chapters(
        out / "index.html",
        chapters,
        title="Does it see danger earlier, and does that help?",
        about="Each study asks one question, says what came of it in a line, and shows the numbers "
        "that this rests on. These are the short forms, which fit a coffee break: the command "
        "beside each study makes the long one. What goes against us is gathered at the end.",
        command=" ".join(["evofsm", *sys.argv[1:]]),
        packages=("scipy",),
    )
    console = terminal.console()
    for chapter in chapters:
        console.print(f"{chapter.title}\n  {chapter.headline}", soft_wrap=True)
    console.print(f"\nPage with all tables and figures: {page}", soft_wrap=True)


def _paper(world: WorldName) -> Maker:
    def make(folder: Path, done: Progress) -> Chapter:
        from evofsm.report.of_others import paper_chapter
        from evofsm.studies.paper import Settings, run_paper
        from evofsm.worlds import open_world

        with open_world(world.value) as place:
            study = run_paper(place, world.value, Settings.load(None), 20, done)
        return paper_chapter(study, folder, "evofsm paper", _silent)

    return make


def _closed_loop(seed: int, workers: int | None) -> Maker:
    def make(folder: Path, done: Progress) -> Chapter:
        from evofsm.report.of_others import closed_loop_chapter
        from evofsm.studies.closed_loop import Plan, run_closed_loop
        from evofsm.worlds.families import load_family

        plan = Plan(seed=seed).shortened()
        study = run_closed_loop(load_family("emergency"), plan, done, workers)
        return closed_loop_chapter(study, folder, "evofsm bench closed-loop", _silent)

    return make


def _detection(seed: int, workers: int | None) -> Maker:
    def make(folder: Path, done: Progress) -> Chapter:
        from evofsm.report.detection import detection_chapter
        from evofsm.studies.detection import FAMILIES, Plan, run_detection

        study = run_detection(FAMILIES, Plan(seed=seed).shortened(), done, workers)
        return detection_chapter(study, folder, "evofsm bench detection", _silent)

    return make


def _prediction(data: Path | None, seed: int, workers: int | None) -> Maker:
    def make(folder: Path, done: Progress) -> Chapter:
        from evofsm.report.prediction import prediction_chapter
        from evofsm.studies.prediction import Plan, log_sources, run_prediction

        logs = log_sources(data) if data is not None else ()
        study = run_prediction(Plan(seed=seed).shortened(), logs, done, workers)
        return prediction_chapter(study, folder, "evofsm bench prediction", _silent)

    return make


def _sensitivity(seed: int, workers: int | None) -> Maker:
    def make(folder: Path, done: Progress) -> Chapter:
        from evofsm.report.sensitivity import sensitivity_chapter
        from evofsm.studies.sensitivity import Plan, run_sensitivity

        study = run_sensitivity(Plan(seed=seed).shortened(), done, workers)
        return sensitivity_chapter(study, folder, "evofsm bench sensitivity", _silent)

    return make


def _real(data: Path, seed: int, workers: int | None) -> Maker:
    def make(folder: Path, done: Progress) -> Chapter:
        from evofsm.report.real import real_chapter
        from evofsm.studies.real import Plan, read_folder, run_real

        plan = Plan(seed=seed).shortened()
        cases, verified = read_folder(data, plan)
        study = run_real(cases, plan, verified, done, workers)
        return real_chapter(study, folder, f"evofsm bench real --data {data}", _silent)

    return make


def _silent(done: int, total: int) -> None:
    """Drawing is quick beside the studies."""
