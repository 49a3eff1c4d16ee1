"""What a file of a learnt risk may hold, and what no car does."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from evofsm.store import ranges

# No car brakes harder than this [m/s²].
_HARDEST = 15.0
# Nor does its speed jump by more from one decision to the next [m/s].
_JUMP = 5.0
# Nor is it asked to brake harder [m/s²].
_ASKED = 100.0
# Decisions are no closer than this [s].
_SHORTEST = 1e-6
# Nor farther apart [s].
_LONGEST = 1e6

_TIME = ranges.Range(0.0, _LONGEST * ranges.MOST_COUNTED)
_ACCELERATION = ranges.Range(ranges.SMALLEST, _ASKED)


def hardest_seen(dt: float) -> float:
    """Braking beyond which a change of one's own speed is no braking, but a sensor's jump [m/s²].

    Examples
    --------
    >>> hardest_seen(0.25)
    35.0
    """
    return _HARDEST + _JUMP / dt


def _of_brakes(settings: Mapping[str, Any]) -> dict[str, ranges.Range]:
    most = hardest_seen(settings["dt"])
    short = ranges.Range(-2.0 * most - _ASKED, 2.0 * most + _ASKED)
    brought = ranges.Range(-most, most)
    return {"brakes": brought, "doubts_brought": brought, "doubts_shortfalls": short}


RISK = ranges.register(
    ranges.Kind(
        "risk",
        {
            **dict.fromkeys(("onsets", "exposure", "seconds"), ranges.Member(("n",), _TIME)),
            "brakes": ranges.Member(("samples",), None),
            "stretches": ranges.Member(("samples",), ranges.FLAG),
            "decels": ranges.Member(("decels",), ranges.Range(ranges.SMALLEST, _HARDEST)),
            "gentle": ranges.Member((1,), ranges.COUNT),
            "lagged": ranges.Member(
                (2,), ranges.Range(-ranges.LARGEST_PRODUCT, ranges.LARGEST_PRODUCT)
            ),
            "noise_gap": ranges.Member(("gaps",), ranges.PRODUCT),
            "noise_speed": ranges.Member(("speeds",), ranges.PRODUCT),
            "noise_leader": ranges.Member(("leaders",), ranges.PRODUCT),
            "doubts_brought": ranges.Member(("brought",), None, since=4),
            "doubts_shortfalls": ranges.Member(("shortfalls",), None, since=4),
        },
        {
            "lowest": ranges.Range(-_ASKED, -ranges.SMALLEST),
            "dt": ranges.Range(_SHORTEST, _LONGEST),
            **dict.fromkeys(("leader_decel", "hard"), _ACCELERATION),
            "own_brakes": ranges.Range(ranges.SMALLEST, 10.0),
            "margin": ranges.SIZE,
        },
        limits=_of_brakes,
    )
)
