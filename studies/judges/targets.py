"""What was asked for before the study was run, as far as its rows can answer it."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from evofsm.cli import count, decimals, percent
from studies.judges.study import Judges
from studies.old.asked import Asked, at_least, at_most
from studies.systems.trial import Row

_PENDULUMS = ("pendulum", "pendulum-cos")


def claims(found: Judges) -> Iterator[Asked]:
    """All that can be judged."""
    if rows := found.of("acc"):
        yield at_most("acc: failures while learning, worst seed", _learning(rows), 2, count)
        clean = sum(row.failed == 0 for row in rows) / len(rows)
        yield at_least("acc: seeds without a failure, held out", clean, 0.95, percent)
        yield at_least("acc: return, median seed", _median(rows, "score"), 545.0, decimals(0))
    for system, controller, kept in (
        ("cartpole", "random", 0.8),
        ("cartpole", "hasty", 0.55),
        ("cartpole-gusts", "random", 0.75),
        ("cartpole-gusts", "hasty", 0.55),
    ):
        if rows := found.of(system, controller):
            who = f"{system}, {controller}"
            total = sum(row.failed for row in rows) / sum(row.episodes for row in rows)
            yield at_most(f"{who}: failed, all seeds", total, 0.02, percent)
            yield at_most(f"{who}: failed, worst seed", _worst(rows), 0.04, percent)
            yield at_most(f"{who}: failures while learning", _learning(rows), 15, count)
            yield at_least(f"{who}: kept, median seed", _median(rows, "kept"), kept, percent)
    for system in _PENDULUMS:
        if rows := found.of(system):
            yield at_most(f"{system}: failed, worst run", _worst(rows), 0.05, percent)
    for family, middle, least in (("emergency", 0.91, 0.89), ("cut_in", 0.96, 0.0)):
        if rows := found.of(family):
            yield at_most(f"{family}: failed, worst seed", _worst(rows), 0.005, percent)
            mobility = _median(rows, "score")
            yield at_least(f"{family}: mobility, median seed", mobility, middle, decimals(3))
            if least:
                low = min(row.score for row in rows)
                yield at_least(f"{family}: mobility, worst seed", low, least, decimals(3))
    if rows := found.of("emergency"):
        what = "emergency: failures while learning, worst seed"
        yield at_most(what, _learning(rows), 6, count)
        late = max(row.failed_late for row in rows)
        yield at_most("emergency: those from episode 31 on", late, 1, count)
    if rows := found.of("emergency", without="memory"):
        total = sum(row.failed for row in rows) / sum(row.episodes for row in rows)
        yield at_least("emergency without memory: failed", total, 0.3, percent)


def _worst(rows: list[Row]) -> float:
    return max(row.failed / row.episodes for row in rows)


def _learning(rows: list[Row]) -> int:
    return max(row.failed_while_learning for row in rows)


def _median(rows: list[Row], name: str) -> float:
    return float(np.median([getattr(row, name) for row in rows]))
