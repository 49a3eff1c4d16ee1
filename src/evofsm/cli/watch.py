"""`evofsm watch`."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from evofsm.cli.common import (
    ControllerOption,
    ReviserOption,
    ToleranceOption,
    WorldName,
    WorldOption,
    plain_errors,
    progress,
    require,
)

with suppress(ModuleNotFoundError):
    import typer

if TYPE_CHECKING:
    from evofsm.studies.closed_loop import Learner
    from evofsm.studies.watching import Session, Watching


@plain_errors
def watch(
    what: Annotated[
        str,
        typer.Argument(
            metavar="FAMILY",
            help="Family of scenarios: paper, emergency, ..., or a TOML file of your own.",
        ),
    ] = "paper",
    case: Annotated[
        int, typer.Option(min=1, help="Which of the family's cases, or of its draws.")
    ] = 1,
    world: WorldOption = WorldName.KINEMATIC,
    controller: ControllerOption = "family",
    reviser: ReviserOption = "least-risk",
    tolerance: ToleranceOption = 0.02,
    learn_first: Annotated[
        int, typer.Option(min=0, help="Episodes to learn from before it is watched.")
    ] = 60,
    fresh: Annotated[
        bool, typer.Option("--fresh", help="Learn nothing before: watch it grow from empty.")
    ] = False,
    learn: Annotated[
        Path | None,
        typer.Option(
            help="Begin with what this folder of an earlier drive --out holds.", show_default=False
        ),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Of the draws.")] = 0,
    speed: Annotated[float, typer.Option(help="At first, as a multiple of real time.")] = 1.0,
    paused: Annotated[bool, typer.Option("--paused", help="Wait at first.")] = False,
    port: Annotated[
        int, typer.Option(min=0, max=65535, help="Of the page; 0 for any that is free.")
    ] = 0,
    no_browser: Annotated[
        bool, typer.Option("--no-browser", help="Print the address; open nothing.")
    ] = False,
) -> None:
    """Watch a run in the browser while it is driven, and act on it.

    The page shows the cars, what the machine believes, latent risk beside time to collision, and
    what was done about it. It answers on this computer only, under the address that is printed.
    Ctrl-C ends it.
    """
    require(websockets="watch", scipy="study")
    from evofsm.report.live import LivePage
    from evofsm.studies.watching import SPEEDS, Player, Watching
    from evofsm.worlds.families import load_family

    if fresh and learn is not None:
        raise ValueError("--fresh and --learn exclude each other")
    if speed not in SPEEDS:
        raise ValueError(f"--speed is {speed:g}; it must be one of {_list(SPEEDS)}")
    watching = Watching(
        load_family(what), world.value, case - 1, controller, reviser, tolerance, seed
    )
    if case > len(watching.cases):
        raise ValueError(f"--case is {case}; {what} has 1 to {len(watching.cases)}")
    learner, learnt = _learner(watching, learn, 0 if fresh else learn_first)

    @contextmanager
    def session() -> Iterator[Session]:
        from evofsm.studies.watching import Session
        from evofsm.worlds import open_world

        with open_world(world.value) as place, Session(watching, learner, place, learnt) as opened:
            yield opened

    with LivePage(port) as page, Player(session, page, paused=paused, speed=speed) as player:
        page.player = player
        _show(page.address, no_browser)
        with suppress(KeyboardInterrupt):
            threading.Event().wait()
    print("\nevofsm: the page is closed")


def _learner(watching: Watching, folder: Path | None, episodes: int) -> tuple[Learner, int]:
    """One that has learnt something, and from how many episodes."""
    from evofsm.studies.closed_loop import Learner
    from evofsm.studies.driving import episodes_learnt
    from evofsm.studies.watching import learn_first, watched_learner

    if folder is not None:
        return Learner.load(folder), episodes_learnt(folder)
    learner = watched_learner(watching.family)
    with progress() as bars:
        task = bars.add_task("Learning first", total=episodes)
        learn_first(
            watching, learner, episodes, lambda done, total: bars.update(task, completed=done)
        )
    return learner, episodes


def _show(address: str, no_browser: bool) -> None:
    import webbrowser

    print("Watch it here (Ctrl-C ends it); whoever has this address may steer the run:")
    print(f"  {address}", flush=True)
    if not no_browser:
        webbrowser.open(address)


def _list(speeds: tuple[float, ...]) -> str:
    return ", ".join(f"{speed:g}" for speed in speeds)
