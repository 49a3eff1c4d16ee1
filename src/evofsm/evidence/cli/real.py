"""`evofsm bench real`: what was learnt on some real drives, judged on others."""

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
def real(
    data: Annotated[
        Path,
        typer.Option(
            help="Folder of runs, a CSV file each (gzipped or not): pair, segment, time, gap, "
            "v_follower, v_leader, a_follower. See docs/real-data.md.",
            show_default=False,
        ),
    ],
    train: Annotated[
        Path | None,
        typer.Option(
            help="Another folder of runs: all that is learnt from, and all of --data is judged. "
            "Without it the runs of --data are dealt to folds.",
            show_default=False,
        ),
    ] = None,
    folds: Annotated[
        int,
        typer.Option(min=2, help="Each run is judged by what the other folds taught (no --train)."),
    ] = 5,
    seed: Annotated[int, typer.Option(min=0, help="Of the folds and the intervals.")] = 0,
    workers: WorkersOption = None,
    short: Annotated[bool, typer.Option("--short", help="Ten runs: a look, not evidence.")] = False,
    out: PageFolder = Path("evofsm-real"),
    as_json: Annotated[
        bool, typer.Option("--json", help="Print the rows of the table as JSON; write nothing.")
    ] = False,
) -> None:
    """Whether what was learnt on some real drives foretells danger in others.

    Events are a time to collision below 3, 2 and 1.5 s, and braking harder than 3 m/s², within 1,
    2 and 5 s. Ours learns on the runs of all folds but one, and is judged on that one, or learns on
    --train and is judged on --data, beside the classic measures. Checksums in MANIFEST.csv or
    SHA256SUMS are held against the files.
    """
    require(scipy="study", **({} if as_json else PAGE))
    from evofsm.evidence.real.study import Plan, read_folder, run_real

    plan = Plan(folds=folds, seed=seed)
    if short:
        plan = plan.shortened()
    training, verified = (None, 0) if train is None else read_folder(train, plan, dealt=False)
    cases, held = read_folder(data, plan, dealt=train is None)
    with progress() as bars:
        done = counter(bars, "Learning and judging")
        study = run_real(cases, plan, verified + held, done, workers, training)

    def make_chapter(folder: Path, command: str, drawn: Progress) -> Chapter:
        from evofsm.evidence.report.real import real_chapter

        return real_chapter(study, folder, command, drawn)

    finish(study.as_rows(), make_chapter, out, as_json=as_json)
