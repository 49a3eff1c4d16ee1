"""`evofsm bench prediction`: how far ahead the state is foreseen, and against what."""

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
def prediction(
    data: Annotated[
        Path | None,
        typer.Option(help="Folder of real logs, a run each; without it simulation alone."),
    ] = None,
    train: Annotated[int, typer.Option(min=1, help="Training episodes of a learning seed.")] = 100,
    test: Annotated[int, typer.Option(min=2, help="Held-out episodes of each family.")] = 100,
    seeds: Annotated[int, typer.Option(min=1, help="Learning seeds.")] = 20,
    seed: Annotated[int, typer.Option(min=0, help="Of everything.")] = 0,
    workers: WorkersOption = None,
    short: Annotated[
        bool, typer.Option("--short", help="A tenth of everything: a look, not evidence.")
    ] = False,
    out: PageFolder = Path("evofsm-prediction"),
    as_json: Annotated[
        bool, typer.Option("--json", help="Print the rows of the tables as JSON; write nothing.")
    ] = False,
) -> None:
    """How well the state 0.01 to 5 s ahead is forecast, against persistence and a batch fit."""
    require(scipy="study", deeptime="dev", **({} if as_json else PAGE))
    from evofsm.evidence.prediction.sources import log_sources
    from evofsm.evidence.prediction.study import Plan, run_prediction

    plan = Plan(train=train, test=test, seeds=seeds, seed=seed)
    if short:
        plan = plan.shortened()
    logs = log_sources(data) if data else ()
    with progress() as bars:
        study = run_prediction(plan, logs, counter(bars, "Learning and forecasting"), workers)

    def make_chapter(folder: Path, command: str, drawn: Progress) -> Chapter:
        from evofsm.evidence.report.prediction import prediction_chapter

        return prediction_chapter(study, folder, command, drawn)

    finish(study.as_dicts(), make_chapter, out, as_json=as_json)
