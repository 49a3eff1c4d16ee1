"""How much is controlled, learnt and tried."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar, Self

from evofsm.cli import ALL, FIRST, option, split_names

#: Parts of the learnt judge that can be taken away, each with what is left then.
PARTS: dict[str, str] = {
    "stretches": "no disturbances at all",
    "memory": "independent residuals in place of remembered stretches",
    "products": "no products of variables and actions",
    "lags": "no latest change and previous action",
    "doubt": "lags are used even where they foresaw failure that never came",
    "jumps": "jumps are learnt like all else",
    "carried": "no residual is carried on where a variable saturates",
    "drift": "the model is not corrected where the system has changed",
    "observer": "variables are taken as they are seen, however noisy sensors are",
    "margin": "no margin",
    "backups": "constant backups alone",
    "breaks": "it is not noticed where disturbances get worse",
    "states": "one state only: nothing may change",
}
#: A value of `Amounts.without` that stands for nothing.
NONE_AWAY = "none"


@dataclass(frozen=True)
class Amounts:
    """All that the study is told."""

    id: ClassVar[str] = "judges"
    question: ClassVar[str] = (
        "Does the learnt judge keep any system from failing, and which of its parts does that?"
    )

    systems: str = option(
        ALL, "Systems with commas, or families of scenarios; all is the ten of the page."
    )
    without: str = option(
        ALL, "Parts that are taken away, each by itself, with commas; all, or none."
    )
    controllers: str = option(
        ALL, "Controllers with commas; all, or first: the first one of each system."
    )
    seeds: int = option(5, "Learning seeds.", min=1)
    train: int | None = option(
        None, "Training episodes. [default: as many as suit the system]", min=1
    )
    test: int = option(100, "Held-out episodes.", min=1)
    seed: int = option(0, "Of everything.", min=0)

    def shortened(self) -> Self:
        """A look, not evidence."""
        return replace(
            self,
            without=NONE_AWAY if self.without == ALL else self.without,
            controllers=FIRST if self.controllers == ALL else self.controllers,
            seeds=1,
            train=min(self.train or 30, 30),
            test=min(self.test, 20),
        )

    @property
    def parts(self) -> tuple[str, ...]:
        """Parts that are taken away.

        Raises
        ------
        ValueError
            If there is no such part.
        """
        if self.without in (ALL, NONE_AWAY):
            return tuple(PARTS) if self.without == ALL else ()
        named = tuple(dict.fromkeys(split_names(self.without)))
        for part in named:
            if part not in PARTS:
                raise ValueError(f"there is no part {part!r}; there are {', '.join(PARTS)}")
        return named
