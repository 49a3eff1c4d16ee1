"""Tables in CSV and Parquet, read with polars piece by piece; and what kind of file a file is."""

from __future__ import annotations

import csv
import gzip
import io
import os
import re
import zlib
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, NoReturn, Self

import numpy as np
from numpy.typing import NDArray

from evofsm.extras import needs
from evofsm.store import LARGEST_OBSERVATION

if TYPE_CHECKING:
    import polars

Numbers = dict[str, NDArray[np.float64]]
Kind = Literal["csv", "parquet", "xml", "osi", "mcap", "bag", "run"]
#: Called with the number of bytes each time some were read from a file.
OnRead = Callable[[int], object]
#: Place of a row, for a message, and what stands there in a column.
Find = Callable[[int, "str | None"], tuple[str, str]]

# Read at once. polars decodes a whole row group for each slice of it: small slices cost time.
_CSV_BYTES, _PARQUET_ROWS = 1 << 21, 1 << 16
_LONGEST_LINE = 1_000_000
_PLAIN: Mapping[str, Any] = {"has_header": False, "ignore_errors": True, "raise_if_empty": False}

_BYTE_ORDER_MARK, _GZIP, _PARQUET = b"\xef\xbb\xbf", b"\x1f\x8b", b"PAR1"
_SQLITE, _MCAP = b"SQLite format 3\0", b"\x89MCAP0\r\n"
# How files begin that others hand around and we do not read: what they are, and the way out.
_FOREIGN = {
    b"\xfd7zXZ\0": "is compressed by xz; unpack it: xz --decompress --keep FILE",
    b"\x5d\0\0": "is compressed by lzma; unpack it: xz --format=lzma --decompress --keep FILE",
    b"BZh": "is compressed by bzip2; unpack it: bzip2 --decompress --keep FILE",
    b"\x28\xb5\x2f\xfd": "is compressed by zstd; unpack it: zstd --decompress FILE",
    b"PK\3\4": "is a zip archive, or an Excel workbook (.xlsx); unpack it, or save it as CSV",
    b"\xd0\xcf\x11\xe0": "is an Excel workbook of the old kind (.xls); save it as CSV",
    b"MATLAB ": "is a MAT-file of MATLAB; write it as CSV there: writetable",
    b"\x89HDF": "is HDF5 (or a MAT-file of MATLAB 7.3); write its table as CSV or Parquet: pandas",
    b"#ROSBAG ": "is a bag of ROS 1; convert it: rosbags-convert --src FILE --dst FOLDER",
    b"LOGG": "is a CAN log of Vector (BLF); decode it to CSV: python-can, cantools",
    b"MDF ": "is a measurement in ASAM MDF (MF4); write it as Parquet or CSV: asammdf",
    b"ARROW1": "is an Arrow (Feather) file; write it as Parquet: pyarrow, polars or pandas",
    b"\xff\xfe": "is text in UTF-16; write it in UTF-8: iconv -f UTF-16 -t UTF-8 FILE",
    b"\xfe\xff": "is text in UTF-16; write it in UTF-8: iconv -f UTF-16 -t UTF-8 FILE",
    b"\x93NUMPY": "is an array of NumPy; write it as CSV with names of columns: numpy.savetxt",
}
# Where an MCAP file has its profile: behind the mark, an opcode and two lengths.
_PROFILE = len(_MCAP) + 1 + 8 + 4

#: Factors that turn units of time into s, and all units into s, m, m/s or m/s².
TIMES = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0}
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
_SPELT |= {"\u00b5s": "us", "\u03bcs": "us", "knots": "kn", "kt": "kn", "m/s/s": "m/s2"}
# What stands in a field where there is no number.
_NOTHING = ("", "na", "n/a", "null", "none")
# What no text holds.
_CONTROL = re.compile(rb"[\0-\x08\x0e-\x1f]")
_DATE = re.compile(r"\s*\d{4}-?\d\d-?\d\d[Tt ]")
_DATE_LIKE = re.compile(r"\s*\d{1,4}([.:/-])\d\d?\1\d")
_ISO = "in ISO 8601, such as 2026-03-14T09:26:53.5+01:00"


