"""How much is watched and judged."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar, Self

from studies.old.own_measure import ABOUT
from studies.old.shim import option, split_names

#: What is judged if nothing else is asked for; see `studies.detection.worlds.world`.
FAMILIES = (
    *("paper", "emergency", "stop_and_go", "cut_in", "ncap", "r157"),
    *("weak_brakes", "rare", "shift", "shift-at-once", "emergency+noise"),
)


@dataclass(frozen=True)
class Amounts:
    """All that the study is told."""

    id: ClassVar[str] = "detection"
    question: ClassVar[str] = "Who sees danger, and how early?"

    family: str = option(
        "",
        "Families with commas, emergency+noise for one with a switch, shift-at-once for "
        "one just shifted. [default: all of the study]",
    )
    seed: int = option(0, "Of everything.", min=0)
    with_grid: bool = option(
        True, "Also over brakes that nobody was told of, own and leader's.", name="--grid/--no-grid"
    )
    measure: str = option("", ABOUT)
    train: int = 100  #: episodes that are watched before anything is judged
    since: int = 20  #: episodes that are watched after a shift
    seeds: int = 20  #: learning seeds; the first one's are the rows, the others their spread
    hours: float = 3.0  #: of held-out driving, and as many to choose thresholds on
    long_hours: float = 30.0  #: the same in the families of `long`
    long: tuple[str, ...] = ("paper", "emergency")
    rounds: int = 200  #: of the bootstrap
    seed_hours: float = 0.5  #: of held-out driving for each of the other learning seeds
    grid: tuple[float, ...] = (2.0, 3.0, 4.0, 5.0, 6.0)  #: own brakes in the grid [m/s²]
    grid_leader: tuple[float, ...] = (3.0, 4.5, 6.0, 7.5, 9.0)  #: leaders' hardest [m/s²]
    grid_train: int = 20  #: episodes that are watched in each world of the grid
    grid_hours: float = 0.5  #: of held-out driving in each

    def shortened(self) -> Self:
        """A look, not evidence: just enough for one false alarm per hour to be measurable."""
        return replace(
            self,
            train=min(self.train, 40),
            seeds=min(self.seeds, 2),
            hours=min(self.hours, 0.5),
            long_hours=min(self.long_hours, 3.0),
            rounds=min(self.rounds, 40),
            seed_hours=0.2,
            grid=(2.0, 4.0, 6.0),
            grid_leader=(3.0, 6.0, 9.0),
            grid_hours=0.2,
        )

    def hours_of(self, name: str) -> float:
        """How long a family is driven [h]."""
        return self.long_hours if name in self.long else self.hours

    @property
    def families(self) -> tuple[str, ...]:
        """Names of the worlds that are judged, as `studies.detection.worlds` knows them."""
        return tuple(split_names(self.family)) or FAMILIES
