"""The study as a command: what it does, and what is told of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

from evofsm.evidence.foresight.amounts import Amounts
from evofsm.evidence.frame import Progress, silent
from evofsm.evidence.study import Study

if TYPE_CHECKING:
    from evofsm.evidence.foresight.study import Foresight
    from evofsm.evidence.report.chapter import Chapter


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
        from evofsm.evidence.foresight.study import run_foresight

        return run_foresight(self, progress, workers)

    def tell(self, found: Foresight) -> Chapter:
        """Who foresees what, and where ours does not."""
        from evofsm.evidence.foresight.chapter import tell

        return tell(found)
