"""Tables in CSV and Parquet, read piece by piece; messages of MCAP; what kind a file is of."""

from __future__ import annotations

import csv
import gzip
import io
import os
import re
import struct
import zlib
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime, timedelta
from functools import cached_property, partial
from itertools import chain, zip_longest
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, NoReturn

import numpy as np
from numpy.typing import NDArray

from evofsm.extras import needs
from evofsm.guard.foresight import DATES
from evofsm.store import LARGEST_OBSERVATION

if TYPE_CHECKING:
    import polars
    from mcap.records import Channel, Chunk, McapRecord, Message, Schema

Numbers = dict[str, NDArray[np.float64]]
Kind = Literal["csv", "parquet", "xml", "osi", "mcap", "bag"]
OnRead = Callable[[int], object]  #: called with the number of bytes each time some were read
Find = Callable[[int], tuple[str, Mapping[str, Any]]]  #: place of a row, and what it holds

# Read at once. polars decodes a whole row group for each slice of it: small slices cost time.
_CSV_BYTES, _PARQUET_ROWS = 1 << 21, 1 << 16
_LONGEST_LINE = 1_000_000
_PLAIN: Mapping[str, Any] = {"has_header": False, "ignore_errors": True, "raise_if_empty": False}

_BYTE_ORDER_MARK, _GZIP, _PARQUET = b"\xef\xbb\xbf", b"\x1f\x8b", b"PAR1"
_SQLITE, _MCAP = b"SQLite format 3\0", b"\x89MCAP0\r\n"
_CONTROL = re.compile(rb"[\0-\x08\x0e-\x1f]")  # what no text holds
# A column may be called as a mark of letters alone; binary data goes on behind that.
_BINARY = rb"(?s:.*" + _CONTROL.pattern + rb")"
# How files begin that others hand around and we do not read: what they are, and the way out.
_FOREIGN = {
    rb"\xfd7zXZ\0": "is compressed by xz; unpack it: xz --decompress --keep FILE",
    rb"\x5d\0\0": "is compressed by lzma; unpack it: xz --format=lzma --decompress --keep FILE",
    rb"BZh" + _BINARY: "is compressed by bzip2; unpack it: bzip2 --decompress --keep FILE",
    rb"\x28\xb5\x2f\xfd": "is compressed by zstd; unpack it: zstd --decompress FILE",
    rb"PK\x03\x04": "is a zip archive, or an Excel workbook (.xlsx); unpack it, or save it as CSV",
    rb"\xd0\xcf\x11\xe0": "is an Excel workbook of the old kind (.xls); save it as CSV",
    rb"MATLAB " + _BINARY: "is a MAT-file of MATLAB; write it as CSV there: writetable",
    rb"\x89HDF": "is HDF5 (or a MAT-file of MATLAB 7.3); write its table as CSV or Parquet: pandas",
    rb"#ROSBAG ": "is a bag of ROS 1; convert it: rosbags-convert --src FILE --dst FOLDER",
    rb"LOGG" + _BINARY: "is a CAN log of Vector (BLF); decode it to CSV: python-can, cantools",
    rb"TDSm" + _BINARY: "is TDMS of LabVIEW; write its channels as CSV: npTDMS",
    rb"ULog\x01": "is a log of PX4 (ULog); write it as CSV: ulog2csv of pyulog",
    rb"\xa3\x95": "is a log of ArduPilot; write it as CSV: mavlogdump.py of pymavlink",
    rb"ORC" + _BINARY: "is Apache ORC; write it as Parquet: pyarrow",
    rb"Obj\x01": "is Avro; write it as CSV or Parquet: polars.read_avro",
    rb"\x80[\x04\x05]\x95": "is a pickle of Python, which may run anything; write its table as "
    "Parquet",
    rb"MDF " + _BINARY: "is a measurement in ASAM MDF (MF4); write it as Parquet or CSV: asammdf",
    rb"ARROW1" + _BINARY: "is an Arrow (Feather) file; write it as Parquet: "
    "polars.read_ipc('FILE').write_parquet('drive.parquet')",
    rb"\xff\xfe|\xfe\xff": "is text in UTF-16; write it in UTF-8: "
    "iconv -f UTF-16 -t UTF-8 FILE > drive.csv",
    rb"\x93NUMPY": "is an array of NumPy; write it as CSV with the names of its columns: "
    "numpy.savetxt('drive.csv', numpy.load('FILE'), delimiter=',', header='time,gap,...')",
    rb"version https://git-lfs": "is a pointer of Git LFS; fetch the file itself: git lfs pull",
    rb"UnFinMF " + _BINARY: "is a measurement in ASAM MDF that was not finalized; write it as CSV: "
    "asammdf",
    rb"\[\s*{": "is JSON; write its rows as CSV: polars.read_json('FILE').write_csv('drive.csv')",
    rb"{": "is JSON; write its rows as CSV: polars.read_ndjson('FILE').write_csv('drive.csv')",
    rb"\(\d+\.\d+\) \w+ [0-9A-F]+#": "is a CAN log (candump); decode it to CSV: cantools",
    rb"date .*\n\s*base (hex|dec)": "is a CAN log of Vector (ASC); decode it to CSV: "
    "python-can, cantools",
    rb"[$!][A-Z]{5},.*\*[0-9A-F]{2}\s": "holds sentences of NMEA 0183; write them as CSV: pynmea2",
    rb"# (HELP|TYPE) \w+ \w": "is what Prometheus fetches; write its series as CSV, a column each",
    rb"\w[^\s,=]*(,[^\s,=]+=[^\s,]+)* [^\s,=]+=[^,\n]+(,[^\s,=]+=[^,\n]+)*( \d{10,})?\n": "is line "
    "protocol of InfluxDB; write it as CSV, with a column for each field",
    rb"[^\0-\x08\x0e-\x1f\n<]*\r[^\0-\x08\x0e-\x1f\n<]+\Z": "has lines that end in CR alone, as of "
    "old Macs; write them with LF: tr '\\r' '\\n' < FILE > drive.csv",
}
_LABVIEW = "***End_of_Header***"  # what stands above its table, twice
_PROFILE = len(_MCAP) + 1 + 8 + 4  # of MCAP, behind the mark, an opcode and two lengths

