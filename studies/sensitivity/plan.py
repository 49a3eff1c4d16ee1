"""The study as a command: what it does, and what is told of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from studies.old.frame import Progress, silent
from studies.old.study import Study
from studies.sensitivity.amounts import Amounts

if TYPE_CHECKING:
    from studies.old.chapter import Chapter
    from studies.sensitivity.study import Sensitivity


@dataclass(frozen=True)
class Plan(Amounts, Study["Sensitivity"]):
    """In what share of settings each claim of the paper holds.

    The paper leaves open how fast the leader gets, how hard it brakes, the gap at the start, and
    more. Each setting drives the paper's 80 runs and is judged by the checks of `evofsm paper`.
    """

    doing = "Driving and learning"
    short = "A twentieth of everything: a look, not evidence."

    def run(self, progress: Progress = silent, workers: int | None = None) -> Sensitivity:
        """Try all settings."""
        from studies.sensitivity.study import run_sensitivity

        return run_sensitivity(self, progress, workers)

    def tell(self, found: Sensitivity) -> Chapter:
        """Shares, reaches, strips and maps."""
        from studies.sensitivity.chapter import tell

        return tell(found)
