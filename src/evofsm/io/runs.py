"""Runs as MCAP, the log format of robotics: what their channels hold, and how they are read.

What was seen (``/observation``), where that is (``/belief``), how dangerous (``/risk``), and what
was done about it (``/decision``); ``/event``, and ``/log`` for Foxglove's log panel. The messages
are JSON with schemas that name every unit, those of ``/log`` Foxglove's own type. What is not
known is left out of a message: JSON has no NaN, and the schemas have one type for each field.
"""

from __future__ import annotations

import io
import json
import math
import os
import struct
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from operator import itemgetter
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from evofsm.driving.naming import DECISION_COLUMNS, VARIABLES, observed
from evofsm.extras import needs
from evofsm.fsm.model import FSMModel
from evofsm.guard.record import RECORD, Column
from evofsm.io.tables import RefusedError, Skips, readable

if TYPE_CHECKING:
    from mcap.records import Channel, Chunk, McapRecord, Message, Schema

#: The profile by which our files are known, and the record that says what was driven.
PROFILE = "evofsm"
#: The attachment that holds the model.
MODEL = "model.evofsm"
FORMAT = "1"
# Where there is no state.
_NO_STATE = -1
# No chunk is larger than this, unpacked [byte], and no episode's beliefs are more numbers.
_LARGEST_CHUNK, _MOST_BELIEFS = 1 << 24, 1 << 27


# -- Channels -------------------------------------------------------------------------------------


def columns_by_topic(names: Sequence[str] = VARIABLES) -> dict[str, tuple[str, ...]]:
    """The columns of decisions by channel; the channel of risks has them without ``risk_``."""
    of_cars, actions = tuple(names) == VARIABLES, ("proposed", "executed", "advised")
    risks = "risk_proposed", "risk_executed", "risk_low", "risk_high", "evidence", "seen"
    return {
        "/observation": ("time", *names, "intake"),
        "/belief": ("state", "belief", "surprise", "n_states"),
        "/risk": (*risks, *(("time_to_collision", "time_headway") if of_cars else ())),
        "/decision": (*actions, *(["realised"] if of_cars else []), "reason", "explanation"),
    }


def field_of(topic: str, name: str) -> str:
    """What a column is called in a channel."""
    return name.removeprefix("risk_") if topic == "/risk" else name


def columns_of(names: Sequence[str], units: Sequence[str] = ()) -> Mapping[str, Column]:
    """The columns of decisions by name, for cars or for variables of these names and units."""
    if tuple(names) == VARIABLES:
        return DECISION_COLUMNS
    suffixes = [f" [{unit}]" if unit else "" for unit in units] + [""] * len(names)
    return dict(RECORD) | {
        name: observed(f"as observed{unit}; left out where missing", itemgetter(k))
        for k, (name, unit) in enumerate(zip(names, suffixes, strict=False))
    }


def schemas_of(
    names: Sequence[str] = VARIABLES, units: Sequence[str] = ()
) -> dict[str, dict[str, Any]]:
    """The JSON schema of each channel, by its topic."""
    columns = columns_of(names, units)
    fields = {
        topic: {field_of(topic, name): _schema(columns.get(name)) for name in of_topic}
        for topic, of_topic in columns_by_topic(names).items()
    }
    fields["/event"] = {
        "kind": _of("string", "episode started, collision, rear-end collision, episode ended ..."),
        "episode": _of("integer", "number of the episode, from 0"),
        "time": _of("number", "since the start of the episode [s]"),
        **{name: _schema(columns[name]) for name in names},
    }
    return {
        topic: {"title": f"evofsm.{topic[1:].capitalize()}", "type": "object", "properties": of_it}
        for topic, of_it in fields.items()
    }


def _of(kind: str, about: str) -> dict[str, Any]:
    return {"type": kind, "description": about}


def _schema(column: Column | None) -> dict[str, Any]:
    if column is None:  # the belief, which is no number
        items = _of("number", "probability")
        return {**_of("array", "probability of each state, from 0"), "items": items}
    return _of({float: "number", int: "integer", str: "string"}[column.kind], column.about)


# -- Reading --------------------------------------------------------------------------------------


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


def read_run(path: str | os.PathLike[str]) -> Run:
    """Read a log that `recording` wrote, all of it checked.

    Parameters
    ----------
    path : str or path-like

    Returns
    -------
    Run
        ``about``, ``model`` and ``episodes``, whose ``columns`` hold everything that the drives'
        decisions held. What was left out is NaN, no state is -1, and states that there were not
        yet have belief 0.

    Raises
    ------
    OSError
        If there is no such file, or it may not be read.
    ValueError
        If it is no MCAP file, holds no run of evofsm, or is damaged; the message says which.
    """
    with readable(path, "a run in MCAP (damaged, cut off, or not written by evofsm?)"):
        return _run_of(_unpacked(path, _LARGEST_CHUNK))


