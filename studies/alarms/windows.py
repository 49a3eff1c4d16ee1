"""What is judged: windows of some seconds, each with its highest score and what came after it."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import islice
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from evofsm.driving import Draw, Family, load_family, measures, training
from studies.alarms.amounts import Amounts
from studies.detection.measures import Detector, Ours, Watcher, classic
from studies.detection.watch import (
    HORIZON,
    Exposure,
    calibration_draws,
    held_out_draws,
    watch,
)
from studies.policies import Group

#: Length of a window [s]; whether danger came is known so much later.
LENGTH = HORIZON
#: Scores that are judged.
SCORES = (Ours.DEFAULT, Ours.COUNTS, "ttc")


class Windows(NamedTuple):
    """n windows of some episodes, in the order of time."""

    score: NDArray[np.float64]  #: (n,) the highest of each window
    happened: NDArray[np.bool_]  #: (n,) whether a collision came in it or within `HORIZON` of it
    episode: NDArray[np.intp]  #: (n,) which they are of, from 0


class Stage(NamedTuple):
    """Where something is judged, with the windows by score."""

    name: str
    changed: bool  #: whether the world is another one than thresholds were chosen in
    windows: dict[str, Windows]


def stages(name: str, plan: Amounts, seed: int) -> tuple[dict[str, Windows], list[Stage]]:
    """What thresholds are chosen on, and what comes then: a family, and after its change if any.

    Parameters
    ----------
    name : str
        Of the family.
    plan : Amounts
    seed : int
        Of all draws, and of what is learnt.
    """
    family = load_family(name)
    watcher = Watcher(family)
    watcher.watch((family, draw) for draw in training(family, seed, 0, plan.train))
    known = [one for one in watcher.detectors() if one.name in SCORES]
    known.append(classic("ttc", Group.FIXED, measures.FIXED_MEASURES["aeb-ttc"]))

    def seen(family: Family, draws: Iterable[Draw], episodes: int) -> dict[str, Windows]:
        watched = tuple(watch(family, draw) for draw in islice(draws, episodes))
        exposure = Exposure(family, watched)
        return {one.name: windows(exposure, one) for one in known}

    chosen_on = seen(family, calibration_draws(family, seed), plan.calibration)
    found = [Stage(name, False, seen(family, held_out_draws(family, seed), plan.episodes))]
    if (after := family.shifted) is not None:
        draws = islice(held_out_draws(after, seed), plan.episodes, None)
        found.append(Stage(f"{name}, after", True, seen(after, draws, plan.episodes)))
    return chosen_on, found


def windows(exposure: Exposure, detector: Detector) -> Windows:
    """Cut episodes into windows; those of which it is not known what came are left out."""
    found = list(_cut(exposure, detector.score(exposure)))
    return Windows(
        np.array([score for score, _, _ in found], np.float64),
        np.array([happened for _, happened, _ in found], np.bool_),
        np.array([episode for _, _, episode in found], np.intp),
    )


def _cut(exposure: Exposure, scores: NDArray[np.float64]) -> Iterator[tuple[float, bool, int]]:
    interval = exposure.family.interval
    length, row = round(LENGTH / interval), 0
    for episode, one in enumerate(exposure.watched):
        n = len(one.commands)
        for begin in range(0, n, length):
            left = one.end - interval * min(begin + length, n)  # from the window's end
            if one.collided or left >= HORIZON:
                score = float(scores[row + begin : row + min(begin + length, n)].max())
                yield score, one.collided and left <= HORIZON, episode
        row += n
