"""MCAP, the log format of robotics: messages are read one by one, however large a file is."""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator
from dataclasses import replace
from typing import TYPE_CHECKING

from evofsm.extras import needs
from evofsm.io.tables import RefusedError, Skips, readable

if TYPE_CHECKING:
    from mcap.records import Channel, Chunk, McapRecord, Message, Schema


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


def _unpacked(path: str | os.PathLike[str], largest: int, skips: Skips) -> Iterator[McapRecord]:
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
