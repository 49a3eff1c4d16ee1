"""`evofsm bench leaders`: how hard leaders brake in real drives, and alarms beside them."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import Annotated

from evofsm.app import counter, plain_errors, print_json, progress

with suppress(ModuleNotFoundError):
    import typer

    WorkersOption = Annotated[
        int | None, typer.Option(min=1, help="Processes. [default: one per core]")
    ]


@plain_errors
def leaders(
    data: Annotated[
        Path,
        typer.Option(help="Folder of runs, as `evofsm bench real` takes it.", show_default=False),
    ],
    first: Annotated[
        int | None,
        typer.Option(
            min=1, help="Count alarms in so many runs, the first by name. [default: in all]"
        ),
    ] = None,
    lowest: Annotated[
        float, typer.Option(max=-0.1, help="Hardest braking that can be commanded [m/s²].")
    ] = -8.0,
    decel: Annotated[
        float, typer.Option(min=0.1, help="What it brings, where own brakes are told [m/s²].")
    ] = 7.0,
    workers: WorkersOption = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the numbers as JSON.")] = False,
) -> None:
    """How hard leaders brake in real drives, and how often shadow mode would alarm beside them.

    Counts hard brakes of leaders, and so the hours until enough were seen to do without an
    assumption; it is the command behind the table in leaders. Then every row is a
    decision in shadow mode, the driver's acceleration the proposal.
    """
    from evofsm.evidence.real.leaders import Limits, run_leaders

    limits = Limits(lowest, decel)
    with progress() as bars:
        study = run_leaders(data, limits, first, counter(bars, "Driving beside"), workers)
    if as_json:
        print_json(
            {
                "leaders": [
                    {**one._asdict(), "brakes": one.brakes._asdict()} for one in study.braked
                ],
                "alarms": [one._asdict() for one in study.alarms],
            }
        )
        return
    from evofsm import app
    from evofsm.app import print_table
    from evofsm.evidence.real.tables_of_leaders import leader_tables

    console = app.console()
    for table in leader_tables(study, limits):
        print_table(console, table)
