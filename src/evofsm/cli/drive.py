"""`evofsm drive`."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import AbstractContextManager, closing, nullcontext
from dataclasses import asdict
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from evofsm.cli.options import (
    ByJudge,
    InWorld,
    Json,
    ModeName,
    Seed,
    Tolerance,
    argument,
    option,
    require,
    require_world,
)
from evofsm.cli.show import facts, print_json, progress, say, show, warn

if TYPE_CHECKING:
    from evofsm.cli.driving import Driving, Results, Setup
    from evofsm.guard import Guard


def drive(
    family: Annotated[
        str, argument("Scenarios (emergency, paper+noise, ...), your own file, or a .sumocfg.")
    ],
    episodes: Annotated[int, option("How many are driven.", min=1, max=2**32)] = 100,
    world: InWorld = "kinematic",
    reviser: Annotated[
        Literal["least-risk", "none"], option("The filter, or none.")
    ] = "least-risk",
    judge: ByJudge = "kinematic",
    mode: Annotated[ModeName, option("How far least-risk goes.")] = "act",
    tolerance: Tolerance = 0.02,
    seed: Seed = 0,
    frozen: Annotated[
        Path | None, option("Drive held-out draws with what this folder holds; learn nothing.")
    ] = None,
    workers: Annotated[
        int | None, option("Drive held-out draws in so many processes; learn nothing.", min=1)
    ] = None,
    out: Annotated[
        Path | None, option("Folder of what was learnt and driven; nothing is driven again.")
    ] = None,
    audit: Annotated[Path | None, option("Append to this log, for evofsm audit.")] = None,
    vehicles: Annotated[
        str, option("Of a SUMO configuration: all, a share, type:NAME, or ids with commas.")
    ] = "10%",
    mcap: Annotated[Path | None, option("Log every episode for Foxglove.")] = None,
    as_json: Json = False,
) -> int | None:
    """Drive scenarios under a safety filter, which learns on the way.

    A machine and its judge learn from every episode, from the first on, unless --frozen or
    --workers is given: then draws are held out, and thousands of episodes are driven on all cores.
    The summary compares with the controller left to itself in the same draws.

    With --out, the same command goes on where it was stopped, whatever stopped it, and comes to the
    same result; with more --episodes, it goes on to these.

    A SUMO configuration (my.sumocfg) is run as it is, once, with guards in the cars that --vehicles
    names; of all else only --mode (act or shadow), --tolerance and --json hold then.
    """
    options = {"frozen": frozen, "workers": workers, "out": out, "audit": audit, "mcap": mcap}
    options = {name: value for name, value in options.items() if value is not None}
    if family.endswith(".sumocfg"):
        if options:
            text = "is for families of scenarios, not for a configuration"
            raise ValueError(f"--{next(iter(options))} {text}")
        from evofsm.cli.sumocfg import run_configuration

        run_configuration(Path(family), vehicles, mode, tolerance, as_json=as_json)
        return None
    if workers is not None and (audit or mcap):
        raise ValueError("--audit and --mcap go with no --workers: workers send no decisions")
    require_world(world, **({"polars": "tables"} if out is not None and workers is None else {}))
    require(**({} if mcap is None else {"mcap": "mcap"}))
    from evofsm.cli.driving import GUARD, Results, Setup, drive_at_once, load_guard, make_guard
    from evofsm.driving import load_family
    from evofsm.guard import Mode

    before, digest = None, ""
    if frozen is not None:
        before, _ = load_guard(frozen)
        digest = sha256((frozen / GUARD).read_bytes()).hexdigest()
    learns = frozen is None and workers is None
    choices = load_family(family), reviser, judge, Mode(mode), tolerance, seed, world
    setup = Setup(*choices, learns, digest)
    with closing(Results(setup, make_guard(setup, before), out)) as results:
        if mcap is not None and results.rows:
            fault = f"{out} has {len(results.rows):,} episodes already; name another folder"
            raise ValueError(f"--mcap holds what one run drives, but {fault}")
        try:
            if workers is not None:
                with progress("Driving", episodes) as move:
                    summary = drive_at_once(results, episodes, workers, move)
            else:
                summary = _drive_in_turn(results, episodes, audit, mcap)
        except KeyboardInterrupt:
            if out is None:
                raise
            how_far = f"{len(results.rows):,} of {episodes:,} episodes"
            warn(f"stopped after {how_far}; the same command goes on from there")
            return 130
    if as_json:
        print_json(asdict(summary.row))
        return None
    show(facts("What came of driving", _summary(summary, setup)))
    if out is not None:
        say(f"What was learnt, and every episode: {out}")
    if mcap is not None:
        say(f"Every decision, for Foxglove: {mcap}")
    return None


# -- Driving --------------------------------------------------------------------------------------


def _drive_in_turn(
    results: Results, episodes: int, audit: Path | None, mcap: Path | None
) -> Driving:
    from evofsm.cli.driving import drive_in_turn

    with _log_of(audit, mcap) as log, progress("Driving", episodes) as move:
        summary = drive_in_turn(results, episodes, move, log)
    if audit is not None:
        warn(f"head of {audit}, to be kept elsewhere: {log.head}")
    return summary


def _log_of(audit: Path | None, mcap: Path | None) -> AbstractContextManager[Any]:
    """What records the decisions; None where nobody wants them."""
    if mcap is not None:
        from evofsm.io import FoxgloveSink

        return FoxgloveSink(None, mcap)
    from evofsm.guard import AuditLog

    return AuditLog(audit) if audit else nullcontext()


# -- What came of it ------------------------------------------------------------------------------


def _summary(driving: Driving, setup: Setup) -> Iterator[tuple[str, str]]:
    """Collisions and their price, and what was learnt."""
    from evofsm.driving.cars import TOLD

    row = driving.row
    kind = "training" if setup.learn else "held-out"
    yield "family", f"{row.family}, {row.episodes:,} {kind} episodes"
    yield "reviser", f"{setup.reviser}, {setup.mode.value}"
    yield "judge", f"{setup.judge}, given {TOLD[setup.judge]}"
    interval = f"(95 %: {row.collision_low:.1%} to {row.collision_high:.1%})"
    share = f"{row.collisions:,} of {row.episodes:,}: {row.collision_rate:.1%}"
    yield "collisions", f"{share} {interval}"
    yield "rate", str(row.failures)
    if row.rear_ends:
        yield "rear-ended", f"{row.rear_ends}"
    yield "mobility", f"{row.mobility:.2f} of the way that the controller makes by itself"
    interventions = f"{row.intervention_rate:.1%} of decisions"
    yield "interventions", f"{interventions}; mean change {row.mean_change:.2f} m/s²"
    yield "comfort", f"RMS jerk {row.jerk:.2f} m/s³"
    yield "learnt", _learnt(driving.guard)


def _learnt(guard: Guard) -> str:
    from evofsm.driving import LatentRisk, dead_ends_of, learners_of

    machine, judge = learners_of(guard)
    states = f"{machine.n_states} states"
    if isinstance(judge, LatentRisk):
        states += f", {len(dead_ends_of(machine, judge))} of them dead ends"
    experience = getattr(judge, "told_by_experience", "")
    return f"{states}; {experience}" if experience else states
