"""A line of the study: what came of one judge, or policy, on one task with one learning seed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from studies.old.scores import bootstrap
from studies.systems.trial import Ended, counted, unrevised_failures
from studies.tasks.amounts import Amounts

#: Our judges: of variables, and of scenes.
OURS = ("learnt", "scene")
#: A failure after so many training episodes is a late one; after half of them, where they are few.
LATE = 50
# Of the training episodes up to then, those whose return is told.
_LATEST = 10


@dataclass(frozen=True)
class Row:
    """What came of one judge on one task with one learning seed."""

    task: str
    controller: str
    judge: str
    told: str  #: what the judge was told
    seed: int  #: learning seed
    trained: int  #: episodes that were learnt from
    failed_while_learning: int  #: of those
    late: int  #: episodes after which a failure is a late one
    failed_late: int
    failures: tuple[int, ...]  #: training episodes that failed, from 1
    score_by_late: float | None  #: mean over the ten training episodes up to `late`
    episodes: int  #: held out
    failed: int  #: of the held-out ones
    failed_low: float  #: 95 % interval of their share (Clopper and Pearson 1934)
    failed_high: float
    unrevised_failed: int  #: of the same episodes, the controller alone
    score: float  #: mean return of held-out episodes
    score_low: float  #: 95 % interval (bootstrap over episodes)
    score_high: float
    kept: float  #: share of proposals that were executed exactly
    mean_change: float  #: of an action, in halves of its range; of discrete ones the share changed
    p50_ms: float  #: of a held-out decision
    p99_ms: float
    speed: float | None  #: mean over held-out episodes [m/s]; None where nothing drives


def row(
    plan: Amounts,
    task: str,
    controller: str,
    judge: str,
    told: str,
    seed: int,
    learnt: Sequence[Ended],
    held_out: Sequence[Ended],
    unrevised_failed: int | None = None,
) -> Row:
    """One line of what is found.

    Parameters
    ----------
    plan : Amounts
    task, controller, judge, told, seed
        As in `Row`.
    learnt, held_out : sequence of Ended
        Episodes.
    unrevised_failed : int, optional
        Without it the task's controller is tried alone.
    """
    late = min(LATE, len(learnt) // 2)
    failures = tuple(place for place, one in enumerate(learnt, start=1) if one.failed)
    by_late = [one.score for one in learnt[max(0, late - _LATEST) : late]]
    scores = np.array([one.score for one in held_out])
    low, high = bootstrap(lambda chosen: float(scores[chosen].mean()), len(scores), plan.rounds)
    if unrevised_failed is None:
        unrevised_failed = unrevised_failures(task, controller, plan.test, plan.seed)
    return Row(
        task=task,
        controller=controller,
        judge=judge,
        told=told,
        seed=seed,
        trained=len(learnt),
        failed_while_learning=len(failures),
        late=late,
        failed_late=sum(place > late for place in failures),
        failures=failures,
        score_by_late=float(np.mean(by_late)) if by_late else None,
        unrevised_failed=unrevised_failed,
        score=float(scores.mean()),
        score_low=low,
        score_high=high,
        **counted(held_out),
    )
