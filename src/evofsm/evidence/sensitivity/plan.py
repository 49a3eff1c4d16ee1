"""The study as a command: what it does, and what is told of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from evofsm.evidence.frame import Progress, silent
from evofsm.evidence.sensitivity.amounts import Amounts
from evofsm.evidence.study import Study

if TYPE_CHECKING:
    from evofsm.evidence.report.chapter import Chapter
    from evofsm.evidence.sensitivity.study import Sensitivity


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
        from evofsm.evidence.sensitivity.study import run_sensitivity

        return run_sensitivity(self, progress, workers)

    def tell(self, found: Sensitivity) -> Chapter:
        """Shares, reaches, strips and maps."""
        from evofsm.evidence.sensitivity.chapter import tell

        return tell(found)
