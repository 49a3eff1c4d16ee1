"""`evofsm drive`."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, closing, contextmanager, nullcontext
from dataclasses import replace
from hashlib import sha256
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Annotated, Any

import typer

from evofsm.cli.options import (
    ControllerOption,
    Json,
    Judge,
    JudgeOption,
    ModeName,
    ReviserOption,
    SeedOption,
    SwitchesOption,
    ToleranceOption,
    World,
    WorldOption,
    family_of,
    require,
    require_world,
    split_names,
)
from evofsm.cli.show import facts, print_json, progress, say, show, table, warn

if TYPE_CHECKING:
    from rich.console import RenderableType

    from evofsm.cli.driving import Driving, Results, Setup
    from evofsm.cli.sumocfg import Attached
    from evofsm.driving.by_state import StateRisk
    from evofsm.guard import Guard
    from evofsm.io.foxglove import FoxgloveSink, RunWriter

# More states than these are not listed.
_MOST = 8


def drive(
    family: Annotated[
        str,
        typer.Argument(
            help="Family of scenarios: emergency, paper, shift, ..., a Python file with one of "
            "your own, or a SUMO configuration (.sumocfg)."
        ),
    ],
    episodes: Annotated[int, typer.Option(min=1, max=2**32, help="How many are driven.")] = 100,
    world: WorldOption = World.KINEMATIC,
    controller: ControllerOption = "family",
    reviser: ReviserOption = "least-risk",
    judge: JudgeOption = Judge.KINEMATIC,
    mode: Annotated[
        ModeName, typer.Option(help="How far least-risk goes: off, shadow, advise, act.")
    ] = ModeName.ACT,
    tolerance: ToleranceOption = 0.02,
    switches: SwitchesOption = "",
    seed: SeedOption = 0,
    learn: Annotated[
        Path | None, typer.Option(help="Go on learning from this folder of an earlier --out.")
    ] = None,
    frozen: Annotated[
        Path | None,
        typer.Option(help="Drive held-out draws with what this folder holds; learn nothing."),
    ] = None,
    workers: Annotated[
        int | None,
        typer.Option(
            min=1,
            help="Drive held-out draws in so many processes, and learn nothing; with --cluster, "
            "wait for so many workers.",
        ),
    ] = None,
    cluster: Annotated[
        str | None,
        typer.Option(
            help="The same by the workers of Dask's scheduler, such as tcp://10.0.0.1:8786."
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            help="Folder for what was learnt, every episode and every decision; what it holds is "
            "not driven again."
        ),
    ] = None,
    audit: Annotated[
        Path | None,
        typer.Option(
            help="Append to this log what the reviser changed or warned of, to be verified and "
            "replayed by evofsm audit."
        ),
    ] = None,
    vehicles: Annotated[
        str,
        typer.Option(
            help="Of a SUMO configuration the guarded cars: all, a share, type:NAME, or ids with "
            "commas."
        ),
    ] = "10%",
    mcap: Annotated[
        Path | None,
        typer.Option(help="Write every episode to this log, for Foxglove and evofsm watch."),
    ] = None,
    foxglove: Annotated[
        int | None,
        typer.Option(
            min=0,
            max=65535,
            help="Serve every decision at this port (8765 is usual) to Foxglove or Lichtblick on "
            "this computer, in real time; it begins when somebody looks on.",
        ),
    ] = None,
    as_json: Json = False,
) -> int | None:
    """Drive scenarios under a reviser; learn on the way.

    A machine and its judge learn from every episode, from the first on, unless --frozen, --workers
    or --cluster is given: then draws are held out, and thousands of episodes are driven on all
    cores or on many computers. The summary compares with the controller left to itself in the same
    draws.

    With --out, the same command goes on where it was stopped, whatever stopped it, and comes to the
    same result; with more --episodes, it goes on to these.

    A SUMO configuration (my.sumocfg) is run as it is, once, with guards in the cars that --vehicles
    names; of all else only --mode (act or shadow), --tolerance and --json hold then.
    """
    at_once = workers is not None or cluster is not None
    given = {"learn": learn, "frozen": frozen, "workers": workers, "cluster": cluster}
    given |= {"out": out, "audit": audit, "mcap": mcap, "foxglove": foxglove}
    given = {name: value for name, value in given.items() if value is not None}
    if family.endswith(".sumocfg"):
        _drive_configuration(Path(family), vehicles, mode, tolerance, given, as_json=as_json)
        return None
    _refuse_pairs(given)
    require_world(world, **({"polars": "tables"} if out is not None and not at_once else {}))
    require(**({} if mcap is None else {"mcap": "mcap"}))
    require(**({} if foxglove is None else {"foxglove": "foxglove"}))
    from evofsm import store
    from evofsm.cli.driving import GUARD, Results, Setup, make_guard
    from evofsm.guard import Guard, Mode

    setup = Setup(
        family_of(family, switches),
        controller,
        reviser,
        judge.value,
        Mode(mode.value),
        tolerance,
        seed,
        world.value,
        learn=frozen is None and not at_once,
    )
    before = None
    if (start := learn or frozen) is not None:
        file = start / GUARD
        before = Guard.load(file)
        reached = int(store.read_header(file).provenance.get("episodes", 0))
        setup = replace(setup, learnt=reached, digest=sha256(file.read_bytes()).hexdigest())
    with closing(Results(setup, make_guard(setup, before), out)) as results:
        if mcap is not None and results.rows:
            found = f"{out} has {len(results.rows):,} episodes already; name another folder"
            raise ValueError(f"--mcap holds what one run drives, but {found}")
        try:
            if at_once:
                driving = _drive_at_once(results, episodes, workers, cluster)
            else:
                driving = _drive_in_turn(results, episodes, audit, mcap, foxglove)
        except KeyboardInterrupt:
            if out is None:
                raise
            how_far = f"{len(results.rows):,} of {episodes:,} episodes"
            warn(f"stopped after {how_far}; the same command goes on from there")
            return 130
    if as_json:
        states = [{**one._asdict(), "is_dead_end": one.is_dead_end} for one in driving.states]
        summary = {**driving.row.as_dict(), "lead_times": driving.lead_times, "states": states}
        print_json(summary)
        return None
    show(facts("What came of driving", _summary(driving, setup)), "", *_states(driving))
    if out is not None:
        say(f"What was learnt, and every episode: {out}")
    if mcap is not None:
        say(f"Every episode, for Foxglove: {mcap}")
    return None


def _refuse_pairs(given: dict[str, Any]) -> None:
    """Raise where two options exclude each other."""
    why = {
        ("learn", "frozen"): "",
        ("learn", "workers"): ": whoever learns drives episodes one after the other",
        ("learn", "cluster"): ": whoever learns drives episodes one after the other",
        ("foxglove", "audit"): ": a guard has one decision logger",
        **{
            (watching, many): ": workers send no decisions"
            for watching in ("audit", "mcap", "foxglove")
            for many in ("workers", "cluster")
        },
    }
    for (one, other), reason in why.items():
        if one in given and other in given:
            raise ValueError(f"--{one} and --{other} exclude each other{reason}")


# -- Driving --------------------------------------------------------------------------------------


def _drive_in_turn(
    results: Results,
    episodes: int,
    audit: Path | None,
    mcap: Path | None,
    foxglove: int | None,
) -> Driving:
    from evofsm.cli.driving import drive_in_turn
    from evofsm.driving import learners_of
    from evofsm.driving.sumo import open_world
    from evofsm.guard import AuditLog

    setup = results.setup
    with (
        AuditLog(audit) if audit else nullcontext() as log,
        open_world(setup.world) as place,
        _recording(setup, episodes, mcap) as run,
        _live(foxglove) as live,
        _shown(episodes) as move,
    ):
        record = None if run is None else run.add
        driving = drive_in_turn(results, episodes, place, move, log or live, record)
        if run is not None:
            run.attach(learners_of(driving.guard)[0].model(**setup.family.labels._asdict()))
    if log is not None:
        warn(f"head of {audit}, to be kept elsewhere: {log.head}")
    return driving


def _drive_at_once(
    results: Results, episodes: int, workers: int | None, cluster: str | None
) -> Driving:
    from evofsm.cli.driving import drive_at_once

    count = workers or (1 if cluster else os.cpu_count() or 1)
    with _shown(episodes) as move:
        return drive_at_once(results, episodes, count, cluster, move)


@contextmanager
def _shown(episodes: int) -> Iterator[Any]:
    """A bar that shows the collisions so far."""
    with progress("Driving", episodes) as move:

        def moved(done: int, collisions: int) -> None:
            rate = f" ({collisions} collisions, {collisions / done:.1%})" if done else ""
            move(done, text=f"Driving{rate}")

        yield moved


def _recording(
    setup: Setup, episodes: int, mcap: Path | None
) -> AbstractContextManager[RunWriter | None]:
    """A log of the run, where one is asked for."""
    if mcap is None:
        return nullcontext()
    from evofsm.io.foxglove import recording

    told = setup.settings | {"family": setup.family.name, "first": setup.first}
    return recording(mcap, told | {"episodes": episodes})


@contextmanager
def _live(port: int | None) -> Iterator[FoxgloveSink | None]:
    """A view in Foxglove, where one is asked for, once somebody looks on."""
    if port is None:
        yield None
        return
    from evofsm.io.foxglove import FOXGLOVE_LAYOUT, FoxgloveSink

    with FoxgloveSink(port, speed=1.0) as sink:
        told = f"open {sink.address} in Foxglove or Lichtblick (Ctrl-C ends it)"
        warn(f"{told}; a layout to import: {FOXGLOVE_LAYOUT}")
        while not sink.await_someone(1.0):  # as Ctrl-C would not end a wait without an end
            pass
        yield sink


# -- What came of it ------------------------------------------------------------------------------


def _summary(driving: Driving, setup: Setup) -> Iterator[tuple[str, str]]:
    """Collisions and their price, and what was learnt."""
    from evofsm.driving.cars import TOLD

    row = driving.row
    kind = "training" if setup.learn else "held-out"
    yield "family", f"{row.family}, {row.episodes:,} {kind} episodes"
    yield "controller", setup.controller
    yield "reviser", f"{setup.reviser}, {setup.mode.value}"
    yield "judge", f"{setup.judge}, given {TOLD[setup.judge]}"
    interval = f"(95 %: {row.collision_low:.1%} to {row.collision_high:.1%})"
    share = f"{row.collisions:,} of {row.episodes:,}: {row.collision_rate:.1%}"
    yield "collisions", f"{share} {interval}"
    yield "rate", str(row.failures)
    if row.rear_ends:
        yield "rear-ended", f"{row.rear_ends}"
    yield "mobility", f"{row.mobility:.2f} of the way that the controller makes by itself"
    changed = f"{row.intervention_rate:.1%} of decisions"
    yield "interventions", f"{changed}; mean change {row.mean_change:.2f} m/s²"
    yield "comfort", f"RMS jerk {row.jerk:.2f} m/s³"
    if times := driving.lead_times:
        warned = sum(time > 0.0 for time in times)
        text = f"{warned} of {len(times)} collisions had an alarm that stayed on"
        yield "lead time", f"{text}; median {median(times):.1f} s before"
    yield "learnt", _learnt(driving.guard)


def _learnt(guard: Guard) -> str:
    from evofsm.driving import LatentRisk, learners_of
    from evofsm.guard import LearntRisk

    machine, judge = learners_of(guard)
    states = f"{machine.n_states} states"
    if isinstance(judge, LearntRisk):
        return f"{states}; {judge.told_by_experience}"
    if not isinstance(judge, LatentRisk):
        return states
    brakes = judge.brakes
    own = f"{brakes.decel:.1f} m/s²" if brakes.known else "not known yet"
    return (
        f"{states}; {len(judge.manoeuvres)} manoeuvres of leaders, "
        f"1 % brake harder than {judge.manoeuvres.exceeded_by(0.01):.1f} m/s²; own brakes: {own}"
    )


def _states(driving: Driving) -> Iterator[RenderableType]:
    """The dead ends, or where no judge says which these are, the states in which it failed."""
    from evofsm.driving import LatentRisk, learners_of

    machine, judge = learners_of(driving.guard)
    is_kinematic = isinstance(judge, LatentRisk)
    count = len(driving.states)
    found = [one for one in driving.states if (one.is_dead_end if is_kinematic else one.failures)]
    if not found:
        yield (
            f"No dead ends among the {count} states."
            if is_kinematic
            else f"No episode ended in failure in any of the {count} states."
        )
        return
    found.sort(key=lambda one: -(one.seconds if is_kinematic else one.failures))
    place = ("state", "gap [m]", "follower [m/s]", "leader [m/s]")

    def cells(one: StateRisk, *others: str) -> Sequence[str]:
        center = machine.centers[one.state].tolist()
        return (f"#{one.state + 1}", *(f"{value:.1f}" for value in center), *others)

    if is_kinematic:
        title = f"Dead ends: {len(found)} of {count} states; seen longest"
        header: tuple[str, ...] = (
            "survives [m/s²]",
            "risk if braking",
            "escape margin",
            "seen [s]",
            "ended here",
        )
        rows = [
            cells(
                one,
                *(f"{one.critical:.1f}", f"{one.risk:.0%}", f"{one.margin:.0%}"),
                *(f"{one.seconds:.1f}", f"{one.failures:g}"),
            )
            for one in found[:_MOST]
        ]
        note = (
            "Dead end: if the leader braked hard now, braking in full would most likely be too "
            "late. Survives: the hardest braking of a leader that braking in full now still "
            "survives; escape margin: how much lower the risk then is than if speed is kept; ended "
            "here: collisions."
        )
    else:
        title = f"Collisions ended in {len(found)} of {count} states"
        header = ("seen [s]", "began here", "ended here")
        rows = [
            cells(one, f"{one.seconds:.1f}", f"{machine.onsets[one.state]:g}", f"{one.failures:g}")
            for one in found[:_MOST]
        ]
        note = (
            "Began here: disturbances, that is, what was not expected and went on for a while; "
            "ended here: collisions."
        )
    yield table(title, (*place, *header), rows)
    yield f"\n{note}"


# -- A SUMO configuration -------------------------------------------------------------------------


def _drive_configuration(
    file: Path,
    vehicles: str,
    mode: ModeName,
    tolerance: float,
    given: dict[str, Any],
    *,
    as_json: bool,
) -> None:
    """Run it to its end, and print what came of it."""
    require(libsumo="sumo")
    from evofsm.cli.sumocfg import drive_configuration

    if given:
        what = "is for families of scenarios, not for a configuration"
        raise ValueError(f"--{next(iter(given))} {what}")
    if mode not in (ModeName.ACT, ModeName.SHADOW):
        raise ValueError(f"--mode is {mode.value!r}; for a configuration it is act or shadow")
    by_ids = not (vehicles == "all" or vehicles.startswith("type:") or vehicles.endswith("%"))
    with progress("Driving") as move:

        def moved(time: float, collisions: int) -> None:
            if time == int(time):
                move(text=f"Driving ({time:,.0f} s, {collisions} collisions)")

        chosen = split_names(vehicles) if by_ids else vehicles
        came = drive_configuration(file, chosen, mode.value, tolerance, moved)
    if as_json:
        print_json(came)
    else:
        show(facts("What came of the simulation", list(_attached(came))))


def _attached(came: Attached) -> Iterator[tuple[str, str]]:
    """Collisions, speed, and what guarding did."""
    what = "held back" if came.mode == "act" else "would have held back"
    yield "simulation", f"{came.configuration}, {came.seconds:,.0f} s"
    yield "guarded", f"{came.guarded:,} cars ({came.vehicles}), {came.mode}"
    if not came.guarded:
        yield "note", f"no car was {came.vehicles}: is it the name of a type or car?"
    of_guarded = f"{came.of_guarded:,} by guarded cars, {came.into_guarded:,} by others into them"
    yield "collisions", f"{came.collisions:,}: {of_guarded}"
    yield "mean speed", f"{came.speed:.2f} m/s of guarded cars"
    share = came.revised / max(1, came.decisions)
    yield "guards", f"{what} {share:.1%} of {came.decisions:,} decisions"
    if came.guarded:
        yield "overhead", f"{came.microseconds:.0f} µs a decision"
