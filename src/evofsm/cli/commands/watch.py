"""`evofsm watch`."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from evofsm.cli.commands.common import progress, say
from evofsm.cli.commands.declared import argument, option
from evofsm.cli.commands.groups import Revised

if TYPE_CHECKING:
    from evofsm.cli.watch.player import Watched
    from evofsm.cli.watch.recording import Recording
    from evofsm.cli.watch.session import Session, Watching
    from evofsm.guard import Guard

# Of a simulation of somebody else's that are watched [s].
_SECONDS = 600.0

Opening = Callable[[], "AbstractContextManager[Watched]"]


@dataclass(frozen=True, kw_only=True)
class Watch(Revised):
    """Watch a run in the browser while it is driven, and act on it; or one that was recorded.

    The page shows the cars, what the machine believes, risk beside time to collision, and
    what was done about it. It is served to this computer only, at the address that is printed, and
    the run begins when the page is first opened. Ctrl-C ends it.
    """

    what: str = argument(
        "Family of scenarios: paper, emergency, ..., or a Python file of your own; a run that "
        "drive --mcap recorded; a log, as evofsm learn reads them, or what a SUMO configuration "
        "drives (.sumocfg), watched in shadow mode.",
        "paper",
        metavar="FAMILY|FILE",
    )
    case: int = option(1, "Which of the family's cases, or of its draws.", min=1)
    learn_first: int = option(60, "Episodes to learn from before it is watched.", min=0)
    fresh: bool = option(False, "Learn nothing before: watch it grow from empty.")
    learn: Path | None = option(
        None, "Begin with what this folder of an earlier drive --out holds."
    )
    topics: Path | None = option(
        None, "Of a bag of ROS 2: which field of which topic is which variable, in TOML."
    )
    speed: float = option(1.0, "At first, as a multiple of real time.")
    paused: bool = option(False, "Show the first frame, and wait.")
    port: int = option(0, "Of the page; 0 for any that is free.", min=0, max=65535)
    no_browser: bool = option(False, "Print the address; open nothing.")

    @property
    def is_recorded(self) -> bool:
        """Whether something recorded is replayed: a run, or a log."""
        return self.what.endswith(".mcap") or self.is_log

    @property
    def is_log(self) -> bool:
        """Whether it is a log that others wrote."""
        from evofsm.driving import FAMILIES
        from evofsm.io.tables import file_kind

        place = Path(self.what)
        if self.what in FAMILIES or place.suffix == ".py":
            return False
        if not (place.is_file() or (place / "metadata.yaml").is_file()):
            return False
        # What is damaged is no kind of MCAP: whoever reads runs says so.
        return place.suffix != ".mcap" or file_kind(self.what) in ("mcap", "bag")

    def packages(self) -> dict[str, str]:
        """What the page needs, and what is shown in it."""
        driven = (
            {"scipy": "study", "mcap": "mcap", "foxglove": "mcap"}
            if self.is_recorded
            else super().packages()
        )
        return {"websockets": "watch", **driven}

    def run(self) -> None:
        """Serve the page until Ctrl-C."""
        from evofsm.cli.watch.live.server import LivePage
        from evofsm.cli.watch.player import SPEEDS, Player

        if self.fresh and self.learn is not None:
            raise ValueError("--fresh and --learn exclude each other")
        if self.speed not in SPEEDS:
            speeds = ", ".join(f"{speed:g}" for speed in SPEEDS)
            raise ValueError(f"--speed is {self.speed:g}; it must be one of {speeds}")
        opened = self._recording() if self.is_recorded else self._session()
        with (
            LivePage(self.port, live=not self.is_recorded) as page,
            # Whoever comes to a run that waits finds its first frame.
            Player(
                opened, page, paused=self.paused, speed=self.speed, awaits=not self.paused
            ) as player,
        ):
            page.player = player
            if self.paused:
                player.step()
            with suppress(KeyboardInterrupt):  # as soon as the address is read
                _show(page.address, self.no_browser)
                threading.Event().wait()
        print("\nevofsm: the page is closed")

    def _recording(self) -> Opening:
        """A run that was recorded, read before the page is opened."""
        from evofsm.cli.watch.recording import Recording

        recording = self._shadowed() if self.is_log else Recording(self.what)
        recording.restart(self.case - 1)
        return lambda: recording

    def _shadowed(self) -> Recording:
        """A log, with what a guard would have said of it."""
        from tempfile import TemporaryDirectory

        from evofsm.cli.configuration import trace_configuration
        from evofsm.cli.watch.logged import MOST_ROWS, record_log
        from evofsm.cli.watch.recording import Recording
        from evofsm.io.rosbag import Topics

        with TemporaryDirectory() as folder, progress() as bars:
            task = bars.add_task("Reading", total=MOST_ROWS)
            topics = None if self.topics is None else Topics.load(self.topics)
            run, log = Path(folder) / "run.mcap", self.what
            if log.endswith(".sumocfg"):
                log = str(Path(folder) / f"{Path(self.what).stem}.xml")
                trace_configuration(Path(self.what), Path(log), seconds=_SECONDS)
            left_out = record_log(
                log,
                run,
                topics=topics,
                judge=self.judge.value,
                tolerance=self.tolerance,
                progress=lambda rows: bars.update(task, completed=rows),
            )
            if left_out:
                say(f"Watched are the first {MOST_ROWS:,} rows; there are more.")
            return Recording(run)

    def _session(self) -> Opening:
        """A session in a world of its own, once something was learnt."""
        from evofsm.cli.watch.session import Watching

        family = self.load_family(self.what)
        watching = Watching(
            family,
            self.world.value,
            self.case - 1,
            self.controller,
            self.reviser,
            self.tolerance,
            self.seed,
            self.judge.value,
        )
        if watching.case >= (cases := len(watching.cases)):
            raise ValueError(f"--case is {self.case}; {family.name} has 1 to {cases}")
        guard, learnt = self._guard(watching)

        @contextmanager
        def session() -> Iterator[Session]:
            from evofsm.cli.watch.session import Session
            from evofsm.driving import open_world

            with (
                open_world(watching.world) as world,
                Session(watching, guard, world, learnt) as opened,
            ):
                yield opened

        return session

    def _guard(self, watching: Watching) -> tuple[Guard, int]:
        """One that has learnt something, and from how many episodes."""
        from evofsm.cli.driving import episodes_learnt
        from evofsm.cli.watch.session import learn_first, watched_guard
        from evofsm.driving import guard_for_family, load_learnt

        if self.learn is not None:
            machine, judge = load_learnt(self.learn)
            guard = guard_for_family(watching.family, machine=machine, judge=judge)
            return guard, episodes_learnt(self.learn)
        guard = watched_guard(watching.family, watching.judge)
        episodes = 0 if self.fresh else self.learn_first
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
