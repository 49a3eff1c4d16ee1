"""Tables: typed columns over rows, written once for pages, the terminal and programs."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from operator import attrgetter
from typing import Any, Generic, TypeVar

from studies.old.shim.numbers import NONE

R = TypeVar("R")


@dataclass(frozen=True)
class Column(Generic[R]):
    """One column: its header, the value that a row has in it, and how that is written.

    Parameters
    ----------
    header : str
    value : str or callable
        Name of the row's attribute (several names with spaces between them: a tuple), or a function
        of the row. None is written as the text of a missing number.
    show : callable
        Writes a value: `percent`, `count`, `decimals(2)`, `span(1)`, ...; a plain tuple is passed
        as several arguments.
    unit : str
        Stands in brackets behind the header.

    Examples
    --------
    >>> from studies.old.shim import percent
    >>> Column("collisions", lambda rate: rate, percent).cell(0.25)
    '25.0 %'
    """

    header: str
    value: str | Callable[[R], Any]
    show: Callable[..., str] = str
    unit: str = ""

    def cell(self, row: R) -> str:
        """The text of a row's value."""
        read = attrgetter(*self.value.split()) if isinstance(self.value, str) else self.value
        found = read(row)
        if found is None:
            return NONE
        return self.show(*found) if type(found) is tuple else self.show(found)


@dataclass(frozen=True)
class Table:
    """Rows under a header, as text; the first column names the row.

    A cell may have several lines: what follows the first stands beside it, smaller.
    """

    title: str
    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    note: str = ""
    ours: tuple[int, ...] = ()  #: rows that are ours, to be set off
    in_words: bool = False  #: whether the cells are words, which may be broken into lines
    failing: tuple[int, ...] = ()  #: rows of which something that was asked for does not hold
    holding: tuple[int, ...] = ()  #: rows of which all that was asked for holds, if that is marked

    @classmethod
    def of(
        cls,
        title: str,
        columns: Sequence[Column[R]],
        rows: Iterable[R],
        note: str = "",
        *,
        in_words: bool = False,
        ours: Callable[[R], bool] | None = None,
        failing: Callable[[R], bool] | None = None,
        holding: Callable[[R], bool] | None = None,
    ) -> Table:
        """A table of typed columns.

        Parameters
        ----------
        title, note : str
        columns : sequence of Column
        rows : iterable
            What the columns take their values from; any type.
        in_words : bool
            Whether the cells are words.
        ours, failing, holding : callable, optional
            Tell of a row whether it is set off.

        Examples
        --------
        >>> from studies.old.shim import decimals
        >>> columns = Column("who", lambda row: row[0]), Column("lead", lambda r: r[1], decimals(1))
        >>> Table.of("Leads", columns, [("ours", 3.0), ("ttc", None)]).rows
        (('ours', '3.0'), ('ttc', '–'))
        """
        every = list(rows)

        def marked(holds: Callable[[R], bool] | None) -> tuple[int, ...]:
            return tuple(place for place, row in enumerate(every) if holds and holds(row))

        return cls(
            title,
            tuple(f"{one.header} [{one.unit}]" if one.unit else one.header for one in columns),
            tuple(tuple(one.cell(row) for one in columns) for row in every),
            note,
            marked(ours),
            in_words,
            marked(failing),
            marked(holding),
        )