def unit_of(text: str) -> str:
    """A unit as we call it, of one in brackets or spelt otherwise; others as they are.

    >>> unit_of("[km/h]"), unit_of("m/s^2"), unit_of("deg")
    ('km/h', 'm/s2', 'deg')
    """
    text = text.strip().strip("[]()<>").replace(" ", "").replace("²", "2").replace("^", "")
    return next(
        (one for one in (text, text.lower()) if one in UNITS), _SPELT.get(text.lower(), text)
    )


def silent(count: int) -> None:
    """Nobody wants to know how much was read."""


def file_kind(path: str) -> Kind:
    """What the file holds, judged by how it begins.

    A trace of OSI begins with nothing of its own and is known by its name, ``.osi``. The folder of
    a bag of ROS 2 is ``"bag"``, as its files are; ``"run"`` is a log that evofsm wrote. A
    ValueError says what a file is that is of a foreign kind, and how it can be read.
    """
    if os.path.isfile(os.path.join(path, "metadata.yaml")):
        return "bag"
    if path.removesuffix(".gz").endswith(".osi"):
        return "osi"
    with Source(path) as source:
        beginning = source.read(64).removeprefix(_BYTE_ORDER_MARK).lstrip()
    if not beginning:
        raise ValueError(f"{path} is empty")
    if foreign := next((says for mark, says in _FOREIGN.items() if beginning.startswith(mark)), ""):
        raise ValueError(f"{path} {foreign}")
    if beginning.startswith(_MCAP):
        profile = beginning[_PROFILE:]
        kinds: dict[bytes, Kind] = {b"ros2": "bag", b"evofsm": "run"}
        return next((kind for mark, kind in kinds.items() if profile.startswith(mark)), "mcap")
    marks: dict[bytes, Kind] = {_PARQUET: "parquet", _SQLITE: "bag", b"<": "xml"}
    return next((kind for mark, kind in marks.items() if beginning.startswith(mark)), "csv")


class Source:
    """A file that is read once, unpacked if it is gzipped."""

    def __init__(self, path: str, on_read: OnRead = silent) -> None:
        if os.path.isdir(path):
            raise IsADirectoryError(f"{path} is a folder; name the files in it")
        if os.path.exists(path) and not os.path.isfile(path):
            raise ValueError(f"{path} is a pipe or a device; write it to a file first")
        self.path = path
        self.lines = 0  # read so far of one that is gzipped
        self._on_read = on_read
        self._raw = io.BufferedReader(io.FileIO(path))
        self._packed = self._raw.peek(2).startswith(_GZIP)
        self._file = gzip.GzipFile(fileobj=self._raw) if self._packed else self._raw

    def __enter__(self) -> Self:
        return self

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
        quotes, most = block.count(b'"'), len(block) + _LONGEST_LINE
        # A quote that is never closed is left to whoever parses them.
        while block and not (block.endswith(b"\n") and (quotes % 2 == 0 or len(block) > most)):
            line = self._take(_LONGEST_LINE, to_line_end=True)
            if not line:
                block += b"" if block.endswith(b"\n") else b"\n"
                break
            block += line
            quotes += line.count(b'"')
            if len(block) > most and not line.endswith(b"\n"):
                where = f"line {self.lines}" if self._packed else f"byte {self._raw.tell():,}"
                raise ValueError(
                    f"{self.path}, about {where}: a line of more than {_LONGEST_LINE:,} bytes; "
                    "this is no table"
                )
        return bytes(block)

    def _take(self, most: int, to_line_end: bool = False) -> bytes:
        before = self._raw.tell()
        try:
            data: bytes = self._file.readline(most) if to_line_end else self._file.read1(most)
        except (EOFError, zlib.error, gzip.BadGzipFile) as error:
            raise ValueError(
                f"{self.path}, after line {self.lines}: the gzip data ends early or is damaged "
                f"(was a copy or a download interrupted, or is it still being written?): {error}"
            ) from error
        if self._packed:
            self.lines += data.count(b"\n")
        self._on_read(self._raw.tell() - before)
        return data


