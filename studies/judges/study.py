"""The study: every system with every controller and learning seed, each part taken away in turn.

Times of decisions depend on the machine; nothing else does, nor on the number of processes.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial

from evofsm.cli import ALL, split_names
from evofsm.fleet import in_order
from studies.judges.amounts import Amounts
from studies.old.frame import Frame, Progress, silent
from studies.systems import SYSTEMS, make_system
from studies.systems.cars import Cars
from studies.systems.trial import Row, trial


@dataclass(frozen=True)
class Judges:
    """All that was found."""

    plan: Amounts
    rows: list[Row]

    @property
    def frame(self) -> Frame:
        """Every row."""
        return Frame(self.rows)

    @property
    def systems(self) -> list[str]:
        """Names, in their order."""
        return list(dict.fromkeys(row.system for row in self.rows))

    @property
    def parts(self) -> list[str]:
        """Those that were taken away, in their order."""
        return list(dict.fromkeys(row.without for row in self.rows if row.without))

    def of(
        self,
        system: str | None = None,
        controller: str | None = None,
        judge: str = "learnt",
        without: str = "",
    ) -> list[Row]:
        """Rows of a judge; of all systems or controllers where none is named."""
        return [
            row
            for row in self.rows
            if (row.judge, row.without) == (judge, without)
            and system in (None, row.system)
            and controller in (None, row.controller)
        ]


def run_judges(plan: Amounts, progress: Progress = silent, workers: int | None = None) -> Judges:
    """Try all that the plan names; see `Study.run`.

    Raises
    ------
    ValueError
        If there is no such system or part.
    """
    return Judges(plan, in_order(list(_tasks(plan)), workers, progress))


def _tasks(plan: Amounts) -> Iterator[partial[Row]]:
    """A trial each, system by system, so that what is told can be drawn in their order."""
    names = dict.fromkeys(SYSTEMS if plan.systems == ALL else split_names(plan.systems))
    parts = plan.parts
    for name in names:
        system = make_system(name)
        for controller in system.chosen(plan.controllers):
            one = partial(trial, name, controller, test=plan.test, base=plan.seed)
            yield partial(one, judge="unrevised", train=0)
            for seed in range(plan.seeds):
                learning = partial(one, seed=seed, train=plan.train)
                if isinstance(system, Cars):
                    yield partial(learning, judge="kinematic")
                yield learning
                for part in parts:
                    yield partial(learning, without=(part,))
