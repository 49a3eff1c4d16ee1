"""Rows of several learning seeds as one, and what a judge's return is worth beside the others'."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

from studies.old.scores import Share
from studies.systems.pooled import middle, pooled
from studies.tasks.rows import Row
from studies.tasks.study import Tasks


class Summary(NamedTuple):
    """All learning seeds of one judge on one task with one controller."""

    task: str
    controller: str
    judge: str
    told: str
    runs: int
    trained: int
    learning: int  #: failures while learning in the worst run
    late: int  #: late ones, in the worst run
    failed: Share  #: held-out episodes of all runs, which share their draws
    worst: float  #: share that failed in the worst run
    score: float  #: of the run in the middle, with its 95 % interval
    score_low: float
    score_high: float
    score_worst: float  #: of the worst run
    of_told: float | None  #: `score` as a share of the best of those told more; None if not above 0
    kept: float  #: median over runs
    change: float  #: median over runs
    p50: float  #: median over runs [ms]
    p99: float  #: of the worst run [ms]
    speed: float | None  #: median over runs [m/s]; None where nothing drives

    @property
    def who(self) -> str:
        """The task and its controller."""
        return f"{self.task}, {self.controller}"

    @property
    def learns(self) -> bool:
        """Whether it was trained."""
        return self.trained > 0


def summary(rows: Sequence[Row], best_told: float | None = None) -> Summary:
    """Rows of one judge on one task with one controller as one.

    Parameters
    ----------
    rows : sequence of Row
    best_told : float, optional
        Return that `Summary.of_told` is a share of.
    """
    first = rows[0]
    speeds = [row.speed for row in rows if row.speed is not None]
    central = sorted(rows, key=lambda row: row.score)[(len(rows) - 1) // 2]
    score = central.score
    return Summary(
        task=first.task,
        controller=first.controller,
        judge=first.judge,
        told=first.told,
        trained=first.trained,
        score=score,
        score_low=central.score_low,
        score_high=central.score_high,
        of_told=score / best_told if best_told and min(best_told, score) > 0.0 else None,
        speed=middle(speeds) if speeds else None,
        **pooled(rows),
    )


def summaries(found: Tasks) -> Iterator[Summary]:
    """Every judge on every task with every controller."""
    for task, controller in found.groups:
        rivals = [one for one in rivals_of(found, task, controller) if not one.failed.held]
        best = max((one.score for one in rivals), default=None)
        for judge in found.judges(task, controller):
            yield summary(found.of(task, controller, judge), best)


def rivals_of(found: Tasks, task: str, controller: str) -> list[Summary]:
    """Those that are told more than failures."""
    every = [summary(found.of(task, controller, j)) for j in found.judges(task, controller)]
    return [one for one in every if not one.told.startswith("nothing")]


def policies(found: Tasks) -> Iterator[Summary]:
    """Policies that were trained, with the filter off and on."""
    for name in dict.fromkeys((row.controller, row.judge) for row in found.policies):
        yield summary([row for row in found.policies if (row.controller, row.judge) == name])


def own_share(found: Tasks, training: str) -> float | None:
    """Of the episodes that are survived with the filter on, the share without; None without one."""
    survived = {
        one.judge: 1.0 - one.failed.value for one in policies(found) if one.controller == training
    }
    if "filter on" not in survived:
        return None
    return survived["filter off"] / survived["filter on"] if survived["filter on"] else None
