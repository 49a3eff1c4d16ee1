"""What was asked for before the study was run, as far as its rows can answer it."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from evofsm.cli import count, decimals, percent
from studies.old.asked import Asked, at_least, at_most
from studies.tasks.rows import LATE, Row
from studies.tasks.study import Tasks

#: So much has to be run before anything of it is judged.
SEEDS, TRAIN = 20, 200
# Failures of a learning seed, seeds without a late one, and return by then, by task.
_LEARNING, _CLEAN = 2, 0.95
RETURNS = {"acc": 545.0, "acc-5": 520.0}
# Share of crashes that is to be prevented, and of the mean speed that is to be kept; and the number
# of held-out episodes before which neither is judged.
CRASHES = {"highway-fast": (0.9, 0.85), "merge": (0.9, 0.85), "intersection": (0.7, 0.85)}
_HELD_OUT = 200


def claims(found: Tasks) -> Iterator[Asked]:
    """All that can be judged: nothing of a shortened run."""
    for task, least in RETURNS.items():
        rows = found.of(task)
        if not is_long(rows):
            continue
        worst = max(row.failed_while_learning for row in rows)
        what = f"{task}: unsafe episodes while learning, worst seed"
        yield at_most(what, worst, _LEARNING, count)
        clean = sum(row.failed_late == 0 for row in rows)
        needed = math.ceil(round(_CLEAN * len(rows), 6))
        yield Asked(
            f"{task}: seeds without an unsafe episode after episode {LATE}",
            f"≥ {needed} of {len(rows)}",
            count(clean),
            clean >= needed,
        )
        by_late = [row.score_by_late for row in rows if row.score_by_late is not None]
        what = f"{task}: return of training episodes {LATE - 9} to {LATE}, median seed"
        yield at_least(what, float(np.median(by_late)), least, decimals(0))
    for task, (fewer, speed) in CRASHES.items():
        for controller in dict.fromkeys(row.controller for row in found.of(task)):
            yield from _crashes(found, task, controller, fewer, speed)


def _crashes(
    found: Tasks, task: str, controller: str, fewer: float, speed: float
) -> Iterator[Asked]:
    """How many crashes fewer there are than without a guard, and at what speed."""
    rows = found.of(task, controller)
    alone = found.of(task, controller, "unrevised")
    if not alone or min(row.episodes for row in rows) < _HELD_OUT:
        return
    crashed = float(np.mean([row.failed / row.episodes for row in rows]))
    before = alone[0].failed / alone[0].episodes
    down = 1.0 - crashed / before if before else 0.0
    kept = float(np.mean([row.speed or 0.0 for row in rows])) / (alone[0].speed or 1.0)
    who = f"{task}, {controller}"
    yield at_least(f"{who}: crashes fewer", down, fewer, percent)
    yield at_least(f"{who}: speed kept", kept, speed, percent)


def is_long(rows: list[Row]) -> bool:
    """Whether rows are those of a run that is long enough."""
    return len(rows) >= SEEDS and all(row.trained >= TRAIN for row in rows)
