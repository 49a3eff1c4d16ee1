"""How much is tried."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar, Self

from evofsm.cli import option


@dataclass(frozen=True)
class Amounts:
    """All that the study is told."""

    id: ClassVar[str] = "sensitivity"
    question: ClassVar[str] = "Do the paper's claims depend on what it leaves open?"

    settings: int = option(
        2000, "Drawn over everything; sweeps, maps and other draws come on top.", min=4
    )
    seed: int = option(0, "Of the draws and of the noise.", min=0)
    levels: int = 33  #: of each parameter in its sweep
    side: int = 15  #: of a map
    halvings: int = 7  #: of the last step of a sweep, in search of where a claim breaks
    rounds: int = 20  #: in which the four cases are driven; fewer are not the paper's study

    def __post_init__(self) -> None:
        least_of = {"settings": 4, "levels": 2, "side": 2, "halvings": 0, "rounds": 1}
        for name, least in least_of.items():
            if getattr(self, name) < least:
                raise ValueError(f"{name} is {getattr(self, name)}; it must be {least} or more")

    def shortened(self) -> Self:
        """About a twentieth of everything: a look, not evidence."""
        return replace(
            self,
            settings=min(self.settings, 80),
            levels=min(self.levels, 7),
            side=min(self.side, 3),
            halvings=min(self.halvings, 2),
        )
