"""Bags of ROS 2 (sqlite3 and MCAP) as tables: which field of which topic is which variable.

Rows have one clock. A row holds the latest value of each variable (a zero-order hold); where one is
too old there is none, and the hole in time begins a new episode.
"""

from __future__ import annotations

import math
import re
import sqlite3
import tomllib
from array import array
from collections import Counter
from collections.abc import Collection, Container, Iterator, Mapping, Sequence
from contextlib import closing
from functools import partial
from itertools import chain
from os import PathLike
from pathlib import Path
from shutil import copyfile
from tempfile import TemporaryDirectory
from typing import Annotated, Any, Literal, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from evofsm.extras import needs
from evofsm.fsm.naming import in_a_line
from evofsm.guard.foresight import span
from evofsm.io import tables
from evofsm.io.tables import UNITS, Piece, RefusedError, Skips, Table, Wanted, in_row, readable
from evofsm.io.vehicles import ACTION

with needs("msgspec", "ros", "a bag of ROS 2"):
    import msgspec
    from msgspec import Meta

_NANOSECONDS = 1_000_000_000
_MCAP = b"\x89MCAP0\r\n"
_ZSTD = b"\x28\xb5\x2f\xfd"  # how what is compressed begins; no message in CDR does
_STEP = re.compile(r"([A-Za-z_]\w*)((?:\[[^\]]+\])*)(?:\.(?=.)|$)")
# What the elements of an array are called by, where they have such a field.
_CALLED = ("name", "child_frame_id", "key")
_MOST_BYTES = 1 << 30  # of a chunk, unpacked
# Spans of two clocks differ where they do by such a share, and by such a time [s].
_SHARE, _SPAN = 0.05, 0.5


# When there were messages with a field [ns], in order, and what stood there.
_Values = tuple[NDArray[np.int64], NDArray[np.float64]]


class Field(NamedTuple):
    """A number in the messages of a topic."""

    text: str
    topic: str
    #: Names of fields, and in brackets places in arrays, from 0, or names of what is in them.
    steps: tuple[str | tuple[int | str], ...]

    @classmethod
    def parse(cls, text: str) -> Self:
        """A topic, and behind its first dot the way to the number: ``/scan.ranges[3]``."""
        topic, _, way = text.partition(".")
        steps: list[str | tuple[int | str]] = []
        while step := _STEP.match(way):
            places = re.findall(r"\[([^\]]+)\]", step[2])
            steps += [step[1], *((int(p) if p.isdecimal() else p,) for p in places)]
            way = way[step.end() :]
        if way or not (steps and topic):
            ways = "/topic.field, /topic.field.field, /topic.field[0].field"
            hint = f"{ways} or, of what has a name in the message, /topic.field[name]"
            raise ValueError(f"{text!r} is no field; write {hint}")
        return cls(text, topic, tuple(steps))

    def read(self, message: Any, called: dict[int, str], count: int = 1) -> float | None:
        """The number in a message; NaN behind the end of an array, None where no name is its own.

        What stands in a place the first time is known by its name from then on, if it has one.
        """
        owner, value = None, message
        try:
            for number, step in enumerate(self.steps):
                if isinstance(step, str):
                    owner, value = value, getattr(value, step)
                    continue
                place, names = step[0], _names_in(owner, value)
                if isinstance(place, int) and number not in called and place < len(names):
                    called[number] = names[place]
                if isinstance(name := called.get(number, place), str):
                    if name not in names:
                        return None
                    place = names.index(name)
                if int(place) >= len(value):
                    return math.nan
                owner, value = None, value[place]
            return float(value)
        except (AttributeError, TypeError, ValueError) as error:
            where = f"message {count} of {self.topic!r}"
            raise RefusedError(f"{self.text} is no number in {where}: {error}") from None


def _names_in(owner: Any, array: Any) -> list[str]:
    """What the elements of an array are called, in it or in an array beside it; or nothing."""
    for beside in vars(owner).values() if owner is not None else ():
        is_names = isinstance(beside, list) and bool(beside) and isinstance(beside[0], str)
        if is_names and len(beside) == len(array):
            return list(beside)
    for field in _CALLED:
        if len(array) and hasattr(array[0], field):
            return [str(getattr(item, field)) for item in array]
    return []


