"""Live rows, read as a log is: which count, what failed, and those of a step as one.

The options are those of ``evofsm learn``, `evofsm.io.LogColumns`; what comes is the same.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import zip_longest
from operator import itemgetter
from statistics import fmean
from typing import Any

from evofsm.cli.monitor.messages import Message, MessageError, Row
from evofsm.io import LogColumns
from evofsm.io.logs import Condition

_BECOME: dict[str, Any] = {"mean": fmean, "last": itemgetter(-1), "max": max, "min": min}


class Slots:
    """Puts rows of a step together; those that wait are one when a row of another step comes."""

    def __init__(self, columns: LogColumns | None = None) -> None:
        self.columns = columns = columns or LogColumns()
        made = columns.resample
        self.step = 0.0 if made is None else made.step  #: [s]; 0 where rows stay as they are
        self.hole = columns.longest_hole  #: up to which a hole costs no episode [s]
        self.names = columns.observe.names
        self._how = {} if made is None else made.how
        told = {"--where": columns.where, "--failed": columns.failed}
        self._conditions = {o: Condition.parse(t, o) for o, t in told.items() if t is not None}
        terms = (term.column for c in self._conditions.values() for term in c.terms)
        #: Keys that rows may have beside the guard's variables, for the conditions.
        self.keys = tuple(dict.fromkeys({*terms} - {*self.names, columns.action}))
        #: Of the log: what the column of its time is called, how dates are written, or its unit.
        self.clock = columns.time, columns.units.get(columns.time, "s")
        self.waiting: list[Row] = []
        self._done = math.nan  # time of the slot that was decided on as nothing came

    def refuse(self, row: Row) -> None:
        """Raise where a row tells of what a condition names what cannot be compared with it."""
        told = dict(zip(self.keys, row.told, strict=False))
        for option, condition in self._conditions.items():
            for term in condition.terms:
                if fault := term.fault(told.get(term.column)):
                    raise MessageError(term.column, f"{fault} ({option})", row.time)

    def lacking(self, row: Message) -> str:
        """What a row does not tell of what conditions name, in words."""
        told = zip(self.keys, row.told, strict=False) if isinstance(row, Row) else ()
        names = ", ".join(name for name, value in told if value is None)
        return f"no {names} in the row, which --failed or --where names" if names else ""

    def fails(self, row: Message | None) -> bool:
        """Whether a row meets what tells of failures."""
        return isinstance(row, Row) and self._holds("--failed", row)

    def counts(self, row: Row) -> bool:
        """Whether it does, or is left out; what a row does not tell is no reason."""
        return "--where" not in self._conditions or self._holds("--where", row, unknown=True)

    def _holds(self, option: str, row: Row, *, unknown: bool = False) -> bool:
        if (condition := self._conditions.get(option)) is None:
            return False
        values: dict[str, Any] = {self.columns.action: row.proposal}
        values |= dict(zip(self.names, row.observation or (), strict=False))
        values |= dict(zip(self.keys, row.told, strict=False))
        if unknown and all(values.get(term.column) is None for term in condition.terms):
            return True
        return condition.holds_of(values)

    def is_over(self, row: Row) -> bool:
        """Whether its step was decided on, as nothing came for long."""
        return bool(self.step) and self._time(row) == self._done

    def add(self, row: Row) -> Row | None:
        """Let a row wait; what waited is returned as one, if it is of another step."""
        before = None
        if self.waiting and self._time(row) != self._time(self.waiting[0]):
            before = self.take()
        self.waiting.append(row)
        return before

    def take(self, *, early: bool = False) -> Row | None:
        """What waits, as one row; ``early``, as nothing came, what else is of its step is late."""
        if not self.waiting:
            return None
        rows, self.waiting = self.waiting, []
        time = self._time(rows[0])
        self._done = time if early else math.nan
        seen = zip_longest(self.names, zip(*(row.observation or () for row in rows), strict=True))
        observation = tuple(_joined(self._how.get(name), column) for name, column in seen if column)
        proposals = [row.proposal for row in rows]
        is_number = all(isinstance(wanted, float | None) for wanted in proposals)
        how = self._how.get(self.columns.action) if is_number else "last"
        return Row(time, observation, _joined(how, proposals))

    def _time(self, row: Row) -> float:
        return self.step * math.floor(row.time / self.step + 1e-9)


def _joined(how: str | None, values: Sequence[Any]) -> Any:
    """What values become, of those that were seen."""
    seen = [value for value in values if value is not None]
    return _BECOME[how or "mean"](seen) if seen else None
