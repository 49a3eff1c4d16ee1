"""`evofsm watch`: a run in the browser, while it is driven, or a log of others."""

from __future__ import annotations

import re
import webbrowser
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from shlex import quote
from typing import Annotated, Any

from typer import Context

from evofsm.cli import options
from evofsm.cli.options import argument, option


@options.reads_logs
def watch(
    ctx: Context,
    what: Annotated[
        str,
        argument(
            "Scenarios for cars (paper, emergency, ...), an environment (CartPole-v1, ...), a file "
            "of Python with one of your own, a log, or a .sumocfg.",
            metavar="FAMILY|ENVIRONMENT|FILE",
        ),
    ] = "paper",
    case: Annotated[int | None, option("Which case, draw or episode.", min=1)] = None,
    world: options.InWorld = "kinematic",
    judge: options.ByJudge = "kinematic",
    tolerance: options.Tolerance = options.TOLERANCE,
    guard: Annotated[Path | None, option("Of a log: a saved guard. [default: of cars]")] = None,
    seed: options.Seed = 0,
    learn_first: Annotated[int, option("Episodes to learn from before, at most.", min=0)] = 60,
    brakes: options.Brakes = options.BRAKES,
    *,
    reading: dict[str, Any],
    no_browser: Annotated[bool, option("Print the address alone.", "--no-browser")] = False,
) -> int:
    """Watch a run in the browser while it is driven, and act on it; or a log.

    A Python file defines a family of scenarios, called family, or a function environment(), which
    returns an environment of Gymnasium, and if it likes controller, failed and variables
    (docs/watch.md). A log is read with the options of evofsm learn, from --observe to --hole.

    The page is served to this computer only, at the address that is printed, and the run begins
    when it is first opened. Ctrl-C ends it.
    """
    options.require(websockets="watch")
    from evofsm.cli.models import load_learning
    from evofsm.cli.show import say
    from evofsm.cli.watch import session
    from evofsm.cli.watch.server import LivePage, Player

    is_log = _is_log(what)
    names = ("world", "judge", "seed", "learn_first") if is_log else ("guard", "brakes", *reading)
    options.refuse_typed(ctx, names, "what is driven" if is_log else f"a log, and {what} is none")
    if is_log:
        risk = None if tolerance == options.TOLERANCE else tolerance
        log_options, units = options.read_with(guard)
        reader = {**log_options, **reading}
        log_guard = None if guard is None else load_learning(guard, reader.get("failed"))
        try:
            log_format = replace(options.reading_of(**reader), usual_units=units)
            is_simulation = what.endswith(options.SUMO)
            show = session.watched_simulation if is_simulation else session.watched_log
            run = show(what, log_format, risk, case, log_guard, brakes=brakes)
        except ValueError as error:
            if reading or "has no column" not in str(error):
                raise
            look = f"evofsm learn {quote(what)} says what it holds, and what to name"
            raise ValueError(f"{error}. Is it no log of cars? {look}") from error
    else:
        run = session.watched_run(
            what, case or 1, world, judge, tolerance=tolerance, seed=seed, learnt=learn_first
        )
    with run, LivePage() as page:
        page.player = player = Player(run, page)
        may = "steer the run" if run.start.live else "look on"
        say(f"Watch it here (Ctrl-C ends it); whoever has this address may {may}:")
        print(f"  {page.address}", flush=True)
        if not no_browser:
            webbrowser.open(page.address)
        with suppress(KeyboardInterrupt):
            player.play()
    say("\nThe page is closed.")
    return 2 if player.fault else 0


def _is_log(what: str) -> bool:
    """Whether it is a log that others wrote; what is nothing that can be watched is refused."""
    from evofsm.driving import FAMILIES

    place = Path(what)
    if what.partition("+")[0] in FAMILIES or re.search(r"-v\d+$", what):
        return False
    if not place.exists():
        if place.suffix or len(place.parts) > 1:
            raise FileNotFoundError(2, "no such file or directory", what)
        fault = f"{what} is neither a file nor one of the families {', '.join(FAMILIES)}"
        hint = "an environment of Gymnasium is named with its version: CartPole-v1"
        raise ValueError(f"{fault}; {hint}")
    return place.suffix != ".py"