class Variable(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Where a variable comes from: a field, less another one, in a unit, plus an offset."""

    field: str
    minus: str | None = None
    unit: str | None = None
    offset: Annotated[float, Meta(ge=-1e9, le=1e9)] = 0.0  #: in units of the SI

    def __post_init__(self) -> None:
        for text in self.fields:
            Field.parse(text)
        if self.unit is not None and self.unit not in UNITS:
            raise ValueError(f"unit is {self.unit!r}; known are {', '.join(UNITS)}")

    @property
    def fields(self) -> list[str]:
        """Those that it is made of."""
        return [self.field] if self.minus is None else [self.field, self.minus]


class Topics(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
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

    variables: Annotated[dict[str, Variable], Meta(min_length=1)]
    interval: Annotated[float, Meta(ge=1e-6, le=1e6)] = 0.1
    oldest: Annotated[float, Meta(gt=0.0, le=1e6)] = 0.5
    stamp: Literal["received", "header"] = "received"

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
            return cls.of(tomllib.loads(Path(path).read_text(encoding="utf-8-sig")))
        except ValueError as error:  # that of TOML is one
            raise ValueError(f"{path}: {error}") from error

    @classmethod
    def of(cls, given: Mapping[str, Any]) -> Self:
        """From a mapping of ``interval``, ``oldest``, ``stamp`` and ``variables``.

        A variable is a field, or has ``field`` and perhaps ``minus``, ``unit`` and ``offset``.

        Examples
        --------
        >>> topics = Topics.of({"variables": {"v": "/odom.speed"}})
        >>> topics.variables["v"].field, topics.interval
        ('/odom.speed', 0.1)
        """
        contents, entries, where = given, given.get("variables"), ""
        try:
            if isinstance(entries, Mapping):
                variables: dict[str, Variable] = {}
                for name, value in entries.items():
                    where = f"variable {name}: "
                    attributes = {"field": value} if isinstance(value, str) else value
                    variables[name] = msgspec.convert(attributes, Variable)
                contents, where = {**given, "variables": variables}, ""
            return msgspec.convert(contents, cls)
        except msgspec.ValidationError as error:
            raise ValueError(f"{where}{error}") from None


class BagTable(Table):
    """A bag as a table: ``time`` [s] from its first message on, and the variables at each tick.

    Those that are not ``observed``, such as the action and what tells of failures, are those of
    half a step later: who answers what was seen does so after it, and for the step to come.
    Where the action is not mapped it is the change of ``v_follower`` to the next row.
    """

    def __init__(self, path: str, topics: Topics, observed: Container[str], skips: Skips) -> None:
        self.path, self.skips, self._topics, self._observed = path, skips, topics, observed
        self.derives = "v_follower" in topics.variables and ACTION not in topics.variables
        self.columns = ["time", *topics.variables, *([ACTION] if self.derives else [])]

    def pieces(self, wanted: Wanted) -> Iterator[Piece]:
        """All columns, whichever are wanted, as one piece."""
        if wanted.texts:
            raise ValueError(
                f"{self.path}: of a bag numbers are read, and {wanted.texts[0]!r} is to be a text "
                f"(of a truth value, which is 0 or 1, write --failed '{wanted.texts[0]}>0')"
            )
        with readable(self.path, "a bag of ROS 2 (damaged, cut off, or still being recorded?)"):
            numbers = self._held(self._messages())
        if not len(numbers["time"]):
            age = f"none older than {self._topics.oldest:g} s (oldest in the file of --topics)"
            raise ValueError(f"{self.path}: at no time are all variables known, {age}")
        find = partial(in_row, self.path, numbers, 0)
        yield Piece(len(numbers["time"]), numbers, find, self.skips, starts=[0])

    def _held(self, found: Mapping[str, _Values]) -> dict[str, NDArray[np.float64]]:
        """Of each tick in which all are known, the latest values before it."""
        topics = self._topics
        interval, oldest = (round(x * _NANOSECONDS) for x in (topics.interval, topics.oldest))
        stamps = np.sort(np.concatenate([stamps for stamps, _ in found.values()]))
        # Ticks while anything was heard of lately: clocks may jump by years.
        ends = np.append(np.flatnonzero(np.diff(stamps) > oldest + interval), len(stamps) - 1)
        begins = np.append(0, ends[:-1] + 1)
        first = -((stamps[0] - stamps[begins]) // interval)
        after = (stamps[ends] + oldest - stamps[0]) // interval + 1
        ticks = np.concatenate([*map(np.arange, first, after)])
        # The last one is the first after all: the failure may be the last that was recorded.
        at = stamps[0] + interval * ticks[(ticks - 1) * interval < stamps[-1] - stamps[0]]
        columns: dict[str, NDArray[np.float64]] = {}
        is_known = np.ones(len(at), np.bool_)
        for name, variable in topics.variables.items():
            when, values = at if name in self._observed else at + interval // 2, []
            for of_field, numbers in (found[field] for field in variable.fields):
                latest = np.searchsorted(of_field, when, side="right") - 1
                is_known &= (latest >= 0) & (when - of_field[latest] <= oldest)
                values.append(numbers[latest])
            factor = 1.0 if variable.unit is None else UNITS[variable.unit]
            columns[name] = factor * (values[0] - sum(values[1:])) + variable.offset
        rows = {"time": (at - stamps[0]) / _NANOSECONDS, **columns}
        rows = {name: column[is_known] for name, column in rows.items()}
        if self.derives:
            action = np.diff(rows["v_follower"], append=np.nan) / topics.interval
            follows = np.diff(at[is_known], append=0) == interval
            rows[ACTION] = np.where(follows, action, np.nan)
        return rows

    def _messages(self) -> dict[str, _Values]:
        """Of each field, when there were messages with it, and what stood there."""
        with needs("rosbags", "ros", f"{self.path}: a bag of ROS 2"):
            import zstandard  # of rosbags
            from rosbags.typesys.store import Typestore
        texts = {text for variable in self._topics.variables.values() for text in variable.fields}
        fields = [*map(Field.parse, texts)]
        topics = {field.topic for field in fields}
        values = {field.text: (array("q"), array("d"), dict[int, str]()) for field in fields}
        stores: dict[_Type, Typestore] = {}
        spans: dict[str, list[int]] = {}  # as recorded from and to, and by headers [ns]
        there, counts = set[str](), Counter[str]()
        for topic, kind, stamp, data in chain.from_iterable(
            (self._of_mcap if is_mcap else _of_sqlite)(file, topics, there)
            for file, is_mcap in _files(Path(self.path))
        ):
            self.skips.on_read(len(data))
            counts[topic] += 1
            if data.startswith(_ZSTD):  # as only the folder's metadata.yaml would say
                data = zstandard.decompress(data)
            if kind not in stores:
                stores[kind] = kind.store(topic)
            message = stores[kind].deserialize_cdr(data, kind.name)
            if hasattr(message, "header"):
                at = message.header.stamp.sec * _NANOSECONDS + message.header.stamp.nanosec
                first, last, begin, end = spans.get(topic, (stamp, stamp, at, at))
                spans[topic] = [min(first, stamp), max(last, stamp), min(begin, at), max(end, at)]
                stamp = at if self._topics.stamp == "header" else stamp
            elif self._topics.stamp == "header":
                fault = f"messages of {topic!r} ({kind.name}) have no header"
                raise RefusedError(f'{fault}; write stamp = "received"')
            for field in fields:
                if field.topic == topic:
                    stamps, numbers, names = values[field.text]
                    number = field.read(message, names, counts[topic])
                    if number is not None:
                        stamps.append(stamp)
                        numbers.append(number)
        if lack := sorted(topics - there):
            cut, has = self.skips.first.get("cut"), ", ".join(sorted(there)) or "no message"
            begins = f"{cut}; before that" if cut else f"{self.path}:"
            raise ValueError(f"{begins} it has no topic {lack[0]!r}; it has {in_a_line(has)}")
        if self._topics.stamp == "received":
            self._compare(spans)
        series: dict[str, _Values] = {}
        for text, (stamps, numbers, _) in values.items():
            if not len(stamps):
                topic = text.partition(".")[0]
                lacks = f"messages with {text}" if counts[topic] else "messages"
                raise RefusedError(f"its topic {topic!r} has no {lacks}")
            order = np.argsort(np.array(stamps), kind="stable")
            series[text] = np.array(stamps)[order], np.array(numbers)[order]
        return series

    def _compare(self, spans: Mapping[str, Sequence[int]]) -> None:
        """Say where messages are recorded at another rate than the one of their headers."""
        for topic, (first, last, begin, end) in spans.items():
            bag_span, own_span = (last - first) / _NANOSECONDS, (end - begin) / _NANOSECONDS
            if own_span and abs(own_span - bag_span) > max(_SPAN, _SHARE * bag_span):
                self.skips.told.append(
                    f"{self.path}: messages of {topic} span {span(own_span)} by their headers, and "
                    f"{span(bag_span)} as recorded, by which times are (played, or simulated, at "
                    'another speed?): stamp = "header" in the file of --topics goes by the headers'
                )
                return

    def _of_mcap(self, file: Path, wanted: Collection[str], there: set[str]) -> _Messages:
        for schema, channel, message in tables.mcap_messages(file, _MOST_BYTES, self.skips):
            there.add(channel.topic)
            if channel.topic in wanted:
                parts = (schema.name, schema.encoding, schema.data) if schema else ("", "", b"")
                kind = _Type(parts[0], channel.message_encoding, parts[1], parts[2].decode())
                yield channel.topic, kind, message.log_time, message.data


# -- Files of a bag -------------------------------------------------------------------------------
# Read here and not by rosbags, which has to understand the types of all topics before it reads one.


class _Type(NamedTuple):
    """Of the messages of a topic, as the bag defines it."""

    name: str
    packed: str  #: how messages are
    language: str  #: of the definition
    definition: str

    def store(self, topic: str) -> Any:
        from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore

        if self.packed != "cdr":
            raise RefusedError(f"messages of {topic!r} are packed as {self.packed}, not as CDR")
        if not self.name:
            raise RefusedError(f"messages of {topic!r} have no schema to say what they hold")
        if not self.definition:
            return get_typestore(Stores.LATEST)
        store = get_typestore(Stores.EMPTY)
        if self.language == "ros2msg":
            store.register(get_types_from_msg(self.definition, self.name))
            return store
        parts = self.definition.split("=" * 80 + "\n")
        for part in parts[1:] if len(parts) > 1 else parts:
            store.register(get_types_from_idl(re.sub(r"\AIDL: .*\n", "", part)))
        return store


_Messages = Iterator[tuple[str, _Type, int, bytes]]


def _files(path: Path) -> Iterator[tuple[Path, bool]]:
    """Those of a bag, unpacked where it is compressed as a whole, and whether each is MCAP."""
    files = [path]
    if path.is_dir():
        from ruamel.yaml import YAML

        about = YAML(typ="safe").load(path / "metadata.yaml")["rosbag2_bagfile_information"]
        files = [path / Path(name).name for name in about["relative_file_paths"]]
    with TemporaryDirectory() as folder:
        for file in files:
            if file.suffix == ".zstd":
                import zstandard

                target = Path(folder) / file.stem
                with file.open("rb") as source, target.open("wb") as out:
                    zstandard.ZstdDecompressor().copy_stream(source, out)
                file = target
            if (log := _log_of(file)) and not Path(f"{file}-shm").exists():
                # No recorder runs; SQLite would write an index beside the file, if it may.
                copyfile(log, Path(folder) / log.name)
                file = Path(copyfile(file, Path(folder) / file.name))
            with file.open("rb") as stream:
                yield file, stream.read(len(_MCAP)) == _MCAP


def _log_of(file: Path) -> Path | None:
    """What SQLite wrote last, and left beside its file, if it did."""
    log = Path(f"{file}-wal")
    return log if log.is_file() and log.stat().st_size else None


def _of_sqlite(file: Path, wanted: Collection[str], there: set[str]) -> _Messages:
    how = "mode=ro" if _log_of(file) else "immutable=1"  # which has no log
    with closing(sqlite3.connect(f"{file.absolute().as_uri()}?{how}", uri=True)) as bag:
        rows = bag.execute("SELECT id, name, type, serialization_format FROM topics").fetchall()
        there |= {topic for _, topic, *_ in rows}
        definitions: dict[str, list[str]] = {}
        if bag.execute("SELECT 1 FROM sqlite_master WHERE name = 'message_definitions'").fetchone():
            columns = "topic_type, encoding, encoded_message_definition FROM message_definitions"
            definitions = {name: fields for name, *fields in bag.execute(f"SELECT {columns}")}
        for number, topic, name, encoding in rows:
            if topic in wanted:
                kind = _Type(name, encoding, *definitions.get(name, ("", "")))
                query = "SELECT timestamp, data FROM messages WHERE topic_id = ? ORDER BY timestamp"
                for stamp, data in bag.execute(query, (number,)):
                    yield topic, kind, stamp, data
