"""Columns of a CSV file by name or by place, missing values as NaN."""

from __future__ import annotations

import csv
import gzip
import zlib
from array import array
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

#: How layouts write that a value is missing.
MISSING = frozenset({"", ".", "nan", "na", "null"})


def name_of(path: Path) -> str:
    """Name of a recording: the file's, without its endings.

    Examples
    --------
    >>> name_of(Path("data/run_7.csv.gz"))
    'run_7'
    """
    return path.name.removesuffix(".gz").rsplit(".", 1)[0]


def header_and_rows(path: Path) -> Iterator[list[str]]:
    """Rows of a CSV file, gzipped or not, as texts; the header is the first of them."""
    opened = gzip.open if path.suffix == ".gz" else open
    with opened(path, "rt", encoding="utf-8-sig", newline="") as file:
        rows = csv.reader(file, skipinitialspace=True)
        try:
            yield from rows
        except (EOFError, zlib.error, gzip.BadGzipFile, csv.Error, UnicodeDecodeError) as error:
            raise ValueError(f"{path}, after line {rows.line_num}: {error}") from error


def places(path: Path, header: Sequence[str], names: Sequence[Sequence[str]]) -> list[int]:
    """Where columns stand, each under one of several names; upper and lower case are alike."""
    known = {name.strip().lower(): place for place, name in enumerate(header)}
    found = []
    for options in names:
        place = next((known[name.lower()] for name in options if name.lower() in known), None)
        if place is None:
            raise ValueError(
                f"{path} has no column {options[0]!r}; it has {', '.join(header[:12])} "
                "(a file of another layout?)"
            )
        found.append(place)
    return found


def read_columns(path: Path, names: Sequence[Sequence[str]]) -> NDArray[np.float64]:
    """Columns of a file with a header, each under one of several names: (columns, rows)."""
    rows = header_and_rows(path)
    return numbers(path, rows, places(path, next(rows, []), names)).T


def numbers(
    path: Path, rows: Iterator[list[str]], columns: Sequence[int], first_line: int = 2
) -> NDArray[np.float64]:
    """The columns at some places of the rows that are left, (rows, columns); NaN: missing.

    A `ValueError` names the file, the line, counted from ``first_line`` on, and the column of what
    is no number.
    """
    found = array("d")
    for line, row in enumerate(rows, first_line):
        if row:
            found.extend(_number(path, line, row, place) for place in columns)
    if not found:
        raise ValueError(f"{path} has a header but no rows")
    return np.array(found).reshape(-1, len(columns))


def _number(path: Path, line: int, row: list[str], place: int) -> float:
    text = row[place].strip() if place < len(row) else ""
    try:
        return float(text)
    except ValueError:
        if text.lower() in MISSING:
            return np.nan
        raise ValueError(
            f"{path}, line {line}, column {place + 1}: {text!r} is no number"
        ) from None
