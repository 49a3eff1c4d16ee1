"""Read a table in CSV or Parquet piece by piece, and turn its columns into numbers and texts."""

from __future__ import annotations

import csv
import io
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import chain
from typing import Any, BinaryIO, NoReturn, Protocol, Self, cast

import numpy as np
from numpy.typing import NDArray

from evofsm.extras import needs
from evofsm.io.dates import looks_like_a_date, microseconds
from evofsm.io.files import BYTE_ORDER_MARK, OnRead, damage_explained, open_unpacked, silent
from evofsm.io.plain import Texts, number_or_gap, parse_plain
from evofsm.store import LARGEST_OBSERVATION

# At once: enough that what Python does in between hardly counts.
_CSV_BYTES = 1 << 21
# Rows at once of a CSV file that is not plain, and characters in which so many may end sooner.
_CSV_ROWS = 8192
_CSV_CHARACTERS = 1 << 22
_LONGEST_LINE = 1_000_000
# Characters of a row, which a quoted field may carry on over many lines.
_LONGEST_ROW = _LONGEST_LINE
_LONGEST_CHARACTER = 4  # bytes, in UTF-8
# polars decodes a whole row group for each slice of it, so small slices would only cost time.
_PARQUET_ROWS = 65536


@dataclass(frozen=True)
class Piece:
    """Some consecutive rows of a table: T values for each column that was asked for."""

    path: str
    unit: str  #: what its places count: "line" as an editor shows it, or "row" from 1
    places: NDArray[np.int64]  #: (T,)
    numbers: dict[str, NDArray[np.float64]]
    texts: dict[str, Texts]
    #: Rows that begin an episode, of a table that knows; None where columns tell episodes apart.
    starts: NDArray[np.int64] | None = None
    cuts: int = 0  #: episodes in it that were cut because too many pairs were on the road at once

    def at(self, row: int) -> str:
        """Where a row stands, for a message."""
        return f"{self.path}, {self.unit} {self.places[row]}"


class Table(Protocol):
    """A table whose header is known and whose rows are still to be read."""

    path: str
    columns: tuple[str, ...]

    def pieces(
        self,
        numbers: Sequence[str],
        texts: Sequence[str],
        dates: Sequence[str] = (),
        gaps: Sequence[str] = (),
    ) -> Iterator[Piece]:
        """Read the named columns, in the order of rows.

        Of the numbers those in ``gaps`` may be missing: NaN, or what whoever asked has to refuse.
        ``dates`` come as numbers, of microseconds.
        """
        ...

    def holds_dates(self, name: str) -> bool:
        """Whether a column holds times of ISO 8601 in place of numbers, as its first row says."""
        ...


