"""What is recorded of a decision: each number once, with its type, its unit and its description.

Tables, logs, the audit log and the live page all read this. A number that is not known is NaN, or
None where it is an int; JSON, which has neither, leaves it out.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from operator import attrgetter
from typing import Any, NamedTuple

from evofsm.guard.api import Intake


class Column(NamedTuple):
    """One number or text of a decision."""

    kind: type[int] | type[float] | type[str] | type[list[Any]]
    about: str  #: with its unit in brackets, and where it is not known
    read: Callable[[Any], Any]  #: from a decision
    in_table: bool = True  #: whether ``decisions.parquet`` has it


def _of(part: str, name: str, kind: type[Any], about: str) -> Column:
    return Column(kind, about, attrgetter(f"{part}.{name}"))


_INTAKE = ", ".join(f"{flag.value} {flag.name}" for flag in Intake if flag.name)
_PROPOSED = "what the controller wanted [m/s²]; left out where there is none"
_STATE = "the most probable one, from 0; left out where none is known"

#: By name in tables and in the audit log; MCAP's channel ``/risk`` drops ``risk_``.
RECORD: Mapping[str, Column] = {
    "time": _of("situation", "time", float, "since the start of the episode [s]"),
    "intake": Column(int, f"what was wrong: a sum of {_INTAKE}", lambda d: int(d.situation.intake)),
    "state": _of("situation", "state", int, _STATE),
    "n_states": Column(
        int,
        "how many states there were",
        lambda d: 0 if d.situation.state is None else len(d.situation.belief),
    ),
    "surprise": _of(
        "situation", "surprise", float, "divergence of forecast and belief [bit]; left out at first"
    ),
    "proposed": _of("revision", "proposed", float, _PROPOSED),
    "executed": _of("revision", "executed", float, "what was commanded [m/s²]"),
    "advised": _of("revision", "advised", float, "what the reviser would have executed [m/s²]"),
    "risk_proposed": _of(
        "revision", "risk_proposed", float, "probability of failure under the proposal"
    ),
    "risk_executed": _of("revision", "risk_executed", float, "the same for what is executed"),
    "risk_low": Column(float, "lower end of its 90 % interval", lambda d: d.revision.interval[0]),
    "risk_high": Column(float, "upper end of its 90 % interval", lambda d: d.revision.interval[1]),
    "evidence": _of(
        "revision", "evidence", float, "disturbances that it rests on, such as braking leaders"
    ),
    "seen": _of("revision", "seen", float, "time spent in states like this one before [s]"),
    "reason": _of("revision", "reason", str, "why, in a few words"),
    "explanation": _of(
        "revision", "explanation", str, "why, in detail; empty where nothing was said"
    )._replace(in_table=False),
}