#: Factors that turn units of time into s, and all units into s, m, m/s or m/s².
TIMES = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0, "d": 86400.0}
_GROUPS: Mapping[str, Mapping[str, float]] = {
    "s": TIMES,
    "m": {"m": 1.0, "mm": 1e-3, "cm": 0.01, "km": 1000.0, "ft": 0.3048},
    "m/s": {"m/s": 1.0, "cm/s": 0.01, "km/h": 1.0 / 3.6, "mph": 0.44704, "kn": 1852.0 / 3600.0}
    | {"ft/s": 0.3048},
    "m/s²": {"m/s2": 1.0, "cm/s2": 0.01, "ft/s2": 0.3048, "g": 9.80665},
}
UNITS = {unit: factor for group in _GROUPS.values() for unit, factor in group.items()}
#: Of each unit the one that it is turned into.
SI = {unit: base for base, group in _GROUPS.items() for unit in group}
_SPELT = {"kmh": "km/h", "kph": "km/h", "kmph": "km/h", "km/hr": "km/h", "mps": "m/s", "sec": "s"}
_SPELT |= {"day": "d", "days": "d", "hour": "h", "hours": "h", "hr": "h", "hrs": "h"}
_SPELT |= {"minute": "min", "minutes": "min", "mins": "min", "msec": "ms", "usec": "us"}
_SPELT |= {"\u00b5s": "us", "\u03bcs": "us", "knots": "kn", "kt": "kn", "m/s/s": "m/s2"}
_COMMENTS = re.compile(r"([ \t]*(#|%|//).*\n|[^\S\n]*\n)*")  # lines of them, and empty ones
_COMMENT = re.compile(r"\A\s*(#|%|//)+\s*")  # what stands before the last line of a comment
MISSING = ("", "na", "n/a", "nan", "null", "none")  #: what stands in a field where nothing does
# By which a comma is known to be a decimal one; thousands it may separate as well, but of no zero.
_DECIMAL_COMMA = re.compile(r"\s*-?(0,\d+|\d+,(\d\d?|\d{4,}))\s*")
_DATE = re.compile(r"\s*\d{4}-?\d\d-?\d\d[Tt ]")
# The day first, as only dots tell; whether its year has a century, and whether seconds follow.
_DAY_FIRST = re.compile(r"\d\d?\.\d\d?\.(?:(\d{4})|\d\d),?[T ]+\d\d?:\d\d(:)?")
_DATE_LIKE = re.compile(r"\s*(\d{1,4}|[A-Z][a-z]{2,8})([.:/ -])(\d\d?|[A-Za-z]{3,9})(\2|, )\d")
_MIDNIGHT = "([T ])24:00"  # at the end of a day
_NO_DATE = 3e9  # from here on it is none: days of Excel in seconds, or another unit [s]
#: What is said where times of day are not as they stand in a log.
IN_UTC = "times of day are told in UTC"
_ISO = "in ISO 8601, such as 2026-03-14T09:26:53.5+01:00, or as 14.03.2026 09:26:53"
_SAYS_HOW = "; --unit 'COLUMN=%m/%d/%Y %I:%M:%S %p' says how others are written"


def unit_of(text: str) -> str:
    """A unit as we call it, of one in brackets or spelt otherwise; others as they are.

    >>> unit_of("[km/h]"), unit_of("m/s^2"), unit_of("deg")
    ('km/h', 'm/s2', 'deg')
    """
    text = text.strip().strip("[]()<>").replace(" ", "").replace("²", "2").replace("^", "")
    names = [name for name in (text, text.lower()) if name in UNITS]
    return names[0] if names else _SPELT.get(text.lower(), text)


def quoted_name(text: str) -> tuple[str, str]:
    """The name in double quotes that a text begins with, as CSV writes one, and the rest.

    >>> quoted_name('"gap, in m"<=0'), quoted_name("gap<=0")
    (('gap, in m', '<=0'), ('', 'gap<=0'))
    """
    quotation = re.match(r'\s*"((?:[^"]|"")+)"\s*', text)
    return (quotation[1].replace('""', '"'), text[quotation.end() :]) if quotation else ("", text)


def file_kind(path: str) -> Kind:
    """What the file holds, by how it begins or is called (``.osi``); what is foreign is refused."""
    if os.path.isfile(os.path.join(path, "metadata.yaml")):
        return "bag"
    if path.removesuffix(".gz").endswith(".osi"):
        return "osi"
    with Source(path) as source:
        head = source.read(4096).removeprefix(_BYTE_ORDER_MARK).lstrip()
        is_packed = source.is_packed
    if not head:
        raise ValueError(f"{path} is empty")
    if b'{"__metadata__"' in head:
        raise ValueError(f"{path} holds what was learnt, and is no log: evofsm inspect prints it")
    if foreign := [says for text, says in _FOREIGN.items() if re.match(text, head)]:
        raise ValueError(f"{path} {foreign[0].replace('FILE', path)}")
    tables = {*re.findall(rb"CREATE TABLE \W?(\w+)", head)}
    if head.startswith(_SQLITE) and tables and b"topics" not in tables:
        way = f"sqlite3 -header -csv {path} 'SELECT * FROM TABLE' > drive.csv"
        raise ValueError(f"{path} is a database of SQLite, and no bag; write it as CSV: {way}")
    if is_packed and head.startswith((_PARQUET, _SQLITE, _MCAP)):
        raise ValueError(f"{path} is gzipped, and cannot be read so; unpack it: gzip -dk {path}")
    if head.startswith(_MCAP):
        return "bag" if head[_PROFILE:].startswith(b"ros2") else "mcap"
    kinds: dict[bytes, Kind] = {_PARQUET: "parquet", _SQLITE: "bag", b"<": "xml"}
    kind: Kind = next((kind for mark, kind in kinds.items() if head.startswith(mark)), "csv")
    if kind == "csv" and b"\0" in head[:64]:  # further down it is a bad row
        cause = "an archive, binary data, or text in UTF-16?"
        raise ValueError(f"{path} is not text in UTF-8 ({cause})")
    return kind


