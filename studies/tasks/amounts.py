"""How much is controlled, learnt and tried."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar, Self

from evofsm.cli import ALL, FIRST, option

# Those of a shortened run, unless others are named.
_SHORT = "acc,cartpole,pendulum"
#: Tasks of which more was asked.
ACC = ("acc", "acc-5")


@dataclass(frozen=True)
class Amounts:
    """All that the study is told."""

    id: ClassVar[str] = "tasks"
    question: ClassVar[str] = "Does it keep the tasks of others from failing, and at what cost?"

    tasks: str = option(
        "", "Tasks with commas, or all. [default: all, or none where --task is given]"
    )
    task: str = option("", "A task of your own, module:Class; see docs/tasks.md.")
    judge: str = option("", "A judge of your own on every task, module:Class.")
    controllers: str = option(
        ALL, "Controllers with commas; all, or first: the first one of each task."
    )
    policies: bool = option(
        True, "Also train policies of CartPole under the guard.", name="--policies/--no-policies"
    )
    seeds: int = option(5, "Learning seeds; of acc 20 at least.", min=1)
    train: int | None = option(
        None, "Training episodes. [default: 200 of acc, as many as suit the others]", min=1
    )
    test: int = option(100, "Held-out episodes.", min=1)
    seed: int = option(0, "Of everything.", min=0)
    acc_seeds: int = 20  #: learning seeds of `ACC`
    acc_train: int = 200  #: training episodes of `ACC`
    rounds: int = 1000  #: of the bootstrap
    generations: int = 12  #: of policies that are trained
    population: int = 16  #: policies in each
    penalty: float = 1.0  #: for each action that is changed, where there is one

    def shortened(self) -> Self:
        """A look, not evidence."""
        return replace(
            self,
            tasks=self.tasks or ("" if self.task else _SHORT),
            controllers=FIRST if self.controllers == ALL else self.controllers,
            seeds=1,
            train=min(self.train or 20, 20),
            test=min(self.test, 10),
            acc_seeds=1,
            rounds=100,
            generations=2,
            population=4,
        )

    def seeds_of(self, task: str) -> int:
        """Learning seeds of a task."""
        return max(self.seeds, self.acc_seeds) if task in ACC else self.seeds

    def train_of(self, task: str) -> int | None:
        """Training episodes of a task; None for as many as suit it."""
        return self.acc_train if self.train is None and task in ACC else self.train
