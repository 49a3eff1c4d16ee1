"""`evofsm bench detection`: who sees danger, how early, and at how many false alarms."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from evofsm.app import PAGE, counter, plain_errors, progress, require, split_names
from evofsm.evidence.cli.common import PageFolder, Progress, WorkersOption, finish

if TYPE_CHECKING:
    from evofsm.evidence.report.chapter import Chapter

with suppress(ModuleNotFoundError):
    import typer


@plain_errors
def detection(
    family: Annotated[
        str,
        typer.Option(
            help="Families with commas, emergency+noise for one with a switch, shift-at-once for "
            "one just shifted. [default: all of the study]",
            show_default=False,
        ),
    ] = "",
    seed: Annotated[int, typer.Option(min=0, help="Of everything.")] = 0,
    grid: Annotated[
        bool, typer.Option(help="Also over brakes that nobody was told of, own and leader's.")
    ] = True,
    workers: WorkersOption = None,
    short: Annotated[
        bool, typer.Option("--short", help="A tenth of everything: a look, not evidence.")
    ] = False,
    out: PageFolder = Path("evofsm-detection"),
    as_json: Annotated[
        bool, typer.Option("--json", help="Print all rows as JSON; write nothing.")
    ] = False,
) -> None:
    """Who sees dead ends and collisions coming: ours, and the classic measures.

    Nobody acts. Ours has watched other episodes; thresholds are chosen on yet others.
    """
    require(scipy="study", **({} if as_json else PAGE))
    from evofsm.evidence.detection.plan import FAMILIES, Plan
    from evofsm.evidence.detection.study import run_detection

    plan = Plan(seed=seed).shortened() if short else Plan(seed=seed)
    families = split_names(family) or FAMILIES
    with progress() as bars:
        study = run_detection(
            families, plan, counter(bars, "Watching and judging"), workers, grid=grid
        )

    def make_chapter(folder: Path, command: str, drawn: Progress) -> Chapter:
        from evofsm.evidence.report.detection import detection_chapter

        return detection_chapter(study, folder, command, drawn)

    rows = [row.as_dict() for row in (*study.rows, *study.grid)]
    finish(rows, make_chapter, out, as_json=as_json)