@dataclass
class Skips:
    """Rows of a file that cannot be right: so many are left out, and counted; more are refused."""

    most: int = 0
    kinds: dict[str, tuple[int, str]] = field(default_factory=dict)  #: how many, and the first
    told: list[str] = field(default_factory=list)  #: what else is to be said
    on_read: OnRead = lambda count: None
    first: dict[str, str] = field(default_factory=dict, init=False)  #: of each kind, in this file

    def __post_init__(self) -> None:
        self._left = self.most

    def leave_out(self, kind: str, why: str | Callable[[], str], rows: int = 1) -> None:
        """Leave a row out, or raise where that is one too many; ``why`` begins with its place."""
        if kind not in self.first:
            self.first[kind] = why if isinstance(why, str) else why()
        self._left -= rows
        if self._left < 0:
            more = f"--skip-bad {self.most} leaves out so many bad rows, and there are more"
            raise ValueError(f"{self.first[kind]}; {more}")
        count, first = self.kinds.get(kind, (0, self.first[kind]))
        self.kinds[kind] = count + 1, first

    def refuse_nothing(self, otherwise: str) -> NoReturn:
        """Raise where no row is left, for what was left out first."""
        faults = (first for kind, first in self.first.items() if kind not in ("comment", "letter"))
        raise ValueError(next(faults, otherwise))


class Source(AbstractContextManager["Source"]):
    """A file that is read once, unpacked if it is gzipped; it may end early if ``skips`` allow."""

    def __init__(self, path: str, skips: Skips | None = None) -> None:
        if os.path.isdir(path):
            raise IsADirectoryError(f"{path} is a folder; name the files in it")
        if os.path.exists(path) and not os.path.isfile(path):
            raise ValueError(f"{path} is a pipe or a device; write it to a file first")
        self.path = path
        self.lines = 0  # read so far of one that is gzipped
        self.is_cut = False  #: whether the last line, once it is read, has no end
        self._skips, self._ended = skips, False
        self._raw = io.BufferedReader(io.FileIO(path))
        self.is_packed = self._raw.peek(2).startswith(_GZIP)
        self._file = gzip.GzipFile(fileobj=self._raw) if self.is_packed else self._raw

    def __exit__(self, *error: object) -> None:
        self._file.close()
        self._raw.close()

    def read(self, size: int) -> bytes:
        """So many bytes, fewer at the end; then none."""
        parts: list[bytes] = []
        while size > 0 and (part := self._take(size)):
            parts.append(part)
            size -= len(part)
        return b"".join(parts)

    def rows(self) -> bytes:
        """The next whole lines, some megabytes of them; no quoted field goes on behind them."""
        block = bytearray(self.read(_CSV_BYTES))
        quotes, most = _count(block, b'"'), len(block) + _LONGEST_LINE
        # A quote that is never closed is left to whoever parses them.
        while block and not (block.endswith(b"\n") and (quotes % 2 == 0 or len(block) > most)):
            line = self._take(_LONGEST_LINE, to_line_end=True)
            if not line:
                self.is_cut = not block.endswith(b"\n")
                block += b"\n" * self.is_cut
                break
            block += line
            quotes += line.count(b'"')
            if len(block) > most and not line.endswith(b"\n"):
                where = f"line {self.lines}" if self.is_packed else f"byte {self._raw.tell():,}"
                fault = f"a line of more than {_LONGEST_LINE:,} bytes; this is no table"
                raise ValueError(f"{self.path}, about {where}: {fault}")
        return bytes(block)

    def _take(self, most: int, to_line_end: bool = False) -> bytes:
        if self._ended:
            return b""
        before = self._raw.tell()
        try:
            data: bytes = self._file.readline(most) if to_line_end else self._file.read1(most)
        except (EOFError, zlib.error, gzip.BadGzipFile) as error:
            cause = "was a copy or a download interrupted, or is it still being written?"
            fault = f"the gzip data ends early or is damaged ({cause}): {error}"
            message = f"{self.path}, after line {self.lines}: {fault}"
            if self._skips is None or not isinstance(error, EOFError):
                raise ValueError(message) from error
            self._skips.leave_out("cut", message)
            self._ended, data = True, b""
        if self.is_packed:
            self.lines += data.count(b"\n")
        if self._skips is not None:
            self._skips.on_read(self._raw.tell() - before)
        return data


class RefusedError(ValueError):
    """What is wrong with a file, in words of our own; `readable` says of which."""


@contextmanager
def readable(path: str | os.PathLike[str], kind: str) -> Iterator[None]:
    """Turn whatever a library runs into in a damaged file into one error that names the file."""
    try:
        yield
    except (OSError, ModuleNotFoundError, KeyboardInterrupt, GeneratorExit):
        raise
    except RefusedError as error:
        raise ValueError(f"{os.fspath(path)}: {error}") from None
    except BaseException as error:  # a panic of polars is no Exception
        why = str(error).partition("\n")[0][:300] or type(error).__name__
        if why.startswith(os.fspath(path)):
            raise
        raise ValueError(f"{os.fspath(path)} cannot be read as {kind}: {why}") from error


