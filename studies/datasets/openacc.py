"""OpenACC: platoons of cars with adaptive cruise control, followed by GNSS.

M. Makridis, K. Mattas, A. Anesiadou, B. Ciuffo, "OpenACC. An open database of car-following
experiments to study the properties of commercial ACC systems", Transportation Research Part C 125,
103047, 2021. Files have some lines on the experiment, then a header with ``Time`` [s],
``Speed1`` [m/s], positions, and ``IVS1`` [m]: the spacing, bumper to bumper, of vehicles 1 and 2.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from itertools import islice
from pathlib import Path

from studies.datasets.columns import header_and_rows, name_of, numbers, places
from studies.datasets.episodes import Episode, cut

# Lines on the experiment before the header, at most.
_MOST_LINES = 20
_SPACING = re.compile(r"IVS(\d+)", re.IGNORECASE)


def read_openacc(path: Path) -> Iterator[Episode]:
    """Read one file of OpenACC; every spacing in it is a pair."""
    rows = header_and_rows(path)
    line, header = _header(path, rows)
    known = {name.lower() for name in header}
    leaders = [int(found[1]) for name in header if (found := _SPACING.fullmatch(name))]
    leaders = [k for k in leaders if {f"speed{k}", f"speed{k + 1}"} <= known]
    if not leaders:
        raise ValueError(f"{path} has no spacing IVS1, IVS2, ... with the speeds of both vehicles")
    names = [(f"IVS{k}", f"Speed{k + 1}", f"Speed{k}") for k in leaders]
    columns = places(path, header, [("Time",), *((name,) for three in names for name in three)])
    table = numbers(path, rows, columns, line + 1)
    for place, k in enumerate(leaders):
        three = table[:, 1 + 3 * place : 4 + 3 * place]
        yield from cut(name_of(path), f"v{k}-v{k + 1}", table[:, 0], three)


def _header(path: Path, rows: Iterator[list[str]]) -> tuple[int, list[str]]:
    """The line of the header, and the names in it; the rows go on after it."""
    for line, row in enumerate(islice(rows, _MOST_LINES), 1):
        names = [name.strip() for name in row]
        if names and names[0].lower() == "time":
            return line, names
    raise ValueError(f"{path}: none of its first {_MOST_LINES} lines begins with Time")
