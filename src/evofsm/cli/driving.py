"""Drive a family of scenarios under a reviser, episode by episode, and learn on the way."""

from __future__ import annotations

import hashlib
import io
import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Self, get_type_hints

import numpy as np
from numpy.typing import NDArray

from evofsm import store
from evofsm.driving import (
    DECISION_COLUMNS,
    IDM,
    TOLD,
    AdaptiveCruise,
    Draw,
    EnvelopeReviser,
    Episode,
    Family,
    LatentRisk,
    Outcome,
    Row,
    StateRisk,
    Unrevised,
    World,
    assess_states,
    drive,
    guard_for_family,
    lead_time,
    learners_of,
    load_judge,
    name_judge,
    outcome_of,
    reference_of,
    save_learnt,
    summarise,
)
from evofsm.driving.measures import FIXED_MEASURES
from evofsm.extras import needs
from evofsm.fleet.checkpoint import Checkpoint, Kept
from evofsm.fsm import EvolvingFSM
from evofsm.guard import (
    TOLERANCE,
    Controller,
    DecisionLogger,
    Explain,
    Guard,
    LearningJudge,
    Mode,
    Reviser,
)

#: Controllers by name; ``family`` is the family's own.
CONTROLLERS = ("family", "aggressive", "normal", "acc", "sumo")
#: Judges by name; `evofsm.driving.TOLD` says what each was told.
JUDGES: tuple[str, ...] = tuple(TOLD)
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
    judge: str = "kinematic"
    mode: Mode = Mode.ACT
    tolerance: float = TOLERANCE
    episodes: int = 100
    seed: int = 0
    learn: bool = True
    first: int = 0  #: episodes driven before, which are not driven again

    @property
    def told(self) -> dict[str, Any]:
        """Who drives what and how, for JSON."""
        return {
            "family": {
                "name": self.family.name,
                "switches": self.family.switches,
                "file": self.family.source and Path(self.family.source).read_text("utf-8"),
            },
            "controller": self.controller,
            "reviser": self.reviser,
            "judge": self.judge,
            "mode": self.mode.value,
            "tolerance": self.tolerance,
            "seed": self.seed,
        }

    def settings(self, world: str, guard: Guard) -> dict[str, Any]:
        """All that an episode depends on, for JSON; not how many there are.

        Parameters
        ----------
        world : str
            Where is driven.
        guard : Guard
            With what was learnt before.
        """
        machine, risk = _files(guard)
        return {
            **self.told,
            "learn": self.learn,
            "first": self.first,
            "world": world,
            "learnt": hashlib.sha256(machine + risk).hexdigest(),
        }


@dataclass(frozen=True)
class Driving:
    """What came of it."""

    row: Row
    lead_times: tuple[float, ...]  #: from the last alarm that stayed on to the collision [s]
    states: list[StateRisk]
    guard: Guard  #: with what it learnt
    decisions: Mapping[str, Sequence[Any]]  #: columns of the table of all decisions


def drive_family(
    setup: Setup,
    guard: Guard,
    world: World,
    progress: Callable[[int, int], None] = lambda done, collisions: None,
    checkpoint: Checkpoint | None = None,
    audit: DecisionLogger | None = None,
    record: Callable[[Episode], None] | None = None,
) -> Driving:
    """Drive the episodes in turn.

    Parameters
    ----------
    setup : Setup
    guard : Guard
        Of `make_guard`.
    world : World
    progress : callable
        Told how many episodes are done, and how many ended in a collision.
    checkpoint : Checkpoint, optional
        Keeps, between two episodes, all that came of those before. Where its file exists, it is
        gone on from, with a guard that has learnt what was learnt until then. The result is the
        same, bit for bit; there may be more episodes than before.
    audit : DecisionLogger, optional
        Writes down what is decided; also in episodes that are driven again after a stop.
    record : callable, optional
        Given each episode that is driven here, none of those before a stop; every decision is then
        explained.

    Raises
    ------
    ValueError
        If the checkpoint is of other work, or of more episodes.
    """
    family = setup.family
    done, guard = Driven.resumed(setup, guard, checkpoint)
    guard.audit, guard.explaining = audit, None if record is None else Explain.ALL
    for draw in draws(setup, len(done.outcomes)):
        controller = make_controller(setup, draw, world)
        alone = reference_of(family, draw, world, controller)
        driven = drive(guard, draw, world, controller)
        if record is not None:
            record(driven)
        done.add(driven, outcome_of(driven, alone, family.interval), setup.tolerance)
        if checkpoint is not None:
            checkpoint.offer(partial(done.keep, guard))
        progress(len(done.outcomes), sum(o.collided for o in done.outcomes))
    if checkpoint is not None:
        checkpoint.keep(done.keep(guard, finished=True))
    return Driving(
        summarise(family.name, setup.reviser, "", done.outcomes, family.interval),
        tuple(done.lead_times),
        _assessed(guard),
        guard,
        done.decisions,
    )