def mcap_messages(
    path: str | os.PathLike[str], largest: int, skips: Skips
) -> Iterator[tuple[Schema | None, Channel, Message]]:
    """All messages of an MCAP file, whose chunks may have so many bytes; where it ends, they do."""
    with needs("mcap", "mcap", f"{os.fspath(path)}: MCAP"):
        from mcap.exceptions import EndOfFile, RecordLengthLimitExceeded
        from mcap.records import Channel, Chunk, Message, Schema
        from mcap.stream_reader import StreamReader, breakup_chunk

    def parts(record: McapRecord) -> Iterable[McapRecord]:
        if not isinstance(record, Chunk):
            return [record]
        return breakup_chunk(_unpacked(record, largest), validate_crc=True)

    schemas, channels = dict[int, Schema](), dict[int, Channel]()
    kind = "MCAP (damaged, cut off, or still being written?)"
    with readable(path, kind), open(path, "rb") as file:
        size = os.fstat(file.fileno()).st_size
        reader = StreamReader(file, emit_chunks=True, validate_crcs=True, record_size_limit=size)
        try:
            for record in chain.from_iterable(map(parts, reader.records)):
                if isinstance(record, Schema):
                    schemas[record.id] = record
                elif isinstance(record, Channel):
                    channels[record.id] = record
                elif isinstance(record, Message):
                    if (channel := channels.get(record.channel_id)) is None:
                        raise RefusedError(f"there is no channel {record.channel_id} of a message")
                    yield schemas.get(channel.schema_id), channel, record
        except (EndOfFile, RecordLengthLimitExceeded, struct.error) as error:
            why = f"it ends within a record, or is damaged there: {error}".removesuffix(": ")
            skips.leave_out("cut", f"{os.fspath(path)}, byte {file.tell():,}: {why}")


def _unpacked(chunk: Chunk, largest: int) -> Chunk:
    """The chunk as it is without compression; of one that is too large no more is unpacked."""
    from lz4.frame import LZ4FrameDecompressor
    from zstandard import ZstdDecompressor

    data = chunk.data
    if chunk.compression == "zstd":
        unpacker = ZstdDecompressor(max_window_size=largest)
        data = unpacker.stream_reader(data).read(largest + 1)
    elif chunk.compression == "lz4":
        data = LZ4FrameDecompressor().decompress(data, max_length=largest + 1)
    elif chunk.compression:
        raise ValueError(f"its chunks are packed as {chunk.compression!r}, which is not known")
    if len(data) > largest:
        raise ValueError(f"a chunk unpacks to more than the {largest:,} bytes it may have")
    return replace(chunk, compression="", data=bytes(data))


# -- Pieces of tables -----------------------------------------------------------------------------


@dataclass
class Piece:
    """Some consecutive rows of a table: T values for each column that was asked for."""

    rows: int
    numbers: Numbers  #: NaN where one is missing
    find: Find
    skips: Skips
    texts: dict[str, polars.Series] = field(default_factory=dict)
    #: Rows that begin an episode, of a table that knows; None where columns tell episodes apart.
    starts: Sequence[int] | None = None
    names: Sequence[str] = ()  #: of these episodes, of a table that knows
    anew: Sequence[int] = ()  #: rows before which something was left out; behind the last one too
    headers: Sequence[int] = ()  #: and those before which the columns are named again
    cut: str = ""  #: column in which the last row's field may go on, as nothing ends it
    bad: NDArray[np.bool_] = field(init=False)  #: (T,) rows to leave out
    spares: Callable[[], NDArray[np.bool_]] | None = None  #: says which rows need not be right

    def __post_init__(self) -> None:
        self.bad = np.zeros(self.rows, np.bool_)

    @cached_property
    def spared(self) -> NDArray[np.bool_]:
        """(T,) rows that need not be right."""
        return np.zeros_like(self.bad) if self.spares is None else self.spares()

    def at(self, row: int) -> str:
        """Where a row stands, for a message."""
        return self.find(row)[0]

    def told(self, row: int, name: str, why: str = "", hint: str = "") -> str:
        """Where a row stands, and what is wrong with what it has in a column."""
        place, fields = self.find(row)
        parts = [fields[part] for part in ([name] if name in fields else name.split(","))]
        text = " ".join("" if part is None else str(part) for part in parts)
        return f"{place}, column {name!r}: {why.format(text[:40]) or explained(text, hint)}"

    def leave_out(self, name: str, where: NDArray[np.bool_], why: str = "", hint: str = "") -> None:
        """Leave out rows for what stands in a column."""
        where = where & ~self.bad
        for row in np.flatnonzero(where & ~self.spared if where.any() else where).tolist():
            self.skips.leave_out("field", partial(self.told, row, name, why, hint))
            self.bad[row] = True

    def unusable(
        self, name: str, low: float = -LARGEST_OBSERVATION, high: float = LARGEST_OBSERVATION
    ) -> NDArray[np.bool_]:
        """In which rows a number is missing, or lies outside of these ends."""
        numbers = self.numbers[name]
        return ~((numbers >= low) & (numbers <= high))

    def take(self, rows: NDArray[np.int64]) -> Piece:
        """Some of its rows."""
        piece = replace(
            self,
            rows=len(rows),
            numbers={name: values[rows] for name, values in self.numbers.items()},
            texts={name: texts.gather(rows) for name, texts in self.texts.items()},
            find=lambda row: self.find(int(rows[row])),
            anew=np.searchsorted(rows, self.anew).tolist(),
            cut=self.cut if rows[-1:].tolist() == [self.rows - 1] else "",
        )
        piece.bad, piece.spared = self.bad[rows], self.spared[rows]
        return piece


def in_row(
    path: str, columns: Mapping[str, Any], before: int, row: int
) -> tuple[str, Mapping[str, Any]]:
    """Where a row stands that is one of some columns, behind so many others; and what it holds."""
    place = f"{path}, row {before + row + 1}"
    return place, {name: column[row] for name, column in columns.items()}


