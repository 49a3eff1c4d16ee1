"""The study as a command: how much is driven, and what is told of it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from evofsm.cli import split_names
from evofsm.paper.frame import Progress, silent
from evofsm.paper.study import Study
from studies.closed_loop.amounts import Amounts

if TYPE_CHECKING:
    from rich.console import Console

    from evofsm.paper.report.chapter import Chapter
    from studies.closed_loop.study import ClosedLoop

# Of the sections with tables beside, those that are short enough.
_IN_THE_TERMINAL = ("shift", "separation", "cases", "machine_cases", "worlds")


@dataclass(frozen=True)
class Plan(Amounts, Study["ClosedLoop"]):
    """How many collisions are prevented, what that costs, and who does better.

    Every policy drives the same held-out draws; ours learns first, with several seeds.
    """

    doing = "Driving and learning"
    short = "A tenth of everything: a look, not evidence."

    def shortened(self) -> Plan:
        """About a tenth of everything: a look, not evidence."""
        return replace(
            self,
            train=min(self.train, 100),
            test=min(self.test, 100),
            seeds=min(self.seeds, 2),
            rule_seeds=min(self.rule_seeds, 1),
            rule_test=20,
            side_train=40,
            side_test=60,
            world_test=5,
            machine_train=min(self.machine_train, 40),
            machine_test=40,
            machine_checks=10,
            shift=replace(
                self.shift,
                before=60,
                after=10,
                held_out=20,
                machine_seeds=1,
                machine_held_out=10,
            ),
        )

    def run(self, progress: Progress = silent, workers: int | None = None) -> ClosedLoop:
        """Drive all policies."""
        from evofsm.driving import load_family
        from studies.closed_loop.study import run_closed_loop

        family = load_family(self.family).with_switches(split_names(self.switches))
        return run_closed_loop(family, self, progress, workers)

    def tell(self, found: ClosedLoop) -> Chapter:
        """Its table, its figures, and where it loses."""
        from studies.closed_loop.chapter import closed_loop_chapter

        return closed_loop_chapter(found)

    def document(self, found: ClosedLoop) -> object:
        """All that was measured, not the rows of the table alone."""
        return found.as_dict()

    def say(self, out: Console, found: ClosedLoop, chapter: Chapter) -> None:
        """Print what all studies print, and the short tables beside it."""
        from evofsm.cli import print_table

        super().say(out, found, chapter)
        for section in chapter.sections:
            for table in section.tables if section.id in _IN_THE_TERMINAL else ():
                print_table(out, table)
