"""How much is driven, and which rates are stated."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar, Literal, Self

from studies.old.shim import option, split_names

Errors = Literal["false alarms", "misses"]

#: Families that are driven unless others are asked for; the last one changes on the way.
FAMILIES = ("emergency", "cut_in", "stop_and_go", "shift")


@dataclass(frozen=True)
class Amounts:
    """All that the study is told."""

    id: ClassVar[str] = "alarms"
    question: ClassVar[str] = "Do alarms keep the rate that they state?"

    family: str = option("", "Families with commas. [default: all of the study]")
    seeds: int = option(3, "Learning seeds, each with draws of its own.", min=1)
    seed: int = option(0, "Of everything.", min=0)
    false_alarms: float = 0.05  #: stated share of safe windows that are in alarm
    misses: float = 0.1  #: stated share of dangerous windows that are not
    step: float = 0.02  #: of the adaptive alarm
    memory: int = 500  #: of the adaptive alarm
    train: int = 60  #: episodes that are watched before anything is judged
    calibration: int = 200  #: episodes that thresholds are chosen on
    episodes: int = 400  #: held-out ones; after a change as many again
    rounds: int = 1000  #: of the bootstrap

    def shortened(self) -> Self:
        """A look, not evidence."""
        return replace(
            self,
            seeds=1,
            train=min(self.train, 20),
            calibration=min(self.calibration, 60),
            episodes=min(self.episodes, 100),
            rounds=min(self.rounds, 200),
        )

    @property
    def families(self) -> tuple[str, ...]:
        """Names of what is driven."""
        return tuple(split_names(self.family)) or FAMILIES

    @property
    def stated(self) -> dict[Errors, float]:
        """The rate that is stated of each kind of errors."""
        return {"false alarms": self.false_alarms, "misses": self.misses}
