"""Runs as MCAP, the log format of robotics, which Foxglove opens: a channel for each question.

What was seen (``/observation``), where that is (``/belief``), how dangerous (``/risk``), and what
was done about it (``/decision``); beside them ``/event``, and ``/log`` for Foxglove's log panel.
The messages are JSON with schemas that name every unit. Episodes follow each other on one axis of
time.

What is not known is left out of a message: JSON has no NaN, and the schemas that Foxglove takes
have one type for each field, so no null.
"""

from __future__ import annotations

import io
import json
import math
import os
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from evofsm import __version__
from evofsm.driving import DECISION_COLUMNS, VARIABLES, Episode
from evofsm.extras import needs
from evofsm.fsm import FSMModel
from evofsm.io.channels import (
    ERROR,
    INFO,
    OF_DECISIONS,
    WARNING,
    encoded,
    field_of,
    is_same,
    log_message,
    messages_of,
    said,
    schemas_of,
)
from evofsm.store import storage

with needs("mcap", "mcap", "reading and writing MCAP"):
    from lz4.frame import LZ4FrameDecompressor
    from mcap.records import Attachment, Channel, Chunk, McapRecord, Message, Metadata
    from mcap.stream_reader import StreamReader, breakup_chunk
    from mcap.writer import Writer
    from zstandard import ZstdDecompressor

#: The attachment that holds the model, and the record that says what was driven.
MODEL, METADATA = "model.evofsm", "evofsm"
_FORMAT = "1"
# Time from the end of an episode to the start of the next [ns].
_PAUSE = 1_000_000_000
_SCHEMAS = schemas_of()
# Where there is no state.
_NONE = -1
# No chunk is larger than this, unpacked, nor all of them together than so many times the file and
# one chunk more [bytes]; and no episode's beliefs are more numbers than the last.
_LARGEST_CHUNK, _DENSEST, _MOST_BELIEFS = 1 << 24, 1000, 1 << 27


@dataclass(frozen=True, eq=False)
class RecordedEpisode:
    """An episode as a log holds it: D decisions over n states."""

    #: By name, a row for each decision: ``time`` [s], ``gap`` [m], ``v_follower``, ``v_leader``
    #: [m/s], ``intake``, ``state`` (-1 for none), ``belief`` (D, n), ``surprise`` [bit],
    #: ``n_states``, ``risk_proposed``, ``risk_executed``, ``risk_low``, ``risk_high``,
    #: ``evidence``, ``seen`` [s], ``time_to_collision``, ``time_headway`` [s], ``proposed``,
    #: ``executed``, ``advised``, ``realised`` [m/s²], ``reason``, ``explanation``.
    columns: Mapping[str, NDArray[Any]]
    collided: bool  #: with the leader
    rear_ended: bool  #: by the car behind
    end_time: float  #: [s]
    end: NDArray[np.float64]  #: (3,) gap [m], v_follower, v_leader [m/s] at the end


@dataclass(frozen=True, eq=False)
class Run:
    """What a log holds."""

    about: Mapping[str, str]  #: what was driven, by whom, with which library
    model: FSMModel | None  #: as it was after the last episode
    episodes: tuple[RecordedEpisode, ...]


# -- Writing --------------------------------------------------------------------------------------


def write_run(
    path: str | os.PathLike[str],
    drives: Iterable[Episode],
    *,
    model: FSMModel | None = None,
    about: Mapping[str, Any] | None = None,
) -> None:
    """Write drives as a log, one after the other; the file appears once it is whole.

    Parameters
    ----------
    path : str or path-like
        A file of that name is replaced.
    drives : iterable of Episode
        Taken one by one, so they need not all be kept at once.
    model : FSMModel, optional
        What was learnt, to be attached.
    about : mapping, optional
        What was driven: family, controller, reviser and so on. What is no text becomes JSON.

    Raises
    ------
    OSError
        If it cannot be written; what was there before is then as it was.

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> from evofsm.driving import drive, load_family, unrevised_guard
    >>> family = load_family("emergency")
    >>> driven = drive(unrevised_guard(family), family.draw(seed=0, index=0))
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_run(Path(folder) / "run.mcap", [driven], about={"controller": "hasty"})
    ...     run = read_run(Path(folder) / "run.mcap")
    >>> run.about["controller"], run.episodes[0].collided
    ('hasty', True)
    >>> bool((run.episodes[0].columns["executed"] == driven.executed).all())
    True
    """
    with recording(path, about) as log:
        for drive in drives:
            log.add(drive)
        if model is not None:
            log.attach(model)


