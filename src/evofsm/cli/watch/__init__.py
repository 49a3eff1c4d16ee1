"""`evofsm watch`: a run in the browser, while it is driven, or a log of others."""

from __future__ import annotations

import asyncio
import re
import webbrowser
from contextlib import suppress
from functools import partial
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Annotated, Any

from evofsm.cli.options import (
    BRAKES,
    TOLERANCE,
    Brakes,
    ByJudge,
    InWorld,
    Judge,
    Reading,
    Seed,
    Tolerance,
    World,
    argument,
    given_of,
    option,
    reading_of,
    reads_logs,
    require,
    require_world,
)
from evofsm.cli.show import progress, say, warn

if TYPE_CHECKING:
    from evofsm.cli.watch.session import Session

# Of a simulation of somebody else's that are watched [s], and positions of cars in them.
_SECONDS, _ENOUGH = 600.0, 100_000


@reads_logs
def watch(
    what: Annotated[
        str,
        argument(
            "Scenarios for cars (paper, emergency, ...), an environment (CartPole-v1, ...), a file "
            "of Python with one of your own, a log, or a .sumocfg.",
            metavar="FAMILY|ENVIRONMENT|FILE",
        ),
    ] = "paper",
    case: Annotated[int | None, option("Which case, draw or episode.", min=1)] = None,
    world: InWorld = "kinematic",
    judge: ByJudge = "kinematic",
    tolerance: Tolerance = TOLERANCE,
    guard: Annotated[Path | None, option("Of a log: a saved guard. [default: of cars]")] = None,
    seed: Seed = 0,
    learn_first: Annotated[int, option("Episodes to learn from before, at most.", min=0)] = 60,
    brakes: Brakes = BRAKES,
    *,
    reading: partial[Reading],
    no_browser: Annotated[bool, option("Print the address alone.", "--no-browser")] = False,
) -> None:
    """Watch a run in the browser while it is driven, and act on it; or a log.

    A Python file defines a family of scenarios, called family, or a function environment(), which
    returns an environment of Gymnasium, and if it likes controller, failed and variables
    (docs/watch.md). A log is read with the options of evofsm learn, from --observe to --hole.

    The page is served to this computer only, at the address that is printed, and the run begins
    when it is first opened. Ctrl-C ends it.
    """
    require(websockets="watch")
    from evofsm.guard import Guard
    from evofsm.store import read_header

    is_log = _is_log(what)
    if not is_log and (given_of(reading) or guard):
        raise ValueError(f"--guard and options of columns are for a log, and {what} is none")
    defaults = {} if guard is None else read_header(guard).provenance.get("read with", {})
    reader = partial(reading_of, **{**reading.keywords, **defaults, **given_of(reading)})
    with suppress(KeyboardInterrupt):
        if is_log:
            risk = None if tolerance == TOLERANCE else tolerance
            log_guard = None if guard is None else Guard.load(guard)
            try:
                run = _logged(what, reader(), risk, case, log_guard, brakes=brakes)
            except ValueError as error:
                if given_of(reading) or "has no column" not in str(error):
                    raise
                look = f"evofsm learn {quote(what)} says what it holds, and what to name"
                raise ValueError(f"{error}. Is it no log of cars? {look}") from error
        else:
            run = _driven(what, case or 1, world, judge, tolerance, seed, learn_first)
        with run:
            asyncio.run(_serve(run, browse=not no_browser))
    say("\nThe page is closed.")


async def _serve(watched: Session, *, browse: bool) -> None:
    from evofsm.cli.watch.player import Player
    from evofsm.cli.watch.server import LivePage

    async with LivePage() as page:
        page.player = Player(watched, page)
        may = "steer the run" if watched.start.live else "look on"
        say(f"Watch it here (Ctrl-C ends it); whoever has this address may {may}:")
        print(f"  {page.address}", flush=True)
        if browse:
            webbrowser.open(page.address)
        await page.player.play()
        await asyncio.Event().wait()  # it broke off; the page says why


def _is_log(what: str) -> bool:
    """Whether it is a log that others wrote; what is nothing that can be watched is refused."""
    from evofsm.driving import FAMILIES

    place = Path(what)
    if what.partition("+")[0] in FAMILIES or re.search(r"-v\d+$", what):
        return False
    if not place.exists():
        if place.suffix or len(place.parts) > 1:
            raise FileNotFoundError(2, "no such file or directory", what)
        raise ValueError(
            f"{what} is neither a file nor one of the families {', '.join(FAMILIES)}; an "
            "environment of Gymnasium is named with its version: CartPole-v1"
        )
    return place.suffix != ".py"


def _logged(what: str, reading: Reading, *asked: Any, **settings: Any) -> Session:
    """A log, or what a configuration of SUMO drives."""
    from tempfile import TemporaryDirectory

    from evofsm.cli.sumocfg import trace_configuration
    from evofsm.cli.watch.session import watched_log

    if not what.endswith(".sumocfg"):
        return watched_log(what, reading, *asked, **settings)
    with TemporaryDirectory() as folder:
        log = Path(folder) / Path(what).name
        duration, is_cut, crashes = trace_configuration(Path(what), log, _SECONDS, _ENOUGH)
        if is_cut:
            warn(f"watched are the first {duration:,.0f} s of the simulation")
        return watched_log(str(log), reading, *asked, collisions=crashes, **settings)


def _driven(
    what: str,
    case: int,
    world: World,
    judge: Judge,
    tolerance: float,
    seed: int,
    episodes: int,
) -> Session:
    """A session of cars in a world of their own, or of an environment."""
    from evofsm.cli.watch.session import (
        OnRoads,
        Session,
        System,
        learn_first,
        read_simulated,
        watched_guard,
    )

    environment = read_simulated(what, seed=seed, tolerance=tolerance)
    if environment is None:
        require_world(world)
        from evofsm.driving import load_family
        from evofsm.driving.sumo import open_world

        family = load_family(what)
        system: System = OnRoads(family, open_world(world), seed)
        guard = watched_guard(family, judge=judge, tolerance=tolerance)
    else:
        system, guard = environment, environment.guard
    with progress("Learning first", episodes) as move:
        learn_first(guard, system, episodes, move)
    return Session(system, guard, case=case - 1)