class CsvTable:
    """A CSV file, gzipped or not, with a header; fields end at a comma, a semicolon or a tab.

    Compiled code reads what is plain. From the first block on that is not, Python's own reader
    does: it knows all that a CSV file may be, and what to say of one that is none.
    """

    def __init__(self, path: str, on_read: OnRead = silent) -> None:
        self.path = path
        self._on_read = on_read
        header: list[str] = []
        with open_unpacked(path) as file, damage_explained(path):
            lines = _lines(path, _text(file))
            first = next(lines, "")
            unmarked = first.removeprefix(BYTE_ORDER_MARK.decode())
            self._separator = max(",;\t", key=unmarked.count)
            of_row = _LinesOfRow(path, chain([unmarked], _kept(lines, header)))
            rows = csv.reader(of_row, delimiter=self._separator)
            self.columns = tuple(name.strip() for name in next(rows, []))
            self._header_lines = rows.line_num
            self._header_size = sum(len(line.encode()) for line in (first, *header))
        if all(_reads(name) for name in self.columns):
            raise ValueError(
                f"{path}, line 1: {unmarked.strip()[:200]!r} is no header; the first line must "
                "name the columns"
            )

    def holds_dates(self, name: str) -> bool:
        """Whether the first row has a time of ISO 8601 there; what else it has is not judged."""
        with open_unpacked(self.path) as file, suppress(ValueError, EOFError, OSError, csv.Error):
            file.read(self._header_size)
            text = _text(file)  # kept until the file is closed
            lines = _lines(self.path, text, reached=self._header_lines)
            row = next(csv.reader(lines, delimiter=self._separator), [])
            return len(row) == len(self.columns) and looks_like_a_date(row[self._place(name)])
        return False

    def pieces(
        self,
        numbers: Sequence[str],
        texts: Sequence[str],
        dates: Sequence[str] = (),
        gaps: Sequence[str] = (),
    ) -> Iterator[Piece]:
        """Read the named columns, in the order of rows."""
        numbers, texts = list(dict.fromkeys(numbers)), list(dict.fromkeys([*texts, *dates]))
        for piece in self._pieces(numbers, texts, gaps):
            for name in dates:
                piece.numbers[name] = _microseconds(piece, name)
            yield piece

    def _pieces(
        self, numbers: Sequence[str], texts: Sequence[str], gaps: Sequence[str]
    ) -> Iterator[Piece]:
        places = [self._place(name) for name in numbers], [self._place(name) for name in texts]
        may_lack = {self._place(name) for name in gaps}
        reached = self._header_lines
        with open_unpacked(self.path, self._on_read) as file:
            file.read(self._header_size)
            while block := _whole_lines(self.path, file, reached):
                rows = parse_plain(block, self._separator, len(self.columns), *places, may_lack)
                if rows is None:
                    rest = (_text(io.BytesIO(block)), _text(file))
                    yield from self._read_carefully(rest, reached, numbers, texts, gaps)
                    return
                piece = Piece(self.path, "line", rows.lines + reached, {}, {})
                for name, values in zip(numbers, rows.numbers, strict=True):
                    if name not in gaps:
                        refuse_unusable(piece, name, values)
                    piece.numbers[name] = values
                piece.texts.update(zip(texts, rows.texts, strict=True))
                yield piece
                reached += rows.n_lines

    def _read_carefully(
        self,
        parts: Iterable[io.TextIOWrapper],
        reached: int,
        numbers: Sequence[str],
        texts: Sequence[str],
        gaps: Sequence[str],
    ) -> Iterator[Piece]:
        """Read the lines of some parts, after those that were read before."""
        places = {name: self._place(name) for name in (*numbers, *texts)}
        lines = _LinesOfRow(self.path, _lines(self.path, *parts, reached=reached), reached)
        rows = csv.reader(lines, delimiter=self._separator)
        with damage_explained(self.path, lambda: lines.number):
            while some := lines.some(rows):
                fields, places_of_rows = self._columns(some)
                piece = Piece(self.path, "line", places_of_rows, {}, {})
                for name in numbers:
                    piece.numbers[name] = _numbers(piece, name, fields[places[name]], name in gaps)
                for name in texts:
                    piece.texts[name] = Texts.of(fields[places[name]])
                yield piece

    def _place(self, name: str) -> int:
        if self.columns.count(name) > 1:
            raise ValueError(f"{self.path}, line 1: two columns are called {name!r}")
        return self.columns.index(name)

    def _columns(
        self, some: list[tuple[int, list[str]]]
    ) -> tuple[list[tuple[str, ...]], NDArray[np.int64]]:
        """Fields column by column, and the line of each row; blank lines are passed over."""
        filled = [(line, row) for line, row in some if row]
        for line, row in filled:
            if len(row) != len(self.columns):
                raise ValueError(
                    f"{self.path}, line {line}: {len(row)} fields, but the header names "
                    f"{len(self.columns)} (was the file cut off, or does a field hold "
                    f"{self._separator!r}?)"
                )
        fields = list(zip(*(row for _, row in filled), strict=True))
        return fields or [()] * len(self.columns), np.array([line for line, _ in filled], np.int64)


