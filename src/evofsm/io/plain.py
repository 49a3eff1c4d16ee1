"""Parse plain CSV in compiled code, a block of whole lines at a time.

Plain are rows of the right number of fields, quoted or not, and decimal numbers; they are parsed
exactly as Python's ``csv`` and ``float`` would. A single field that may be a number of another kind
is left to ``float``; a block with anything else in it is not parsed, and the caller has to read it
with Python's own reader.
"""

from __future__ import annotations

import math
from collections.abc import Container, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise, repeat
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from evofsm.fsm import compiled, kernel

_NEWLINE, _RETURN, _QUOTE = ord("\n"), ord("\r"), ord('"')
_PLUS, _MINUS, _POINT, _ZERO, _NINE = (ord(sign) for sign in "+-.09")
_SMALL_E, _LARGE_E = ord("e"), ord("E")

_NOT_PLAIN = -1
# Longer lines hold a field that is longer than the csv module allows, or might.
_LONGEST_LINE = 100_000
# So many digits fit an integer of 64 bits.
_MOST_DIGITS = 18
_MOST_EXPONENT_DIGITS = 4
# Integers up to here, and powers of ten up to 10^22, are exact as floats.
_EXACT = 1 << 53
_POWERS = 10.0 ** np.arange(23)
# A quotient of 60 bits and a power of ten up to this lies so far from the middle between two
# floats, if not right on it, that twice the precision of a float is enough to round it.
_MOST_DECIMALS = 19
# What stands in a field where there is no number.
_NOTHING = ("", "na", "n/a", "null", "none")
# Cuts a float into two halves whose products are exact (Veltkamp).
_SPLITTER = float((1 << 27) + 1)


@dataclass(frozen=True)
class Texts:
    """A column of texts, in which one that repeats in consecutive rows is kept once."""

    values: Sequence[str]  #: each differs from the one before
    firsts: NDArray[np.int64]  #: row in which each begins
    rows: int

    @classmethod
    def of(cls, fields: Sequence[str]) -> Self:
        """The column that holds a text for each row."""
        before: Sequence[str | None] = [None, *fields]
        firsts = [row for row, (last, text) in enumerate(pairwise(before)) if text != last]
        return cls([fields[row] for row in firsts], np.array(firsts, np.int64), len(fields))

    @property
    def lengths(self) -> NDArray[np.int64]:
        """Number of rows for which each value stays."""
        return np.diff(self.firsts, append=self.rows)

    def at(self, row: int) -> str:
        """The text in a row."""
        return self.values[int(np.searchsorted(self.firsts, row, side="right")) - 1]

    def __iter__(self) -> Iterator[str]:
        for value, length in zip(self.values, self.lengths.tolist(), strict=True):
            yield from repeat(value, length)


class PlainRows(NamedTuple):
    """What a block holds: T rows."""

    n_lines: int  #: in the block
    lines: NDArray[np.int64]  #: (T,) line of each row, from 1 in the block
    numbers: NDArray[np.float64]  #: (columns asked for as numbers, T)
    texts: list[Texts]  #: of each column asked for as texts


def number_or_gap(field: str | bytes) -> float:
    """The number in a field; NaN where it says that there is none."""
    text = field.decode() if isinstance(field, bytes) else field
    return math.nan if text.strip().lower() in _NOTHING else float(field)


