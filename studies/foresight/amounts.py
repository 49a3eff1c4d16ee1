"""How much is run, learnt and foreseen."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar, Self

from studies.old.shim import option

#: Steps within which a failure counts.
HORIZONS = (10, 25, 50)


@dataclass(frozen=True)
class Amounts:
    """All that the study is told."""

    id: ClassVar[str] = "foresight"
    question: ClassVar[str] = "Is it foreseen that a task fails within so many steps?"

    tasks: str = option("acc,cartpole,pendulum", "Systems with commas.")
    train: int = option(80, "Training episodes of a learning seed.", min=4)
    test: int = option(80, "Held-out episodes.", min=2)
    seeds: int = option(5, "Learning seeds.", min=1)
    seed: int = option(0, "Of everything.", min=0)
    calibration: int = 40  #: episodes on which probabilities and thresholds are set
    every: int = 5  #: steps from a forecast that is judged to the next one
    rounds: int = 200  #: of the bootstrap

    def shortened(self) -> Self:
        """A look, not evidence."""
        return replace(
            self,
            train=min(self.train, 20),
            test=min(self.test, 15),
            calibration=min(self.calibration, 10),
            seeds=1,
            rounds=min(self.rounds, 40),
        )
