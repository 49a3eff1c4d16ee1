"""The study as a command: what it does, and what is told of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from studies.alarms.amounts import Amounts
from studies.old.frame import Progress, silent
from studies.old.study import Study

if TYPE_CHECKING:
    from studies.alarms.study import Found
    from studies.old.chapter import Chapter


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
