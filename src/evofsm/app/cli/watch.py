"""`evofsm watch`."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from evofsm.app.cli.common import (
    ControllerOption,
    ReviserOption,
    SwitchesOption,
    ToleranceOption,
    WorldName,
    WorldOption,
    of_world,
    plain_errors,
    progress,
    require,
    split_names,
)

with suppress(ModuleNotFoundError):
    import typer

if TYPE_CHECKING:
    from evofsm.app.watch.player import Watched
    from evofsm.app.watch.session import Session, Watching
    from evofsm.guard import Guard


@plain_errors
def watch(
    what: Annotated[
        str,
        typer.Argument(
            metavar="FAMILY|FILE",
            help="Family of scenarios: paper, emergency, ..., or a TOML file of your own; or a run "
            "that drive --mcap recorded, to be replayed.",
        ),
    ] = "paper",
    case: Annotated[
        int, typer.Option(min=1, help="Which of the family's cases, or of its draws.")
    ] = 1,
    world: WorldOption = WorldName.KINEMATIC,
    controller: ControllerOption = "family",
    reviser: ReviserOption = "least-risk",
    tolerance: ToleranceOption = 0.02,
    switches: SwitchesOption = "",
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
    paused: Annotated[
        bool, typer.Option("--paused", help="Show the first frame, and wait.")
    ] = False,
    port: Annotated[
        int, typer.Option(min=0, max=65535, help="Of the page; 0 for any that is free.")
    ] = 0,
    no_browser: Annotated[
        bool, typer.Option("--no-browser", help="Print the address; open nothing.")
    ] = False,
) -> None:
    """Watch a run in the browser while it is driven, and act on it; or one that was recorded.

    The page shows the cars, what the machine believes, latent risk beside time to collision, and
    what was done about it. It answers on this computer only, under the address that is printed,
    and the run begins as the page is first opened. Ctrl-C ends it.
    """
    recorded = {"mcap": "mcap"} if what.endswith(".mcap") else of_world(world)
    require(websockets="watch", scipy="study", **recorded)
    from evofsm.app.watch.live.server import LivePage
    from evofsm.app.watch.player import SPEEDS, Player
    from evofsm.app.watch.session import Watching
    from evofsm.driving import load_family

    if fresh and learn is not None:
        raise ValueError("--fresh and --learn exclude each other")
    if speed not in SPEEDS:
        raise ValueError(f"--speed is {speed:g}; it must be one of {_list(SPEEDS)}")
    is_recorded = what.endswith(".mcap")
    if is_recorded:
        opened = _recording(what, case)
    else:
        family = load_family(what).with_switches(split_names(switches))
        watching = Watching(family, world.value, case - 1, controller, reviser, tolerance, seed)
        opened = _session(watching, learn, 0 if fresh else learn_first)
    with (
        LivePage(port, live=not is_recorded) as page,
        # Whoever comes to a run that waits finds its first frame.
        Player(opened, page, paused=paused, speed=speed, awaits=not paused) as player,
    ):
        page.player = player
        if paused:
            player.step()
        _show(page.address, no_browser)
        with suppress(KeyboardInterrupt):
            threading.Event().wait()
    print("\nevofsm: the page is closed")


Opening = Callable[[], "AbstractContextManager[Watched]"]


def _recording(path: str, case: int) -> Opening:
    """A run that was recorded, read before the page is opened."""
    require(mcap="mcap")
    from evofsm.app.watch.recording import Recording

    recording = Recording(path)
    recording.restart(case - 1)
    return lambda: recording


def _session(watching: Watching, learn: Path | None, learn_first: int) -> Opening:
    """A session in a world of its own, once something was learnt."""
    cases = len(watching.cases)
    if watching.case >= cases:
        raise ValueError(f"--case is {watching.case + 1}; {watching.family.name} has 1 to {cases}")
    guard, learnt = _guard(watching, learn, learn_first)

    @contextmanager
    def session() -> Iterator[Session]:
        from evofsm.app.watch.session import Session
        from evofsm.driving import open_world

        with (
            open_world(watching.world) as world,
            Session(watching, guard, world, learnt) as opened,
        ):
            yield opened

    return session


def _guard(watching: Watching, folder: Path | None, episodes: int) -> tuple[Guard, int]:
    """One that has learnt something, and from how many episodes."""
    from evofsm.app.driving import episodes_learnt
    from evofsm.app.watch.session import learn_first, watched_guard
    from evofsm.driving import guard_for_family, load_learnt

    if folder is not None:
        machine, judge = load_learnt(folder)
        guard = guard_for_family(watching.family, machine=machine, judge=judge)
        return guard, episodes_learnt(folder)
    guard = watched_guard(watching.family)
    with progress() as bars:
        task = bars.add_task("Learning first", total=episodes)
        learn_first(
            watching, guard, episodes, lambda done, total: bars.update(task, completed=done)
        )
    return guard, episodes


def _show(address: str, no_browser: bool) -> None:
    import webbrowser

    print("Watch it here (Ctrl-C ends it); whoever has this address may steer the run:")
    print(f"  {address}", flush=True)
    if not no_browser:
        webbrowser.open(address)


def _list(speeds: tuple[float, ...]) -> str:
    return ", ".join(f"{speed:g}" for speed in speeds)
