"""Bags of ROS 2 (sqlite3 and MCAP) as tables: which field of which topic is which variable.

A file in TOML says so::

    interval = 0.1         # from a row to the next [s]
    oldest = 0.5           # of a value [s]
    stamp = "received"     # when it was recorded; "header": what its header says

    [variables.gap]
    field = "/radar/objects.objects[0].distance"
    offset = -1.2          # the radar sits so far before the bumper [m]

    [variables.v_follower]
    field = "/vehicle/odometry.twist.twist.linear.x"
    unit = "km/h"

    [variables.v_leader]
    field = "/leader/odometry.twist.twist.linear.x"

Topics send when they like, and rows have one clock. A row holds the latest value of each variable
that came before it or with it (a zero-order hold): nothing is interpolated, and nothing is known
before it was. Rows begin once all variables are known. A row with a value older than ``oldest`` is
left out, which makes a hole in time, and the row after it begins a new episode.
"""

from __future__ import annotations

import heapq
import math
import re
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any, Literal, NamedTuple, Self

import numpy as np

from evofsm.extras import needs
from evofsm.fsm import positive
from evofsm.io.files import OnRead
from evofsm.io.following import ACTION
from evofsm.io.tables import Piece, refuse_unusable
from evofsm.io.units import KNOWN

#: The clock of a bag.
TIME = "time"

_ROWS_AT_ONCE = 4096
# Messages in whose midst one may be recorded too late.
_LATE = 256
_SHORTEST = 1e-6  # [s]
_NANOSECONDS = 1_000_000_000
_KEYS = {"interval", "oldest", "stamp", "variables"}
_VARIABLE_KEYS = {"field", "minus", "unit", "offset"}
_STEP = re.compile(r"([A-Za-z_]\w*)((?:\[\d+\])*)")


class Field(NamedTuple):
    """A number in the messages of a topic."""

    topic: str
    steps: tuple[str | int, ...]  #: names of fields, and places in arrays, from 0

    @classmethod
    def parse(cls, text: str) -> Self:
        """A topic, and behind its first dot the way to the number.

        Examples
        --------
        >>> Field.parse("/scan.ranges[3]")
        Field(topic='/scan', steps=('ranges', 3))
        """
        topic, _, way = text.partition(".")
        steps: list[str | int] = []
        for name in way.split("."):
            found = _STEP.fullmatch(name)
            if not (found and topic):
                raise ValueError(
                    f"{text!r} is no field; write /topic.field, /topic.field.field or "
                    "/topic.field[0].field"
                )
            steps += [found[1], *(int(place) for place in re.findall(r"\d+", found[2]))]
        return cls(topic, tuple(steps))

    def read(self, message: Any) -> float:
        """The number in a message; NaN behind the end of an array."""
        value = message
        for step in self.steps:
            if isinstance(step, int):
                if step >= len(value):
                    return math.nan
                value = value[step]
            else:
                value = getattr(value, step)
        return float(value)

    def __str__(self) -> str:
        way = (f"[{step}]" if isinstance(step, int) else f".{step}" for step in self.steps)
        return self.topic + "".join(way)


class Source(NamedTuple):
    """Where a variable comes from: a field, less another one, times a factor, plus an offset."""

    field: Field
    minus: Field | None
    factor: float
    offset: float  #: in units of the SI


@dataclass(frozen=True)
class Topics:
    """What the topics of bags mean.

    Parameters
    ----------
    variables : mapping
        Where each one comes from.
    interval : float
        Time from a row to the next [s].
    oldest : float
        A value older than this is not known any more [s].
    stamp : {"received", "header"}
        When a message is: as it was recorded, or as its header says.
    """

    variables: Mapping[str, Source]
    interval: float = 0.1
    oldest: float = 0.5
    stamp: Literal["received", "header"] = "received"

    @classmethod
    def load(cls, path: str | PathLike[str]) -> Self:
        """Read the file.

        Raises
        ------
        OSError
            If there is no such file.
        ValueError
            If it is no TOML, or says something else; the message names it.
        """
        try:
            return cls.of(tomllib.loads(Path(path).read_text(encoding="utf-8")))
        except (ValueError, TypeError) as error:  # that of TOML is a ValueError
            raise ValueError(f"{path}: {error}") from error

    @classmethod
    def of(cls, told: Mapping[str, Any]) -> Self:
        """The same of what is in the file.

        Examples
        --------
        >>> topics = Topics.of({"variables": {"v": {"field": "/odom.speed", "unit": "kn"}}})
        >>> topics.variables["v"].factor
        0.5144444444444445
        """
        _refuse_unknown("it", told, _KEYS)
        stamp = told.get("stamp", "received")
        if stamp not in ("received", "header"):
            raise ValueError(f"stamp is {stamp!r}; it must be received or header")
        variables = told.get("variables", {})
        if not (isinstance(variables, dict) and variables):
            raise ValueError("it names no variables; write [variables.gap] and field = ...")
        interval = float(told.get("interval", cls.interval))
        if not _SHORTEST <= interval < math.inf:
            raise ValueError(f"interval is {interval}; it must be at least {_SHORTEST:g} s")
        return cls(
            {name: _source(name, one) for name, one in variables.items()},
            interval,
            positive("oldest", float(told.get("oldest", cls.oldest))),
            stamp,
        )

    @property
    def fields(self) -> tuple[Field, ...]:
        """All that are read, each once."""
        found = (field for one in self.variables.values() for field in (one.field, one.minus))
        return tuple(dict.fromkeys(field for field in found if field is not None))