def _assessed(guard: Guard) -> list[StateRisk]:
    """The states; how dangerous each is by itself is known to a judge of leaders alone."""
    machine, judge = learners_of(guard)
    if isinstance(judge, LatentRisk):
        return assess_states(machine, judge)
    nan, seconds = math.nan, machine.visits * judge.dt
    return [
        StateRisk(state, nan, nan, nan, float(seen), float(failures))
        for state, (seen, failures) in enumerate(zip(seconds, machine.endings, strict=True))
    ]


def draws(setup: Setup, done: int = 0) -> Iterator[Draw]:
    """What is driven: training draws while learning, held-out ones else; but those done."""
    split = "train" if setup.learn else "test"
    for index in range(setup.first + done, setup.first + setup.episodes):
        yield setup.family.draw(setup.seed, index, split=split)


def make_guard(
    setup: Setup, machine: EvolvingFSM | None = None, judge: LearningJudge | None = None
) -> Guard:
    """A guard whose reviser and judge have the setup's names, with what was learnt before.

    Raises
    ------
    ValueError
        If there is no such reviser or judge, or what was learnt is of another judge.
    """
    family, name = setup.family, _ALIASES.get(setup.reviser, setup.reviser)
    if judge is not None and (found := name_judge(judge)) != setup.judge:
        raise ValueError(f"what was learnt is of the judge {found!r}, not of {setup.judge!r}")
    ours = guard_for_family(
        family,
        tolerance=setup.tolerance,
        mode=setup.mode,
        machine=machine,
        judge=judge or setup.judge,
        seed=setup.seed,
        learn=setup.learn,
    )
    if name == "least-risk":
        return ours
    if name not in ("none", *FIXED_MEASURES):
        raise ValueError(f"there is no reviser {name!r}; there are {', '.join(REVISERS)}")
    reviser: Reviser = Unrevised(family.actions)
    if name != "none":
        if setup.mode is not Mode.ACT:
            raise ValueError(f"reviser {setup.reviser!r} can only act; modes are for least-risk")
        reviser = EnvelopeReviser(FIXED_MEASURES[name], family.actions, family.interval)
    return Guard.of(
        reviser,
        interval=family.interval,
        machine=ours.machine,
        judge=ours.judge,
        learn=setup.learn,
    )


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
    from evofsm.driving import SumoDriver, SumoWorld

    if not isinstance(world, SumoWorld):
        raise ValueError("the controller 'sumo' is SUMO's own; it needs the world 'sumo'")
    return SumoDriver(world)


def write_driving(driving: Driving, setup: Setup, out: Path) -> None:
    """Write what was learnt, every decision as a table, and the summary; each whole or not at all.

    Raises
    ------
    OSError
        If one of them cannot be written; those before it are, and it is as it was.
    """
    with needs("polars", "tables", "writing decisions as Parquet"):
        import polars
    drove = {"family": setup.family.name, "seed": setup.seed, "first": setup.first}
    told = {**drove, "episodes": setup.episodes, "reviser": setup.reviser}
    save_learnt(driving.guard, out, told)
    with store.replacing(out / "decisions.parquet") as file:
        polars.DataFrame(driving.decisions).write_parquet(file)
    summary = {
        **driving.row.as_dict(),
        "lead_times": driving.lead_times,
        "episodes_learnt": setup.first + setup.episodes * setup.learn,
    }
    with store.replacing(out / _SUMMARY) as file:
        file.write(json.dumps(summary, indent=2).encode())


def episodes_learnt(folder: Path) -> int:
    """How many episodes what was saved in a folder has learnt from."""
    return int(json.loads((folder / _SUMMARY).read_text("utf-8"))["episodes_learnt"])


