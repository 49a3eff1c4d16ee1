"""How much is learnt and judged."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from evofsm.app import option
from evofsm.evidence.study import Progress, Study, silent

if TYPE_CHECKING:
    from evofsm.evidence.real.study import RealStudy
    from evofsm.evidence.report.chapter import Chapter


@dataclass(frozen=True)
class Plan(Study["RealStudy"]):
    """Whether what was learnt on some real drives foretells danger in others.

    Events are a time to collision below 3, 2 and 1.5 s, and braking harder than 3 m/s², within 1,
    2 and 5 s. Ours learns on the runs of all folds but one, and is judged on that one, or learns on
    --train and is judged on --data, beside the classic measures. Checksums in MANIFEST.csv or
    SHA256SUMS are held against the files.
    """

    id = "real"
    question = "Does what was learnt on some real drives foretell danger in others?"
    doing = "Learning and judging"
    short = "Ten runs: a look, not evidence."

    data: Path | None = option(
        None,
        "Folder of runs, a CSV file each (gzipped or not): pair, segment, time, gap, "
        "v_follower, v_leader, a_follower. See docs/real-data.md.",
        required=True,
    )
    train: Path | None = option(
        None,
        "Another folder of runs: all that is learnt from, and all of --data is judged. "
        "Without it the runs of --data are dealt to folds.",
    )
    folds: int = option(5, "Each run is judged by what the other folds taught (no --train).", min=2)
    seed: int = option(0, "Of the folds and the intervals.", min=0)
    rounds: int = 500  #: of the bootstrap
    most_runs: int | None = None  #: as many runs at most, drawn with the seed; None for all

    def shortened(self) -> Plan:
        """A few runs: a look, not evidence."""
        return replace(self, folds=2, rounds=100, most_runs=10)

    def run(self, progress: Progress = silent, workers: int | None = None) -> RealStudy:
        """Learn on some runs of ``data``, or on those of ``train``, and judge on the others.

        Raises
        ------
        ValueError
            If ``data`` is missing, or a file is not what it should be.
        """
        from evofsm.evidence.real.study import read_folder, run_real

        if self.data is None:
            raise ValueError("data is None; it must be a folder of runs")
        training, checked = None, 0
        if self.train is not None:
            training, checked = read_folder(self.train, self, dealt=False)
        cases, verified = read_folder(self.data, self, dealt=training is None)
        return run_real(cases, self, checked + verified, progress, workers, training)

    def tell(self, found: RealStudy) -> Chapter:
        """Tables, figures, and where it loses."""
        from evofsm.evidence.real.chapter import tell

        return tell(found)