class Wanted(NamedTuple):
    """What is read of a table."""

    numbers: Sequence[str]
    texts: Sequence[str] = ()
    dates: Sequence[str] = ()  #: which together come as a number, of microseconds
    form: str = ""  #: how dates are written, as `strftime` has it; else as they look
    #: Which rows of a piece do not count.
    spares: Callable[[Piece], NDArray[np.bool_]] | None = None

    @property
    def all(self) -> list[str]:
        """Columns that are read, each once."""
        return list(dict.fromkeys([*self.numbers, *self.texts, *self.dates]))

    def piece(self, frame: polars.DataFrame, find: Find, skips: Skips) -> Piece:
        """The columns of some rows as what is wanted of them; numbers may be given as texts."""
        import polars

        piece, odd = Piece(len(frame), {}, find, skips), dict[str, NDArray[np.bool_]]()
        for name in self.numbers:
            values = frame[name]
            if values.dtype == polars.String:
                fields = values.str.strip_chars()
                values = fields.cast(polars.Float64, strict=False)
                wrong = values.is_null() & ~fields.fill_null("").str.to_lowercase().is_in(MISSING)
                if wrong.any():
                    odd[name] = wrong.to_numpy()
            piece.numbers[name] = values.cast(polars.Float64).to_numpy()
        for name in self.texts:
            texts = frame[name].cast(polars.String)
            piece.texts[name] = texts.fill_null("") if texts.null_count() else texts
        if self.spares:  # as it was read, whatever becomes of it
            was = replace(piece, numbers={**piece.numbers}, texts={**piece.texts})
            piece.spares = partial(self.spares, was)
        for name, rows in odd.items():
            piece.leave_out(name, rows)
        if self.dates:
            dates = frame[self.dates[0]]
            for name in self.dates[1:]:  # the time of day, behind the date
                dates = dates.cast(polars.String) + " " + frame[name].cast(polars.String)
            name = ",".join(self.dates)
            piece.numbers[name] = _microseconds(piece, name, dates, self.form)
        return piece


class Table:
    """A table whose header is known and whose rows are still to be read."""

    path: str
    columns: Sequence[str]
    skips: Skips
    separator = ""  #: of fields in a line
    #: As a row below the names says; empty of a column of which it does not.
    units: Mapping[str, str] = {}
    #: Whether an action is what the rows say of the next one, and unknown where none follows.
    derives = False

    def pieces(self, wanted: Wanted) -> Iterator[Piece]:
        """Read columns, in the order of rows."""
        raise NotImplementedError

    def first(self, name: str) -> str:
        """What stands first in a column; nothing of a table of numbers alone."""
        return ""


class _Odd(NamedTuple):
    """What Python's own reader makes of some lines."""

    columns: Sequence[str]  #: of the next lines
    rows: list[tuple[int, list[str]]]  #: lines, and what is wanted of them
    anew: list[int]  #: rows before which something was left out
    headers: list[int]  #: rows before which the columns are named again
    left_out: list[tuple[int, str]]  #: lines that are no rows, and why; of a comment nothing


class Dialect:
    """How fields stand in the lines of a table: by the line that names columns, and some below."""

    most_above, most_below = 100, 4  #: lines in which names are looked for, and units below them

    def __init__(self, header: str, below: Sequence[str]) -> None:
        header = _COMMENT.sub("", header, count=1)
        self.separator = _separator(header)
        self.columns = _fields(header, self.separator)
        self.units: Mapping[str, str] = {}  #: as a row below the names says
        rows = [_fields(row, self.separator) for row in below]
        values = next((row for row in rows[: self.most_below] if any(map(is_value, row))), [])
        above = rows[: rows.index(values)] if values else rows[:1]
        units = [unit_of(text) for row in above[:1] for text in row]
        pairs = zip(units, values, strict=False)
        over = any(is_value(value) and text.lower() not in MISSING for text, value in pairs)
        #: How many rows below the names say what numbers are, such as their units.
        self.n_told = len(above) if over or any(unit in UNITS for unit in units) else 0
        if self.n_told:
            self.units, rows = dict(zip(self.columns, units, strict=False)), rows[self.n_told :]
        self.first_row = rows[0] if rows else []
        self.has_commas = self.separator == ";"
        if self.separator in ",\t|":  # at commas, within quotes
            self.has_commas = _has_decimal_commas(zip_longest(*rows, fillvalue=""))

    def miscounted(self, count: int, named: int) -> str:
        """What is wrong with a line of so many fields."""
        why = f"(cut off, a quote not closed, or does a field hold {self.separator!r}?)"
        return f"{count} fields, but the header names {named} {why}"


def _has_decimal_commas(columns: Iterable[Iterable[str]]) -> bool:
    """Whether columns of numbers have them, by one that parts no thousands."""
    commas, points = list[bool](), False
    for column in columns:
        fields = [text for text in column if text.strip().lower() not in MISSING]
        if 2 * sum(is_number(text.replace(",", ".")) for text in fields) > len(fields):
            commas += [bool(_DECIMAL_COMMA.fullmatch(text)) for text in fields if "," in text]
            points |= any("." in text and "," not in text for text in fields)
    return all(commas) if commas and points else any(commas)  # where points are decimal, of all


