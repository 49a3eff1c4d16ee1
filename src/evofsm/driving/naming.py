"""What is observed and recorded of car following, and how a place of it is put into words."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from operator import attrgetter

from numpy.typing import ArrayLike

from evofsm.driving.measures import time_headway, time_to_collision
from evofsm.fsm.naming import Labels, Words
from evofsm.fsm.validation import real_array
from evofsm.guard.record import RECORD, Column

#: What is observed of car following, and its units.
VARIABLES, UNITS = ("gap", "v_follower", "v_leader"), ("m", "m/s", "m/s")

# Up to these a gap [m] and a speed [m/s] are called so.
_GAPS = ((2.0, "nearly touching"), (15.0, "close"), (40.0, "at a distance"))
_FAR = "far"
_SPEEDS = ((0.5, "standing"), (8.0, "slow"), (20.0, "at medium speed"))
_FAST = "fast"
# Speeds that differ by less are called equal [m/s].
_EQUAL = 0.5


def name_state(center: ArrayLike, decimals: int = 0) -> str:
    """Where a state lies, in words: its gap, its speed, and how fast the gap closes or opens.

    Examples
    --------
    >>> name_state([9.2, 4.1, 3.0])
    'close (9 m), slow (4 m/s), closing at 1 m/s'
    >>> name_state([60.0, 25.0, 27.3], decimals=1)
    'far (60.0 m), fast (25.0 m/s), opening at 2.3 m/s'
    """
    where = real_array("center", center, 1)
    if len(where) != 3:
        raise ValueError(f"center has {len(where)} variables; a name needs gap and both speeds")
    gap, speed, leader = where.tolist()
    parts = [
        f"{_word(gap, _GAPS, _FAR)} ({_plain(gap, decimals)} m)",
        f"{_word(speed, _SPEEDS, _FAST)} ({_plain(speed, decimals)} m/s)",
        _change(speed - leader, decimals),
    ]
    return ", ".join(parts)


def _word(value: float, bands: Sequence[tuple[float, str]], beyond: str) -> str:
    return next((word for most, word in bands if value <= most), beyond)


def _plain(value: float, decimals: int) -> str:
    """Rounded, without a minus before a zero."""
    return f"{round(value, decimals) + 0.0:.{decimals}f}"


def _change(closing: float, decimals: int) -> str:
    if abs(closing) < _EQUAL and decimals == 0:
        return "at equal speeds"
    return f"{'closing' if closing > 0.0 else 'opening'} at {abs(closing):.{decimals}f} m/s"


#: How places and actions of car following are worded: an entry point of ``evofsm.words``.
WORDS = Words(name_state, "m/s²")
#: Of car following.
LABELS = Labels(names=VARIABLES, units=UNITS)

#: By name, in the order of ``decisions.parquet``, which has those that are `Column.in_table`: what
#: was observed, the numbers of every decision, what came of it, and texts.
DECISION_COLUMNS: Mapping[str, Column] = {
    "time": RECORD["time"],
    "gap": Column(
        float,
        "from bumper to bumper, as observed [m]; left out where missing",
        lambda one: float(one.situation.observation[0]),
    ),
    "v_follower": Column(
        float,
        "speed of the follower [m/s]; left out where missing",
        lambda one: float(one.situation.observation[1]),
    ),
    "v_leader": Column(
        float,
        "speed of the leader [m/s]; left out where missing",
        lambda one: float(one.situation.observation[2]),
    ),
    "time_to_collision": Column(
        float,
        "[s]; left out where the gap does not close",
        lambda one: float(time_to_collision(one.situation.observation)),
        in_table=False,
    ),
    "time_headway": Column(
        float,
        "[s]; left out where the follower stands",
        lambda one: float(time_headway(one.situation.observation)),
        in_table=False,
    ),
    **{name: column for name, column in RECORD.items() if column.kind is not str},
    "realised": Column(
        float,
        "what the body did until the next decision [m/s²]; left out where there is none",
        attrgetter("realised"),
    ),
    **RECORD,
}
