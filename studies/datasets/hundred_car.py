"""100-Car: crashes and near-crashes of naturalistic driving, seen by the follower's own radar.

T. A. Dingus et al., "The 100-Car Naturalistic Driving Study, Phase II", DOT HS 810 593, 2006; event
time series of the Virginia Tech Transportation Institute (doi:10.15787/VTT1/CEU6RB). Columns go by
place: 1 event, 3 time [s], 5 speed [mph]; then, for up to seven targets ahead, 21-27 identity,
35-41 range [ft], 49-55 range rate [ft/s, positive where it grows], 63-69 azimuth [rad]. The range
is taken as the gap: the radar sits at the front bumper.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import chain
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from studies.datasets.columns import header_and_rows, name_of, numbers
from studies.datasets.episodes import Episode, cut

_FOOT, _MPH = 0.3048, 0.44704
_TARGETS = 7
_EVENT, _TIME, _SPEED = 0, 2, 4
_IDENTITY, _RANGE, _RATE, _AZIMUTH = 20, 34, 48, 62
_COLUMNS = [
    *(_EVENT, _TIME, _SPEED),
    *(first + k for first in (_IDENTITY, _RANGE, _RATE, _AZIMUTH) for k in range(_TARGETS)),
]
#: A target farther aside than this is not on the follower's lane [m].
HALF_LANE = 1.8


def read_hundred_car(path: Path) -> Iterator[Episode]:
    """Read event time series; the leader is the nearest target ahead on the own lane."""
    rows = header_and_rows(path)
    first = next(rows, [])
    if len(first) <= max(_COLUMNS):
        raise ValueError(
            f"{path} has {len(first)} columns; event time series of 100-Car have more than "
            f"{max(_COLUMNS)} (a file of another layout?)"
        )
    headed = not first[_TIME].strip().replace(".", "", 1).isdigit()
    table = numbers(path, rows if headed else chain([first], rows), _COLUMNS, 2 if headed else 1)
    event, times, speed = table[:, 0], table[:, 1], table[:, 2]
    speed = np.where(speed >= 0.0, _MPH * speed, np.nan)  # -1 where there is none
    identity, gap, rate = _leader(table[:, 3:].reshape(len(table), 4, _TARGETS))
    observations = np.column_stack([gap, speed, np.maximum(speed + rate, 0.0)])
    changed = np.diff(event) != 0.0
    changed |= identity[1:] != identity[:-1]
    for part in np.split(np.arange(len(table)), np.flatnonzero(changed) + 1):
        pair = f"event {event[part[0]]:g}, target {identity[part[0]]:g}"
        yield from cut(name_of(path), pair, times[part], observations[part])


def _leader(
    radar: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Identity, range [m] and range rate [m/s] of the nearest target ahead; NaN without one.

    ``radar`` is (T, 4, targets): identity, range, range rate and azimuth.
    """
    identity, distance, rate, azimuth = np.moveaxis(radar, 1, 0)
    aside = np.abs(_FOOT * distance * np.sin(azimuth))
    candidate = (identity > 0.0) & (distance > 0.0) & (aside < HALF_LANE)
    reach = np.where(candidate, distance, np.inf)
    nearest = np.argmin(reach, axis=1)[:, None]
    seen = candidate.any(axis=1)
    chosen = (np.take_along_axis(one, nearest, axis=1)[:, 0] for one in (identity, distance, rate))
    who, how_far, how_fast = (np.where(seen, one, np.nan) for one in chosen)
    return np.where(seen, who, 0.0), _FOOT * how_far, _FOOT * how_fast
