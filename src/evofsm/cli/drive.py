"""`evofsm paper` and `evofsm drive`."""

from __future__ import annotations

import shlex
import sys
from contextlib import closing
from dataclasses import asdict
from hashlib import sha256
from pathlib import Path
from typing import Annotated, Literal

from typer import Context

from evofsm.cli import options
from evofsm.cli.options import argument, option

# What stands in the beginning of each file of a reproduction.
_MARKS = {
    "index.html": "<title>Does the paper&#39;s machine do what the paper says? – evofsm</title>",
    "claims.json": '"id": "collisions_by_case"',
    "model.evofsm": "evofsm paper",
}


def paper(
    world: options.InWorld = "sumo",
    rounds: Annotated[int, option("How often the four cases are driven.", min=1)] = 20,
    out: Annotated[Path, option("Folder for the page and the model.")] = Path("evofsm-paper"),
    as_json: options.Json = False,
) -> int:
    """Reproduce the paper: drive its 80 runs, and hold every claim against them.

    Ends with 0 if all claims hold, with 1 if any does not.
    """
    options.require_world(world, polars="tables", matplotlib="plot", jinja2="plot")
    out.mkdir(parents=True, exist_ok=True)  # where that fails nothing is driven first
    options.refuse_foreign({out / name: mark for name, mark in _MARKS.items()})
    from evofsm.cli.show import print_json, print_page, progress
    from evofsm.driving.sumo import open_world
    from evofsm.paper import Settings, check_claims, run_paper
    from evofsm.paper.reproduction import page_of, write

    with progress(f"Driving and learning ({world})") as move:
        study = run_paper(open_world(world), world, Settings.load(), rounds, move)
    command, claims = shlex.join(["evofsm", *sys.argv[1:]]), check_claims(study)
    page = write(study, out, command)
    if as_json:
        print_json([claim._asdict() for claim in claims])
    else:
        print_page(page_of(study, command))
        print(f"\nPage with all figures: {page}")
    return 0 if all(claim.holds for claim in claims) else 1


def drive(
    ctx: Context,
    family: Annotated[
        str, argument("Scenarios (emergency, paper+noise, ...), your own file, or a .sumocfg.")
    ],
    episodes: Annotated[int, option("How many are driven.", min=1, max=2**32)] = 100,
    world: options.InWorld = "kinematic",
    reviser: Annotated[
        Literal["least-risk", "none"], option("The filter, or none.")
    ] = "least-risk",
    judge: options.ByJudge = "kinematic",
    mode: Annotated[options.ModeName, option("How far least-risk goes.")] = "act",
    tolerance: options.Tolerance = options.TOLERANCE,
    seed: options.Seed = 0,
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
    as_json: options.Json = False,
) -> int | None:
    """Drive scenarios under a safety filter, which learns on the way.

    A machine and its judge learn from every episode, from the first on, unless --frozen or
    --workers is given: then draws are held out, and thousands of episodes are driven on all cores.
    The summary compares with the controller left to itself in the same draws.

    With --out, the same command goes on where it was stopped, whatever stopped it, and comes to the
    same result; with more --episodes, it goes on to these.

    A SUMO configuration (my.sumocfg) is run as it is, with guards in the cars that --vehicles names
    and, to act, alone before; of all else only --mode (act or shadow), --tolerance and --json hold.
    What the one alone writes is called alone.NAME. Two cars that touch again within 5 s have one
    collision; stops and parking are no time lost.
    """
    from evofsm.cli import driving
    from evofsm.cli.show import facts, print_json, progress, say, show, warn

    if family.endswith(options.SUMO):
        common = {"family", "vehicles", "mode", "tolerance", "as_json"}
        options.refuse_typed(ctx, sorted(ctx.params.keys() - common), "families of scenarios")
        driving.run_configuration(Path(family), vehicles, mode, tolerance, as_json=as_json)
        return None
    options.refuse_typed(ctx, ["vehicles"], "a configuration of SUMO")
    options.refuse_typed(ctx, ["mode", "tolerance"] * (reviser == "none"), "--reviser least-risk")
    if workers is not None and (audit or mcap):
        raise ValueError("--audit and --mcap go with no --workers: workers send no decisions")
    if workers is not None and frozen is None and reviser != "none":
        warn("warning: --workers learn nothing: --frozen FOLDER drives with what was learnt there")
    extras = {"polars": "tables"} if out is not None and workers is None else {}
    options.require_world(world, **extras, **({"mcap": "mcap"} if mcap else {}))
    from evofsm.driving import load_family
    from evofsm.guard import Mode

    before, digest = None, ""
    if frozen is not None:
        before, _ = driving.load_guard(frozen)
        digest = sha256((frozen / driving.GUARD).read_bytes()).hexdigest()
    choices = load_family(family), reviser, judge, Mode(mode), tolerance, seed, world
    setup = driving.Setup(*choices, frozen is None and workers is None, digest)
    guard = driving.make_guard(setup, before)
    with closing(driving.Results(setup, guard, out)) as results:
        if mcap is not None and results.rows:
            fault = f"{out} has {len(results.rows):,} episodes already; name another folder"
            raise ValueError(f"--mcap holds what one run drives, but {fault}")
        try:
            if workers is not None:
                with progress("Driving", episodes) as move:
                    summary = driving.drive_at_once(results, episodes, workers, move)
            else:
                with driving.log_of(audit, mcap) as log, progress("Driving", episodes) as move:
                    summary = driving.drive_in_turn(results, episodes, move, log)
                if audit is not None:
                    warn(f"head of {audit}, to be kept elsewhere: {log.head}")
        except KeyboardInterrupt:
            if out is None:
                raise
            how_far = f"{len(results.rows):,} of {episodes:,} episodes"
            warn(f"stopped after {how_far}; the same command goes on from there")
            return 130
    if as_json:
        print_json(asdict(summary))
        return None
    show(facts("What came of driving", driving.told_of(summary, results)))
    if out is not None:
        say(f"What was learnt, and every episode: {out}")
    if mcap is not None:
        say(f"Every decision, for Foxglove: {mcap}")
    return None
