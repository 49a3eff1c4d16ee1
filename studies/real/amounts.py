"""How much is learnt and judged."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar, Self

from studies.old.shim import option


@dataclass(frozen=True)
class Amounts:
    """All that the study is told."""

    id: ClassVar[str] = "real"
    question: ClassVar[str] = "Does what was learnt on some real drives foretell danger in others?"

    data: Path | None = option(
        None,
        "Folder of runs, a CSV file each (gzipped or not): pair, segment, time, gap, "
        "v_follower, v_leader, a_follower. See docs/real-data.md.",
        required=True,
    )
    train: Path | None = option(
        None,
        "Another folder of runs: all that is learnt from, and all of --data is judged. "
        "Without it the runs of --data are dealt to folds.",
    )
    folds: int = option(5, "Each run is judged by what the other folds taught (no --train).", min=2)
    seed: int = option(0, "Of the folds and the intervals.", min=0)
    rounds: int = 500  #: of the bootstrap
    most_runs: int | None = None  #: as many runs at most, drawn with the seed; None for all

    def shortened(self) -> Self:
        """A few runs: a look, not evidence."""
        return replace(self, folds=2, rounds=100, most_runs=10)