def parse_plain(
    block: bytes,
    separator: str,
    n_columns: int,
    numbers: Sequence[int],
    texts: Sequence[int],
    gaps: Container[int] = (),
) -> PlainRows | None:
    """Parse whole lines of CSV; returns None if they are not plain.

    Parameters
    ----------
    block : bytes
        Lines, all of them ended.
    separator : str
        What ends a field.
    n_columns : int
        Fields that every line has to have; blank lines are passed over.
    numbers, texts : sequence of int
        Columns to read as numbers and as texts, each at most once, counted from 0.
    gaps : container of int
        Those of the numbers that may be missing, as an empty field.
    """
    data = np.frombuffer(block, np.uint8)
    # Compiled code does not look where an array ends, so there has to be room for every row: one a
    # line, each of whose fields takes a byte at least, and one that turns out to have too few.
    capacity = min(int(np.count_nonzero(data == _NEWLINE)), len(block) // n_columns + 1)
    lines = np.empty(capacity, np.int64)
    values = np.empty((len(numbers), capacity))
    doubts = np.empty((len(numbers) * capacity, 4), np.int64)
    changes = np.empty((len(texts), capacity, 3), np.int64)
    counts = np.zeros(len(texts), np.int64)
    n_lines, rows, n_doubts, is_ascii = _parse_rows(
        data,
        ord(separator),
        _slots(n_columns, numbers),
        _slots(n_columns, texts),
        lines,
        values,
        doubts,
        changes,
        counts,
    )
    if n_lines == _NOT_PLAIN:
        return None
    try:
        if not is_ascii:
            block.decode()
        for slot, row, first, last in doubts[:n_doubts].tolist():
            read = number_or_gap if numbers[slot] in gaps else float
            values[slot, row] = read(block[first:last])
    except ValueError:  # no UTF-8, or no number
        return None
    columns = []
    for change, count in zip(changes, counts.tolist(), strict=True):
        found = [block[first:last].decode() for first, last in change[:count, 1:].tolist()]
        columns.append(Texts(found, change[:count, 0].copy(), rows))
    return PlainRows(n_lines, lines[:rows], values[:, :rows], columns)


def _slots(n_columns: int, wanted: Sequence[int]) -> NDArray[np.int64]:
    """For each column, which of those wanted it is; -1 for none."""
    slots = np.full(n_columns, -1)
    slots[list(wanted)] = range(len(wanted))
    return slots


def _parse(
    block: NDArray[np.uint8],
    separator: int,
    number_slots: NDArray[np.int64],
    text_slots: NDArray[np.int64],
    lines: NDArray[np.int64],
    numbers: NDArray[np.float64],
    doubts: NDArray[np.int64],
    changes: NDArray[np.int64],
    counts: NDArray[np.int64],
) -> tuple[int, int, int, bool]:
    """Fill the arrays; returns lines or `_NOT_PLAIN`, rows, doubts, and whether all is ASCII.

    A doubt is a slot, a row, and where the field begins and ends; a change of a text is a row
    and the same. No loop needs to look for the end of the block: a line's end stops each.
    """
    i = row = line = n_doubts = bits = 0
    last_column = len(number_slots) - 1
    while i < len(block):
        line += 1
        begin = i
        i += _at(block, i) == _RETURN
        if _at(block, i) == _NEWLINE:
            i += 1
            continue
        i = begin
        for column in range(last_column + 1):
            quoted = _at(block, i) == _QUOTE
            i += quoted
            first = i
            slot = number_slots[column]
            sure = False
            if slot >= 0:
                numbers[slot, row], i, sure = _number(block, i)
                if quoted:
                    sure &= _at(block, i) == _QUOTE
                else:
                    sure &= (
                        _at(block, i) == separator
                        or _at(block, i) == _NEWLINE
                        or _at(block, i) == _RETURN
                    )
            if not sure:
                while not (
                    _at(block, i) == _NEWLINE
                    or _at(block, i) == _RETURN
                    or _at(block, i) == _QUOTE
                    or (_at(block, i) == separator and not quoted)
                ):
                    bits |= _at(block, i)
                    i += 1
                if slot >= 0:
                    doubt = doubts[n_doubts]
                    doubt[0], doubt[1], doubt[2], doubt[3] = slot, row, first, i
                    n_doubts += 1
            end = i
            if quoted:
                if _at(block, i) != _QUOTE:
                    return _NOT_PLAIN, 0, 0, False
                i += 1
            if column == last_column:
                i += _at(block, i) == _RETURN
                if _at(block, i) != _NEWLINE:
                    return _NOT_PLAIN, 0, 0, False
            elif _at(block, i) != separator:
                return _NOT_PLAIN, 0, 0, False
            i += 1
            slot = text_slots[column]
            if slot >= 0:
                known = counts[slot]
                if known == 0 or _differ(block, changes[slot, known - 1], first, end):
                    change = changes[slot, known]
                    change[0], change[1], change[2] = row, first, end
                    counts[slot] += 1
        if i - begin > _LONGEST_LINE:
            return _NOT_PLAIN, 0, 0, False
        lines[row] = line
        row += 1
    return line, row, n_doubts, bits < 128


@kernel
def _at(block: NDArray[np.uint8], i: int) -> int:
    """The byte at ``i``, which Numba need not look at for being negative."""
    return int(np.int64(block[np.uintp(i)]))


@kernel
def _differ(block: NDArray[np.uint8], change: NDArray[np.int64], first: int, end: int) -> bool:
    """Whether a field holds another text than the latest one."""
    length = end - first
    if length != change[2] - change[1]:
        return True
    k = 0
    while k < length and block[first + k] == block[change[1] + k]:
        k += 1
    return k < length


@kernel
def _number(block: NDArray[np.uint8], i: int) -> tuple[float, int, bool]:
    """The number that begins at ``i``, where it ends, and whether that is beyond doubt."""
    negative = _at(block, i) == _MINUS
    i += negative or _at(block, i) == _PLUS
    begin = i
    while _at(block, i) == _ZERO:
        i += 1
    first = i
    digits = 0
    while _ZERO <= _at(block, i) <= _NINE:
        digits = 10 * digits + (_at(block, i) - _ZERO)
        i += 1
    found = i - begin
    significant = i - first
    exponent = 0
    if _at(block, i) == _POINT:
        i += 1
        begin = i
        if significant == 0:
            while _at(block, i) == _ZERO:
                i += 1
        first = i
        while _ZERO <= _at(block, i) <= _NINE:
            digits = 10 * digits + (_at(block, i) - _ZERO)
            i += 1
        exponent = begin - i
        found += i - begin
        significant += i - first
    sure = found > 0 and significant <= _MOST_DIGITS
    if _at(block, i) == _SMALL_E or _at(block, i) == _LARGE_E:
        i += 1
        falling = _at(block, i) == _MINUS
        i += falling or _at(block, i) == _PLUS
        first = i
        power = 0
        while _ZERO <= _at(block, i) <= _NINE:
            power = 10 * power + (_at(block, i) - _ZERO)
            i += 1
        sure &= 0 < i - first <= _MOST_EXPONENT_DIGITS
        exponent += -power if falling else power
    if not sure:
        return 0.0, i, False
    value, sure = _scaled(digits, exponent)
    return (-value if negative else value), i, sure


@kernel
def _scaled(digits: int, exponent: int) -> tuple[float, bool]:
    """``digits * 10^exponent`` rounded once, and whether it could be had that way."""
    value = np.float64(digits)
    if digits == 0:
        return value, True
    if digits <= _EXACT and 0 <= exponent < len(_POWERS):
        return value * _POWERS[exponent], True
    if digits <= _EXACT and -len(_POWERS) < exponent < 0:
        return value / _POWERS[-exponent], True
    if -_MOST_DECIMALS <= exponent < 0:
        divisor = _POWERS[-exponent]
        quotient = value / divisor
        rest = _remainder(value, quotient, divisor) + np.float64(digits - np.int64(value))
        return quotient + rest / divisor, True
    return value, False


@kernel
def _remainder(value: float, quotient: float, divisor: float) -> float:
    """``value - quotient * divisor`` without any rounding, for the quotient of the two (Dekker)."""
    large = quotient * _SPLITTER
    large = large - (large - quotient)
    small = quotient - large
    wide = divisor * _SPLITTER
    wide = wide - (wide - divisor)
    narrow = divisor - wide
    product = quotient * divisor
    error = ((large * wide - product) + large * narrow + small * wide) + small * narrow
    return (value - product) - error


# Without the lock of the interpreter, so that a machine can learn meanwhile.
_parse_rows = compiled(_parse, nogil=True, _nrt=False)
