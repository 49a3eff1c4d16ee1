"""How much is tried, and whom."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar, Self

from evofsm.cli import argument, option, split_names

#: Beside the package's families: one whose answer is known, and one that both ways see.
TOY, SELDOM = "toy", "seldom"
#: Who may judge. Without one, the family's controller drives as it likes.
NOBODY = "none"
JUDGES = (NOBODY, "kinematic", "learnt")

_FAMILIES, _JUDGES = f"{TOY},{SELDOM},emergency", ",".join(JUDGES)


@dataclass(frozen=True)
class Amounts:
    """All that the study is told."""

    id: ClassVar[str] = "break"
    question: ClassVar[str] = "In which scenarios does the guard fail, and how likely are they?"

    family: str = argument(
        "Families with commas: emergency, cut_in, ..., a file of your own, seldom (collisions are "
        "rare without a guard) or toy (no car; its probability is 1e-5).",
        _FAMILIES,
    )
    judge: str = option(_JUDGES, "Who judges, with commas: none (no guard), kinematic, learnt.")
    switches: tuple[str, ...] = option(
        (),
        "noise, delay, actuator, jerk, third_car; with commas.",
        name="--with",
        parse=split_names,
    )
    train: int = option(60, "Episodes that a guard learns from before it is frozen.", min=0)
    learnt: str | None = option(
        None,
        "Folder of evofsm drive --out: what was learnt there is frozen and tried. [default: a "
        "guard learns first]",
    )
    runs: int = option(10, "Independent runs of splitting; the interval rests on them.", min=2)
    cases: int = option(100, "Cases side by side in a run.", min=5)
    moves: int = option(10, "Moves of each copy at each level.", min=1)
    least: float = option(1e-8, "A run is given up below this probability.", min=1e-300, max=0.5)
    plain: int = option(1_000_000, "Plain samples, without a guard.", min=0)
    guarded: int = option(20_000, "Plain samples under a guard, which take longer.", min=0)
    keep: int = option(10, "Cases that are kept of those found, the most likely first.", min=1)
    seed: int = option(0, "Of everything.", min=0)

    def shortened(self) -> Self:
        """A look, not evidence."""
        return replace(
            self,
            family=f"{TOY},{SELDOM}" if self.family == _FAMILIES else self.family,
            judge=f"{NOBODY},kinematic" if self.judge == _JUDGES else self.judge,
            train=min(self.train, 20),
            runs=min(self.runs, 3),
            cases=min(self.cases, 30),
            moves=min(self.moves, 3),
            least=max(self.least, 1e-4),
            plain=min(self.plain, 3000),
            guarded=min(self.guarded, 100),
        )

    @property
    def families(self) -> tuple[str, ...]:
        """Names or files, each once.

        Raises
        ------
        ValueError
            If there is none.
        """
        named = tuple(dict.fromkeys(split_names(self.family)))
        if not named:
            raise ValueError("no family is named")
        return named

    @property
    def judges(self) -> tuple[str, ...]:
        """Names, each once.

        Raises
        ------
        ValueError
            If there is no such judge, or none is named.
        """
        named = tuple(dict.fromkeys(split_names(self.judge)))
        for name in named:
            if name not in JUDGES:
                raise ValueError(f"there is no judge {name!r}; there are {', '.join(JUDGES)}")
        if not named:
            raise ValueError(f"no judge is named; there are {', '.join(JUDGES)}")
        return named
