"""A judge of scenes in a file: the episodes that it remembers. All else follows from them."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from evofsm.guard.scene.memory import Episode
from evofsm.store import ranges

_SOME = ranges.Range(-math.inf, math.inf)
_INDEX = ranges.Range(-1.0, ranges.MOST_COUNTED, whole=True)
KIND = ranges.register(
    ranges.Kind(
        "scenerisk",
        {
            "own": ranges.Member(("n", "o"), _SOME),
            "actions": ranges.Member(("n",), _INDEX),
            "counts": ranges.Member(("n",), ranges.COUNT),
            "away": ranges.Member(("m", "p"), _SOME),
            "other": ranges.Member(("m", "r"), _SOME),
            "links": ranges.Member(("m",), _INDEX),
            "moments": ranges.Member(("e",), ranges.FROM_1),
            "failed": ranges.Member(("e",), ranges.FLAG),
        },
        {
            "dt": ranges.SIZE,
            "n_actions": ranges.FROM_1,
            "columns": ranges.FROM_1,
            "horizon": ranges.SIZE,
            "failures": ranges.COUNT,
            "fitted": ranges.COUNT,
        },
    )
)
_JOINED = ("own", "actions", "counts", "away", "other", "links")


def arrays_of(episodes: list[Episode]) -> dict[str, NDArray[Any]]:
    """All episodes, one after the other."""
    if not episodes:
        flat = ("actions", "counts", "links")
        arrays = {name: np.zeros((0,) if name in flat else (0, 0)) for name in _JOINED}
    else:
        arrays = {
            name: np.concatenate([getattr(one, name) for one in episodes]) for name in _JOINED
        }
    return {name: array.astype(np.float64) for name, array in arrays.items()} | {
        "moments": np.array([len(one.own) for one in episodes], np.float64),
        "failed": np.array([one.failed for one in episodes], np.float64),
    }


def episodes_of(arrays: dict[str, NDArray[Any]]) -> list[Episode]:
    """What such arrays hold.

    Raises
    ------
    ValueError
        If arrays contradict each other.
    """
    moments, failed = arrays["moments"].astype(int), arrays["failed"].astype(bool)
    actions, counts = arrays["actions"].astype(int), arrays["counts"].astype(int)
    links = arrays["links"].astype(int)
    if moments.sum() != len(counts) or counts.sum() != len(links):
        raise ValueError("moments and objects are not as many as counted")
    episodes, first, object_ = [], 0, 0
    for length, fails in zip(moments, failed, strict=True):
        last = first + length
        some = slice(object_, object_ + int(counts[first:last].sum()))
        episodes.append(
            Episode(
                arrays["own"][first:last],
                actions[first:last],
                counts[first:last],
                arrays["away"][some],
                arrays["other"][some],
                links[some],
                bool(fails),
            )
        )
        first, object_ = last, some.stop
        if (links[some] >= some.stop - some.start).any():
            raise ValueError("an object is linked beyond its episode")
    return episodes
