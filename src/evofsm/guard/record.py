"""What is recorded of a decision: each number once, with its name, its unit and its description.

Tables, logs, the audit log, the live page and Gymnasium's ``info`` all read this. A number that is
not known is NaN, or None where it is whole; JSON that has neither leaves it out.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from operator import attrgetter
from typing import Any, NamedTuple

from evofsm.guard.protocols import Intake, Revision, Situation


class Pair(NamedTuple):
    """A situation and what was decided in it."""

    situation: Situation
    revision: Revision


class Column(NamedTuple):
    """One number or text of a decision."""

    kind: type[int] | type[float] | type[str]
    about: str  #: with its unit in brackets, and where it is not known
    read: Callable[[Any], Any]  #: from a decision
    info: str = ""  #: its name in Gymnasium's ``info``, after ``reviser/``; empty where it is not
    in_table: bool = True  #: whether ``decisions.parquet`` has it


def _seen(kind: type[int] | type[float] | type[str], name: str, about: str) -> Column:
    return Column(kind, about, attrgetter(f"situation.{name}"))


def _decided(
    kind: type[int] | type[float] | type[str], name: str, about: str, info: str = ""
) -> Column:
    return Column(kind, about, attrgetter(f"revision.{name}"), info)


_INTAKE = ", ".join(f"{flag.value} {flag.name}" for flag in Intake if flag.name)

#: By name in tables and in the audit log. Elsewhere two have other names: MCAP's channel ``/risk``
#: drops ``risk_``, and ``info`` has its own.
RECORD: Mapping[str, Column] = {
    "time": _seen(float, "time", "since the start of the episode [s]"),
    "intake": Column(
        int, f"what was wrong: a sum of {_INTAKE}", lambda one: int(one.situation.intake)
    ),
    "state": _seen(int, "state", "the most probable one, from 0; left out where none is known"),
    "n_states": Column(
        int,
        "how many states there were",
        lambda one: 0 if one.situation.state is None else len(one.situation.belief),
    ),
    "surprise": _seen(
        float, "surprise", "divergence of forecast and belief [bit]; left out at first"
    ),
    "proposed": _decided(
        float, "proposed", "what the controller wanted [m/s²]; left out where there is none"
    ),
    "executed": _decided(float, "executed", "what was commanded [m/s²]"),
    "advised": _decided(float, "advised", "what the reviser would have executed [m/s²]"),
    "risk_proposed": _decided(
        float, "risk_proposed", "probability of failure under the proposal", "risk_proposed"
    ),
    "risk_executed": _decided(float, "risk_executed", "the same for what is executed", "risk"),
    "risk_low": Column(
        float, "lower end of its 90 % interval", lambda one: one.revision.interval[0]
    ),
    "risk_high": Column(
        float, "upper end of its 90 % interval", lambda one: one.revision.interval[1]
    ),
    "evidence": _decided(
        float, "evidence", "disturbances that it rests on, such as braking leaders"
    ),
    "seen": _decided(float, "seen", "time spent in states like this one before [s]"),
    "reason": _decided(str, "reason", "why, in a few words", "reason"),
    "explanation": _decided(
        str, "explanation", "why, in detail; empty where nothing was said"
    )._replace(in_table=False),
}


def info_of(revision: Revision) -> dict[str, Any]:
    """What Gymnasium's ``info`` says of a decision, but for the actions."""
    one = Pair(None, revision)  # type: ignore[arg-type]  # nothing of a situation stands there
    return {f"reviser/{by.info}": by.read(one) for by in RECORD.values() if by.info}
