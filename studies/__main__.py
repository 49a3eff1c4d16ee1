"""``python -m studies NAME``: a command for every study, and ``evidence`` for all in short."""

from __future__ import annotations

from typing import TYPE_CHECKING

from evofsm.cli import commands
from studies.cli.bench import command_of
from studies.cli.evidence import Evidence
from studies.cli.leaders import Leaders
from studies.studies import STUDIES

if TYPE_CHECKING:
    import typer


def application() -> typer.Typer:
    """The studies that hold ours against others."""
    studies = [command_of(study) for study in STUDIES.values() if study.id != "paper"]
    about = "Studies: ours against the baselines, on held-out scenarios."
    return commands.group("studies", about, *studies, Leaders, Evidence)


if __name__ == "__main__":
    commands.main(application)
