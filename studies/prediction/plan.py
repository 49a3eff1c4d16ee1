"""The study as a command: what it does, and what is told of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

from studies.old.frame import Progress, silent
from studies.old.study import Study
from studies.prediction.amounts import Amounts

if TYPE_CHECKING:
    from studies.old.chapter import Chapter
    from studies.prediction.study import Prediction


@dataclass(frozen=True)
class Plan(Amounts, Study["Prediction"]):
    """How well the state 0.01 to 5 s ahead is forecast, against persistence and a batch fit."""

    doing = "Learning and forecasting"
    short = "A tenth of everything: a look, not evidence."
    needed: ClassVar[Mapping[str, str]] = {"scipy": "study", "deeptime": "dev"}

    def run(self, progress: Progress = silent, workers: int | None = None) -> Prediction:
        """Let all methods forecast all families, and the logs of ``data``."""
        from studies.prediction.sources import log_sources
        from studies.prediction.study import run_prediction

        logs = () if self.data is None else log_sources(self.data)
        return run_prediction(self, logs, progress, workers)

    def tell(self, found: Prediction) -> Chapter:
        """Skill over horizon, and what makes it."""
        from studies.prediction.chapter import tell

        return tell(found)
