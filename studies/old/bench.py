"""A command for every study, made from the study's own fields."""

from __future__ import annotations

from dataclasses import dataclass, field, make_dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from studies.old.shim import PAGE, Command, command_line, counter, option, print_json, progress
from studies.old.study import Study

_FOLDER = "Folder for the page, its figures and the data."


@dataclass(frozen=True, kw_only=True)
class RunStudy(Command):
    """Run a study: print its rows as JSON, or write the page and print what it says."""

    study: Study[Any]
    workers: int | None = option(None, "Processes. [default: one per core]", min=1)
    short: bool = option(False, "A look, not evidence.")
    out: Path = option(Path("evofsm-study"), _FOLDER)
    as_json: bool = option(False, "Print all rows as JSON; write nothing.", name="--json")

    def packages(self) -> dict[str, str]:
        """What the study needs, and its page."""
        return {**self.study.needed, **({} if self.as_json else PAGE)}

    def run(self) -> None:
        """Do what was asked for."""
        study = self.study.shortened() if self.short else self.study
        with progress() as bars:
            found = study.run(counter(bars, study.doing), self.workers)
        if self.as_json:
            print_json(found.frame.as_dicts())
            return
        from studies.old.chapter import write_chapters
        from studies.old.shim import console, to_json

        self.out.mkdir(parents=True, exist_ok=True)
        with progress() as bars:
            drawn = counter(bars, "Drawing figures")
            chapter = study.chapter(found, self.out, command_line(), drawn)
        document = to_json(study.document(found))
        (self.out / f"{study.id}.json").write_text(f"{document}\n", encoding="utf-8")
        if find_spec("polars"):
            found.frame.write_parquet(self.out / f"{study.id}.parquet")
        page = write_chapters(self.out / "index.html", [chapter], command=command_line())
        screen = console()
        study.say(screen, found, chapter)
        screen.print(f"Page with all figures: {page}", soft_wrap=True)


def command_of(study: type[Study[Any]]) -> type[Command]:
    """The command of a study: its options are those of its fields, and those that all have."""
    fields: list[tuple[str, Any, Any]] = [
        ("study", study, field()),
        ("short", bool, option(False, study.short)),
        ("out", Path, option(Path(f"evofsm-{study.id}"), _FOLDER)),
    ]
    name = study.id.title().replace("-", "")
    return make_dataclass(
        name,
        fields,
        bases=(RunStudy,),
        namespace={"__doc__": study.__doc__},
        frozen=True,
        kw_only=True,
    )
