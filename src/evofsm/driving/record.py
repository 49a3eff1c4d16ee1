"""What is recorded of a decision about a car, beside what is of every decision."""

from __future__ import annotations

from collections.abc import Mapping
from operator import attrgetter

from evofsm.driving.risk.headway import time_headway
from evofsm.driving.risk.ttc import time_to_collision
from evofsm.guard import RECORD, Column

#: By name in tables.
COLUMNS: Mapping[str, Column] = {
    **RECORD,
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
    ),
    "time_headway": Column(
        float,
        "[s]; left out where the follower stands",
        lambda one: float(time_headway(one.situation.observation)),
    ),
    "realised": Column(
        float,
        "what the body did until the next decision [m/s²]; left out where there is none",
        attrgetter("realised"),
    ),
}