def messages(
    path: str | os.PathLike[str], largest: int, skips: Skips
) -> Iterator[tuple[Schema | None, Channel, Message]]:
    """All messages of any MCAP file, in their order, with the schemas and channels before them.

    None of its chunks is larger than so [byte]; where it ends early, so do they.
    """
    with needs("mcap", "mcap", f"{os.fspath(path)}: MCAP"):
        from mcap.records import Channel, Message, Schema
    schemas, channels = dict[int, Schema](), dict[int, Channel]()
    with readable(path, "MCAP (damaged, cut off, or still being written?)"):
        for record in _unpacked(path, largest, skips):
            if isinstance(record, Schema):
                schemas[record.id] = record
            elif isinstance(record, Channel):
                channels[record.id] = record
            elif isinstance(record, Message):
                if (channel := channels.get(record.channel_id)) is None:
                    raise RefusedError(f"there is no channel {record.channel_id} of a message")
                yield schemas.get(channel.schema_id), channel, record


def _unpacked(
    path: str | os.PathLike[str], largest: int, skips: Skips | None = None
) -> Iterator[McapRecord]:
    with needs("mcap", "mcap", "reading MCAP"):
        from mcap.exceptions import EndOfFile, RecordLengthLimitExceeded
        from mcap.records import Chunk
        from mcap.stream_reader import StreamReader, breakup_chunk
    with open(path, "rb") as file:
        size = os.fstat(file.fileno()).st_size
        reader = StreamReader(file, emit_chunks=True, validate_crcs=True, record_size_limit=size)
        records = reader.records
        while True:
            try:
                record = next(records, None)
            except (EndOfFile, RecordLengthLimitExceeded, struct.error) as error:
                if skips is None:
                    raise
                why = f"it ends within a record, or is damaged there {error}".strip()
                skips.leave_out("cut", f"{os.fspath(path)}, byte {file.tell():,}: {why}")
                return
            if record is None:
                return
            if not isinstance(record, Chunk):
                yield record
                continue
            data = _unpacked_chunk(record, largest)
            if len(data) > largest:
                raise ValueError(f"a chunk unpacks to more than the {largest:,} bytes it may have")
            yield from breakup_chunk(replace(record, compression="", data=data), validate_crc=True)


def _unpacked_chunk(chunk: Chunk, largest: int) -> bytes:
    """What is in a chunk, or at least the beginning of what is too large."""
    from lz4.frame import LZ4FrameDecompressor
    from zstandard import ZstdDecompressor

    if chunk.compression == "zstd":
        unpacker = ZstdDecompressor(max_window_size=largest)
        return bytes(unpacker.stream_reader(chunk.data).read(largest + 1))
    if chunk.compression == "lz4":
        return bytes(LZ4FrameDecompressor().decompress(chunk.data, max_length=largest + 1))
    if chunk.compression:
        raise ValueError(f"its chunks are packed as {chunk.compression!r}, which is not known")
    return chunk.data


def _run_of(records: Iterable[McapRecord]) -> Run:
    from mcap.records import Attachment, Channel, Message, Metadata

    about: dict[str, str] | None = None
    model: FSMModel | None = None
    topics: dict[int, str] = {}
    episodes: list[RecordedEpisode] = []
    events: list[str] = []
    present: dict[str, list[dict[str, Any]]] = {}  # messages of the episode under way, by topic
    of_decisions = columns_by_topic()
    for record in records:
        if isinstance(record, Metadata) and record.name == PROFILE:
            about = dict(record.metadata)
            if (version := about.get("format")) != FORMAT:
                raise ValueError(f"its format is {version!r}, and this library reads {FORMAT!r}")
        elif isinstance(record, Attachment) and record.name == MODEL:
            model = FSMModel.load(io.BytesIO(record.data))
        elif isinstance(record, Channel):
            topics[record.id] = record.topic
        elif isinstance(record, Message):
            topic = topics[record.channel_id]
            if topic in of_decisions:
                if not present:
                    raise ValueError("a decision is outside of every episode")
                present[topic].append(json.loads(record.data))
            elif topic == "/event":
                event = json.loads(record.data)
                if (event["kind"] == "episode started") == bool(present):
                    raise ValueError("an episode has no end, or no beginning")
                if event["kind"] == "episode started":
                    present, events = {topic: [] for topic in of_decisions}, []
                elif event["kind"] == "episode ended":
                    episodes.append(_episode(present, events, event))
                    present = {}
                else:
                    events.append(event["kind"])
    if present:
        raise ValueError("it ends within an episode")
    if about is None:
        raise ValueError("it holds no run of evofsm")
    return Run(about, model, tuple(episodes))


def _episode(
    messages: Mapping[str, list[dict[str, Any]]], events: list[str], end: Mapping[str, Any]
) -> RecordedEpisode:
    counts = {topic: len(of_topic) for topic, of_topic in messages.items()}
    if len(set(counts.values())) != 1:
        raise ValueError(f"its channels hold different numbers of decisions: {counts}")
    columns = {
        name: _column(name, field_of(topic, name), messages[topic])
        for topic, names in columns_by_topic().items()
        for name in names
    }
    # Times that were left out are infinite where all that they follow from is known.
    is_known = np.isfinite([columns[name] for name in VARIABLES]).all(axis=0)
    for name in ("time_to_collision", "time_headway"):
        columns[name][np.isnan(columns[name]) & is_known] = math.inf
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
        return np.array([message.get(field, _NO_STATE) for message in messages], np.int64)
    return np.array([message.get(field, math.nan) for message in messages], np.float64)
