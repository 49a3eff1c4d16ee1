"""`evofsm campaign`."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from concurrent.futures import Executor
from contextlib import AbstractContextManager, suppress
from enum import StrEnum
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from evofsm.app.cli.common import (
    ControllerOption,
    FamilyArgument,
    ModeOption,
    ReviserOption,
    SummaryAsJson,
    SwitchesOption,
    ToleranceOption,
    WorldName,
    WorldOption,
    chosen_mode,
    of_world,
    plain_errors,
    print_json,
    progress,
    require,
    split_names,
)

with suppress(ModuleNotFoundError):
    import typer

if TYPE_CHECKING:
    from evofsm.app.campaign import Campaign, Result


class ExecutorName(StrEnum):
    """Who drives."""

    PROCESS = "process"
    DASK = "dask"


@plain_errors
def campaign(
    family: FamilyArgument,
    episodes: Annotated[
        int, typer.Option(min=1, max=2**32, help="How many held-out draws are driven.")
    ] = 10_000,
    executor: Annotated[
        ExecutorName, typer.Option(help="Processes of this computer, or the workers of Dask.")
    ] = ExecutorName.PROCESS,
    scheduler: Annotated[
        str | None,
        typer.Option(
            help="Address of Dask's scheduler, such as tcp://10.0.0.1:8786.", show_default=False
        ),
    ] = None,
    workers: Annotated[
        int | None,
        typer.Option(
            min=1,
            help="Processes; with dask, how many workers to wait for. "
            "[default: one per core; with dask, those there are]",
            show_default=False,
        ),
    ] = None,
    controller: ControllerOption = "family",
    reviser: ReviserOption = "least-risk",
    mode: ModeOption = "act",
    tolerance: ToleranceOption = 0.02,
    world: WorldOption = WorldName.KINEMATIC,
    seed: Annotated[int, typer.Option(min=0, help="Of the draws.")] = 0,
    switches: SwitchesOption = "",
    frozen: Annotated[
        Path | None,
        typer.Option(
            help="What was learnt: folder of an earlier drive --out. [default: nothing]",
            show_default=False,
        ),
    ] = None,
    out: Annotated[
        Path, typer.Option(help="Folder of the campaign; what it holds is not driven again.")
    ] = Path("evofsm-campaign"),
    as_json: SummaryAsJson = False,
) -> None:
    """Drive thousands of held-out episodes, on all cores or on a cluster.

    Each episode is written to the folder as it comes. After an interruption the same command goes
    on where it stopped; the result is the same whoever drives, and whatever happened to them.
    """
    workers_too = {"distributed": "cluster"} if executor == "dask" else {}
    require(scipy="study", **of_world(world), **workers_too)
    from evofsm.app.campaign import Campaign
    from evofsm.app.driving import Setup, make_guard
    from evofsm.app.text.columns import console
    from evofsm.app.text.driving import print_outcome
    from evofsm.driving import learnt_by, load_family, load_learnt

    chosen = load_family(family).with_switches(split_names(switches))
    setup = Setup(
        *(chosen, controller, reviser, chosen_mode(mode), tolerance, episodes, seed), learn=False
    )
    guard = make_guard(setup, *(load_learnt(frozen) if frozen else ()))
    open_executor, count = _executor(executor, scheduler, workers)
    out.mkdir(parents=True, exist_ok=True)
    result = _drive(Campaign(setup, learnt_by(guard)[1], world.value), out, open_executor, count)
    if as_json:
        print_json({**result.row.as_dict(), "lead_times": list(result.lead_times)})
        return
    screen = console()
    print_outcome(screen, result.row, result.lead_times, guard, setup)
    screen.print(f"Every episode, and their journal: {out}", soft_wrap=True)


def _executor(
    name: ExecutorName, scheduler: str | None, workers: int | None
) -> tuple[Callable[[], AbstractContextManager[Executor]], int]:
    """Who drives, and how many at once."""
    from evofsm.fleet import Processes, cluster, cluster_threads

    if name == "process":
        if scheduler is not None:
            raise ValueError("--scheduler is for --executor dask")
        count = workers or os.cpu_count() or 1
        return partial(Processes, count), count
    if scheduler is None:
        raise ValueError("--executor dask needs --scheduler, such as tcp://10.0.0.1:8786")
    return partial(cluster, scheduler), cluster_threads(scheduler, workers or 1)


def _drive(
    campaign: Campaign,
    out: Path,
    open_executor: Callable[[], AbstractContextManager[Executor]],
    workers: int,
) -> Result:
    """With a bar; an interruption says how far it came."""
    from evofsm.app.campaign import drive_campaign

    reached = 0
    with progress("episodes") as bars:
        task = bars.add_task("Driving", total=campaign.setup.episodes, start=False)

        def show(done: int, total: int) -> None:
            nonlocal reached
            reached = done
            bars.start_task(task)
            bars.update(task, completed=done, total=total)

        try:
            return drive_campaign(campaign, out, open_executor, workers, show)
        except KeyboardInterrupt:
            pass
    print(
        f"\nevofsm: stopped after {reached:,} of {campaign.setup.episodes:,} episodes; the same "
        "command goes on from there",
        file=sys.stderr,
    )
    raise typer.Exit(130)
