"""What was asked for before the study was run, as far as its rows can answer it."""

from __future__ import annotations

from collections.abc import Iterator

from studies.breaks.study import Breaks
from studies.old.asked import Asked


def claims(found: Breaks) -> Iterator[Asked]:
    """All that can be judged."""
    for row in found.rows:
        if row.hits is not None:
            yield Asked(
                f"{row.name}: splitting and the known probability",
                f"{row.known:.3g} within chance (99 %)",
                f"{row.probability:.3g}",
                row.hits,
            )
        if row.agrees is not None:
            yield Asked(
                f"{row.name}: splitting and plain sampling",
                f"{row.plain_probability:.3g} within chance (99 %)",
                f"{row.probability:.3g}",
                row.agrees,
            )
