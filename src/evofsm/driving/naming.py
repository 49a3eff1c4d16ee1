"""What is observed and recorded of car following, and how a place of it is put into words."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from operator import attrgetter, itemgetter
from typing import Any

from numpy.typing import ArrayLike

from evofsm.driving.measures import time_headway, time_to_collision
from evofsm.fsm.naming import Labels, Words
from evofsm.fsm.validation import real_array
from evofsm.guard.record import RECORD, Column

#: What is observed of car following, and its units.
VARIABLES, UNITS = ("gap", "v_follower", "v_leader"), ("m", "m/s", "m/s")
#: What a speed of a car [m/s] can be, and what these three.
SPEEDS = -150.0, 150.0
#: Nobody reverses faster: who seems to counts against the direction of travel [m/s].
REVERSE = -5.0
RANGES = (-1e3, 1e6), (REVERSE, SPEEDS[1]), SPEEDS

# Up to these a gap [m] and a speed [m/s] are called so.
Bands = Sequence[tuple[float, str]]
_DISTANCES = ((2.0, "nearly touching"), (15.0, "close"), (40.0, "at a distance"), (math.inf, "far"))
_FAST = ((0.5, "standing"), (8.0, "slow"), (20.0, "at medium speed"), (math.inf, "fast"))
# Speeds that differ by less are called equal [m/s].
_EQUAL_SPEED = 0.5


def name_state(center: ArrayLike) -> str:
    """Where a state lies, in words: its gap, its speed, and how fast the gap closes or opens.

    Examples
    --------
    >>> name_state([60.0, 25.0, 27.3])
    'far (60 m), fast (25 m/s), opening at 2 m/s'
    """
    gap, speed, leader = real_array("center", center, 1).tolist()
    closing_speed = speed - leader
    change = f"{'closing' if closing_speed > 0.0 else 'opening'} at {abs(closing_speed):.0f} m/s"
    change = "at equal speeds" if abs(closing_speed) < _EQUAL_SPEED else change
    return ", ".join([_placed(gap, _DISTANCES, "m"), _placed(speed, _FAST, "m/s"), change])


def _placed(value: float, bands: Bands, unit: str) -> str:
    word = next((word for most, word in bands if value <= most), bands[-1][1])
    # Adding 0 takes the minus from a zero.
    return f"{word} ({round(value, 0) + 0.0:.0f} {unit})"


#: How places and actions of car following are worded: an entry point of ``evofsm.words``.
WORDS = Words(name_state, "m/s²")
#: Of car following.
LABELS = Labels(names=VARIABLES, units=UNITS)


def observed(about: str, of: Callable[[Any], Any], *, in_table: bool = True) -> Column:
    """The column of a number that is made of what was observed."""
    return Column(float, about, lambda record: float(of(record.situation.observation)), in_table)


#: By name, in the order of ``decisions.parquet``, which has those that are `Column.in_table`: what
#: was observed, the numbers of every decision, what came of it, and texts.
DECISION_COLUMNS: Mapping[str, Column] = {
    "time": RECORD["time"],
    "gap": observed("gap from bumper to bumper [m]; left out where missing", itemgetter(0)),
    "v_follower": observed("speed of the follower [m/s]; left out where missing", itemgetter(1)),
    "v_leader": observed("speed of the leader [m/s]; left out where missing", itemgetter(2)),
    "time_to_collision": observed(
        "[s]; left out where the gap does not close", time_to_collision, in_table=False
    ),
    "time_headway": observed(
        "[s]; left out where the follower stands", time_headway, in_table=False
    ),
    **{name: column for name, column in RECORD.items() if column.kind is not str},
    "realised": Column(
        float,
        "what the body did until the next decision [m/s²]; left out where there is none",
        attrgetter("realised"),
    ),
    **RECORD,
}
