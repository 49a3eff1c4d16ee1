"""The channels of a run in robotics' formats: what was seen, believed, judged and decided.

A message for each decision on four channels, beside ``/event`` and ``/log``. Logs in MCAP and what
is sent live have the same, so that one layout shows both.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np

from evofsm.driving import DECISION_COLUMNS, UNITS, VARIABLES
from evofsm.guard import RECORD, Action, Column, Decision, Revision

#: Levels of foxglove.Log.
INFO, WARNING, ERROR = 2, 3, 4

_SECOND = 1_000_000_000  # [ns]
_SAME = 1e-9
_JSON_TYPES = {float: "number", int: "integer", str: "string"}
_OF_CARS = ("time_to_collision", "time_headway")


def columns_of(names: Sequence[str]) -> dict[str, tuple[str, ...]]:
    """The columns of an episode by channel; the channel of risks has them without ``risk_``."""
    of_cars = tuple(names) == VARIABLES
    return {
        "/observation": ("time", *names, "intake"),
        "/belief": ("state", "belief", "surprise", "n_states"),
        "/risk": (
            *("risk_proposed", "risk_executed", "risk_low", "risk_high", "evidence", "seen"),
            *(_OF_CARS if of_cars else ()),
        ),
        "/decision": (
            *("proposed", "executed", "advised"),
            *(("realised",) if of_cars else ()),
            *("reason", "explanation"),
        ),
    }


#: Of cars.
OF_DECISIONS = columns_of(VARIABLES)


def field_of(topic: str, name: str) -> str:
    """What a column of decisions is called in a channel."""
    return name.removeprefix("risk_") if topic == "/risk" else name


def schemas_of(
    names: Sequence[str] = VARIABLES, units: Sequence[str] = UNITS
) -> dict[str, dict[str, Any]]:
    """The JSON schema of each channel, by its topic.

    Examples
    --------
    >>> list(schemas_of(["angle"], ["rad"])["/observation"]["properties"])
    ['time', 'angle', 'intake']
    """
    observed = _observed(names, units)
    fields = {
        topic: {field_of(topic, name): _schema(name, observed) for name in of_topic}
        for topic, of_topic in columns_of(names).items()
    }
    fields |= {"/event": _EVENT | {name: _schema(name, observed) for name in names}, "/log": _LOG}
    if tuple(names) == VARIABLES:
        fields["/event"] |= _TRUE
    return {
        topic: {
            "title": _TITLES.get(topic, f"evofsm.{topic[1:].capitalize()}"),
            "type": "object",
            "properties": properties,
        }
        for topic, properties in fields.items()
    }


def messages_of(
    decision: Decision, names: Sequence[str] = VARIABLES
) -> Iterator[tuple[str, dict[str, Any]]]:
    """What a decision says on each channel."""
    known = decision.situation.state is not None
    belief = decision.situation.belief.tolist() if known else []
    observed = _observed(names, ())
    for topic, of_topic in columns_of(names).items():
        message = {}
        for name in of_topic:
            column = observed.get(name) or RECORD.get(name) or DECISION_COLUMNS.get(name)
            read = belief if column is None else column.read(decision)
            message[field_of(topic, name)] = read
        yield topic, message


def log_message(level: int, at: int, message: str) -> dict[str, Any]:
    """A line for the log panel, at a time [ns]."""
    sec, nsec = divmod(at, _SECOND)
    about = {"timestamp": {"sec": sec, "nsec": nsec}, "level": level, "message": message}
    return {**about, "name": "evofsm", "file": "", "line": 0}


def said(revision: Revision, unit: str = "m/s²") -> str:
    """A decision that was changed, or would have been, in a line."""
    kept = is_same(revision.executed, revision.proposed)
    what = "would advise" if kept else "executed"
    instead = _number(revision.advised if kept else revision.executed)
    unit = f" {unit}" if unit else ""
    return f"proposed {_number(revision.proposed)}, {what} {instead}{unit}: {revision.reason}"


def is_same(one: Action, other: Action) -> bool:
    """Whether two actions are the same, but for rounding; NaN is no action."""
    return bool(np.all(np.abs(np.subtract(one, other)) <= _SAME))


def encoded(message: Mapping[str, Any]) -> bytes:
    """A message as JSON; what is not known is left out."""
    known = {name: value for name, value in message.items() if _is_known(value)}
    return json.dumps(known, ensure_ascii=False, allow_nan=False).encode()


def _number(action: Any) -> str:
    return f"{action:+.2f}" if isinstance(action, float) else str(action)


def _is_known(value: Any) -> bool:
    return value is not None and not (isinstance(value, float) and not math.isfinite(value))


def _of(kind: str, description: str) -> dict[str, Any]:
    return {"type": kind, "description": description}


def _observed(names: Sequence[str], units: Sequence[str]) -> dict[str, Column]:
    """The variables of an observation as columns."""
    if tuple(names) == VARIABLES:
        return {name: DECISION_COLUMNS[name] for name in names}
    given = [*units, *("" for _ in names)]
    return {
        name: Column(
            float,
            f"as observed{f' [{unit}]' if unit else ''}; left out where missing",
            partial(_value, k),
        )
        for k, (name, unit) in enumerate(zip(names, given, strict=False))
    }


def _value(place: int, decision: Decision) -> float:
    return float(decision.situation.observation[place])


def _schema(name: str, observed: Mapping[str, Column]) -> dict[str, Any]:
    if name == "belief":
        items = _of("number", "probability")
        return {**_of("array", "probability of each state, from 0"), "items": items}
    column = observed.get(name) or RECORD.get(name) or DECISION_COLUMNS[name]
    return _of(_JSON_TYPES[column.kind], column.about)


_TITLES = {"/log": "foxglove.Log"}
_EVENT = {
    "kind": _of("string", "episode started, collision, rear-end collision or episode ended"),
    "episode": _of("integer", "number of the episode, from 0"),
    "time": _of("number", "since the start of the episode [s]"),
}
_TRUE = {
    "gap": _of("number", "from bumper to bumper, as it truly was [m]"),
    "v_follower": _of("number", "speed of the follower [m/s]"),
    "v_leader": _of("number", "speed of the leader [m/s]"),
}
# As Foxglove knows it, which is by its name.
_LOG = {
    "timestamp": {
        **_of("object", "when"),
        "properties": {"sec": {"type": "integer"}, "nsec": {"type": "integer"}},
    },
    "level": {
        "description": "how grave",
        "oneOf": [
            {"title": name, "const": level}
            for level, name in enumerate(("UNKNOWN", "DEBUG", "INFO", "WARNING", "ERROR", "FATAL"))
        ],
    },
    "message": _of("string", "what happened"),
    "name": _of("string", "who says so"),
    "file": _of("string", "empty"),
    "line": _of("integer", "0"),
}
