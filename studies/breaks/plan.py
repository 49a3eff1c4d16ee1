"""The study as a command: what it does, and what is told of it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from studies.breaks.amounts import Amounts
from studies.old.frame import Progress, silent
from studies.old.study import Study

if TYPE_CHECKING:
    from studies.breaks.study import Breaks
    from studies.old.chapter import Chapter


@dataclass(frozen=True)
class Plan(Amounts, Study["Breaks"]):
    """Search scenarios in which the guard fails, and estimate how likely they are.

    Adaptive multilevel splitting draws scenarios closer and closer to a collision, from a family's
    own distribution; plain sampling stands beside it. The guard is frozen. What is found is written
    as a family (found-FAMILY-JUDGE.py) that evofsm drive and campaign take.
    """

    doing = "Searching"
    short = "Few cases, and rare only to 1 in 10,000: a look, not evidence."

    def run(self, progress: Progress = silent, workers: int | None = None) -> Breaks:
        """Search all that is named."""
        from studies.breaks.study import run_breaks

        return run_breaks(self, progress, workers)

    def tell(self, found: Breaks) -> Chapter:
        """What is found, how likely it is, and where it loses."""
        from studies.breaks.chapter import tell

        return tell(found)

    def chapter(
        self, found: Breaks, folder: Path, command: str, progress: Progress = silent
    ) -> Chapter:
        """The same with its figures drawn, and the cases that were found as families."""
        from studies.breaks.regression import write_cases

        write_cases(found, folder, command)
        return super().chapter(found, folder, command, progress)

    def document(self, found: Breaks) -> object:
        """Every row, with the cases that were found."""
        return [
            {**row, "found": [case.as_dict() for case in cases]}
            for row, cases in zip(found.frame.as_dicts(), found.cases, strict=True)
        ]