class CsvTable(Table):
    """A CSV file, gzipped or not, with a header; fields end at a comma, semicolon, tab, | or space.

    The header is the line that has most of the names that are looked for; one further down names
    the columns anew. polars reads blocks of plain lines; Python's own reader, which is slower,
    blocks with anything odd, such as a line break within quotes, and what a message is to name.
    """

    def __init__(self, path: str, names: Collection[str] = (), skips: Skips | None = None) -> None:
        with needs("polars", "tables", f"{path}: a table"):
            import polars  # noqa: F401 (said here, before the work begins)
        self.path, self.skips = path, skips or Skips()
        # A field may be long that nobody asks for; lines are bounded.
        csv.field_size_limit(max(csv.field_size_limit(), _CSV_BYTES + 2 * _LONGEST_LINE))
        with Source(path, Skips(1)) as source:  # said where the rows are read
            text = decoded(source.rows(), path).removeprefix("\ufeff")
        most = Dialect.most_above + next(_COMMENTS.finditer(text))[0].count("\n")
        lines = [line.rstrip("\r") for line in text.split("\n", most)[:most]]
        at = self._header(lines, set(names))
        self._dialect = dialect = Dialect(lines[at], lines[at + 1 :])
        self.columns, self.units, header = dialect.columns, dialect.units, lines[at]
        self.separator = dialect.separator
        self._above = at + 1 + dialect.n_told  # lines before the first row
        # With nothing in it that has a meaning; polars is not to be left alone with others.
        pattern = f'"[^"{dialect.separator}\\r\\n]*"(?=[{dialect.separator}\\r\\n])'
        self._quoted = re.compile(pattern.encode())
        if any(map(is_date, self.columns)) or all(map(is_number, self.columns)):
            hint = "a line above the rows must name the columns"
            fault = f"{header.strip()[:200]!r} is no header; {hint}"
            raise ValueError(f"{path}, line {at + 1}: {fault}")

    def _header(self, lines: Sequence[str], names: set[str]) -> int:
        """Which line names the columns: the one with most names, or the last before the rows."""
        headers = [Dialect(line, ()).columns for line in lines]
        there = [(len(names & {*line}), sum(map(is_value, line))) for line in headers]
        scores = [has * (has >= values) for has, values in there]  # a number may name a column, too
        if any(scores):
            return scores.index(max(scores))
        rows = [at for at, line in enumerate(lines) if line.strip() and not _COMMENT.match(line)]
        rows = [at for at in rows if not lines[at].startswith("sep=")]
        ends = [place for place, at in enumerate(rows, 1) if lines[at].startswith(_LABVIEW)]
        rows = rows[ends[:2][-1] :] if ends else rows  # there may be more segments
        counts = [sum(map(bool, headers[at])) for at in rows], [len(headers[at]) for at in rows]
        usual, size = (max(n, key=n.count, default=0) for n in counts)

        def is_title(fields: Sequence[str]) -> bool:  # of fewer fields, or of others and numbers
            is_odd = len(fields) != size and any(map(is_number, fields))
            return is_odd or sum(map(bool, fields)) < usual

        first = next((at for at in rows if not is_title(headers[at])), 0)
        separator = _separator(lines[first])
        above, row = (_fields(lines[at], separator) for at in (max(first - 1, 0), first))
        return first - 1 if first and is_number(row[0]) and len(above) == len(row) else first

    def first(self, name: str) -> str:
        """What the first row has in a column."""
        return dict(zip(self.columns, self._dialect.first_row, strict=False)).get(name, "")

    def holds(self, name: str) -> Literal["number", "text", ""]:
        """What a column holds, by its first row; nothing of one without a name of its own."""
        if not name or self.columns.count(name) > 1:
            return ""
        text = self.first(name)
        return "number" if is_number(text.replace(",", ".", self._dialect.has_commas)) else "text"

    def pieces(self, wanted: Wanted) -> Iterator[Piece]:
        """Read columns, in the order of rows."""
        import polars
        from polars import selectors

        if twice := [name for name in wanted.all if self.columns.count(name) > 1]:
            fault = f"two columns are called {twice[0]!r}"
            raise ValueError(f"{self.path}, line {self._above}: {fault}")
        columns, behind = self.columns, [False, False]
        with Source(self.path, self.skips) as source:
            for block, lines_before in self._blocks(source):
                here = partial(self._odd, block, lines_before, columns, wanted)
                frame = self._plain(block, columns, wanted)
                anew, headers = ([0] * is_first for is_first in behind)
                is_cut = source.is_cut
                if frame is None:
                    odd = here()
                    columns, anew, headers = odd.columns, anew + odd.anew, headers + odd.headers
                    is_cut &= lines_before + block.count(b"\n") in [n for n, _ in odd.rows[-1:]]
                    for line, why in odd.left_out:
                        place = f"{self.path}, line {line}: {why or 'a comment'}"
                        self.skips.leave_out("row" if why else "comment", place, bool(why))
                    schema = dict.fromkeys(wanted.all, polars.String)
                    fields = [fields for _, fields in odd.rows]
                    frame = polars.DataFrame(fields, schema, orient="row")
                if self._dialect.has_commas:
                    texts = selectors.by_name(wanted.numbers) & selectors.string()
                    frame = frame.with_columns(texts.str.replace(",", ".", literal=True))
                behind = [len(frame) in rows for rows in (anew, headers)]
                if len(frame) or anew or headers:
                    piece = wanted.piece(frame, partial(self._find, here, wanted), self.skips)
                    piece.anew, piece.headers = anew, headers
                    piece.cut = columns[-1] if is_cut else ""
                    yield piece

    def _blocks(self, source: Source) -> Iterator[tuple[bytes, int]]:
        """Lines of the file that are not all empty, and how many were before."""
        lines_before = 0
        while block := source.rows():
            if not block.isascii():
                text = decoded(block, self.path, lines_before)
                block_lines = text.split("\n") if "\ufffd" in text else ()
                for number, line in enumerate(block_lines, lines_before + 1):
                    if "\ufffd" in line:
                        self.skips.leave_out("letter", f"{self.path}, line {number}", 0)
                block = text.encode()
            while lines_before < self._above:
                block, lines_before = block.partition(b"\n")[2], lines_before + 1
            lines = _count(block, b"\n")
            if lines < len(block):
                yield block, lines_before
            lines_before += lines

    def _plain(
        self, block: bytes, columns: Sequence[str], wanted: Wanted
    ) -> polars.DataFrame | None:
        """The columns, numbers as such where all are; None where anything is odd."""
        import polars

        if b'"' in block and 2 * len(self._quoted.findall(block)) != _count(block, b'"'):
            return None
        # As polars calls columns, for there may be two of one name.
        names = {f"column_{columns.index(name) + 1}": name for name in wanted.all}
        kinds: dict[str, Any] = {f"column_{k + 1}": polars.String for k in range(len(columns))}
        numbers = {place: polars.Float64 for place, name in names.items() if name in wanted.numbers}
        separator = self._dialect.separator
        # At commas, decimal ones are within quotes, and the block is none of plain lines.
        has_commas = self._dialect.has_commas and separator != ","
        dialect: Any = {"separator": separator, "decimal_comma": has_commas}
        for schema in (kinds | numbers, kinds):
            try:
                frame = polars.read_csv(block, columns=[*names], schema=schema, **dialect, **_PLAIN)
            except (polars.exceptions.PolarsError, polars.exceptions.PanicException):
                return None
            if _count(block, separator.encode()) != len(frame) * (len(columns) - 1):
                return None
            if not any(frame[place].null_count() for place in numbers):
                break
        frame = frame.rename(names)
        texts = frame.select(wanted.numbers).select(polars.col(polars.String).str.strip_chars())
        return None if any(text.is_in(wanted.all).any() for text in texts) else frame

    def _odd(self, block: bytes, reached: int, columns: Sequence[str], wanted: Wanted) -> _Odd:
        """The rows of some lines; those of another length are none."""
        text = io.StringIO(block.decode(), newline="")
        reader = csv.reader(text, delimiter=self._dialect.separator, strict=True)
        rows, left_out = list[tuple[int, list[str]]](), list[tuple[int, str]]()
        anew, headers = list[int](), list[int]()
        places = [columns.index(name) for name in wanted.all]
        may_name = any(name.encode() in block for name in wanted.all)
        last_line, is_labview = 0, {"X_Value", "Comment"} <= {*columns}
        while True:
            try:
                for fields in filter(None, reader):
                    line = reached + reader.line_num
                    if is_labview and len(fields) == len(columns) - 1:
                        fields.append("")  # no comment, and no tab before it
                    if may_name and self._named_anew(fields, wanted, line):
                        columns = _names(fields)
                        places = [columns.index(name) for name in wanted.all]
                        headers.append(len(rows))
                    elif is_labview and not is_value(fields[0] or "0"):  # above a segment
                        left_out.append((line, ""))
                    elif len(fields) == len(columns):
                        rows.append((line, [fields[place] for place in places]))
                    elif _COMMENT.match(fields[0]):
                        left_out.append((line, ""))
                    else:
                        anew.append(len(rows))
                        left_out.append((line, self._dialect.miscounted(len(fields), len(columns))))
                    last_line = reader.line_num
                return _Odd(columns, rows, anew, headers, left_out)
            except csv.Error as error:
                line, why = reached + reader.line_num, f"{error} (an unclosed quote?)"
                if reader.line_num > last_line + 1:
                    raise ValueError(f"{self.path}, line {line}: {why}") from error
                anew.append(len(rows))
                left_out.append((line, why))
                last_line = reader.line_num

    def _named_anew(self, fields: Sequence[str], wanted: Wanted, line: int) -> bool:
        """Whether a row is no row but names the columns once more."""
        omissions = set(wanted.all).difference(_names(fields))
        if omissions and len(wanted.all) - len(omissions) > 1:
            fault = f"it names the columns anew, without {min(omissions)!r}"
            hint = "two logs in one file? learn them apart"
            raise ValueError(f"{self.path}, line {line}: {fault} ({hint})")
        return not omissions

    def _find(self, here: Callable[[], _Odd], wanted: Wanted, row: int) -> tuple[str, Any]:
        line, fields = here().rows[row]
        return f"{self.path}, line {line}", dict(zip(wanted.all, fields, strict=True))


