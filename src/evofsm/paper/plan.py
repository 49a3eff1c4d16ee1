"""How often the paper's cases are driven, and where."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from evofsm.paper.frame import Progress, silent
from evofsm.paper.study import Study

if TYPE_CHECKING:
    from evofsm.paper.claims import Reproduction
    from evofsm.paper.report.chapter import Chapter


@dataclass(frozen=True)
class Plan(Study["Reproduction"]):
    """Reproduce the paper: drive its 80 runs, and hold every claim against them."""

    id = "paper"
    question = "Does the paper's machine do what the paper says?"
    doing = "Driving and learning"
    short = "All of it, which is short."
    program = "evofsm"

    world: str = "sumo"
    rounds: int = 20  #: how often the four cases are driven
    settings: Path | None = None  #: TOML file with settings in place of the paper's

    def shortened(self) -> Plan:
        """All of it, which is short."""
        return replace(self)

    def run(self, progress: Progress = silent, workers: int | None = None) -> Reproduction:
        """Drive the four cases, round by round, in one process."""
        from evofsm.driving import open_world
        from evofsm.paper.claims import Reproduction, check_claims
        from evofsm.paper.runs import run_paper
        from evofsm.paper.settings import Settings

        with open_world(self.world) as place:
            settings = Settings.load(self.settings)
            study = run_paper(place, self.world, settings, self.rounds, progress)
        return Reproduction(study, check_claims(study))

    def tell(self, found: Reproduction) -> Chapter:
        """Every claim beside what was measured."""
        from evofsm.paper.chapter import paper_chapter

        return paper_chapter(found.study, found.claims)
