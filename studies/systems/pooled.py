"""Runs that stand together, as one: what the studies of judges and of tasks both tell of them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import lru_cache
from typing import Any

import numpy as np

from studies.old.scores import Share, share_of


def pooled(rows: Sequence[Any]) -> dict[str, Any]:
    """What is told of some runs of one judge, under the names that it has in a summary of them.

    Parameters
    ----------
    rows : sequence
        Rows of either study, `studies.systems.trial.Row` or that of tasks.
    """
    return {
        "runs": len(rows),
        "learning": max(row.failed_while_learning for row in rows),
        "late": max(row.failed_late for row in rows),
        "failed": _share(sum(row.failed for row in rows), sum(row.episodes for row in rows)),
        "worst": max(row.failed / row.episodes for row in rows),
        "score_worst": min(row.score for row in rows),
        "kept": middle(row.kept for row in rows),
        "change": middle(row.mean_change for row in rows),
        "p50": middle(row.p50_ms for row in rows),
        "p99": max(row.p99_ms for row in rows),
    }


def middle(values: Iterable[float]) -> float:
    """The median."""
    return float(np.median(list(values)))


@lru_cache(maxsize=4096)
def _share(held: int, tried: int) -> Share:
    return share_of([True] * held + [False] * (tried - held))
