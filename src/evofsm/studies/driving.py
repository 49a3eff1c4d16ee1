"""Drive a family of scenarios under a reviser, episode by episode, and learn on the way."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from evofsm._extras import needs
from evofsm.drivers.acc import AdaptiveCruise
from evofsm.drivers.idm import IDM
from evofsm.framework.loop import Drive
from evofsm.framework.reviser import EnvelopeReviser, Mode, Unrevised
from evofsm.protocols import Controller, Reviser
from evofsm.risk.by_state import StateRisk, assess_states
from evofsm.studies.closed_loop import (
    FIXED_MEASURES,
    Learner,
    Outcome,
    Reference,
    Row,
    outcome,
    reference,
    summarise,
)
from evofsm.studies.closed_loop.learner import drive_alone
from evofsm.worlds.families import Draw, Family
from evofsm.worlds.road import VARIABLES, World

#: Controllers by name; ``family`` is the family's own.
CONTROLLERS = ("family", "aggressive", "normal", "acc", "sumo")
#: Revisers by name: none, ours, and the classic measures.
REVISERS = ("least-risk", "none", "rss", "aeb", *FIXED_MEASURES)

_SUMMARY = "summary.json"
_ALIASES = {"rss": "rss-r157", "aeb": "aeb-ttc"}


@dataclass(frozen=True)
class Setup:
    """What is asked for."""

    family: Family
    controller: str = "family"
    reviser: str = "least-risk"
    mode: Mode = Mode.ACT
    tolerance: float = 0.02
    episodes: int = 100
    seed: int = 0
    learn: bool = True
    first: int = 0  #: episodes driven before, which are not driven again


@dataclass(frozen=True)
class Driving:
    """What came of it."""

    row: Row
    lead_times: tuple[float, ...]  #: from the last alarm that stayed on to the collision [s]
    states: list[StateRisk]
    drives: list[Drive]


def drive_family(
    setup: Setup,
    learner: Learner,
    world: World,
    progress: Callable[[int, int], None] = lambda done, collisions: None,
) -> Driving:
    """Drive the episodes in turn.

    Parameters
    ----------
    setup : Setup
    learner : Learner
        Learns if ``setup.learn``.
    world : World
    progress : callable
        Told how many episodes are done, and how many ended in a collision.
    """
    family = setup.family
    reviser = make_reviser(setup, learner)
    drives: list[Drive] = []
    outcomes: list[Outcome] = []
    for draw in draws(setup):
        controller = make_controller(setup, draw, world)
        unrevised = drive_unrevised(family, draw, world, controller)
        drive = learner.drive(
            family, draw, reviser, learn=setup.learn, world=world, controller=controller
        )
        outcomes.append(outcome(drive, unrevised, family.interval))
        drives.append(drive)
        progress(len(drives), sum(o.collided for o in outcomes))
    collided = [drive for drive in drives if drive.episode.collided]
    return Driving(
        summarise(family.name, setup.reviser, "", outcomes, family.interval),
        tuple(lead_time(drive, setup.tolerance) for drive in collided if is_judged(drive)),
        assess_states(learner.machine.model(), learner.risk),
        drives,
    )


def drive_unrevised(family: Family, draw: Draw, world: World, controller: Controller) -> Reference:
    """How far the controller comes by itself."""
    alone = drive_alone(family, draw, Unrevised(family.actions), None, world, controller)
    return reference(alone, draw.scenario.leader.brake_decel)


def draws(setup: Setup) -> Iterator[Draw]:
    """What is driven: training draws while learning, held-out ones else."""
    split = "train" if setup.learn else "test"
    for index in range(setup.first, setup.first + setup.episodes):
        yield setup.family.draw(setup.seed, index, split=split)


def make_reviser(setup: Setup, learner: Learner) -> Reviser:
    """A reviser by its name."""
    family = setup.family
    if setup.reviser == "least-risk":
        return learner.reviser(family, setup.tolerance, setup.mode)
    if setup.reviser == "none":
        return Unrevised(family.actions)
    if setup.mode is not Mode.ACT:
        raise ValueError(f"reviser {setup.reviser!r} can only act; modes are for least-risk")
    name = _ALIASES.get(setup.reviser, setup.reviser)
    if name not in FIXED_MEASURES:
        raise ValueError(f"there is no reviser {name!r}; there are {', '.join(REVISERS)}")
    return EnvelopeReviser(FIXED_MEASURES[name], family.actions, family.interval)


def make_controller(setup: Setup, draw: Draw, world: World) -> Controller:
    """A controller by its name, within the family's range of actions."""
    low, high = setup.family.actions.low, setup.family.actions.high
    match setup.controller:
        case "family":
            return draw.controller
        case "aggressive":
            return IDM(2.25, 28.0, 0.8, 0.3, 2.0, lowest=low, highest=high)
        case "normal":
            return IDM(1.25, 25.0, 2.0, 1.5, 2.0, lowest=low, highest=high)
        case "acc":
            return AdaptiveCruise(25.0, 2.0, 1.1, lowest=low, highest=high)
        case "sumo":
            return _sumo_driver(world)
    raise ValueError(
        f"there is no controller {setup.controller!r}; there are {', '.join(CONTROLLERS)}"
    )


