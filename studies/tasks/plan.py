"""The study as a command: what it does, and what is told of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

from studies.old.frame import Progress, silent
from studies.old.study import Study
from studies.tasks.amounts import Amounts

if TYPE_CHECKING:
    from studies.old.chapter import Chapter
    from studies.tasks.study import Tasks


@dataclass(frozen=True)
class Plan(Amounts, Study["Tasks"]):
    """How often tasks that others set fail under ours, and under judges that are told more.

    Each judge learns, if it learns, while it decides; then it is frozen and tried on held-out
    episodes. What it was told stands in every row.
    """

    doing = "Learning and trying"
    short = "One seed, one controller of each task, 20 training episodes: a look, not evidence."
    needed: ClassVar[Mapping[str, str]] = {"scipy": "study", "gymnasium": "gym"}

    def run(self, progress: Progress = silent, workers: int | None = None) -> Tasks:
        """Try all that is named."""
        from studies.tasks.study import run_tasks

        return run_tasks(self, progress, workers)

    def tell(self, found: Tasks) -> Chapter:
        """What fails, what it costs, and where it loses."""
        from studies.tasks.chapter import tell

        return tell(found)
