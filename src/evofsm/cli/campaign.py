"""A campaign: thousands of held-out episodes of a family, driven by many processes.

Each one is a draw of its own, driven under the reviser with what was learnt before, beside the
controller left to itself; nothing is learnt on the way. So episodes do not depend on each other.
"""

from __future__ import annotations

import csv
import hashlib
import io
import json
import pickle
from collections.abc import Callable
from concurrent.futures import Executor
from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import cache, lru_cache, partial
from importlib.metadata import version
from pathlib import Path
from threading import Lock
from typing import Any

from evofsm.cli.driving import Setup, make_controller, make_guard
from evofsm.driving import Outcome, Row, Trial, World, open_world, summarise
from evofsm.fleet import Batch, run_campaign
from evofsm.fleet.checkpoint import versions
from evofsm.fleet.journal import Journal, Record, room_needed
from evofsm.guard import Guard, LearningJudge

#: The journal in the folder of a campaign.
JOURNAL = "journal.jsonl"
_EPISODES, _SUMMARY = "episodes.csv", "summary.json"


@dataclass(frozen=True)
class Campaign:
    """What is driven."""

    setup: Setup  #: which does not learn
    judge: LearningJudge  #: with what was learnt before
    world: str = "kinematic"

    def guard(self) -> Guard:
        """Who revises; no states decide."""
        return make_guard(self.setup, judge=self.judge)

    @property
    def settings(self) -> dict[str, Any]:
        """All that an episode depends on, for JSON; not how many there are."""
        return {
            **self.setup.told,
            "world": self.world,
            "learnt": _digest(self.judge),
            "versions": _versions(self.world),
        }


@dataclass(frozen=True)
class Result:
    """What came of it."""

    row: Row
    lead_times: tuple[float, ...]  #: as `evofsm.cli.driving.Driving` has them


def drive_campaign(
    campaign: Campaign,
    out: Path,
    open_executor: Callable[[], AbstractContextManager[Executor]],
    workers: int,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Result:
    """Drive what a folder does not hold yet, and write what came of all of it.

    Parameters
    ----------
    campaign : Campaign
    out : Path
        Folder of the journal, and of what is made of it at the end.
    open_executor, workers, progress
        As in `evofsm.fleet.campaign.run_campaign`.

    Raises
    ------
    ValueError
        If the folder holds a campaign of other settings.
    """
    setup = campaign.setup
    campaign.guard()  # if there is none of this name, it shows here and not in a worker
    with Journal(out / JOURNAL, campaign.settings) as journal:
        work = partial(drive_batch, pickle.dumps((campaign, _versions(campaign.world))))
        records = run_campaign(work, setup.episodes, journal, open_executor, workers, progress)
        outcomes = [Outcome(*(record[name] for name in Outcome._fields)) for record in records]
        row = summarise(setup.family.name, setup.reviser, "", outcomes, setup.family.interval)
        lead_times = (record["lead_time"] for record in records)
        result = Result(row, tuple(time for time in lead_times if time is not None))
        _write(result, records, out)
    return result


def _write(result: Result, records: list[Record], out: Path) -> None:
    """Write the episodes in turn, and the row they add up to."""
    path = out / _EPISODES
    with room_needed(path), open(path, "w", newline="", encoding="utf-8") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(["episode", *records[0]])
        table.writerows([k, *record.values()] for k, record in enumerate(records))
    summary = {**result.row.as_dict(), "lead_times": result.lead_times}
    with room_needed(out / _SUMMARY):
        (out / _SUMMARY).write_text(json.dumps(summary, indent=2), encoding="utf-8")


def _digest(judge: LearningJudge) -> str:
    """Of all that is asked: of what saving it writes."""
    file = io.BytesIO()
    judge.save(file)
    return hashlib.sha256(file.getvalue()).hexdigest()


def _versions(world: str) -> dict[str, str]:
    """Of everything that may change a digit."""
    return {**versions(), **({"libsumo": version("libsumo")} if world == "sumo" else {})}


# -- In a worker ----------------------------------------------------------------------------------

# Threads of a process share one world, and what was learnt.
_one_at_a_time = Lock()


def drive_batch(packed: bytes, batch: Batch) -> list[Record]:
    """Drive some episodes of a campaign.

    Parameters
    ----------
    packed : bytes
        The campaign, and the versions it is driven with, pickled once for all of its batches.
    batch : tuple of int

    Raises
    ------
    ValueError
        If other versions are installed here.
    """
    with _one_at_a_time:
        campaign, guard = _unpacked(packed)
        return [_drive(campaign, guard, episode) for episode in batch]


@lru_cache(maxsize=1)
def _unpacked(packed: bytes) -> tuple[Campaign, Guard]:
    campaign, versions = pickle.loads(packed)
    if (here := _versions(campaign.world)) != versions:
        raise ValueError(f"a worker has {here}, but the campaign needs {versions}")
    return campaign, campaign.guard()


@cache
def _world(name: str) -> World:
    """The world of this process, open for as long as it lives."""
    return open_world(name).__enter__()


def _drive(campaign: Campaign, guard: Guard, episode: int) -> Record:
    setup, world = campaign.setup, _world(campaign.world)
    trial = Trial(
        setup.family, guard, world, setup.seed, controller=partial(make_controller, setup)
    )
    return {name: value for name, value in trial(episode).items() if name != "episode"}