@contextmanager
def recording(
    path: str | os.PathLike[str], about: Mapping[str, Any] | None = None
) -> Iterator[RunWriter]:
    """A log that grows episode by episode; the file appears at the end, if all went well.

    Parameters
    ----------
    path, about
        As in `write_run`.

    Yields
    ------
    RunWriter

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     with recording(Path(folder) / "run.mcap", {"family": "emergency"}) as log:
    ...         pass  # log.add(drive), and log.attach(model) at the end
    ...     read_run(Path(folder) / "run.mcap").about["family"]
    'emergency'
    """
    with storage.replacing(path) as file:
        log = RunWriter(file, about or {})
        yield log
        log.finish()


class RunWriter:
    """Writes episode after episode; `recording` opens one. It keeps only part of an episode.

    Parameters
    ----------
    file : binary file
        Open for writing.
    about : mapping
        As in `write_run`.
    """

    def __init__(self, file: BinaryIO, about: Mapping[str, Any]) -> None:
        self._episodes = 0
        self._begin = 0  # of the episode, on the axis of time [ns]
        self._mcap = Writer(file, enable_data_crcs=True)
        self._mcap.start(profile="", library=f"evofsm {__version__}")
        self._channels = {topic: self._channel(topic) for topic in _SCHEMAS}
        told = {"library": f"evofsm {__version__}", **about, "format": _FORMAT}
        self._mcap.add_metadata(METADATA, {name: _text(value) for name, value in told.items()})

    def _channel(self, topic: str) -> int:
        schema = _SCHEMAS[topic]
        name = schema["title"]
        number = self._mcap.register_schema(name, "jsonschema", json.dumps(schema).encode())
        return self._mcap.register_channel(topic, "json", number)

    def add(self, episode: Episode) -> None:
        """Write the next episode.

        Parameters
        ----------
        episode : Episode
            With its decisions.
        """
        start, end = float(episode.time[0]), float(episode.time[-1])
        self._event("episode started", start, episode.observations[0])
        for number, (decision, changed) in enumerate(
            zip(episode.decisions, episode.changed.tolist(), strict=True)
        ):
            time = decision.situation.time
            for topic, message in messages_of(decision):
                self._send(topic, time, message, number)
            revision = decision.revision
            if changed or not is_same(revision.advised, revision.executed):
                self._log(WARNING if changed else INFO, time, said(revision))
        for happened, kind in (
            (episode.collided, "collision"),
            (episode.rear_ended, "rear-end collision"),
        ):
            if happened:
                self._event(kind, end, episode.observations[-1])
                self._log(ERROR, end, kind)
        self._event("episode ended", end, episode.observations[-1])
        self._begin += _nanoseconds(end) + _PAUSE
        self._episodes += 1

    def attach(self, model: FSMModel) -> None:
        """Attach what was learnt.

        Parameters
        ----------
        model : FSMModel
        """
        file = io.BytesIO()
        model.save(file)
        self._mcap.add_attachment(0, self._begin, MODEL, "application/zip", file.getvalue())

    def finish(self) -> None:
        """Write the index, which ends the log."""
        self._mcap.finish()  # type: ignore[no-untyped-call]

    def _event(self, kind: str, time: float, observation: NDArray[np.float64]) -> None:
        where = dict(zip(VARIABLES, observation.tolist(), strict=True))
        about = {"kind": kind, "episode": self._episodes, "time": time, **where}
        self._send("/event", time, about, 0)

    def _log(self, level: int, time: float, message: str) -> None:
        self._send("/log", time, log_message(level, self._begin + _nanoseconds(time), message), 0)

    def _send(self, topic: str, time: float, message: Mapping[str, Any], number: int) -> None:
        at = self._begin + _nanoseconds(time)
        self._mcap.add_message(self._channels[topic], at, encoded(message), at, number)