class RefusedError(ValueError):
    """What is wrong with a file, in words of our own; `readable` says of which."""


@contextmanager
def readable(path: str | os.PathLike[str], kind: str) -> Iterator[None]:
    """Turn whatever a library runs into in a damaged file into one error that names the file."""
    try:
        yield
    except (OSError, ModuleNotFoundError):
        raise
    except RefusedError as error:
        raise ValueError(f"{os.fspath(path)}: {error}") from None
    except Exception as error:
        why = str(error)[:300] or type(error).__name__
        raise ValueError(f"{os.fspath(path)} cannot be read as {kind}: {why}") from error


# -- Pieces of tables -----------------------------------------------------------------------------


@dataclass(frozen=True)
class Piece:
    """Some consecutive rows of a table: T values for each column that was asked for."""

    rows: int
    numbers: Numbers  #: NaN where one is missing
    find: Find
    texts: dict[str, polars.Series] = field(default_factory=dict)
    #: Rows that begin an episode, of a table that knows; None where columns tell episodes apart.
    starts: Sequence[int] | None = None
    names: Sequence[str] = ()  #: of these episodes, of a table that knows

    @classmethod
    def of_numbers(
        cls, path: str, before: int, numbers: Numbers, starts: Sequence[int], names: Sequence[str]
    ) -> Self:
        """Rows of numbers alone, after so many others."""

        def find(row: int, name: str | None) -> tuple[str, str]:
            text = "" if name is None else str(numbers[name][row])
            return f"{path}, row {before + row + 1}", text

        return cls(len(next(iter(numbers.values()))), numbers, find, starts=starts, names=names)

    def at(self, row: int) -> str:
        """Where a row stands, for a message."""
        return self.find(row, None)[0]

    def refuse(self, row: int, name: str, why: str = "") -> NoReturn:
        """Raise for what stands in a row and column."""
        place, text = self.find(row, name)
        raise ValueError(f"{place}, column {name!r}: {why.format(text[:40]) or explained(text)}")

    def refuse_unusable(
        self,
        name: str,
        where: NDArray[np.bool_] | bool = True,
        ends: tuple[float, float] = (-LARGEST_OBSERVATION, LARGEST_OBSERVATION),
        why: str = "",
    ) -> None:
        """Raise where a number cannot be learnt, or lies outside of these ends; NaN is none."""
        numbers = self.numbers[name]
        unusable = ~((numbers >= ends[0]) & (numbers <= ends[1])) & where
        if unusable.any():
            self.refuse(int(np.argmax(unusable)), name, why)


class Wanted(NamedTuple):
    """What is read of a table."""

    numbers: Sequence[str]
    texts: Sequence[str] = ()
    gaps: Collection[str] = ()  #: numbers that may be missing or infinite; others are refused then
    date: str | None = None  #: comes as a number, of microseconds

    @property
    def all(self) -> list[str]:
        """Columns that are read, each once."""
        dates = [self.date] if self.date else []
        return list(dict.fromkeys([*self.numbers, *self.texts, *dates]))

    def piece(self, found: Mapping[str, polars.Series], find: Find) -> Piece:
        """The columns of some rows as what is wanted of them; numbers may be given as texts."""
        import polars

        piece = Piece(len(found[self.all[0]]), {}, find)
        for name in dict.fromkeys(self.numbers):
            values = found[name]
            if values.dtype == polars.String:
                fields = values.str.strip_chars()
                values = fields.cast(polars.Float64, strict=False)
                wrong = values.is_null() & ~fields.str.to_lowercase().is_in(_NOTHING)
                if wrong.any():
                    piece.refuse(int(wrong.arg_max() or 0), name)
            piece.numbers[name] = values.cast(polars.Float64).to_numpy()
            if name not in self.gaps:
                piece.refuse_unusable(name)
        for name in self.texts:
            texts = found[name].cast(polars.String)
            piece.texts[name] = texts.fill_null("") if texts.null_count() else texts
        if self.date is not None:
            piece.numbers[self.date] = _microseconds(piece, self.date, found[self.date])
        return piece