# -- What has been driven so far ------------------------------------------------------------------

#: The columns of ``decisions.parquet``; `driving/record.py` says which they are.
DECISION_TABLE = (
    "episode",
    *(name for name, column in DECISION_COLUMNS.items() if column.in_table),
)
# Where there is no state.
_NONE = -1


class Driven:
    """Outcomes of the episodes so far, and the columns of the table of their decisions."""

    def __init__(self) -> None:
        self.outcomes: list[Outcome] = []
        self.lead_times: list[float] = []
        self.decisions: dict[str, list[Any]] = {name: [] for name in DECISION_TABLE}

    def add(self, drive: Episode, came_of_it: Outcome, tolerance: float) -> None:
        """Take in the next episode."""
        self.decisions["episode"] += [len(self.outcomes)] * len(drive.decisions)
        for name in DECISION_TABLE[1:]:
            self.decisions[name] += map(DECISION_COLUMNS[name].read, drive.decisions)
        self.outcomes.append(came_of_it)
        lead = lead_time(drive, tolerance)
        if lead is not None:
            self.lead_times.append(lead)

    @classmethod
    def resumed(
        cls, setup: Setup, guard: Guard, checkpoint: Checkpoint | None
    ) -> tuple[Self, Guard]:
        """What was driven before, if anything was, and the guard as it was after it."""
        done = cls()
        if checkpoint is None:
            return done, guard
        kept = checkpoint.begin(done.keep(guard))
        with store.explained(checkpoint.path):
            done._restore(kept.arrays)
            files = (io.BytesIO(kept.arrays[name].tobytes()) for name in ("machine", "risk"))
            machine = EvolvingFSM.load(next(files))
            guard = make_guard(setup, machine, load_judge(next(files)))
        if len(done.outcomes) > setup.episodes:
            raise ValueError(
                f"{checkpoint.path} has driven {len(done.outcomes)} episodes, more than "
                f"{setup.episodes}"
            )
        return done, guard

    def keep(self, guard: Guard, finished: bool = False) -> Kept:
        """All of it and what was learnt, for a checkpoint."""
        machine, risk = _files(guard)
        columns = {
            f"decided_{name}": _column(name, self.decisions[name]) for name in DECISION_TABLE
        }
        return Kept(
            {"episodes": len(self.outcomes)},
            {
                "machine": np.frombuffer(machine, np.uint8),
                "risk": np.frombuffer(risk, np.uint8),
                "outcomes": np.array(self.outcomes, np.float64).reshape(-1, len(Outcome._fields)),
                "lead_times": np.array(self.lead_times, np.float64),
                **columns,
            },
            finished,
        )

    def _restore(self, arrays: Mapping[str, NDArray[Any]]) -> None:
        kinds = get_type_hints(Outcome).values()
        for row in arrays["outcomes"].tolist():
            self.outcomes.append(Outcome(*(kind(v) for kind, v in zip(kinds, row, strict=True))))
        self.lead_times = arrays["lead_times"].tolist()
        for name in DECISION_TABLE:
            self.decisions[name] = _values(name, arrays[f"decided_{name}"])
        if len({len(column) for column in self.decisions.values()}) != 1:
            raise ValueError("columns of decisions are of different lengths")


def _kind(name: str) -> type:
    return int if name == "episode" else DECISION_COLUMNS[name].kind


def _column(name: str, values: Sequence[Any]) -> NDArray[Any]:
    """A column of decisions as an array; texts as JSON."""
    if _kind(name) is str:
        return np.frombuffer(json.dumps(values).encode(), np.uint8)
    if _kind(name) is int:
        return np.array([_NONE if value is None else value for value in values], np.int64)
    return np.array(values, np.float64)


def _values(name: str, column: NDArray[Any]) -> list[Any]:
    """The column that `_column` made an array of."""
    if _kind(name) is str:
        return [str(text) for text in json.loads(column.tobytes())]
    values: list[Any] = column.tolist()
    return values if _kind(name) is float else [None if one == _NONE else one for one in values]


def _files(guard: Guard) -> tuple[bytes, bytes]:
    """The files of its machine and of its judge."""
    files = io.BytesIO(), io.BytesIO()
    machine, judge = learners_of(guard)
    machine.save(files[0])
    judge.save(files[1])
    return files[0].getvalue(), files[1].getvalue()
