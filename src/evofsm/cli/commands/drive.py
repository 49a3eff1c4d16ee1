"""`evofsm drive`."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from evofsm.cli.commands.common import progress, split_names
from evofsm.cli.commands.declared import option
from evofsm.cli.commands.groups import Driven
from evofsm.cli.show import print_json

if TYPE_CHECKING:
    from evofsm.cli.driving import Driving, Setup
    from evofsm.driving import World
    from evofsm.fleet.checkpoint import Checkpoint
    from evofsm.guard import DecisionLogger, Guard
    from evofsm.io.foxglove import FoxgloveSink, RunWriter


@dataclass(frozen=True, kw_only=True)
class Drive(Driven):
    """Drive scenarios under a reviser; learn on the way.

    A machine and its judge learn from every episode, from the first on, unless --frozen.
    The summary compares with the controller left to itself in the same draws.

    With --checkpoint, the same command goes on where it was stopped, whatever stopped it, and comes
    to the same result; with more --episodes, it goes on to these.

    A SUMO configuration (my.sumocfg) is run as it is, once, with guards in the cars that --vehicles
    names; of all else only --mode (act or shadow), --tolerance and --json hold then.
    """

    episodes: int = option(100, "How many are driven.", min=1)
    learn: Path | None = option(None, "Go on learning from this folder of an earlier --out.")
    frozen: Path | None = option(
        None, "Drive held-out draws with what this folder holds; learn nothing."
    )
    out: Path | None = option(None, "Folder for what was learnt and every decision.")
    checkpoint: Path | None = option(
        None,
        "Keep what came of the episodes so far in this file; where it exists, go on from it.",
    )
    every: str = option("60s", "Time between two checkpoints: 10s, 5m; 0s for every episode.")
    audit: Path | None = option(
        None,
        "Append to this log what the reviser changed or warned of, to be verified and replayed by "
        "evofsm audit.",
    )
    vehicles: str = option(
        "10%",
        "Of a SUMO configuration the guarded cars: all, a share, type:NAME, or ids with commas.",
    )
    mcap: Path | None = option(
        None, "Write every episode to this log, for Foxglove and evofsm export."
    )
    foxglove: int | None = option(
        None,
        "Serve every decision at this port (8765 is usual) to Foxglove or Lichtblick on this "
        "computer, in real time; it begins when somebody looks on.",
        min=0,
        max=65535,
    )

    def packages(self) -> dict[str, str]:
        """What the files that are asked for need as well."""
        if self._is_configuration:
            return {"libsumo": "sumo"}
        written = {"polars": "tables"} if self.out else {}
        logs = {"mcap": "mcap", "foxglove": "mcap"} if self.mcap or self.foxglove else {}
        return super().packages() | written | logs

    def run(self) -> None:
        """Drive, and print what came of it."""
        if self._is_configuration:
            self._run_configuration()
            return
        from evofsm.cli.driving import episodes_learnt, make_guard, write_driving
        from evofsm.cli.text.columns import console
        from evofsm.cli.text.driving import driving_document, print_driving
        from evofsm.driving import learners_of, load_learnt, open_world
        from evofsm.fleet.checkpoint import Checkpoint, duration, result_kept
        from evofsm.guard import AuditLog

        if self.learn is not None and self.frozen is not None:
            raise ValueError("--learn and --frozen exclude each other")
        if self.mcap is not None and self.checkpoint is not None:
            raise ValueError(
                "--mcap and --checkpoint exclude each other: a log holds what one run has driven"
            )
        if self.foxglove is not None and self.audit is not None:
            raise ValueError("--foxglove and --audit exclude each other: a guard has one witness")
        interval = duration(self.every)
        first = episodes_learnt(self.learn) if self.learn else 0
        setup = self.setup(self.episodes, learn=self.frozen is None, first=first)
        start = self.learn or self.frozen
        guard = make_guard(setup, *(load_learnt(start) if start else ()))
        if self.out is not None:
            self.out.mkdir(parents=True, exist_ok=True)
        keeper = None
        if self.checkpoint is not None:
            work = setup.settings(self.world.value, guard)
            keeper = Checkpoint(self.checkpoint, work, interval)
        with (
            AuditLog(self.audit) if self.audit else nullcontext() as log,
            open_world(self.world.value) as place,
            self._recording(setup) as run,
            self._live() as live,
        ):
            driving = _drive(setup, guard, place, keeper, log or live, run)
            if run is not None:
                run.attach(learners_of(driving.guard)[0].model(**setup.family.labels._asdict()))
        if self.out is not None:
            with result_kept(keeper):
                write_driving(driving, setup, self.out)
        if self.as_json:
            print_json(driving_document(driving))
            return
        screen = console()
        print_driving(screen, driving, setup)
        if self.out is not None:
            screen.print(f"What was learnt, and every decision: {self.out}", soft_wrap=True)
        if self.mcap is not None:
            screen.print(f"Every episode, for Foxglove: {self.mcap}", soft_wrap=True)
        if log is not None:
            screen.print(f"Head of {self.audit}, to be kept elsewhere: {log.head}", soft_wrap=True)

    @property
    def _is_configuration(self) -> bool:
        return self.family.endswith(".sumocfg")

    def _run_configuration(self) -> None:
        from evofsm.cli.configuration import drive_configuration
        from evofsm.cli.text.columns import console
        from evofsm.cli.text.configuration import print_attached

        for name in ("learn", "frozen", "out", "checkpoint", "audit", "mcap"):
            if getattr(self, name) is not None:
                raise ValueError(f"--{name} is for families of scenarios, not for a configuration")
        if self.mode not in ("act", "shadow"):
            raise ValueError(f"--mode is {self.mode!r}; for a configuration it is act or shadow")
        named = self.vehicles.startswith("type:") or self.vehicles == "all"
        ids = not named and not self.vehicles.endswith("%")
        chosen = split_names(self.vehicles) if ids else self.vehicles
        with progress() as bars:
            task = bars.add_task("Driving", total=None)

            def show(time: float, collisions: int) -> None:
                if time == int(time):
                    text = f"Driving ({time:,.0f} s, {collisions} collisions)"
                    bars.update(task, description=text)

            file = Path(self.family)
            came = drive_configuration(file, chosen, self.mode, self.tolerance, show)
        if self.as_json:
            print_json(came.document())
        else:
            print_attached(console(), came)

    def _recording(self, setup: Setup) -> AbstractContextManager[RunWriter | None]:
        """A log of the run, where one is asked for."""
        if self.mcap is None:
            return nullcontext()
        from evofsm.io import recording

        told = setup.told | {"family": setup.family.name, "learn": setup.learn}
        told |= {"first": setup.first, "episodes": setup.episodes, "world": self.world.value}
        return recording(self.mcap, told)

    @contextmanager
    def _live(self) -> Iterator[FoxgloveSink | None]:
        """A view in Foxglove, where one is asked for, once somebody looks on."""
        if self.foxglove is None:
            yield None
            return
        from evofsm.io import FOXGLOVE_LAYOUT, FoxgloveSink

        with FoxgloveSink(self.foxglove, speed=1.0) as sink:
            told = f"Open {sink.address} in Foxglove or Lichtblick (Ctrl-C ends it)"
            print(f"{told}; a layout to import: {FOXGLOVE_LAYOUT}", file=sys.stderr, flush=True)
            while not sink.await_someone(1.0):  # as Ctrl-C would not end a wait without an end
                pass
            yield sink


def _drive(
    setup: Setup,
    guard: Guard,
    place: World,
    checkpoint: Checkpoint | None,
    audit: DecisionLogger | None,
    run: RunWriter | None,
) -> Driving:
    """With a bar that shows the collisions so far."""
    from evofsm.cli.driving import drive_family

    with progress() as bars:
        task = bars.add_task("Driving", total=setup.episodes)

        def show(done: int, collisions: int) -> None:
            text = f"Driving ({collisions} collisions, {collisions / done:.1%})"
            bars.update(task, completed=done, description=text)

        record = None if run is None else run.add
        return drive_family(setup, guard, place, show, checkpoint, audit, record)