def _sumo_driver(world: World) -> Controller:
    from evofsm.worlds.sumo import SumoWorld
    from evofsm.worlds.sumo_driver import SumoDriver

    if not isinstance(world, SumoWorld):
        raise ValueError("the controller 'sumo' is SUMO's own; it needs the world 'sumo'")
    return SumoDriver(world)


def write_driving(driving: Driving, learner: Learner, setup: Setup, out: Path) -> None:
    """Write what was learnt, the summary, and every decision as a table."""
    learner.save(out)
    summary = {
        **driving.row.as_dict(),
        "lead_times": driving.lead_times,
        "episodes_learnt": setup.first + setup.episodes * setup.learn,
    }
    (out / _SUMMARY).write_text(json.dumps(summary, indent=2), encoding="utf-8")
    with needs("polars", "tables", "writing decisions as Parquet"):
        import polars
    polars.DataFrame(_decision_columns(driving.drives)).write_parquet(out / "decisions.parquet")


def episodes_learnt(folder: Path) -> int:
    """How many episodes what was saved in a folder has learnt from."""
    return int(json.loads((folder / _SUMMARY).read_text("utf-8"))["episodes_learnt"])


def _decision_columns(drives: Sequence[Drive]) -> dict[str, Any]:
    """A row for each decision, episodes one after another."""
    decisions = [
        (episode, *decision) for episode, drive in enumerate(drives) for decision in drive.decisions
    ]
    seen = np.array([situation.observation for _, situation, _, _ in decisions])
    return {
        "episode": [episode for episode, _, _, _ in decisions],
        "time": [situation.time for _, situation, _, _ in decisions],
        **{name: seen[:, column] for column, name in enumerate(VARIABLES)},
        "state": [situation.state for _, situation, _, _ in decisions],
        "surprise": [situation.surprise for _, situation, _, _ in decisions],
        **{
            name: [getattr(revision, name) for _, _, revision, _ in decisions]
            for name in (
                "proposed",
                "executed",
                "advised",
                "risk_proposed",
                "risk_executed",
                "seen",
            )
        },
        "realised": [realised for _, _, _, realised in decisions],
        "reason": [revision.reason for _, _, revision, _ in decisions],
    }


def is_judged(drive: Drive) -> bool:
    """Whether the reviser says how likely failure is."""
    return not math.isnan(drive.decisions[0].revision.risk_proposed)


def lead_time(drive: Drive, tolerance: float) -> float:
    """From the alarm that stays on to the end of the run [s]; 0 without one."""
    alarm = math.nan
    for decision in drive.decisions:
        if decision.revision.risk_proposed > tolerance:
            alarm = decision.situation.time if math.isnan(alarm) else alarm
        else:
            alarm = math.nan
    return 0.0 if math.isnan(alarm) else float(drive.episode.time[-1] - alarm)
