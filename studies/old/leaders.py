"""`python -m studies leaders`: how hard leaders brake in real drives, and alarms beside them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from studies.old.shim import REQUIRED, Command, counter, option, print_json, progress


@dataclass(frozen=True, kw_only=True)
class Leaders(Command):
    """How hard leaders brake in real drives, and how often shadow mode would alarm beside them.

    Counts hard brakes of leaders, and so the hours until enough were seen to do without an
    assumption; it is the command behind the table in leaders. Then every row is a
    decision in shadow mode, the driver's acceleration the proposal.
    """

    data: Path = option(REQUIRED, "Folder of runs, as `python -m studies real` takes it.")
    first: int | None = option(
        None, "Count alarms in so many runs, the first by name. [default: in all]", min=1
    )
    lowest: float = option(-8.0, "Hardest braking that can be commanded [m/s²].", max=-0.1)
    decel: float = option(7.0, "What it brings, where own brakes are told [m/s²].", min=0.1)
    workers: int | None = option(None, "Processes. [default: one per core]", min=1)
    as_json: bool = option(False, "Print the numbers as JSON.", name="--json")

    def run(self) -> None:
        """Count, and print the tables."""
        from studies.old.shim import console, print_table, spelled_out
        from studies.real.leaders import Limits, run_leaders

        limits = Limits(self.lowest, self.decel)
        with progress() as bars:
            done = counter(bars, "Driving beside")
            study = run_leaders(self.data, limits, self.first, done, self.workers)
        if self.as_json:
            print_json(spelled_out({"leaders": study.braked, "alarms": study.alarms}))
            return
        from studies.real.tables_of_leaders import leader_tables

        screen = console()
        for table in leader_tables(study, limits):
            print_table(screen, table)
