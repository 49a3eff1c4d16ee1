"""What a file of a learnt risk may hold, and what no car does."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from numpy.typing import NDArray

from evofsm.store import COUNT, FLAG, MOST_COUNTED, SIZE, SMALLEST, Kind, Numbers

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

_TIME = Numbers(least=0.0, most=_LONGEST * MOST_COUNTED)
_ACCELERATION = Numbers(least=SMALLEST, most=_ASKED)
_PRODUCT = Numbers(least=-1e300, most=1e300)
_NOISE = Numbers(least=0.0, most=1e300)


def hardest_seen(dt: float) -> float:
    """Braking beyond which a change of one's own speed is no braking, but a sensor's jump [m/s²].

    Examples
    --------
    >>> hardest_seen(0.25)
    35.0
    """
    return _HARDEST + _JUMP / dt


def refuse_other_brakes(dt: float, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Raise for braking that could not have been seen at this interval of time."""
    most = hardest_seen(dt)
    brought = Numbers(("n",), -most, most)
    brought.refuse_others("brakes", arrays["brakes"])
    brought.refuse_others("doubts_brought", arrays["doubts_brought"])
    short = Numbers(("n",), -2.0 * most - _ASKED, 2.0 * most + _ASKED)
    short.refuse_others("doubts_shortfalls", arrays["doubts_shortfalls"])


RISK = Kind(
    "risk",
    {
        **dict.fromkeys(("onsets", "exposure", "seconds"), _TIME.of("n")),
        "brakes": Numbers(("samples",)),
        "stretches": FLAG.of("samples"),
        "decels": Numbers(("decels",), SMALLEST, _HARDEST),
        "gentle": COUNT.of(1),
        "lagged": _PRODUCT.of(2),
        "noise_gap": _NOISE.of("gaps"),
        "noise_speed": _NOISE.of("speeds"),
        "noise_leader": _NOISE.of("leaders"),
        "doubts_brought": Numbers(("brought",)),
        "doubts_shortfalls": Numbers(("shortfalls",)),
    },
    {
        "lowest": Numbers(least=-_ASKED, most=-SMALLEST),
        "dt": Numbers(least=_SHORTEST, most=_LONGEST),
        **dict.fromkeys(("leader_decel", "hard"), _ACCELERATION),
        "own_brakes": Numbers(least=SMALLEST, most=10.0),
        "margin": SIZE,
    },
)
