"""The study as a command: what it does, and what is told of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from evofsm.paper.frame import Progress, silent
from evofsm.paper.study import Study
from studies.alarms.amounts import Amounts

if TYPE_CHECKING:
    from evofsm.paper.report.chapter import Chapter
    from studies.alarms.study import Found


@dataclass(frozen=True)
class Plan(Amounts, Study["Found"]):
    """Whether alarms keep the rate of errors that they state, where the world changes too.

    Nobody acts. Thresholds that adapt stand beside those that are chosen once.
    """

    doing = "Watching and alarming"
    short = "One seed, a quarter of the episodes: a look, not evidence."

    def run(self, progress: Progress = silent, workers: int | None = None) -> Found:
        """Drive all families, and let every alarm judge every score."""
        from studies.alarms.study import run_alarms

        return run_alarms(self, progress, workers)

    def tell(self, found: Found) -> Chapter:
        """Which rates are kept, at what price, and which are not."""
        from studies.alarms.chapter import tell

        return tell(found)
