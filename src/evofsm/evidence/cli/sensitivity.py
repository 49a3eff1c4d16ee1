"""`evofsm bench sensitivity`: how far the paper's claims depend on what it leaves open."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from evofsm.app import PAGE, counter, plain_errors, progress, require
from evofsm.evidence.cli.common import PageFolder, Progress, WorkersOption, finish

if TYPE_CHECKING:
    from evofsm.evidence.report.chapter import Chapter

with suppress(ModuleNotFoundError):
    import typer


@plain_errors
def sensitivity(
    settings: Annotated[
        int,
        typer.Option(
            min=4, help="Drawn over everything; sweeps, maps and other draws come on top."
        ),
    ] = 2000,
    seed: Annotated[int, typer.Option(min=0, help="Of the draws and of the noise.")] = 0,
    workers: WorkersOption = None,
    short: Annotated[
        bool, typer.Option("--short", help="A twentieth of everything: a look, not evidence.")
    ] = False,
    out: PageFolder = Path("evofsm-sensitivity"),
    as_json: Annotated[
        bool, typer.Option("--json", help="Print a row for each setting as JSON; write nothing.")
    ] = False,
) -> None:
    """In what share of settings each claim of the paper holds.

    The paper leaves open how fast the leader gets, how hard it brakes, the gap at the start, and
    more. Each setting drives the paper's 80 runs and is judged by the checks of `evofsm paper`.
    """
    require(scipy="study", **({} if as_json else PAGE))
    from evofsm.evidence.sensitivity.study import Plan, run_sensitivity

    plan = Plan(settings=settings, seed=seed)
    if short:
        plan = plan.shortened()
    with progress() as bars:
        study = run_sensitivity(plan, counter(bars, "Driving and learning"), workers)

    def make_chapter(folder: Path, command: str, drawn: Progress) -> Chapter:
        from evofsm.evidence.report.sensitivity import sensitivity_chapter

        return sensitivity_chapter(study, folder, command, drawn)

    finish(study.as_dicts(), make_chapter, out, as_json=as_json)
