"""`evofsm drive`."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext, suppress
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
    from evofsm.app.driving import Driving, Setup
    from evofsm.driving import World
    from evofsm.files import Checkpoint
    from evofsm.guard import AuditLog, Guard
    from evofsm.io import RunWriter


@plain_errors
def drive(
    family: FamilyArgument,
    controller: ControllerOption = "family",
    reviser: ReviserOption = "least-risk",
    mode: ModeOption = "act",
    tolerance: ToleranceOption = 0.02,
    world: WorldOption = WorldName.KINEMATIC,
    episodes: Annotated[int, typer.Option(min=1, help="How many are driven.")] = 100,
    seed: Annotated[int, typer.Option(min=0, help="Of the draws.")] = 0,
    switches: SwitchesOption = "",
    learn: Annotated[
        Path | None,
        typer.Option(
            help="Go on learning from this folder of an earlier --out.", show_default=False
        ),
    ] = None,
    frozen: Annotated[
        Path | None,
        typer.Option(
            help="Drive held-out draws with what this folder holds; learn nothing.",
            show_default=False,
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(help="Folder for what was learnt and every decision.", show_default=False),
    ] = None,
    checkpoint: Annotated[
        Path | None,
        typer.Option(
            help="Keep what came of the episodes so far in this file; where it exists, go on "
            "from it.",
            show_default=False,
        ),
    ] = None,
    every: Annotated[
        str, typer.Option(help="Time between two checkpoints: 10s, 5m; 0s for every episode.")
    ] = "60s",
    audit: Annotated[
        Path | None,
        typer.Option(
            help="Append to this log what the reviser changed or warned of, to be verified and "
            "replayed by evofsm audit.",
            show_default=False,
        ),
    ] = None,
    mcap: Annotated[
        Path | None,
        typer.Option(
            help="Write every episode to this log, for Foxglove and evofsm export.",
            show_default=False,
        ),
    ] = None,
    as_json: SummaryAsJson = False,
) -> None:
    """Drive scenarios under a reviser; learn on the way.

    A machine and its latent risk learn from every episode, from the first on, unless --frozen.
    The summary compares with the controller left to itself in the same draws.

    With --checkpoint, the same command goes on where it was stopped, whatever stopped it, and comes
    to the same result; with more --episodes, it goes on to these.
    """
    require(
        scipy="study",
        **of_world(world),
        **({"polars": "tables"} if out else {}),
        **({"mcap": "mcap"} if mcap else {}),
    )
    from evofsm.app.driving import Setup, episodes_learnt, make_guard, write_driving
    from evofsm.app.text.columns import console
    from evofsm.app.text.driving import driving_document, print_driving
    from evofsm.driving import learnt_by, load_family, load_learnt, open_world
    from evofsm.files import Checkpoint, duration, result_kept
    from evofsm.guard import AuditLog

    if learn is not None and frozen is not None:
        raise ValueError("--learn and --frozen exclude each other")
    if mcap is not None and checkpoint is not None:
        raise ValueError(
            "--mcap and --checkpoint exclude each other: a log holds what one run has driven"
        )
    interval = duration(every)
    chosen = load_family(family).with_switches(split_names(switches))
    setup = Setup(
        chosen,
        controller,
        reviser,
        chosen_mode(mode),
        tolerance,
        episodes,
        seed,
        learn=frozen is None,
        first=episodes_learnt(learn) if learn else 0,
    )
    start = learn or frozen
    guard = make_guard(setup, *(load_learnt(start) if start else ()))
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
    keeper = None
    if checkpoint is not None:
        keeper = Checkpoint(checkpoint, setup.settings(world.value, guard), interval)
    with (
        AuditLog(audit) if audit else nullcontext() as log,
        open_world(world.value) as place,
        _recording(mcap, setup, world.value) as run,
    ):
        driving = _drive(setup, guard, place, keeper, log, run)
        if run is not None:
            run.attach(learnt_by(driving.guard)[0].model(**chosen.labels._asdict()))
    if out is not None:
        with result_kept(keeper):
            write_driving(driving, setup, out)
    if as_json:
        print_json(driving_document(driving))
        return
    screen = console()
    print_driving(screen, driving, setup)
    if out is not None:
        screen.print(f"What was learnt, and every decision: {out}", soft_wrap=True)
    if mcap is not None:
        screen.print(f"Every episode, for Foxglove: {mcap}", soft_wrap=True)
    if log is not None:
        screen.print(f"Head of {audit}, to be kept elsewhere: {log.head}", soft_wrap=True)


def _drive(
    setup: Setup,
    guard: Guard,
    place: World,
    checkpoint: Checkpoint | None,
    audit: AuditLog | None,
    run: RunWriter | None,
) -> Driving:
    """With a bar that shows the collisions so far."""
    from evofsm.app.driving import drive_family

    with progress() as bars:
        task = bars.add_task("Driving", total=setup.episodes)

        def show(done: int, collisions: int) -> None:
            text = f"Driving ({collisions} collisions, {collisions / done:.1%})"
            bars.update(task, completed=done, description=text)

        record = None if run is None else run.add
        return drive_family(setup, guard, place, show, checkpoint, audit, record)


def _recording(
    path: Path | None, setup: Setup, world: str
) -> AbstractContextManager[RunWriter | None]:
    """A log of the run, where one is asked for."""
    if path is None:
        return nullcontext()
    from evofsm.io import recording

    told = {**setup.told, "family": setup.family.name, "learn": setup.learn, "first": setup.first}
    return recording(path, {**told, "episodes": setup.episodes, "world": world})
