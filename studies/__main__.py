"""``python -m studies NAME``: a command for every study, and ``evidence`` for all in short."""

from __future__ import annotations

import sys
import time
from importlib import import_module
from pathlib import Path
from typing import Annotated

import typer

from evofsm.cli import print_page
from evofsm.paper import write_page
from studies import lib

#: Where each study is, in the order in which the evidence tells them.
STUDIES = {
    "closed-loop": "closed_loop:ClosedLoop",
    "detection": "detection:Detection",
    "falsification": "falsification:Falsification",
    "judges": "judges:Judges",
    "tasks": "judges:Tasks",
    "good": "good:Good",
    "peers": "peers:Peers",
    "forecasts": "forecasts:ForecastStudy",
    "machines": "machines:Machines",
    "sensitivity": "sensitivity:Sensitivity",
    "traffic": "traffic:Traffic",
    "real": "real:Real",
    "leaders": "real:Leaders",
}
#: Those that need real drives, and those that need packages that are heavy.
REAL, HEAVY = ("real", "leaders"), ("peers",)
_ABOUT = (
    "Each study asks one question and shows the numbers that its answer rests on, and which rows "
    "go against us. These are the short forms, too small for conclusions: the command of each "
    "study makes the long one."
)


def study(name: str) -> type[lib.Study]:
    """The class of a study."""
    module, _, kind = STUDIES[name].partition(":")
    found: type[lib.Study] = getattr(import_module(f"studies.{module}"), kind)
    return found


def evidence(
    data: Annotated[
        Path | None,
        typer.Option(help="Folder of real drives, without which what needs them is left out."),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of every study.")] = 0,
    workers: Annotated[
        int | None, typer.Option(min=1, help="Processes; one per core if not given.")
    ] = None,
    out: Annotated[Path, typer.Option(help="Folder for the page and its figures.")] = Path(
        "evofsm-evidence"
    ),
) -> None:
    """All studies in their short form, on one page: what holds, and where it loses.

    Studies that need torch are left out where it is not installed.
    """
    with lib.refused():
        kinds = [study(name) for name in STUDIES if name not in REAL or data is not None]
        kinds = [kind for kind in kinds if kind.name not in HEAVY or not lib.absent(kind.needed)]
        for kind in kinds:
            lib.require(kind.needed)
        pages = []
        for kind in kinds:
            begun = time.monotonic()
            given = {"data": data} if kind.name in REAL else {}
            asked = kind(seed=seed, **given).shortened()
            pages.append(asked.page(asked.run(workers)))
            print(f"{kind.name}: {time.monotonic() - begun:.0f} s", file=sys.stderr)
            title = "Does it see danger earlier, and does that help?"
            page = write_page(out / "index.html", pages, title, _ABOUT)  # lest a crash loses all
        print_page(*pages)
        print(f"\nPage with all tables and figures: {page}")


def main() -> None:
    """Run the command that was asked for; of the studies only that one is imported."""
    app = typer.Typer(
        name="studies",
        help="Studies: ours against the baselines, on held-out scenarios.",
        no_args_is_help=True,
        add_completion=False,
        pretty_exceptions_enable=False,
    )
    asked = sys.argv[1] if len(sys.argv) > 1 else ""
    for name in [asked] if asked in STUDIES else STUDIES:
        app.command(name)(lib.command(study(name)))
    app.command()(evidence)
    app()


if __name__ == "__main__":
    main()