class Table:
    """A table whose header is known and whose rows are still to be read."""

    path: str
    columns: Sequence[str]
    #: As a row below the names says; empty of a column of which it does not.
    units: Mapping[str, str] = {}

    def pieces(self, wanted: Wanted) -> Iterator[Piece]:
        """Read columns, in the order of rows."""
        raise NotImplementedError

    def holds_dates(self, name: str) -> bool:
        """Whether a column holds times of ISO 8601 in place of numbers, as its first row says."""
        return False


class CsvTable(Table):
    """A CSV file, gzipped or not, with a header; fields end at a comma, a semicolon or a tab.

    Where they end at a semicolon, a number may have a decimal comma.
    polars reads blocks of plain lines; Python's own reader, which is slower, blocks with anything
    odd, such as a line break within quotes, and what a message is to name.
    """

    def __init__(self, path: str, on_read: OnRead = silent) -> None:
        with needs("polars", "tables", f"{path}: a table"):
            import polars  # noqa: F401 (said here, before the work begins)
        self.path = path
        self._on_read = on_read
        # A field may be long that nobody asks for; lines are bounded.
        csv.field_size_limit(max(csv.field_size_limit(), _CSV_BYTES + 2 * _LONGEST_LINE))
        with Source(path) as source:
            lines = self._text(source.rows(), 0).removeprefix("\ufeff").split("\n", 4)[:4]
        self._above = 1 + lines[0].startswith("sep=")  # lines before the first row
        text, *first = (line.rstrip("\r") for line in lines[self._above - 1 :] or [""])
        self._separator = max(",;\t", key=text.count)
        self.columns = [name.strip() for name in self._split(text, 1)]
        # With nothing in it that has a meaning; polars is not to be left alone with others.
        quoted = f'"[^"{self._separator}\\r\\n]*"(?=[{self._separator}\\r\\n])'
        self._quoted = re.compile(quoted.encode())
        rows = [self._split(row, 2) for row in first]
        told = [unit_of(text) for text in rows[0]] if rows else []
        if any(one in UNITS for one in told) and not any(map(_is_number, told)):
            self.units = dict(zip(self.columns, told, strict=False))
            self._above, rows = self._above + 1, rows[1:]
        self._first_row = rows[0] if rows else []
        if all(_is_number(name) for name in self.columns):
            raise ValueError(
                f"{path}, line 1: {text.strip()[:200]!r} is no header; the first line must name "
                "the columns"
            )

    def _split(self, line: str, number: int) -> list[str]:
        try:  # the first row may go on in the next line
            return next(csv.reader([line], delimiter=self._separator, strict=number == 1), [])
        except csv.Error as error:
            raise self._no_csv(number, error) from error

    def _no_csv(self, line: int, error: csv.Error) -> ValueError:
        return ValueError(f"{self.path}, line {line}: {error} (an unclosed quote?)")

    def holds_dates(self, name: str) -> bool:
        """Whether the first row has a time of ISO 8601 there; what else it has is not judged."""
        first = dict(zip(self.columns, self._first_row, strict=False))
        return _DATE.match(first.get(name, "")) is not None

    def pieces(self, wanted: Wanted) -> Iterator[Piece]:
        """Read columns, in the order of rows."""
        import polars

        if twice := [name for name in wanted.all if self.columns.count(name) > 1]:
            raise ValueError(f"{self.path}, line 1: two columns are called {twice[0]!r}")
        places = {name: self.columns.index(name) for name in wanted.all}
        with Source(self.path, self._on_read) as source:
            reached = 0
            while block := source.rows():
                if not block.isascii():
                    block = self._text(block, reached).encode()
                while reached < self._above:
                    block, reached = block.partition(b"\n")[2], reached + 1
                found = self._plain(block, places, wanted.numbers)
                is_plain = found is not None
                if found is None:
                    rows = self._odd(block, reached)[1]
                    fields = {name: [row[k] for row in rows] for name, k in places.items()}
                    found = polars.DataFrame(fields, dict.fromkeys(places, polars.String)).to_dict()
                    for name in wanted.numbers if self._separator == ";" else ():
                        found[name] = found[name].str.replace(",", ".", literal=True)
                if n_rows := len(found[wanted.all[0]]):
                    yield wanted.piece(found, partial(self._find, block, reached))
                reached += n_rows if is_plain else block.count(b"\n")

    def _plain(
        self, block: bytes, places: Mapping[str, int], numbers: Sequence[str]
    ) -> dict[str, polars.Series] | None:
        """The columns, numbers as such; None where anything is odd."""
        import polars

        if b'"' in block and 2 * len(self._quoted.findall(block)) != block.count(b'"'):
            return None
        # As polars calls columns, for there may be two of one name.
        kinds: dict[str, Any] = {f"column_{k + 1}": polars.String for k in range(len(self.columns))}
        kinds |= {f"column_{places[name] + 1}": polars.Float64 for name in numbers}
        wanted = [f"column_{place + 1}" for place in places.values()]
        dialect: Any = {"separator": self._separator, "decimal_comma": self._separator == ";"}
        try:
            frame = polars.read_csv(block, columns=wanted, schema=kinds, **dialect, **_PLAIN)
        except (polars.exceptions.PolarsError, polars.exceptions.PanicException):
            return None
        found = {name: frame[f"column_{place + 1}"] for name, place in places.items()}
        is_whole = block.count(self._separator.encode()) == len(frame) * (len(self.columns) - 1)
        lacks = any(found[name].null_count() for name in numbers)
        return found if is_whole and not lacks else None

    def _odd(self, block: bytes, reached: int) -> tuple[list[int], list[list[str]]]:
        """The lines of rows, and their fields."""
        text = io.StringIO(block.decode(), newline="")
        rows = csv.reader(text, delimiter=self._separator, strict=True)
        lines, found = list[int](), list[list[str]]()
        try:
            for fields in filter(None, rows):
                lines.append(reached + rows.line_num)
                found.append(fields)
                if len(fields) != len(self.columns):
                    raise ValueError(
                        f"{self.path}, line {lines[-1]}: {len(fields)} fields, but the header "
                        f"names {len(self.columns)} (was the file cut off, is a quote not closed, "
                        f"or does a field hold {self._separator!r}?)"
                    )
        except csv.Error as error:
            raise self._no_csv(reached + rows.line_num, error) from error
        return lines, found

    def _find(self, block: bytes, reached: int, row: int, name: str | None) -> tuple[str, str]:
        lines, rows = self._odd(block, reached)
        text = "" if name is None else rows[row][self.columns.index(name)]
        return f"{self.path}, line {lines[row]}", text

    def _text(self, block: bytes, reached: int) -> str:
        """Lines in UTF-8 or, where they are none, in the encoding of Western Europe."""
        try:
            return block.decode()
        except UnicodeDecodeError as error:
            if not _CONTROL.search(block):
                return block.decode("cp1252", errors="replace")
            line = reached + block.count(b"\n", 0, error.start)
            raise ValueError(
                f"{self.path}, after line {line}: this is not text in UTF-8 (a file of another "
                "kind, or saved in another encoding?)"
            ) from error


