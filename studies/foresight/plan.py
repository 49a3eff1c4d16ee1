"""The study as a command: what it does, and what is told of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

from studies.foresight.amounts import Amounts
from studies.old.frame import Progress, silent
from studies.old.study import Study

if TYPE_CHECKING:
    from studies.foresight.study import Foresight
    from studies.old.chapter import Chapter


@dataclass(frozen=True)
class Plan(Amounts, Study["Foresight"]):
    """How well a failure within 10, 25 and 50 steps is foreseen, given the action.

    From episodes of mixed controllers, by ours and by logistic regression, nearest neighbours and
    extrapolation.
    """

    doing = "Learning and foreseeing"
    short = "One seed, half of the episodes: a look, not evidence."
    needed: ClassVar[Mapping[str, str]] = {"scipy": "study", "gymnasium": "gym"}

    def run(self, progress: Progress = silent, workers: int | None = None) -> Foresight:
        """Let all foresee all tasks."""
        from studies.foresight.study import run_foresight

        return run_foresight(self, progress, workers)

    def tell(self, found: Foresight) -> Chapter:
        """Who foresees what, and where ours does not."""
        from studies.foresight.chapter import tell

        return tell(found)
