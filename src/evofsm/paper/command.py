"""`evofsm paper`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from evofsm.cli import (
    PAGE,
    InWorld,
    WorldName,
    command_line,
    counter,
    option,
    print_json,
    progress,
)


@dataclass(frozen=True, kw_only=True)
class Paper(InWorld):
    """Reproduce the paper: drive its 80 runs, and hold every claim against them.

    Ends with 0 if all claims hold, with 1 if any does not.
    """

    world: WorldName = option(WorldName.SUMO, "SUMO itself, or the same motion in closed form.")
    rounds: int = option(20, "How often the four cases are driven.", min=1)
    out: Path = option(Path("evofsm-paper"), "Folder for the page, figures, traces and the model.")
    settings: Path | None = option(None, "TOML file with settings to use in place of the paper's.")
    as_json: bool = option(False, "Print the claims as JSON instead of tables.", name="--json")

    def packages(self) -> dict[str, str]:
        """What the runs need, and their page."""
        return {"polars": "tables", **PAGE} | super().packages()

    def run(self) -> int:
        """Drive, hold every claim against the runs, and write the page."""
        from evofsm.cli import console
        from evofsm.paper.files import write_data
        from evofsm.paper.plan import Plan
        from evofsm.paper.report.chapter import write_chapters

        plan = Plan(self.world.value, self.rounds, self.settings)
        with progress() as bars:
            found = plan.run(counter(bars, f"{plan.doing} ({self.world})"))
            self.out.mkdir(parents=True, exist_ok=True)
            drawn = counter(bars, "Drawing figures")
            chapter = plan.chapter(found, self.out / "figures", command_line(), drawn)
        write_data(found.study, found.claims, chapter.tables[1:], self.out)
        page = write_chapters(self.out / "index.html", [chapter], command=command_line())
        if self.as_json:
            print_json(found.frame.as_dicts())
        else:
            screen = console()
            plan.say(screen, found, chapter)
            screen.print(f"Page with all figures: {page}", soft_wrap=True)
        return 0 if all(claim.holds for claim in found.claims) else 1
