"""`evofsm campaign`."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from concurrent.futures import Executor
from contextlib import AbstractContextManager
from dataclasses import dataclass
from enum import StrEnum
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from evofsm.cli.commands.common import progress
from evofsm.cli.commands.declared import option
from evofsm.cli.commands.groups import Driven
from evofsm.cli.show import print_json

if TYPE_CHECKING:
    from evofsm.cli.campaign import Result
    from evofsm.cli.driving import Setup
    from evofsm.guard import Guard


class ExecutorName(StrEnum):
    """Who drives."""

    PROCESS = "process"
    DASK = "dask"


@dataclass(frozen=True, kw_only=True)
class Campaign(Driven):
    """Drive thousands of held-out episodes, on all cores or on a cluster.

    Each episode is written to the folder as it comes. After an interruption the same command goes
    on where it stopped; the result is the same whoever drives, and whatever happened to them.
    """

    episodes: int = option(10_000, "How many held-out draws are driven.", min=1, max=2**32)
    executor: ExecutorName = option(
        ExecutorName.PROCESS, "Processes of this computer, or the workers of Dask."
    )
    scheduler: str | None = option(
        None, "Address of Dask's scheduler, such as tcp://10.0.0.1:8786."
    )
    workers: int | None = option(
        None,
        "Processes; with dask, how many workers to wait for. "
        "[default: one per core; with dask, those there are]",
        min=1,
    )
    frozen: Path | None = option(
        None, "What was learnt: folder of an earlier drive --out. [default: nothing]"
    )
    out: Path = option(
        Path("evofsm-campaign"), "Folder of the campaign; what it holds is not driven again."
    )

    def packages(self) -> dict[str, str]:
        """What the executor needs as well."""
        dask = self.executor is ExecutorName.DASK
        return super().packages() | ({"distributed": "cluster"} if dask else {})

    def run(self) -> int | None:
        """Drive what the folder does not hold yet, and print what came of all of it."""
        from evofsm.cli.driving import make_guard
        from evofsm.cli.text.columns import console
        from evofsm.cli.text.driving import print_outcome
        from evofsm.driving import load_learnt

        setup = self.setup(self.episodes, learn=False)
        guard = make_guard(setup, *(load_learnt(self.frozen) if self.frozen else ()))
        open_executor, count = self._executor()
        self.out.mkdir(parents=True, exist_ok=True)
        result = self._drive(setup, guard, open_executor, count)
        if result is None:
            return 130
        if self.as_json:
            print_json({**result.row.as_dict(), "lead_times": list(result.lead_times)})
            return None
        screen = console()
        print_outcome(screen, result.row, result.lead_times, guard, setup)
        screen.print(f"Every episode, and their journal: {self.out}", soft_wrap=True)
        return None

    def _executor(self) -> tuple[Callable[[], AbstractContextManager[Executor]], int]:
        """Who drives, and how many at once."""
        from evofsm.fleet import Processes, cluster, cluster_threads

        if self.executor is ExecutorName.PROCESS:
            if self.scheduler is not None:
                raise ValueError("--scheduler is for --executor dask")
            count = self.workers or os.cpu_count() or 1
            return partial(Processes, count), count
        if self.scheduler is None:
            raise ValueError("--executor dask needs --scheduler, such as tcp://10.0.0.1:8786")
        return partial(cluster, self.scheduler), cluster_threads(self.scheduler, self.workers or 1)

    def _drive(
        self,
        setup: Setup,
        guard: Guard,
        open_executor: Callable[[], AbstractContextManager[Executor]],
        workers: int,
    ) -> Result | None:
        """With a bar; an interruption says how far it came, and returns None."""
        from evofsm.cli import campaign
        from evofsm.driving import learners_of

        driven = campaign.Campaign(setup, learners_of(guard)[1], self.world.value)
        reached = 0
        with progress("episodes") as bars:
            task = bars.add_task("Driving", total=self.episodes, start=False)

            def show(done: int, total: int) -> None:
                nonlocal reached
                reached = done
                bars.start_task(task)
                bars.update(task, completed=done, total=total)

            try:
                return campaign.drive_campaign(driven, self.out, open_executor, workers, show)
            except KeyboardInterrupt:
                pass
        print(
            f"\nevofsm: stopped after {reached:,} of {self.episodes:,} episodes; the same "
            "command goes on from there",
            file=sys.stderr,
        )
        return None
