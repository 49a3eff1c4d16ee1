"""What numbers in a file may be: least, most and whether whole, for each array and setting.

One table for every kind of file. What was read is held against it, and what is to be written: a
file whose checksum is right may still hold what no learning could have left. The bounds are those
of learning from observations up to `LARGEST_OBSERVATION` in size, with room for rounding, so that
whatever was learnt can be kept.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

#: Squares of larger numbers, summed over a long run, would overflow.
LARGEST_OBSERVATION = 1e100
_SMALLEST = math.ulp(0.0)
_BELOW_1 = math.nextafter(1.0, 0.0)
# Counts that go up by 1 end here.
_MOST_COUNTED = float(1 << 53)
_ROUNDING = 1e-6
# Products of two observations, each over the smallest scale there may be, and sums of many.
_LARGEST_PRODUCT = 1e300
# No car brakes harder than this, nor does its speed jump by more in a decision [m/s², m/s].
_HARDEST, _JUMP = 15.0, 5.0
# Nor is it asked to [m/s²]; and decisions are no closer, nor farther apart [s].
_ASKED, _SHORTEST, _LONGEST = 100.0, 1e-6, 1e6


class Range(NamedTuple):
    """From the least number to the most, both included."""

    least: float
    most: float
    whole: bool = False

    def refuse_others(self, name: str, numbers: NDArray[Any]) -> None:
        """Raise for a number that is not in the range, or not whole where it must be."""
        if not numbers.size:
            return
        for number in (float(numbers.min()), float(numbers.max())):
            if not self.least <= number <= self.most:  # as NaN never is
                raise ValueError(
                    f"{name} of {number:g} cannot be right: it must lie between {self.least:g} and "
                    f"{self.most:g}"
                )
        if self.whole and (numbers != np.rint(numbers)).any():
            raise ValueError(f"{name} holds a fraction; it must be whole")


_COUNT = Range(0.0, _MOST_COUNTED, whole=True)
_FROM_1 = Range(1.0, _MOST_COUNTED, whole=True)
_SUM = Range(0.0, _MOST_COUNTED)
_FLAG = Range(0.0, 1.0, whole=True)
_SHARE = Range(0.0, 1.0 + _ROUNDING)
_FARTHEST = (1.0 + _ROUNDING) * LARGEST_OBSERVATION
_OBSERVED = Range(-_FARTHEST, _FARTHEST)
_APART = Range(-2.0 * _FARTHEST, 2.0 * _FARTHEST)
_PRODUCT = Range(0.0, _LARGEST_PRODUCT)
_SIZE = Range(_SMALLEST, LARGEST_OBSERVATION)
_ACCELERATION = Range(_SMALLEST, _ASKED)
# Of all states together, where they were merged into one.
_FREQUENCY = Range(0.0, LARGEST_OBSERVATION)

_OF_STATES = {
    "centers": _OBSERVED,
    "potentials": _SHARE,
    "uses": _COUNT,
    "origin_frequency": _FREQUENCY,
    **dict.fromkeys(("visits", "endings", "episodes", "failed_soon", "changes"), _COUNT),
    **dict.fromkeys(("tried", "failed_after"), _COUNT),
    **dict.fromkeys(("decisions", "failures"), _SUM),  # shared out by belief
    "founded": _COUNT,
    "joined": _FLAG,
}
ARRAYS: Mapping[str, Mapping[str, Range]] = {
    "machine": {
        **_OF_STATES,
        **dict.fromkeys(("n_states", "n_founded", "n_observations", "clock", "began"), _COUNT),
        **dict.fromkeys(("state", "ids", "latest_visit", "latest_try"), _COUNT),
        **dict.fromkeys(("action", "places"), Range(-1.0, _MOST_COUNTED, whole=True)),
        "chained": _FLAG,
        **dict.fromkeys(("first", "latest"), _OBSERVED),
        "mean": _APART,
        **dict.fromkeys(("scatter", "squared_distances"), _PRODUCT),
        "belief": _SHARE,
        "matrices": Range(0.0, 1e31),  # over their scales
        "scales": Range(1e-31, _SHARE.most),
    },
    "model": {**_OF_STATES, "transition_matrices": _SHARE},
    "risk": {
        **dict.fromkeys(("onsets", "exposure"), Range(0.0, _LONGEST * _MOST_COUNTED)),
        "seconds": Range(0.0, _LONGEST * _MOST_COUNTED),
        "decels": Range(_SMALLEST, _HARDEST),
        "gentle": _COUNT,
        "stretches": _FLAG,
        "lagged": Range(-_LARGEST_PRODUCT, _LARGEST_PRODUCT),
        **dict.fromkeys(("noise_gap", "noise_speed", "noise_leader"), _PRODUCT),
        # "brakes" and what is kept of doubts in them: see `_of_brakes`.
    },
    "guard": {},
    "checkpoint": {},
}

Settings: TypeAlias = "Mapping[str, Range | Settings]"
_RULE: dict[str, Any] = {
    "memory": Range(2.0, _MOST_COUNTED, whole=True),
    **dict.fromkeys(("radius", "spread", "distance"), _SIZE),
    "scales": Range(1e-20, 1e20),
    "share": Range(_SMALLEST, 1.0),
}
_RULE["base"] = _RULE
_OF_MACHINE: dict[str, Any] = {
    "n_actions": _FROM_1,
    **dict.fromkeys(("radius", "spread"), _SIZE),
    **dict.fromkeys(("distance_weight", "prior_frequency"), Range(_SMALLEST, 1e50)),
    "learning_rate": Range(_SMALLEST, _BELOW_1),
    "belief_tolerance": Range(0.0, _BELOW_1),
    **dict.fromkeys(("max_states", "failure_horizon"), _FROM_1),
    "when_full": _FLAG,
    "rule": _RULE,
}
SETTINGS: Mapping[str, Settings] = {
    "machine": _OF_MACHINE,
    "model": {
        "width": Range(0.0, 1e308),
        "dt": _SIZE,
        "rule": _RULE,
        "settings": _OF_MACHINE,
        "actions": {"low": _OBSERVED, "high": _OBSERVED, "width": _SIZE},
    },
    "risk": {
        "lowest": Range(-_ASKED, -_SMALLEST),
        "dt": Range(_SHORTEST, _LONGEST),
        **dict.fromkeys(("leader_decel", "hard"), _ACCELERATION),
        "own_brakes": Range(_SMALLEST, 10.0),
        "margin": _SIZE,
    },
    "guard": {},
    "checkpoint": {},
}


def hardest_seen(dt: float) -> float:
    """Braking beyond which a change of one's own speed is no braking, but a sensor's jump [m/s²].

    Examples
    --------
    >>> hardest_seen(0.25)
    35.0
    """
    return _HARDEST + _JUMP / dt


def refuse_others(
    kind: str, settings: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]] = {}
) -> None:
    """Raise a ValueError for a number that a file of some kind may not hold, naming it.

    Examples
    --------
    >>> refuse_others("model", {"width": float("nan")})
    Traceback (most recent call last):
    ValueError: width of nan cannot be right: it must lie between 0 and 1e+308
    """
    _refuse_settings(settings, SETTINGS[kind])
    ranges = dict(ARRAYS[kind])
    if kind == "risk":
        ranges |= _of_brakes(settings["dt"])
    for name, array in arrays.items():
        if name in ranges:
            ranges[name].refuse_others(name, array)


def _of_brakes(dt: float) -> dict[str, Range]:
    most = hardest_seen(dt)
    brought, short = Range(-most, most), Range(-2.0 * most - _ASKED, 2.0 * most + _ASKED)
    return {"brakes": brought, "doubts_brought": brought, "doubts_shortfalls": short}


def _refuse_settings(settings: Mapping[str, Any], ranges: Settings, within: str = "") -> None:
    """The same of settings, those within settings included; None says that one is not set."""
    for name, value in settings.items():
        wanted = ranges.get(name)
        if wanted is None or value is None:
            continue
        if not isinstance(wanted, Range):
            if isinstance(value, Mapping):
                _refuse_settings(value, wanted, f"{within}{name}.")
            continue
        numbers = np.array(value)
        if numbers.dtype.kind not in "iuf":
            raise ValueError(f"{within}{name} is {value!r}; it must be a number")
        wanted.refuse_others(f"{within}{name}", numbers)
