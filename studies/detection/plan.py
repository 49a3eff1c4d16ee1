"""The study as a command: what it does, and what is told of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from studies.detection.amounts import Amounts
from studies.old.frame import Progress, silent
from studies.old.study import Study

if TYPE_CHECKING:
    from studies.detection.study import Detection
    from studies.old.chapter import Chapter


@dataclass(frozen=True)
class Plan(Amounts, Study["Detection"]):
    """Who sees dead ends and collisions coming: ours, and the classic measures.

    Nobody acts. Ours has watched other episodes; thresholds are chosen on yet others.
    """

    doing = "Watching and judging"
    short = "A tenth of everything: a look, not evidence."

    def run(self, progress: Progress = silent, workers: int | None = None) -> Detection:
        """Judge every measure in every world."""
        from studies.detection.study import run_detection

        return run_detection(self, progress, workers)

    def tell(self, found: Detection) -> Chapter:
        """Who sees danger, how early, and where ours does not."""
        from studies.detection.chapter import tell

        return tell(found)