_AS_PARQUET = "Parquet (was a copy or a download interrupted?)"


class ParquetTable(Table):
    """A Parquet file; read with polars because pyarrow cannot be imported beside libsumo."""

    def __init__(self, path: str, skips: Skips | None = None) -> None:
        with needs("polars", "tables", f"{path}: Parquet"):
            import polars
            from polars import selectors
        self.path, self.skips = path, skips or Skips()
        # polars takes other paths for addresses on the network, or of somebody's home.
        self._scan = polars.scan_parquet(os.path.abspath(path), glob=False)
        with readable(self.path, _AS_PARQUET):
            seconds = selectors.duration().dt.total_nanoseconds() / 1e9
            self._scan = self._scan.with_columns(seconds)
            self._types = self._scan.collect_schema()
            self._rows = int(self._scan.select(polars.len()).collect().item())
        self.columns = list(self._types)

    def first(self, name: str) -> str:
        """The first of its values."""
        if name not in self.columns:
            return ""
        with readable(self.path, _AS_PARQUET):
            frame = self._scan.select(name).drop_nulls().head(1).collect()
        return str(frame.item()) if len(frame) else ""

    def holds(self, name: str) -> Literal["number", "text", ""]:
        """What a column holds, by its type, as far as that is known."""
        import polars

        kind = self._types[name]
        is_text = kind in (polars.String, polars.Categorical, polars.Boolean) or kind.is_temporal()
        return "number" if kind.is_numeric() else "text" if is_text else ""

    def pieces(self, wanted: Wanted) -> Iterator[Piece]:
        """Read columns, in the order of rows."""
        for name in wanted.numbers:
            if not self._types[name].is_numeric():
                holds = f"column {name!r} holds {self._types[name]}"
                raise ValueError(f"{self.path}: {holds}, not numbers")
        part = self._scan.select(wanted.all)
        # Not collect_batches: it reads ahead of a slow consumer without bound (polars #28569).
        for first in range(0, self._rows, _PARQUET_ROWS):
            with readable(self.path, _AS_PARQUET):
                frame = part.slice(first, _PARQUET_ROWS).collect()
            find = partial(in_row, self.path, frame.to_dict(), first)
            yield wanted.piece(frame, find, self.skips)
            self.skips.on_read(os.path.getsize(self.path) * len(frame) // self._rows)


# -- Fields ---------------------------------------------------------------------------------------


def decoded(block: bytes, path: str, reached: int = 0) -> str:
    """Lines in UTF-8 or, where most letters beyond ASCII are none, in that of Western Europe."""
    try:
        return block.decode()
    except UnicodeDecodeError as error:
        if not _CONTROL.search(block):
            text = block.decode(errors="ignore")
            n_lost = len(block) - (n_read := len(text.encode()))  # bytes, also of those that count
            encoding = "utf-8" if n_read - len(text) >= n_lost else "cp1252"
            return block.decode(encoding, errors="replace")
        line = reached + block.count(b"\n", 0, error.start)
        fault = "not text in UTF-8 (a file of another kind, or saved in another encoding?)"
        raise ValueError(f"{path}, after line {line}: this is {fault}") from error


def _count(block: bytes | bytearray, byte: bytes) -> int:
    """How often a byte is there; of many of them, faster than ``block.count``."""
    return int((np.frombuffer(block, np.uint8) == byte[0]).sum()) if byte in block else 0


def _separator(line: str) -> str:
    line = re.sub('"[^"]*"', "", line)
    decimal = re.compile(r"[^,]*(\d,\d[^,]*)?")  # commas are, where another sign parts such fields
    signs = [s for s in ";\t|" if s in line and all(map(decimal.fullmatch, line.split(s)))]
    return max(signs or ",;\t|", key=line.count) if re.search("[,;\t|]", line) else " "


def _fields(line: str, separator: str) -> list[str]:
    """The fields of a line as names; where its quotes are odd, as they stand."""
    return _names(next(csv.reader([line.replace("\r", " ")], delimiter=separator), []))


def _names(fields: Sequence[str]) -> list[str]:
    first = [_COMMENT.sub("", text, count=1) for text in fields[:1]]
    return [name.strip() for name in (*first, *fields[1:])]


def explained(text: str, hint: str = "") -> str:
    """Why a text is not the number it should be, or one that cannot be learnt."""
    if not text.strip():
        return f"the field is empty{hint or ' (a missing measurement?)'}"
    if is_number(text):
        return f"{text[:40]} cannot be learnt{hint or ' (a missing or failed measurement?)'}"
    if is_number(text.replace(",", ".")):
        return f"{text[:40]!r} is no number (a decimal comma? write 1.5)"
    if "," in text and is_number(text.replace(",", "").replace(".", "")):
        marks = "points" if -1 < text.find(".") < text.find(",") else "commas"
        return f"{text[:40]!r} is no number ({marks} between thousands? leave them out)"
    if _DATE_LIKE.match(text):
        return f"{text[:40]!r} is no number (a date? it has to be {_ISO}{_SAYS_HOW})"
    return f"{text[:40]!r} is no number (a text, a date, or a unit behind the number?)"


def is_date(text: str) -> bool:
    """Whether it is, or is meant to be, a time of ISO 8601, or one that begins with the day."""
    return (_DATE.match(text) or _DAY_FIRST.match(text.strip())) is not None


def date(time: float, unit: str = "") -> str:
    """A time [s], as people read it; with its unit, where it is no date."""
    if not DATES <= time < _NO_DATE:
        return f"{time:.13g}{unit}"
    text = f"{datetime.fromtimestamp(round(time, 3), UTC):%Y-%m-%d %H:%M:%S.%f}"
    return text[:-3].removesuffix(".000").removesuffix(":00")


def seconds_of_date(text: str, form: str = "") -> float:
    """Since 1970, of one date as logs are read; a ValueError if it is none.

    >>> seconds_of_date("01.01.1970 00:01:30,5"), seconds_of_date("1970-01-01T24:00:00+01:00")
    (90.5, 82800.0)
    """
    text, n_ends = re.subn(_MIDNIGHT, r"\g<1>00:00", text.strip())
    if form:
        when = datetime.strptime(text, form)
    else:
        if match := re.fullmatch(r"(\d\d?)\.(\d\d?)\.(\d\d|\d{4}),?[T ]+(\d\d?)(:.*)", text):
            day, month, year, hour, rest = match.groups()
            text = f"{'20' * (len(year) == 2)}{year}-{month:0>2}-{day:0>2} {hour:0>2}{rest}"
        when = datetime.fromisoformat(text)
    return when.replace(tzinfo=when.tzinfo or UTC).timestamp() + 86400.0 * n_ends


def is_number(text: str) -> bool:
    """Whether it is one for all that read tables."""
    try:
        float(text.replace("_", "x"))  # which Python reads, and nobody else
    except ValueError:
        return False
    return True


def is_value(text: str) -> bool:
    """Whether it is a number, perhaps with a decimal comma, or a date."""
    return is_number(text.replace(",", ".")) or is_date(text)


def _microseconds(
    piece: Piece, name: str, dates: polars.Series, form: str = ""
) -> NDArray[np.float64]:
    """Microseconds since 1970, exactly; without a zone a date is taken as UTC."""
    import polars

    why = f"{{!r}} is not read as a date; all must be {_ISO}, and all have a zone, or none"
    if dates.dtype == polars.String:
        texts, parts = dates.str.strip_chars(), ""
        if not form and (match := _DAY_FIRST.match(str(texts.first()))):
            form = f"%d.%m.%{'Y' if match[1] else 'y'} %H:%M{':%S' if match[2] else ''}"
            parts = "%.f" if match[2] else ""
        if form and not re.search("%[YyFDcs]", form):  # a time of day
            texts, form = "1970-01-01 " + texts, f"%Y-%m-%d {form}"
        form = form.replace(",%f", ".%f").replace(".%f", "%.f").replace("%f", "%6f")  # as polars
        if "," not in form and texts.str.contains(",", literal=True).any():
            texts = texts.str.replace(r",\s+", " ").str.replace(",", ".", literal=True)
        ends = texts.str.contains(_MIDNIGHT)
        texts = texts.str.replace(_MIDNIGHT, "${1}00:00") if ends.any() else texts
        try:
            dates = texts.str.to_datetime(form or None, strict=False)
            if parts and dates.null_count():  # which is slower
                dates = texts.str.to_datetime(form + parts, strict=False)
        except polars.exceptions.ComputeError:  # it knows no form from the first one
            dates = polars.Series(name, [None] * len(texts), polars.Datetime("us"))
        dates += ends.cast(polars.Int64) * timedelta(days=1)
    if dates.null_count():
        piece.leave_out(name, dates.is_null().to_numpy(), f"{why}{_SAYS_HOW}")
    return dates.dt.epoch("us").cast(polars.Float64).to_numpy()
