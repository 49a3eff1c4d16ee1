"""The study as a command: what it does, and what is told of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from evofsm.evidence.detection.amounts import Amounts
from evofsm.evidence.frame import Progress, silent
from evofsm.evidence.study import Study

if TYPE_CHECKING:
    from evofsm.evidence.detection.study import Detection
    from evofsm.evidence.report.chapter import Chapter


@dataclass(frozen=True)
class Plan(Amounts, Study["Detection"]):
    """Who sees dead ends and collisions coming: ours, and the classic measures.

    Nobody acts. Ours has watched other episodes; thresholds are chosen on yet others.
    """

    doing = "Watching and judging"
    short = "A tenth of everything: a look, not evidence."

    def run(self, progress: Progress = silent, workers: int | None = None) -> Detection:
        """Judge every measure in every world."""
        from evofsm.evidence.detection.study import run_detection

        return run_detection(self, progress, workers)

    def tell(self, found: Detection) -> Chapter:
        """Who sees danger, how early, and where ours does not."""
        from evofsm.evidence.detection.chapter import tell

        return tell(found)