def _source(name: str, told: Any) -> Source:
    if isinstance(told, str):
        told = {"field": told}
    if not (isinstance(told, dict) and isinstance(told.get("field"), str)):
        raise ValueError(f"variable {name} names no field, such as '/odom.twist.twist.linear.x'")
    _refuse_unknown(f"variable {name}", told, _VARIABLE_KEYS)
    unit, offset = told.get("unit"), float(told.get("offset", 0.0))
    if unit is not None and unit not in KNOWN:
        raise ValueError(f"variable {name}: unit is {unit!r}; known are {', '.join(KNOWN)}")
    if not math.isfinite(offset):
        raise ValueError(f"variable {name}: offset is {offset}; it must be finite")
    minus = told.get("minus")
    return Source(
        Field.parse(told["field"]),
        None if minus is None else Field.parse(minus),
        1.0 if unit is None else KNOWN[unit][1],
        offset,
    )


def _refuse_unknown(what: str, told: Mapping[str, Any], known: set[str]) -> None:
    if unknown := sorted(set(told) - known):
        raise ValueError(f"{what} says {unknown[0]!r}; known are {', '.join(sorted(known))}")


class BagTable:
    """A bag as a table with a row for each tick of one clock.

    Its columns are ``time`` [s], from the bag's first message on, and the variables; where
    ``v_follower`` is one of them and ``a_follower`` is not, also the change of the former to the
    next row.

    Parameters
    ----------
    path : str
        Of the folder that holds ``metadata.yaml``, or of a single ``.mcap`` or ``.db3``.
    topics : Topics
    on_read : callable
        Called with the number of bytes of messages that were read.

    Raises
    ------
    ModuleNotFoundError
        If rosbags is not installed.
    """

    def __init__(self, path: str, topics: Topics, on_read: OnRead) -> None:
        self.path = path
        self._topics = topics
        self._on_read = on_read
        self._derives = "v_follower" in topics.variables and ACTION not in topics.variables
        self.columns = (TIME, *topics.variables, *([ACTION] if self._derives else []))

    def holds_dates(self, name: str) -> bool:
        """Never: the clock counts seconds."""
        return False

    def pieces(
        self,
        numbers: Sequence[str],
        texts: Sequence[str],
        dates: Sequence[str] = (),
        gaps: Sequence[str] = (),
    ) -> Iterator[Piece]:
        """All columns, whichever are asked for, some thousand rows at once.

        Raises
        ------
        ValueError
            If the bag is damaged, lacks a topic or a field, no row comes of it, or a text is asked
            for.
        """
        if texts:
            raise ValueError(
                f"{self.path}: of a bag numbers are read, and {texts[0]!r} is to be a text (of a "
                f"truth value, which is 0 or 1, write --failed '{texts[0]}>0')"
            )
        known = [name for name in numbers if name in self._topics.variables and name not in gaps]
        for piece in self._all():
            for name in known:
                refuse_unusable(piece, name, piece.numbers[name])
            yield piece

    def _all(self) -> Iterator[Piece]:
        rows, reached, begins = list[list[float]](), 0, True
        for row in self._rows():
            rows.append(row)
            if len(rows) > _ROWS_AT_ONCE:  # the last one waits for the one after it
                yield self._piece(rows, reached, begins)
                reached, begins = reached + _ROWS_AT_ONCE, False
                del rows[:_ROWS_AT_ONCE]
        if rows:
            yield self._piece([*rows, []], reached, begins)
        if not reached and not rows:
            raise ValueError(
                f"{self.path}: at no time are all variables known, none older than "
                f"{self._topics.oldest:g} s (oldest in the file of --topics)"
            )

    def _piece(self, rows: Sequence[list[float]], reached: int, begins: bool) -> Piece:
        """All rows but the last, which says what was done after the one before it."""
        *these, after = rows
        table = np.array(these)
        numbers = dict(zip((TIME, *self._topics.variables), table.T, strict=True))
        if self._derives:
            last = np.array([after]) if after else np.full((1, table.shape[1]), np.nan)
            whole = np.vstack([table, last])
            speeds = whole[:, 1 + list(self._topics.variables).index("v_follower")]
            numbers[ACTION] = np.diff(speeds) / self._topics.interval
            numbers[ACTION][~np.isclose(np.diff(whole[:, 0]), self._topics.interval)] = np.nan
        places = np.arange(reached + 1, reached + len(these) + 1)
        starts = np.zeros(1 if begins else 0, np.int64)
        return Piece(self.path, "row", places, numbers, {}, starts)

    def _rows(self) -> Iterator[list[float]]:
        """Time and variables of each tick in which all are known."""
        topics = self._topics
        interval, oldest = (
            round(seconds * _NANOSECONDS) for seconds in (topics.interval, topics.oldest)
        )
        values: dict[Field, float] = {}
        since: dict[str, int] = {}
        of_topic = _by_topic(topics.fields)
        first = tick = stamp = 0

        def is_known() -> bool:
            return len(since) == len(of_topic) and tick - min(since.values()) <= oldest

        with _explained(self.path):
            for stamp, topic, message in self._messages(of_topic):
                if not since:
                    first = tick = stamp
                while tick < stamp and is_known():
                    yield self._row((tick - first) / _NANOSECONDS, values)
                    tick += interval
                if tick < stamp:  # what is too old, or lacking, is so up to this message
                    tick += -((tick - stamp) // interval) * interval
                for field in of_topic[topic]:
                    values[field] = _read(field, message)
                since[topic] = stamp
            if tick == stamp and is_known():
                yield self._row((tick - first) / _NANOSECONDS, values)

    def _row(self, time: float, values: Mapping[Field, float]) -> list[float]:
        row = [time]
        for source in self._topics.variables.values():
            value = values[source.field]
            if source.minus is not None:
                value -= values[source.minus]
            row.append(source.factor * value + source.offset)
        return row

    def _messages(self, wanted: Mapping[str, Any]) -> Iterator[tuple[int, str, Any]]:
        """When each message of a topic that is wanted was, its topic, and the message."""
        with needs("rosbags", "ros", f"{self.path}: a bag of ROS 2"):
            from rosbags.highlevel import AnyReader
            from rosbags.typesys import Stores, get_typestore
        usual = get_typestore(Stores.LATEST)
        with AnyReader([Path(self.path)], default_typestore=usual) as reader:
            there = sorted({one.topic for one in reader.connections})
            if lacking := [topic for topic in wanted if topic not in there]:
                raise _BagError(f"it has no topic {lacking[0]!r}; it has {', '.join(there)}")
            connections = [one for one in reader.connections if one.topic in wanted]
            found = self._decoded(reader, connections)
            yield from _in_order(found) if self._topics.stamp == "header" else found

    def _decoded(self, reader: Any, connections: Sequence[Any]) -> Iterator[tuple[int, str, Any]]:
        for connection, received, data in reader.messages(connections=connections):
            self._on_read(len(data))
            message = reader.deserialize(data, connection.msgtype)
            stamp = received
            if self._topics.stamp == "header":
                header = getattr(message, "header", None)
                if header is None:
                    raise _BagError(
                        f"messages of {connection.topic!r} ({connection.msgtype}) have no header; "
                        'write stamp = "received"'
                    )
                stamp = header.stamp.sec * _NANOSECONDS + header.stamp.nanosec
            yield stamp, connection.topic, message


def _in_order(messages: Iterator[tuple[int, str, Any]]) -> Iterator[tuple[int, str, Any]]:
    """The same in the order of their stamps, where none comes later than some hundred others."""
    waiting: list[tuple[int, int, str, Any]] = []
    for number, (stamp, topic, message) in enumerate(messages):
        heapq.heappush(waiting, (stamp, number, topic, message))
        if len(waiting) > _LATE:
            at, _, *rest = heapq.heappop(waiting)
            yield at, rest[0], rest[1]
    while waiting:
        at, _, *rest = heapq.heappop(waiting)
        yield at, rest[0], rest[1]


def _by_topic(fields: Sequence[Field]) -> dict[str, list[Field]]:
    found: dict[str, list[Field]] = {}
    for field in fields:
        found.setdefault(field.topic, []).append(field)
    return found


def _read(field: Field, message: Any) -> float:
    try:
        return field.read(message)
    except (AttributeError, TypeError, ValueError) as error:
        raise _BagError(f"{field} is no number in messages of {field.topic!r}: {error}") from None


class _BagError(ValueError):
    """What is wrong with a bag, in words of our own."""


@contextmanager
def _explained(path: str) -> Iterator[None]:
    try:
        yield
    except ModuleNotFoundError:
        raise
    except _BagError as error:
        raise ValueError(f"{path}: {error}") from None
    except Exception as error:  # whatever the reader of bags ran into
        why = str(error)[:300] or type(error).__name__
        raise ValueError(
            f"{path} cannot be read as a bag of ROS 2 (damaged, cut off, or still being "
            f"recorded?): {why}"
        ) from error
