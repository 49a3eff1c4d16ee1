"""`python -m studies evidence`: all studies, on one page."""

from __future__ import annotations

import sys
import time
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
from studies.studies import STUDIES

_ABOUT = (
    "Each study asks one question, says what came of it in a line, and shows the numbers that this "
    "rests on. These are the short forms, which fit a coffee break: the command beside each study "
    "makes the long one. What goes against us is gathered at the end."
)


@dataclass(frozen=True, kw_only=True)
class Evidence(InWorld):
    """All studies in their short form, on one page: what holds, and where it loses.

    The page names the command of each study's long form.
    """

    data: Path | None = option(
        None,
        "Folder of real drives, as `python -m studies real` takes it; without it that study is "
        "left out.",
    )
    world: WorldName = option(WorldName.SUMO, "SUMO itself, or the same motion in closed form.")
    seed: int = option(0, "Of every study.", min=0)
    workers: int | None = option(None, "Processes. [default: one per core]", min=1)
    out: Path = option(Path("evofsm-evidence"), "Folder for the page and its figures.")
    as_json: bool = option(
        False, "Print what was found as JSON instead of a summary.", name="--json"
    )

    def packages(self) -> dict[str, str]:
        """What all studies need, and their page."""
        needed = {"scipy": "study", "deeptime": "dev", "gymnasium": "gym"}
        return {**needed, **PAGE} | super().packages()

    def run(self) -> None:
        """Run every study, and write the page."""
        from evofsm import cli
        from evofsm.paper import terminal
        from evofsm.paper.report.chapter import write_chapters

        self.out.mkdir(parents=True, exist_ok=True)
        chapters = []
        given = {"data": self.data, "seed": self.seed, "world": self.world.value}
        studies = [
            made for study in STUDIES.values() if (made := study.in_short(**given)) is not None
        ]
        with progress() as bars:
            for study in studies:
                begun, name = time.monotonic(), study.id.replace("-", " ")
                found = study.run(counter(bars, f"Study: {name}"), self.workers)
                chapters.append(study.chapter(found, self.out / study.id, study.command))
                print(f"{name}: {time.monotonic() - begun:.0f} s", file=sys.stderr)
        page = write_chapters(
            self.out / "index.html",
            chapters,
            title="Does it see danger earlier, and does that help?",
            about=_ABOUT,
            command=command_line(),
        )
        if self.as_json:
            print_json({"page": str(page), "chapters": [chapter.as_dict() for chapter in chapters]})
            return
        console = cli.console()
        terminal.print_headlines(console, chapters)
        console.print(f"Page with all tables and figures: {page}", soft_wrap=True)
