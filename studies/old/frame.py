"""What studies and pages share: rows, and how far the work has come."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from evofsm.extras import needs

#: Called with the number of tasks done, and of all tasks.
Progress = Callable[[int, int], None]


def silent(done: int, total: int) -> None:
    """A `Progress` that does nothing."""


@dataclass(frozen=True)
class Frame:
    """Rows of a study, all of one type: a frozen dataclass, one row a line of one table."""

    rows: Sequence[Any]

    def as_dicts(self) -> list[dict[str, Any]]:
        """Every row as plain values, for JSON; a row may say by ``as_dict`` what it is."""
        return [row.as_dict() if hasattr(row, "as_dict") else asdict(row) for row in self.rows]

    def write_parquet(self, path: Path) -> None:
        """Write all rows as one Parquet file.

        Raises
        ------
        ModuleNotFoundError
            If polars is not installed.
        """
        with needs("polars", "tables", "writing rows as Parquet"):
            import polars
        # An absolute path, for polars takes others for addresses on the network.
        polars.DataFrame(self.as_dicts(), infer_schema_length=None).write_parquet(path.absolute())