class ParquetTable(Table):
    """A Parquet file; read with polars because pyarrow cannot be imported beside libsumo."""

    def __init__(self, path: str, on_read: OnRead = silent) -> None:
        with needs("polars", "tables", f"{path}: Parquet"):
            import polars
        self.path = path
        self._on_read = on_read
        # polars takes other paths for addresses on the network, or of somebody's home.
        self._scan = polars.scan_parquet(os.path.abspath(path), glob=False)
        with self._readable():
            self._types = self._scan.collect_schema()
            self._rows = int(self._scan.select(polars.len()).collect().item())
        self.columns = list(self._types)

    def holds_dates(self, name: str) -> bool:
        """Whether its type says so, or the first of its texts."""
        import polars

        if self._types[name] == polars.String and self._rows:
            with self._readable():
                first = self._scan.select(name).head(1).collect().item()
            return _DATE.match(str(first or "")) is not None
        return isinstance(self._types[name], polars.Datetime)

    def pieces(self, wanted: Wanted) -> Iterator[Piece]:
        """Read columns, in the order of rows."""
        for name in wanted.numbers:
            if not self._types[name].is_numeric():
                raise ValueError(
                    f"{self.path}: column {name!r} holds {self._types[name]}, not numbers"
                )
        part = self._scan.select(wanted.all)
        # Not collect_batches: it reads ahead of a slow consumer without bound (polars #28569).
        for first in range(0, self._rows, _PARQUET_ROWS):
            with self._readable():
                frame = part.slice(first, _PARQUET_ROWS).collect()
            found = {name: frame[name] for name in wanted.all}
            yield wanted.piece(found, partial(self._find, frame, first))
            self._on_read(os.path.getsize(self.path) * len(frame) // self._rows)

    def _find(
        self, frame: polars.DataFrame, first: int, row: int, name: str | None
    ) -> tuple[str, str]:
        value = None if name is None else frame[name][row]
        return f"{self.path}, row {first + row + 1}", "" if value is None else str(value)

    @contextmanager
    def _readable(self) -> Iterator[None]:
        import polars

        try:
            yield
        # A panic is what polars makes of some damaged files; it is no Exception.
        except (polars.exceptions.PolarsError, polars.exceptions.PanicException) as error:
            cause = str(error).partition("\n")[0][:300]
            why = "(was a copy or a download interrupted?)"
            raise ValueError(f"{self.path} cannot be read as Parquet {why}: {cause}") from error


# -- Fields ---------------------------------------------------------------------------------------


def explained(text: str) -> str:
    """Why a text is not the number it should be, or one that cannot be learnt."""
    if not text.strip():
        return (
            "the field is empty (a missing measurement, or no leader? --no-leader end leaves such "
            "rows out; an episode's last action may be any number)"
        )
    if _is_number(text):
        return (
            f"{text[:40]} cannot be learnt (a missing or failed measurement? leave the row out: a "
            "hole in time begins a new episode)"
        )
    if _is_number(text.replace(",", ".")):
        return f"{text[:40]!r} is no number (a decimal comma? write 1.5)"
    if _DATE_LIKE.match(text):
        return f"{text[:40]!r} is no number (a date? it has to be {_ISO})"
    return f"{text[:40]!r} is no number (a text, a date, or a unit behind the number?)"


def _is_number(text: str) -> bool:
    try:
        float(text.replace("_", "x"))  # which Python reads, and nobody else
    except ValueError:
        return False
    return True


def _microseconds(piece: Piece, name: str, dates: polars.Series) -> NDArray[np.float64]:
    """Microseconds since 1970, exactly; without a zone a date is taken as UTC."""
    import polars

    why = f"{{!r}} is not read as a date; all must be {_ISO}, and all have a zone, or none"
    if dates.dtype == polars.String:
        texts = dates.str.strip_chars().str.replace(",", ".", literal=True)
        try:
            dates = texts.str.to_datetime(strict=False)
        except polars.exceptions.ComputeError:
            piece.refuse(0, name, why)
    if dates.null_count():
        piece.refuse(int(dates.is_null().arg_max() or 0), name, why)
    return dates.dt.epoch("us").cast(polars.Float64).to_numpy()