def _text(value: Any) -> str:
    return value if isinstance(value, str) else json.dumps(value, ensure_ascii=False)


def _nanoseconds(seconds: float) -> int:
    return round(seconds * 1e9)


# -- Reading --------------------------------------------------------------------------------------


def read_run(path: str | os.PathLike[str]) -> Run:
    """Read a log that `write_run` or `RunWriter` wrote, all of it checked.

    Parameters
    ----------
    path : str or path-like

    Returns
    -------
    Run
        Everything the drives' decisions held. What was left out is NaN, no state is -1, and states
        that there were not yet have belief 0.

    Raises
    ------
    OSError
        If there is no such file, or it may not be read.
    ValueError
        If it is no MCAP file, holds no run of evofsm, or is damaged; the message says which.

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_run(Path(folder) / "run.mcap", [], about={"seed": 3})
    ...     read_run(Path(folder) / "run.mcap").about["seed"]
    '3'
    """
    with _explained(path, "a run in MCAP (damaged, cut off, or not written by evofsm?)"):
        return _read(_unpacked(path, _LARGEST_CHUNK))


def records(path: str | os.PathLike[str], largest: int) -> Iterator[McapRecord]:
    """All records of any MCAP file, in their order, none of whose chunks is larger than so [byte].

    Raises
    ------
    OSError
        If there is no such file, or it may not be read.
    ValueError
        If it is damaged.
    """
    with _explained(path, "MCAP (damaged, cut off, or still being written?)"):
        yield from _unpacked(path, largest)


def _unpacked(path: str | os.PathLike[str], largest: int) -> Iterator[McapRecord]:
    """All records, those in chunks among them."""
    with open(path, "rb") as file:
        size = file.seek(0, os.SEEK_END)
        file.seek(0)
        reader = StreamReader(file, emit_chunks=True, validate_crcs=True, record_size_limit=size)
        yield from _unpacked_records(reader, size, largest)


def _unpacked_records(reader: StreamReader, size: int, largest: int) -> Iterator[McapRecord]:
    """The same of a file of so many bytes."""
    room = _DENSEST * size + largest
    for record in reader.records:
        if not isinstance(record, Chunk):
            yield record
            continue
        data = _unpacked_chunk(record, largest)
        room -= len(data)
        if len(data) > largest or room < 0:
            raise ValueError(f"it unpacks to more than was ever packed in {size:,} bytes")
        yield from breakup_chunk(replace(record, compression="", data=data), validate_crc=True)


def _unpacked_chunk(chunk: Chunk, largest: int) -> bytes:
    """What is in a chunk, or at least the beginning of what is too large."""
    most = largest + 1
    if chunk.compression == "zstd":
        unpacker = ZstdDecompressor(max_window_size=largest)
        with unpacker.stream_reader(chunk.data) as stream:
            return bytes(stream.read(most))
    if chunk.compression == "lz4":
        return bytes(LZ4FrameDecompressor().decompress(chunk.data, max_length=most))
    if chunk.compression:
        raise ValueError(f"its chunks are packed as {chunk.compression!r}, which is not known")
    return chunk.data


def _read(records: Iterable[McapRecord]) -> Run:
    """The run, in one pass over all records."""
    about: dict[str, str] | None = None
    model: FSMModel | None = None
    topics: dict[int, str] = {}
    episodes = _Episodes()
    for record in records:
        if isinstance(record, Metadata) and record.name == METADATA:
            about = dict(record.metadata)
            _refuse_other_formats(about)
        elif isinstance(record, Attachment) and record.name == MODEL:
            model = FSMModel.load(io.BytesIO(record.data))
        elif isinstance(record, Channel):
            topics[record.id] = record.topic
        elif isinstance(record, Message):
            if about is None and topics[record.channel_id] in _SCHEMAS:
                raise ValueError("its messages come before what it is about; was it rewritten?")
            episodes.take(topics[record.channel_id], record.data)
    if about is None:
        raise ValueError("it holds no run of evofsm")
    return Run(about, model, episodes.finished())


