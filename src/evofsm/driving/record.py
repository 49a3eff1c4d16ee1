"""What is recorded of a decision about a car, beside what is of every decision."""

from __future__ import annotations

from collections.abc import Mapping
from operator import attrgetter

from evofsm.driving.measures import time_headway, time_to_collision
from evofsm.guard.record import RECORD, Column

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
