"""The study as a command: what it does, and what is told of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from studies.old.frame import Progress, silent
from studies.old.study import Study
from studies.real.amounts import Amounts

if TYPE_CHECKING:
    from studies.old.chapter import Chapter
    from studies.real.study import RealStudy


@dataclass(frozen=True)
class Plan(Amounts, Study["RealStudy"]):
    """Whether what was learnt on some real drives foretells danger in others.

    Events are a time to collision below 3, 2 and 1.5 s, and braking harder than 3 m/s², within 1,
    2 and 5 s. Ours learns on the runs of all folds but one, and is judged on that one, or learns on
    --train and is judged on --data, beside the classic measures. Checksums in MANIFEST.csv or
    SHA256SUMS are held against the files.
    """

    doing = "Learning and judging"
    short = "Ten runs: a look, not evidence."

    def run(self, progress: Progress = silent, workers: int | None = None) -> RealStudy:
        """Learn on some runs of ``data``, or on those of ``train``, and judge on the others.

        Raises
        ------
        ValueError
            If ``data`` is missing, or a file is not what it should be.
        """
        from studies.real.study import read_folder, run_real

        if self.data is None:
            raise ValueError("data is None; it must be a folder of runs")
        training, checked = None, 0
        if self.train is not None:
            training, checked = read_folder(self.train, self, dealt=False)
        cases, verified = read_folder(self.data, self, dealt=training is None)
        return run_real(cases, self, checked + verified, progress, workers, training)

    def tell(self, found: RealStudy) -> Chapter:
        """Tables, figures, and where it loses."""
        from studies.real.chapter import tell

        return tell(found)