class ParquetTable:
    """A Parquet file; read with polars because pyarrow cannot be imported beside libsumo."""

    def __init__(self, path: str, on_read: OnRead = silent) -> None:
        with needs("polars", "tables", f"{path}: Parquet"):
            import polars
        self.path = path
        self._on_read = on_read
        try:
            # polars takes other paths for addresses on the network, or of somebody's home.
            self._scan = polars.scan_parquet(os.path.abspath(path), glob=False)
            self._types = self._scan.collect_schema()
            self._rows = int(self._scan.select(polars.len()).collect().item())
        # A panic is what polars makes of some damaged files; it is no Exception.
        except (polars.exceptions.PolarsError, polars.exceptions.PanicException) as error:
            self._refuse(error)
        self.columns = tuple(self._types)

    def holds_dates(self, name: str) -> bool:
        """Whether its type says so, or the first of its texts."""
        import polars

        kind = self._types[name]
        if kind == polars.String and self._rows:
            return looks_like_a_date(str(self._scan.select(name).head(1).collect().item() or ""))
        return isinstance(kind, polars.Datetime)

    def pieces(
        self,
        numbers: Sequence[str],
        texts: Sequence[str],
        dates: Sequence[str] = (),
        gaps: Sequence[str] = (),
    ) -> Iterator[Piece]:
        """Read the named columns, in the order of rows."""
        import polars

        for name in numbers:
            if not self._types[name].is_numeric():
                raise ValueError(
                    f"{self.path}: column {name!r} holds {self._types[name]}, not numbers"
                )
        texts = [*texts, *(name for name in dates if self._types[name] == polars.String)]
        wanted = self._scan.select(list(dict.fromkeys([*numbers, *texts, *dates])))
        size = os.path.getsize(self.path)
        # Not collect_batches: it reads ahead of a slow consumer without bound (polars #28569).
        for first in range(0, self._rows, _PARQUET_ROWS):
            try:
                frame = wanted.slice(first, _PARQUET_ROWS).collect()
            except (polars.exceptions.PolarsError, polars.exceptions.PanicException) as error:
                self._refuse(error)
            rows = len(frame)
            places = np.arange(first + 1, first + rows + 1)
            piece = Piece(self.path, "row", places, {}, {})
            for name in numbers:
                values = frame[name].cast(polars.Float64).to_numpy()
                if name not in gaps:
                    refuse_unusable(piece, name, values)
                piece.numbers[name] = values
            for name in texts:
                fields = frame[name].cast(polars.String).fill_null("")
                firsts = fields.ne_missing(fields.shift()).arg_true()
                piece.texts[name] = Texts(
                    fields.gather(firsts).to_list(), firsts.to_numpy().astype(np.int64), rows
                )
            for name in dates:
                if name in piece.texts:
                    piece.numbers[name] = _microseconds(piece, name)
                else:
                    ticks = frame[name].dt.epoch("us").cast(polars.Float64).to_numpy()
                    refuse_unusable(piece, name, ticks)
                    piece.numbers[name] = ticks
            self._on_read(size * rows // self._rows)
            yield piece

    def _refuse(self, error: BaseException) -> NoReturn:
        cause = str(error).partition("\n")[0][:300]
        raise ValueError(
            f"{self.path} cannot be read as Parquet (was a copy or a download interrupted?): "
            f"{cause}"
        ) from error


def _text(file: Any) -> io.TextIOWrapper:
    return io.TextIOWrapper(file, encoding="utf-8", newline="")


def _whole_lines(path: str, file: BinaryIO, reached: int) -> bytes:
    """The next lines of a file, the last one ended whether it is in the file or not."""
    file = cast(io.BufferedReader, file)
    parts: list[bytes] = []
    missing = _CSV_BYTES
    with damage_explained(path, lambda: reached + b"".join(parts).count(b"\n")):
        # Not `read`: where the file is damaged, it would forget what came before.
        while missing > 0 and (part := file.read1(missing)):
            parts.append(part)
            missing -= len(part)
        if parts and not parts[-1].endswith(b"\n"):
            parts.append(file.readline(_LONGEST_CHARACTER * _LONGEST_LINE))
            if not parts[-1].endswith(b"\n"):
                parts.append(b"\n")
    return b"".join(parts)


def _lines(path: str, *parts: io.TextIOWrapper, reached: int = 0) -> Iterator[str]:
    """The lines of the parts of a file; none is read whole that no table would hold."""
    number = reached
    for text in parts:
        while line := text.readline(_LONGEST_LINE):
            number += 1
            if len(line) == _LONGEST_LINE and not line.endswith("\n"):
                raise ValueError(
                    f"{path}, line {number}: longer than {_LONGEST_LINE:,} characters; "
                    "this is no table"
                )
            yield line


class _LinesOfRow:
    """Lines for a csv reader, which sees no end to a row whose quotes go on opening."""

    def __init__(self, path: str, lines: Iterator[str], reached: int = 0) -> None:
        self._path = path
        self._lines = lines
        self._size = 0  # of the row that is being read
        self.number = reached  #: of the latest line

    def __iter__(self) -> Self:
        return self

    def __next__(self) -> str:
        line = next(self._lines)
        self.number += 1
        self._size += len(line)
        if self._size > _LONGEST_ROW:
            raise ValueError(
                f"{self._path}, line {self.number}: a row of more than {_LONGEST_ROW:,} characters "
                "(an unclosed quote?)"
            )
        return line

    def some(self, rows: Iterator[list[str]]) -> list[tuple[int, list[str]]]:
        """The next rows that a reader makes of these lines, each with its last line."""
        found: list[tuple[int, list[str]]] = []
        size = 0
        for row in rows:
            found.append((self.number, row))
            size += self._size
            self._size = 0
            if len(found) == _CSV_ROWS or size > _CSV_CHARACTERS:
                break
        return found


def _kept(lines: Iterator[str], into: list[str]) -> Iterator[str]:
    """The same lines, each kept as well once it is read."""
    for line in lines:
        into.append(line)
        yield line


def _reads(text: str, read: Callable[[str], object] = float) -> bool:
    """Whether a text can be read, as a number or by another function."""
    try:
        read(text)
    except ValueError:
        return False
    return True


def _numbers(piece: Piece, name: str, fields: Sequence[str], may_lack: bool) -> NDArray[np.float64]:
    read = number_or_gap if may_lack else float
    try:
        values = np.fromiter(map(read, fields), np.float64, len(fields))
    except ValueError:
        row = next(row for row, field in enumerate(fields) if not _reads(field, read))
        raise ValueError(f"{piece.at(row)}, column {name!r}: {explain_text(fields[row])}") from None
    if not may_lack:
        refuse_unusable(piece, name, values)
    return values


def _microseconds(piece: Piece, name: str) -> NDArray[np.float64]:
    """Dates of a column of texts."""
    texts = piece.texts[name]
    try:
        return np.repeat(microseconds(texts.values), texts.lengths)
    except ValueError as error:
        wrong = [not _reads(text, lambda one: microseconds([one])) for text in texts.values]
        row = int(texts.firsts[wrong.index(True)]) if any(wrong) else 0
        raise ValueError(
            f"{piece.at(row)}, column {name!r}: {error}; the first row has a date, so all must "
            "have one in ISO 8601, such as 2026-03-14T09:26:53.5+01:00"
        ) from None


def refuse_unusable(piece: Piece, name: str, values: NDArray[np.float64]) -> None:
    """Raise where a number cannot be learnt; NaN is none."""
    usable = np.abs(values) <= LARGEST_OBSERVATION  # false of NaN
    if not usable.all():
        row = int(np.argmin(usable))
        raise ValueError(
            f"{piece.at(row)}, column {name!r}: {values[row]} cannot be learnt "
            "(a missing or failed measurement? leave the row out: a hole in time begins a new "
            "episode)"
        )


def explain_text(text: str) -> str:
    """Why a text is not the number it should be."""
    if not text.strip():
        return (
            "the field is empty (a missing measurement, or no leader? --no-leader end leaves such "
            "rows out; an episode's last action may be any number)"
        )
    if _reads(text.replace(",", ".")):
        return f"{text[:40]!r} is no number (a decimal comma? write 1.5)"
    return f"{text[:40]!r} is no number (a text, a date, or a unit behind the number?)"
