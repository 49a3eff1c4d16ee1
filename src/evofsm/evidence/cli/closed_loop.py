"""`evofsm bench closed-loop`: how many collisions are prevented, and what that costs."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from evofsm.app import (
    PAGE,
    SwitchesOption,
    ToleranceOption,
    counter,
    plain_errors,
    progress,
    require,
    split_names,
)
from evofsm.evidence.cli.common import PageFolder, Progress, WorkersOption, finish

if TYPE_CHECKING:
    from rich.console import Console

    from evofsm.evidence.report.chapter import Chapter

with suppress(ModuleNotFoundError):
    import typer


@plain_errors
def closed_loop(
    family: Annotated[
        str, typer.Option(help="Family of scenarios, or a TOML file of your own.")
    ] = "emergency",
    train: Annotated[int, typer.Option(min=1, help="Training episodes of a learning seed.")] = 300,
    test: Annotated[int, typer.Option(min=1, help="Held-out episodes of every policy.")] = 1000,
    seeds: Annotated[int, typer.Option(min=1, help="Learning seeds.")] = 20,
    seed: Annotated[int, typer.Option(min=0, help="Of everything.")] = 0,
    tolerance: ToleranceOption = 0.02,
    switches: SwitchesOption = "",
    rule_seeds: Annotated[
        int,
        typer.Option(min=0, help="Learning seeds in the comparison of state rules; 0: none."),
    ] = 2,
    workers: WorkersOption = None,
    short: Annotated[
        bool, typer.Option("--short", help="A tenth of everything: a look, not evidence.")
    ] = False,
    out: PageFolder = Path("evofsm-closed-loop"),
    as_json: Annotated[
        bool, typer.Option("--json", help="Print the rows of the table as JSON; write nothing.")
    ] = False,
) -> None:
    """How many collisions are prevented, what that costs, and who does better.

    Every policy drives the same held-out draws; ours learns first, with several seeds.
    """
    require(scipy="study", **({} if as_json else PAGE))
    from evofsm.driving import load_family
    from evofsm.evidence.closed_loop.study import Plan, run_closed_loop

    chosen = load_family(family).with_switches(split_names(switches))
    plan = Plan(
        train=train,
        test=test,
        seeds=seeds,
        seed=seed,
        tolerance=tolerance,
        rule_seeds=rule_seeds,
    )
    if short:
        plan = plan.shortened()
    with progress() as bars:
        study = run_closed_loop(chosen, plan, counter(bars, "Driving and learning"), workers)

    def make_chapter(folder: Path, command: str, drawn: Progress) -> Chapter:
        from evofsm.evidence.report.closed_loop import closed_loop_chapter

        return closed_loop_chapter(study, folder, command, drawn)

    def say(console: Console) -> None:
        from evofsm.evidence.terminal import print_closed_loop

        print_closed_loop(console, study)

    rows = [row.as_dict() for row in study.rows]
    finish(rows, make_chapter, out, as_json=as_json, document=study.as_dict(), say=say)
