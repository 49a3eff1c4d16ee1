"""Bags of ROS 2 (sqlite3 and MCAP) as tables: which field of which topic is which variable.

Topics send when they like, and rows have one clock. A row holds the latest value of each variable
that came before it or with it (a zero-order hold): nothing is interpolated, and nothing is known
before it was. Rows begin once all variables are known. A row with a value that is too old is left
out, which makes a hole in time, and the row after it begins a new episode.
"""

from __future__ import annotations

import heapq
import math
import re
import tomllib
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import chain, islice, pairwise
from os import PathLike
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np

from evofsm.extras import needs
from evofsm.fsm import positive
from evofsm.io.tables import UNITS, OnRead, Piece, Table, Wanted
from evofsm.io.vehicles import ACTION

_ROWS_AT_ONCE = 4096
# Messages in whose midst one may be recorded too late.
_LATE = 256
_SHORTEST = 1e-6  # [s]
_NANOSECONDS = 1_000_000_000
_STEP = re.compile(r"([A-Za-z_]\w*)((?:\[\d+\])*)")


class Field(NamedTuple):
    """A number in the messages of a topic."""

    text: str
    topic: str
    steps: tuple[str | int, ...]  #: names of fields, and places in arrays, from 0

    @classmethod
    def parse(cls, text: Any) -> Self:
        """A topic, and behind its first dot the way to the number: ``/scan.ranges[3]``."""
        topic, _, way = str(text).partition(".")
        found = [_STEP.fullmatch(name) for name in way.split(".")]
        steps: list[str | int] = []
        for step in found:
            if not (step and topic and isinstance(text, str)):
                raise ValueError(
                    f"{text!r} is no field; write /topic.field, /topic.field.field or "
                    "/topic.field[0].field"
                )
            steps += [step[1], *map(int, re.findall(r"\d+", step[2]))]
        return cls(text, topic, tuple(steps))

    def read(self, message: Any) -> float:
        """The number in a message; NaN behind the end of an array."""
        value = message
        try:
            for step in self.steps:
                if isinstance(step, int):
                    if step >= len(value):
                        return math.nan
                    value = value[step]
                else:
                    value = getattr(value, step)
            return float(value)
        except (AttributeError, TypeError, ValueError) as error:
            raise _BagError(
                f"{self.text} is no number in messages of {self.topic!r}: {error}"
            ) from None


class Variable(NamedTuple):
    """Where a variable comes from: a field, less another one, times a factor, plus an offset."""

    field: Field
    minus: Field | None
    factor: float
    offset: float  #: in units of the SI

    @classmethod
    def of(cls, name: str, given: Any) -> Self:
        """From what a file says of it."""
        given = given if isinstance(given, Mapping) else {"field": given}
        _refuse_unknown(f"variable {name}", given, "field", "minus", "unit", "offset")
        unit, offset, minus = given.get("unit"), given.get("offset", 0.0), given.get("minus")
        if unit is not None and unit not in UNITS:
            raise ValueError(f"variable {name}: unit is {unit!r}; known are {', '.join(UNITS)}")
        if not math.isfinite(offset):
            raise ValueError(f"variable {name}: offset is {offset}; it must be finite")
        try:
            field = Field.parse(given.get("field"))
            less = None if minus is None else Field.parse(minus)
        except ValueError as error:
            raise ValueError(f"variable {name}: {error}") from None
        return cls(field, less, 1.0 if unit is None else UNITS[unit][1], float(offset))


