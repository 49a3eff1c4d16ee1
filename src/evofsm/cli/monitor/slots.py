"""Live rows, read as a log is: in CSV too, which count, what failed, those of a step as one."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterator, Sequence
from hashlib import sha256
from itertools import zip_longest
from operator import itemgetter
from statistics import fmean
from typing import Any

from evofsm.cli.monitor.messages import LONGEST, NO_ROW, Message, MessageError, Row
from evofsm.io import LogColumns, tables
from evofsm.io.logs import Resample, units_of
from evofsm.io.tables import Dialect, decoded, explained, is_date, is_number, is_value

_BECOME: dict[str, Any] = {"mean": fmean, "last": itemgetter(-1), "max": max, "min": min}


class Slots:
    """Puts rows of a step together; those that wait are one when a row of another step comes."""

    def __init__(self, columns: LogColumns | None = None) -> None:
        self.columns = columns = columns or LogColumns()
        #: [s], 0 where rows stay as they are; and what the values of a column become.
        self.step, self._how = columns.resample or Resample(0.0)
        self.hole = columns.longest_hole  #: up to which a hole costs no episode [s]
        self.names = columns.observe.names
        self._conditions = columns.conditions
        self._terms = [(o, term) for o, c in self._conditions.items() for term in c.terms]
        extra = dict.fromkeys([*(t.column for _, t in self._terms), *(columns.episode or ())])
        #: Keys that rows may have beside the guard's variables, for conditions and episodes.
        self.keys = tuple(name for name in extra if name not in (*self.names, columns.action))
        self.compared = [t.column for _, t in self._terms if t.of_number]  #: with a number
        #: Of the log: what the column of its time is called, how dates are written, or its unit.
        self.clock = columns.time, columns.units.get(columns.time, "s")
        self.waiting: list[Row] = []
        self._done = math.nan  # time of the slot that was decided on as nothing came

    def refuse(self, row: Row) -> None:
        """Raise where a row cannot be compared with a condition, or be one with others."""
        for option, term in () if self.spares(row) else self._terms:
            value = row.told.get(term.column)
            faults = [t.fault(value) for _, t in self._terms if t.column == term.column]
            if all(faults):
                raise MessageError(term.column, f"{faults[0]} ({option})", row.clock)
        if self.step and (row.ahead or not row.observation):
            raise MessageError("objects", "are not resampled; send rows of the variables", row.time)

    def lacking(self, row: Message) -> str:
        """What a row does not tell of what conditions name, in words."""
        fields = row.told if isinstance(row, Row) else {}
        names = ", ".join(name for name, value in fields.items() if value is None)
        options = " or ".join([*self._conditions, *["--episode"] * bool(self.columns.episode)])
        return f"no {names} in the row, which {options} names" * bool(names)

    def holds(self, option: str, row: Message | None) -> bool | None:
        """Whether a row meets the condition of an option; None where nothing is told of it."""
        if (condition := self._conditions.get(option)) is None:
            return None
        values = self._values(row)
        is_told = any(values.get(term.column) is not None for term in condition.terms)
        return bool(condition.holds_of(values)) if is_told else None

    def fails(self, row: Message | None) -> bool:
        """Whether a row meets what tells of failures."""
        return bool(self.holds("--failed", row)) and not self.holds("--no-leader", row)

    def spares(self, row: Row) -> bool:
        """Whether it surely fails or does not count, whatever else stands in it."""
        values = self._values(row)
        return any(c.holds_of(values) is (o != "--where") for o, c in self._conditions.items())

    def _values(self, row: Message | None) -> dict[str, Any]:
        if not isinstance(row, Row):
            return {}
        variables = dict(zip(self.names, row.observation or (), strict=False))
        return {self.columns.action: row.proposal, **variables, **row.told}

    def change(self, row: Message | None, before: Message | None) -> str:
        """In words, what tells that a row is of another episode than one before it."""
        if not (self.columns.episode and isinstance(row, Row) and isinstance(before, Row)):
            return ""
        now, then = self._values(row), self._values(before)
        changes = (name for name in self.columns.episode if now.get(name) != then.get(name))
        return ", ".join(f"{name} {now.get(name)} after {then.get(name)}" for name in changes)

    def is_over(self, row: Row) -> bool:
        """Whether its step was decided on, as nothing came for long."""
        return bool(self.step) and self._time(row) == self._done

    def add(self, row: Row) -> Row | None:
        """Let a row wait; what waited is returned as one, if it is of another step."""
        before = None if self._is_of_step(row) else self.take()
        self.waiting.append(row)
        return before

    def take(self, *, early: bool = False) -> Row | None:
        """What waits, as one row; ``early``, as nothing came, what else is of its step is late."""
        if not self.waiting:
            return None
        rows, self.waiting = self.waiting, []
        begin, hours = self._time(rows[0]), rows[0].hours
        self._done = begin if early else math.nan
        pairs = zip_longest(self.names, zip(*(row.observation or () for row in rows), strict=True))
        observation = tuple(_joined(self._how.get(name), cells) for name, cells in pairs if cells)
        proposals = [row.proposal for row in rows]
        are_numbers = all(isinstance(proposal, float | None) for proposal in proposals)
        how = self._how.get(self.columns.action) if are_numbers else "last"
        return Row(begin + self.step, observation, _joined(how, proposals), hours=hours)

    def leave_out(self, row: Row) -> None:
        """Leave out what waits of the step of a row with which it failed: it is no whole one."""
        if self._is_of_step(row):
            self.waiting.clear()

    def _is_of_step(self, row: Row) -> bool:
        """Whether it belongs to what waits."""
        return bool(self.waiting) and self._time(row) == self._time(self.waiting[0])

    def _time(self, row: Row) -> float:
        return self.step * math.floor(row.time / self.step + 1e-9)


class CsvRows:
    """Lines of CSV as messages, below one that names the columns; others stay as they are."""

    def __init__(self, slots: Slots, variables: Sequence[str], *, acts: bool) -> None:
        self._columns = columns = slots.columns
        actions = [columns.action, "proposal"] * acts
        self._variables = slots.names[: len(variables)]
        self._numbers = {*self._variables, *actions, *slots.compared}
        if "%" not in columns.units.get(columns.time, ""):
            self._numbers.add(columns.time)
        names = *self._variables, *slots.keys, *columns.time.split(","), "proposal"
        #: What messages call the columns that are read.
        self._called = dict(zip(names, (*variables, *names[len(variables) :]), strict=True))
        self._called |= dict.fromkeys(actions, "proposal")
        self._called[columns.time] = "time"
        self._count, self._factors = 0, dict[str, float]()
        self._head: list[str] = []  # the line with the names, and those below to the first row
        self._dialect: Dialect | None = None  # once that row has come
        self._may_be_title = not acts  # who drives along sends no log
        self._needs = *self._variables, *columns.time.split(",")
        self._above: Sequence[str] = ()  # fields of the line before
        self._unread = ""  # why lines are no rows, as names are missing
        self.place, self.in_csv = "", False  #: of a line, as what is said of it begins
        self.heard = ""  #: digest of all lines so far

    def read(self, line: bytes, *, is_cut: bool = False) -> bytes | dict[str, Any] | None:
        """The keys of a row, or JSON as it is; None of names of columns, a title or units."""
        self._count += 1
        self.place, self.in_csv = f"line {self._count}: ", False
        begin = line.lstrip(b"\xef\xbb\xbf \t")[:1]
        if is_cut and begin not in (b"{", b""):  # a number would still be one
            fault = "has no line end behind it, and may be cut off: end it, if it is whole"
            raise MessageError("line", fault)
        self.heard = sha256(self.heard.encode() + line[:LONGEST]).hexdigest()
        self._may_be_title &= begin != b"{" and self._count < Dialect.most_above
        if begin in (b"{", b""):
            return None if self._may_be_title else line
        try:
            text = decoded(line, "").removeprefix("\ufeff")
        except ValueError:
            return line
        self.in_csv = True
        may_name = any(name in text for name in self._variables)
        columns = Dialect(text, ()).columns if may_name else []
        if {*self._needs} <= {*columns}:
            self._head, self._dialect = [text], None
            self._may_be_title, self._unread = False, ""
            for name in self._called:
                if columns.count(name) > 1:
                    self._head, self._unread = [], f"{name} is the name of several columns"
                    raise MessageError(name, "is the name of several columns")
            return None
        if {*self._variables} & {*columns}:  # the names of another log
            self._head = []
        if not self._head:
            self._refuse_unnamed(text)
            return None if self._may_be_title else line
        try:
            if self._dialect is None and self._has_units(text):
                return None
            assert self._dialect is not None
            return dict(self._told(self._dialect, text))
        except csv.Error as error:
            raise MessageError("line", f"{error} (an unclosed quote?)") from None

    def _refuse_unnamed(self, text: str) -> None:
        """Raise where a line tells that names are missing above the rows; and then at each."""
        if self._unread:
            raise MessageError("line", f"was not read: {self._unread}")
        above, self._above = self._above, Dialect(text, ()).columns
        needs, lower_case = ([x.casefold() for x in xs] for xs in (self._needs, self._above))
        if not _begins_row(self._above):  # it may name the columns itself
            above = self._above if {*needs} & {*lower_case} else ()
        elif all(self._above):  # a title has no field in most columns
            above = above or self._above
        omissions = [name for name in self._needs if name not in above]
        if len(above) < 2 or len(above) != len(self._above) or not omissions:
            return
        about, self._unread = "line", NO_ROW
        if not _begins_row(above):
            about, *rest = omissions
            fault = ", nor is ".join([f"{about} is no column", *rest])
            near = ", ".join(x for x in above if x not in self._needs and x.casefold() in needs)
            near = f" ({near}? case counts)" if near else ""
            self._unread = f"{fault}; there are {', '.join(above)}{near}"
        raise MessageError(about, self._unread.removeprefix(f"{about} "))

    def _has_units(self, text: str) -> bool:
        """Whether a line below the names tells units, or the like; the first row tells the rest."""
        self._head = [*self._head, text]
        header, *below = self._head
        dialect = Dialect(header, below)
        fields = next(csv.reader([text], delimiter=dialect.separator, strict=True))
        if not any(map(is_value, fields)) and len(below) <= Dialect.most_below:
            return True
        numbers = [name for name in dialect.columns if name in self._numbers]
        units = {name: unit for name, unit in self._columns.units.items() if "%" not in unit}
        units = {**self._columns.usual_units, **dialect.units, **units_of(units, numbers)}
        self._factors = {name: tables.UNITS.get(units.get(name, ""), 1.0) for name in numbers}
        self._dialect = dialect
        return dialect.n_told == len(below)

    def _told(self, dialect: Dialect, text: str) -> Iterator[tuple[str, Any]]:
        """What a row tells, by the keys of messages."""
        fields = next(csv.reader([text], delimiter=dialect.separator, strict=True))
        if len(fields) != (n_columns := len(dialect.columns)):
            raise MessageError("line", dialect.miscounted(len(fields), n_columns))
        for name, field in zip(dialect.columns, map(str.strip, fields), strict=True):
            if name in self._numbers and not is_date(field):
                yield self._called[name], self._number(name, field, dialect)
            elif name in self._called:
                yield self._called[name], field or None

    def _number(self, name: str, text: str, dialect: Dialect) -> float | str | None:
        """What stands in a field, numbers in units of the SI; None where nothing does."""
        if text.lower().removeprefix("-") in tables.MISSING:
            return None
        if not is_number(plain := text.replace(",", ".") if dialect.has_commas else text):
            if self._called[name] not in ("time", "proposal"):
                return text
            raise MessageError(name, explained(text))
        number = float(plain) * self._factors[name]
        return int(number) if self._called[name] == "proposal" and number.is_integer() else number


def _begins_row(fields: Sequence[str]) -> bool:
    return is_value(next(filter(None, fields), ""))


def _joined(how: str | None, values: Sequence[Any]) -> Any:
    """What values become, of those that were seen."""
    entries = [value for value in values if value is not None]
    return _BECOME[how or "mean"](entries) if entries else None
