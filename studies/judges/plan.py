"""The study as a command: what it does, and what is told of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

from studies.judges.amounts import Amounts
from studies.old.frame import Progress, silent
from studies.old.study import Study

if TYPE_CHECKING:
    from studies.judges.study import Judges
    from studies.old.chapter import Chapter


@dataclass(frozen=True)
class Plan(Amounts, Study["Judges"]):
    """How often systems fail under the learnt judge, whole and with each part taken away.

    It is told the range of the action, the interval, and which episodes failed. It learns while it
    decides; then it is frozen and tried on held-out episodes.
    """

    doing = "Learning and trying"
    short = "One seed, one controller of each system, no part taken away: a look, not evidence."
    needed: ClassVar[Mapping[str, str]] = {"scipy": "study", "gymnasium": "gym"}

    def run(self, progress: Progress = silent, workers: int | None = None) -> Judges:
        """Try all that is named."""
        from studies.judges.study import run_judges

        return run_judges(self, progress, workers)

    def tell(self, found: Judges) -> Chapter:
        """What fails, what each part is worth, and where it loses."""
        from studies.judges.chapter import tell

        return tell(found)
