"""How much is driven, read and forecast."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar, Self

from studies.old.shim import option


@dataclass(frozen=True)
class Amounts:
    """All that the study is told."""

    id: ClassVar[str] = "prediction"
    question: ClassVar[str] = "How far ahead is the state foreseen?"

    data: Path | None = option(
        None, "Folder of real logs, a run each; without it simulation alone."
    )

    train: int = option(100, "Training episodes of a learning seed.", min=1)
    test: int = option(100, "Held-out episodes of each family.", min=2)
    seeds: int = option(20, "Learning seeds.", min=1)
    seed: int = option(0, "Of everything.", min=0)
    fine_train: int = 20  #: the same, where every step of 0.01 s is observed
    fine_test: int = 20
    fine_seeds: int = 5  #: learning seeds of those
    parts: int = 3  #: into which runs are split
    runs: int | None = None  #: of one origin at most; None for all
    ablation: tuple[str, ...] = ("emergency", "stop_and_go")  #: families in the ablation
    ablation_runs: int = 6  #: of one origin at most in the ablation; 0: none
    rounds: int = 1000  #: of the bootstrap

    def shortened(self) -> Self:
        """A look, not evidence."""
        return replace(
            self,
            train=min(self.train, 40),
            test=min(self.test, 30),
            fine_train=min(self.fine_train, 5),
            fine_test=min(self.fine_test, 5),
            seeds=min(self.seeds, 2),
            fine_seeds=min(self.fine_seeds, 1),
            parts=min(self.parts, 2),
            runs=12,
            ablation=self.ablation[-1:],
            rounds=min(self.rounds, 200),
        )