@dataclass(frozen=True)
class Topics:
    """What the topics of bags mean.

    Parameters
    ----------
    variables : mapping
        Where each one comes from; see `of`.
    interval : float
        Time from a row to the next [s].
    oldest : float
        A value older than this is not known any more [s].
    stamp : {"received", "header"}
        When a message is: as it was recorded, or as its header says.
    """

    variables: Mapping[str, Variable]
    interval: float = 0.1
    oldest: float = 0.5
    stamp: str = "received"

    @classmethod
    def load(cls, path: str | PathLike[str]) -> Self:
        """Read a file in TOML, with what `of` takes.

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
    def of(cls, given: Mapping[str, Any]) -> Self:
        """From a mapping of ``interval``, ``oldest``, ``stamp`` and ``variables``.

        A variable is a field, or has ``field`` and perhaps ``minus``, ``unit`` and ``offset``.

        Examples
        --------
        >>> topics = Topics.of({"variables": {"v": {"field": "/odom.speed", "unit": "kn"}}})
        >>> topics.variables["v"].factor
        0.5144444444444445
        """
        _refuse_unknown("it", given, "interval", "oldest", "stamp", "variables")
        stamp = given.get("stamp", "received")
        if stamp not in ("received", "header"):
            raise ValueError(f"stamp is {stamp!r}; it must be received or header")
        variables = given.get("variables")
        if not (isinstance(variables, Mapping) and variables):
            raise ValueError("it names no variables; write [variables.gap] and field = ...")
        interval = float(given.get("interval", cls.interval))
        if not _SHORTEST <= interval < math.inf:
            raise ValueError(f"interval is {interval}; it must be at least {_SHORTEST:g} s")
        return cls(
            {name: Variable.of(name, one) for name, one in variables.items()},
            interval,
            positive("oldest", float(given.get("oldest", cls.oldest))),
            stamp,
        )


def _refuse_unknown(what: str, given: Mapping[str, Any], *known: str) -> None:
    if unknown := sorted(set(given) - set(known)):
        raise ValueError(f"{what} says {unknown[0]!r}; known are {', '.join(known)}")


class BagTable(Table):
    """A bag as a table with a row for each tick of one clock.

    Its columns are ``time`` [s], from the bag's first message on, and the variables; where
    ``v_follower`` is one of them and ``a_follower`` is not, also the change of the former to the
    next row.
    """

    def __init__(self, path: str, topics: Topics, on_read: OnRead) -> None:
        self.path = path
        self._topics = topics
        self._on_read = on_read
        self.columns = ["time", *topics.variables]
        self._speed = 0  # place of the speed from which the action is derived
        if "v_follower" in topics.variables and ACTION not in topics.variables:
            self._speed = self.columns.index("v_follower")
            self.columns.append(ACTION)

    def pieces(self, wanted: Wanted) -> Iterator[Piece]:
        """All columns, whichever are wanted, some thousand rows at once."""
        if wanted.texts:
            raise ValueError(
                f"{self.path}: of a bag numbers are read, and {wanted.texts[0]!r} is to be a text "
                f"(of a truth value, which is 0 or 1, write --failed '{wanted.texts[0]}>0')"
            )
        rows, before = self._with_action(self._rows()), 0
        while some := list(islice(rows, _ROWS_AT_ONCE)):
            numbers = dict(zip(self.columns, np.array(some).T, strict=True))
            begins = np.zeros(int(before == 0), np.int64)
            piece = Piece.of_numbers(self.path, before, numbers, begins)
            for name in wanted.numbers:
                if name in self._topics.variables and name not in wanted.gaps:
                    piece.refuse_unusable(name)
            yield piece
            before += len(some)
        if not before:
            raise ValueError(
                f"{self.path}: at no time are all variables known, none older than "
                f"{self._topics.oldest:g} s (oldest in the file of --topics)"
            )

    def _with_action(self, rows: Iterable[list[float]]) -> Iterator[list[float]]:
        interval = self._topics.interval
        for row, after in pairwise(chain(rows, [[math.nan] * len(self.columns)])):
            if self._speed:
                follows = math.isclose(after[0] - row[0], interval, rel_tol=1e-6)
                change = after[self._speed] - row[self._speed]
                row.append(change / interval if follows else math.nan)
            yield row

    def _rows(self) -> Iterator[list[float]]:
        """Time and variables of each tick in which all are known."""
        topics = self._topics
        interval, oldest = (round(x * _NANOSECONDS) for x in (topics.interval, topics.oldest))
        fields = {f for v in topics.variables.values() for f in (v.field, v.minus) if f}
        of_topic = {
            topic: [one for one in fields if one.topic == topic]
            for topic in {one.topic for one in fields}
        }
        values: dict[Field, float] = {}
        since: dict[str, int] = {}
        first = tick = stamp = 0

        def row() -> list[float] | None:
            if len(since) < len(of_topic) or tick - min(since.values()) > oldest:
                return None
            return [(tick - first) / _NANOSECONDS] + [
                v.factor * (values[v.field] - (values[v.minus] if v.minus else 0.0)) + v.offset
                for v in topics.variables.values()
            ]

        with _explained(self.path):
            for stamp, topic, message in self._messages(set(of_topic)):
                if not since:
                    first = tick = stamp
                while tick < stamp and (known := row()):
                    yield known
                    tick += interval
                if tick < stamp:  # what is too old, or lacking, is so up to this message
                    tick += -((tick - stamp) // interval) * interval
                for field in of_topic[topic]:
                    values[field] = field.read(message)
                since[topic] = stamp
            if tick == stamp and (known := row()):
                yield known

    def _messages(self, wanted: set[str]) -> Iterator[tuple[int, str, Any]]:
        """When each message of a topic that is wanted was, its topic, and the message."""
        with needs("rosbags", "ros", f"{self.path}: a bag of ROS 2"):
            from rosbags.highlevel import AnyReader
            from rosbags.typesys import Stores, get_typestore
        usual = get_typestore(Stores.LATEST)
        with AnyReader([Path(self.path)], default_typestore=usual) as reader:
            there = sorted({one.topic for one in reader.connections})
            if lacking := sorted(wanted - set(there)):
                raise _BagError(f"it has no topic {lacking[0]!r}; it has {', '.join(there)}")
            found = self._decoded(reader, wanted)
            yield from _in_order(found) if self._topics.stamp == "header" else found

    def _decoded(self, reader: Any, wanted: set[str]) -> Iterator[tuple[int, str, Any]]:
        connections = [one for one in reader.connections if one.topic in wanted]
        for connection, stamp, data in reader.messages(connections=connections):
            self._on_read(len(data))
            message = reader.deserialize(data, connection.msgtype)
            if self._topics.stamp == "header":
                header = getattr(message, "header", None)
                if header is None:
                    raise _BagError(
                        f"messages of {connection.topic!r} ({connection.msgtype}) have no header; "
                        'write stamp = "received"'
                    )
                stamp = header.stamp.sec * _NANOSECONDS + header.stamp.nanosec
            yield stamp, connection.topic, message


def _in_order(messages: Iterable[tuple[int, str, Any]]) -> Iterator[tuple[int, str, Any]]:
    """The same in the order of their stamps, where none comes later than some hundred others."""
    waiting: list[tuple[int, int, str, Any]] = []
    for number, (stamp, topic, message) in enumerate(messages):
        heapq.heappush(waiting, (stamp, number, topic, message))
        if len(waiting) > _LATE:
            at, _, topic, message = heapq.heappop(waiting)
            yield at, topic, message
    for at, _, topic, message in sorted(waiting):
        yield at, topic, message


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
