"""How well measures tell dead ends from the rest: the area under the ROC curve.

The truth is the oracle's, which knows both cars' limits: leader and follower brake as hard as they
can from now on, and still collide. Every decision of unrevised held-out runs is a case.
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from evofsm.driving import (
    FIXED_MEASURES,
    Family,
    Group,
    ResponsibilitySensitiveSafety,
    drive,
    guard_for_family,
    held_out,
    is_dead_end,
    learnt_by,
    teach,
    training,
    unrevised,
)
from evofsm.evidence.scores import auroc, bootstrap
from evofsm.guard import Mode, RiskMeasure


class Separation(NamedTuple):
    """One measure."""

    family: str
    measure: str
    group: str
    auroc: float
    low: float  #: 95 % interval (bootstrap over episodes)
    high: float
    dead_end_share: float
    episodes: int


def run_separation(family: Family, train: int, test: int, seed: int = 0) -> dict[str, list[Any]]:
    """Score every measure; ours has watched the training runs, without acting."""
    watching = guard_for_family(family, tolerance=0.01, mode=Mode.SHADOW)
    teach(watching, training(family, seed, 0, train))
    measures: dict[tuple[str, str], RiskMeasure] = {
        ("evofsm", Group.LEARNT): learnt_by(watching)[1],
        ("rss-matched", Group.MATCHED): ResponsibilitySensitiveSafety.matched(
            family.decel, family.leader_decel
        ),
        **{(name, Group.FIXED): measure for name, measure in FIXED_MEASURES.items()},
    }
    seen, truth = [], []
    for draw in held_out(family, seed, test):
        decisions = drive(unrevised(family), draw).decisions
        rows = np.array([decision.situation.observation for decision in decisions])
        seen.append(rows)
        truth.append(is_dead_end(rows, family.decel, family.leader_decel))
    share = float(np.concatenate(truth).mean())
    separations = []
    for (name, group), measure in measures.items():
        scores = [measure.score(rows, family.interval) for rows in seen]
        low, high = bootstrap(partial(_over, scores, truth), test)
        area = auroc(np.concatenate(scores), np.concatenate(truth))
        separations.append(Separation(family.name, name, group, area, low, high, share, test))
    return {"separations": separations}


def _over(
    scores: list[NDArray[np.float64]], truth: list[NDArray[np.bool_]], chosen: NDArray[np.intp]
) -> float:
    """Area over some episodes."""
    return auroc(
        np.concatenate([scores[i] for i in chosen]), np.concatenate([truth[i] for i in chosen])
    )
