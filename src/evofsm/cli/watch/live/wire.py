"""What is sent to the page: each message one JSON object, its numbers as people need them."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable
from typing import Any

from evofsm.cli.watch.live.words import tell
from evofsm.cli.watch.player import SPEEDS, Clock
from evofsm.cli.watch.shown import Frame, Graph, Start
from evofsm.driving import name_state, name_states

# What is not worth sending of a number.
_DIGITS = 5


def encode(message: Any) -> str:
    """As JSON; what is no finite number becomes null.

    Examples
    --------
    >>> encode({"kind": "clock", "speed": float("inf")})
    '{"kind":"clock","speed":null}'
    """
    return json.dumps(_plain(message), separators=(",", ":"), allow_nan=False)


def start_message(start: Start, *, live: bool) -> dict[str, Any]:
    """That a run begins; ``live`` if it can be acted on."""
    return {"kind": "start", **start._asdict(), "live": live, "speeds": SPEEDS}


def clock_message(clock: Clock) -> dict[str, Any]:
    """How it is played."""
    return {"kind": "clock", **clock._asdict()}


def frame_message(frame: Frame, start: Start) -> dict[str, Any]:
    """A frame, with the story so far in words."""
    danger = frame.story.danger
    return {
        **frame._asdict(),
        "kind": "frame",
        "here": name_state(frame.observation),
        "danger": danger._asdict() if danger and frame.story.in_danger else None,
        "story": {**frame.story._asdict(), "danger": None, "dead_end": _dead_end(frame)},
        "told": tell(frame, start)._asdict(),
    }


def _dead_end(frame: Frame) -> float:
    """Since when not even full braking helps [s]; NaN where it does."""
    danger = frame.story.danger
    return danger.dead_end if danger is not None else math.nan


def graph_message(graph: Graph) -> dict[str, Any]:
    """The states, named."""
    names = name_states([state.center for state in graph.states])
    return {
        "kind": "graph",
        "number": graph.number,
        "states": [
            {**state._asdict(), "name": name}
            for state, name in zip(graph.states, names, strict=True)
        ],
        "transitions": [list(way) for way in graph.transitions],
    }


def _plain(value: Any) -> Any:
    if isinstance(value, bool) or value is None or isinstance(value, str | int):
        return value
    if isinstance(value, float):
        return round(value, _DIGITS) if math.isfinite(value) else None
    if isinstance(value, dict):
        return {name: _plain(part) for name, part in value.items()}
    if hasattr(value, "_asdict"):
        return _plain(value._asdict())
    if isinstance(value, Iterable):
        return [_plain(part) for part in value]
    raise TypeError(f"{type(value).__name__} is nothing that is sent")
