"""How much is driven."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

from evofsm.app import option, split_names
from evofsm.evidence.study import Progress, Study, silent

if TYPE_CHECKING:
    from rich.console import Console

    from evofsm.evidence.closed_loop.study import ClosedLoop
    from evofsm.evidence.report.chapter import Chapter

# Of the sections with tables beside, those that are short enough.
_IN_THE_TERMINAL = ("shift", "separation", "cases", "worlds")


@dataclass(frozen=True)
class ShiftPlan:
    """How much is driven around a shift."""

    before: int = 100  #: episodes of the stream before the shift
    after: int = 60  #: and after it
    held_out: int = 200  #: episodes of each test


@dataclass(frozen=True)
class Plan(Study["ClosedLoop"]):
    """How many collisions are prevented, what that costs, and who does better.

    Every policy drives the same held-out draws; ours learns first, with several seeds.
    """

    id = "closed-loop"
    question = (
        "Does latent risk, learnt online, prevent collisions, at what cost, and against whom?"
    )
    doing = "Driving and learning"
    short = "A tenth of everything: a look, not evidence."

    family: str = option("emergency", "Family of scenarios, or a TOML file of your own.")
    train: int = option(300, "Training episodes of a learning seed.", min=1)
    test: int = option(1000, "Held-out episodes of every policy.", min=1)
    seeds: int = option(20, "Learning seeds.", min=1)
    seed: int = option(0, "Of everything.", min=0)
    tolerance: float = option(0.02, "Share of leaders' hard brakes that need not be survived.")
    switches: str = option(
        "", "noise, delay, actuator, jerk, third_car; with commas.", name="--with"
    )
    rule_seeds: int = option(2, "Learning seeds in the comparison of state rules; 0: none.", min=0)
    rule_test: int = 100  #: held-out episodes in it, and in the trade-off
    side_train: int = 100  #: training episodes of the studies beside the table
    side_test: int = 300  #: held-out episodes of them
    world_test: int = 50  #: episodes driven in both worlds
    shift: ShiftPlan = field(default_factory=ShiftPlan)

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
            shift=replace(self.shift, before=60, after=10, held_out=20),
        )

    def run(self, progress: Progress = silent, workers: int | None = None) -> ClosedLoop:
        """Drive all policies."""
        from evofsm.driving import load_family
        from evofsm.evidence.closed_loop.study import run_closed_loop

        family = load_family(self.family).with_switches(split_names(self.switches))
        return run_closed_loop(family, self, progress, workers)

    def tell(self, found: ClosedLoop) -> Chapter:
        """Its table, its figures, and where it loses."""
        from evofsm.evidence.closed_loop.chapter import closed_loop_chapter

        return closed_loop_chapter(found)

    def document(self, found: ClosedLoop) -> object:
        """All that was measured, not the rows of the table alone."""
        return found.as_dict()

    def say(self, out: Console, found: ClosedLoop, chapter: Chapter) -> None:
        """Print what all studies print, and the short tables beside it."""
        from evofsm.app import print_table

        super().say(out, found, chapter)
        for section in chapter.sections:
            for table in section.tables if section.id in _IN_THE_TERMINAL else ():
                print_table(out, table)
