"""What was asked for before the study was run, as far as its rows can answer it."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from evofsm.app import count, number
from evofsm.evidence.report.asked import Asked
from evofsm.evidence.tasks.rows import LATE, Row
from evofsm.evidence.tasks.study import Tasks

#: So much has to be run before anything of it is judged.
SEEDS, TRAIN = 20, 200
# Failures of a learning seed, seeds without a late one, and return by then, by task.
_LEARNING, _CLEAN = 2, 0.95
RETURNS = {"acc": 545.0, "acc-5": 520.0}


def claims(found: Tasks) -> Iterator[Asked]:
    """All that can be judged: nothing of a shortened run."""
    for task, least in RETURNS.items():
        rows = found.of(task)
        if not is_long(rows):
            continue
        worst = max(row.failed_while_learning for row in rows)
        yield Asked(
            f"{task}: unsafe episodes while learning, worst seed",
            f"≤ {_LEARNING}",
            count(worst),
            worst <= _LEARNING,
        )
        clean = sum(row.failed_late == 0 for row in rows)
        yield Asked(
            f"{task}: seeds without an unsafe episode after episode {LATE}",
            f"≥ {_CLEAN * len(rows):.0f} of {len(rows)}",
            count(clean),
            clean >= _CLEAN * len(rows),
        )
        by_late = [row.score_by_late for row in rows if row.score_by_late is not None]
        middle = float(np.median(by_late))
        yield Asked(
            f"{task}: return of training episodes {LATE - 9} to {LATE}, median seed",
            f"≥ {least:.0f}",
            number(middle, 0),
            middle >= least,
        )


def is_long(rows: list[Row]) -> bool:
    """Whether rows are those of a run that is long enough."""
    return len(rows) >= SEEDS and all(row.trained >= TRAIN for row in rows)
