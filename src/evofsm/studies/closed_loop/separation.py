"""How well measures tell dead ends from the rest: the area under the ROC curve.

The truth is the oracle's, which knows both cars' limits: leader and follower brake as hard as they
can from now on, and still collide. Every decision of unrevised held-out runs is a case.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from evofsm._extras import needs
from evofsm.framework.reviser import Mode, Unrevised
from evofsm.protocols import RiskMeasure
from evofsm.risk.dead_end import is_dead_end
from evofsm.risk.rss import ResponsibilitySensitiveSafety
from evofsm.studies.closed_loop.learner import Learner, drive_alone, held_out, training
from evofsm.studies.closed_loop.policies import FIXED_MEASURES, Group
from evofsm.worlds.families import Family

with needs("scipy", "study", "the area under a ROC curve"):
    from scipy.stats import rankdata


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
    learner = Learner.new(family)
    watching = learner.reviser(family, 0.01, Mode.SHADOW)
    learner.teach(family, training(family, seed, 0, train), watching)
    measures: dict[tuple[str, str], RiskMeasure] = {
        ("evofsm", Group.LEARNT): learner.risk,
        ("rss-matched", Group.MATCHED): ResponsibilitySensitiveSafety.matched(
            family.decel, family.leader_decel
        ),
        **{(name, Group.FIXED): measure for name, measure in FIXED_MEASURES.items()},
    }
    seen, truth = [], []
    for draw in held_out(family, seed, test):
        drive = drive_alone(family, draw, Unrevised(family.actions), None)
        rows = np.array([decision.situation.observation for decision in drive.decisions])
        seen.append(rows)
        truth.append(is_dead_end(rows, family.decel, family.leader_decel))
    share = float(np.concatenate(truth).mean())
    separations = []
    for (name, group), measure in measures.items():
        scores = [measure.score(rows, family.interval) for rows in seen]
        low, high = _bootstrap(scores, truth)
        area = auroc(np.concatenate(scores), np.concatenate(truth))
        separations.append(Separation(family.name, name, group, area, low, high, share, test))
    return {"separations": separations}


def auroc(score: NDArray[np.float64], truth: NDArray[np.bool_]) -> float:
    """Probability that a positive case scores above a negative one, ties counting half.

    Examples
    --------
    >>> auroc(np.array([0.1, 0.4, 0.4, 0.8]), np.array([False, False, True, True]))
    0.875
    """
    positive = int(truth.sum())
    negative = len(truth) - positive
    if positive == 0 or negative == 0:
        return float("nan")
    above = rankdata(score)[truth].sum() - positive * (positive + 1) / 2
    return float(above / (positive * negative))


def _bootstrap(
    scores: list[NDArray[np.float64]], truth: list[NDArray[np.bool_]], rounds: int = 200
) -> tuple[float, float]:
    """95 % interval, by resampling episodes."""
    rng = np.random.default_rng(0)
    areas = []
    for _ in range(rounds):
        chosen = rng.integers(len(scores), size=len(scores))
        areas.append(
            auroc(
                np.concatenate([scores[i] for i in chosen]),
                np.concatenate([truth[i] for i in chosen]),
            )
        )
    low, high = np.nanquantile(areas, [0.025, 0.975])
    return float(low), float(high)
