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
        from evofsm.paper.page import print_page
        from evofsm.paper.reproduction import reproduce

        with progress() as bars:
            done = counter(bars, f"Driving and learning ({self.world})")
            found = reproduce(self.world.value, self.rounds, self.settings, done)
        page = found.write(self.out, command_line())
        if self.as_json:
            print_json([claim._asdict() for claim in found.claims])
        else:
            print_page(found.page(command_line()))
            print(f"\nPage with all figures: {page}")
        return 0 if found.holds else 1