def _refuse_other_formats(about: Mapping[str, str]) -> None:
    if (version := about.get("format")) != _FORMAT:
        raise ValueError(f"its format is {version!r}, and this library reads {_FORMAT!r}")


class _Episodes:
    """Puts messages together to episodes."""

    def __init__(self) -> None:
        self._whole: list[RecordedEpisode] = []
        self._events: list[str] = []
        self._messages: dict[str, list[dict[str, Any]]] = {}  # of the one under way, by topic

    def take(self, topic: str, encoded: bytes) -> None:
        """The next message."""
        if topic in self._messages:
            self._messages[topic].append(json.loads(encoded))
        elif topic in OF_DECISIONS:
            raise ValueError("a decision is outside of every episode")
        elif topic == "/event":
            self._happened(json.loads(encoded))

    def _happened(self, event: Mapping[str, Any]) -> None:
        if (event["kind"] == "episode started") == bool(self._messages):
            raise ValueError("an episode has no end, or no beginning")
        if event["kind"] == "episode started":
            self._messages, self._events = {topic: [] for topic in OF_DECISIONS}, []
        elif event["kind"] == "episode ended":
            self._whole.append(_episode(self._messages, self._events, event))
            self._messages = {}
        else:
            self._events.append(event["kind"])

    def finished(self) -> tuple[RecordedEpisode, ...]:
        """All of them."""
        if self._messages:
            raise ValueError("it ends within an episode")
        return tuple(self._whole)


def _episode(
    messages: Mapping[str, list[dict[str, Any]]], events: list[str], end: Mapping[str, Any]
) -> RecordedEpisode:
    """An episode from its messages."""
    counts = {topic: len(of_topic) for topic, of_topic in messages.items()}
    if len(set(counts.values())) != 1:
        raise ValueError(f"its channels hold different numbers of decisions: {counts}")
    columns = {
        name: _column(name, field_of(topic, name), messages[topic])
        for topic, names in OF_DECISIONS.items()
        for name in names
    }
    _restore_infinities(columns)
    where = np.array([end[name] for name in VARIABLES], np.float64)
    for array in (where, *columns.values()):
        array.setflags(write=False)
    return RecordedEpisode(
        columns=columns,
        collided="collision" in events,
        rear_ended="rear-end collision" in events,
        end_time=float(end["time"]),
        end=where,
    )


def _column(name: str, field: str, messages: list[dict[str, Any]]) -> NDArray[Any]:
    """A field of all messages, in their order."""
    if name == "belief":
        rows = [message[field] for message in messages]
        longest = max(map(len, rows), default=0)
        if len(rows) * longest > _MOST_BELIEFS:
            raise ValueError(f"an episode of {len(rows):,} beliefs in {longest:,} states")
        beliefs = np.zeros((len(rows), longest))
        for row, belief in zip(beliefs, rows, strict=True):
            row[: len(belief)] = belief
        return beliefs
    kind = DECISION_COLUMNS[name].kind
    if kind is str:
        return np.array([str(message[field]) for message in messages], dtype=object)
    if kind is int:
        return np.array([message.get(field, _NONE) for message in messages], np.int64)
    return np.array([message.get(field, math.nan) for message in messages], np.float64)


def _restore_infinities(columns: dict[str, NDArray[Any]]) -> None:
    """Times that were left out are infinite where all that they follow from is known."""
    seen = np.isfinite([columns[name] for name in VARIABLES]).all(axis=0)
    for name in ("time_to_collision", "time_headway"):
        columns[name][np.isnan(columns[name]) & seen] = math.inf


@contextmanager
def _explained(path: str | os.PathLike[str], kind: str) -> Iterator[None]:
    """Turn whatever reading a damaged file runs into into one error that names the file."""
    try:
        yield
    except OSError:
        raise
    except Exception as error:  # of the MCAP reader, of what unpacks for it, or ours
        why = str(error)[:300] or type(error).__name__
        raise ValueError(f"{os.fspath(path)} cannot be read as {kind}: {why}") from error
