"""`evofsm monitor`."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import ExitStack, closing
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from evofsm.cli.commands.common import chosen_mode
from evofsm.cli.commands.declared import Command, argument, option

if TYPE_CHECKING:
    from evofsm.cli.monitor.carriers import Station
    from evofsm.guard import Guard


@dataclass(frozen=True, kw_only=True)
class Monitor(Command):
    """Decide beside a stack of your own: rows in, decisions out, a JSON line each.

    A row: {"time": 0.1, "gap": 32, "v_follower": 20, "v_leader": 18, "proposal": 0.5}, in s, m,
    m/s and m/s²; or a scene of objects; or the variables of the guard. docs/monitor.md describes
    all messages. What cannot be used is answered by a line that names it.

    Rows come from standard input, a file, a socket, UDP or Zenoh. Nothing is learnt without
    --learn, and nothing is changed without --mode act. Ctrl-C or SIGTERM ends it, with everything
    saved.
    """

    file: Path | None = argument(
        "JSON lines, or a run that drive --mcap recorded. [default: standard input]", None
    )
    guard: Path | None = option(
        None, "A saved guard. Without one, that of a car that is told how hard it brakes."
    )
    interval: float = option(0.1, "Time between two rows [s]; a saved guard has its own.")
    brakes: float = option(
        6.0, "Hardest braking of the own car [m/s²], if no guard is given.", min=0.5, max=20.0
    )
    traffic: bool = option(
        False, "Judge all objects of scenes, who is behind included; nothing of it is learnt."
    )
    mode: str = option(
        "shadow", "How far it goes: shadow (it executes what is proposed), advise, or act."
    )
    proposal: float | None = option(None, "Taken for that of rows without one.")
    learn: bool = option(False, "Learn from what comes.")
    state: Path | None = option(
        None, "Keep all of it in this file, and go on from there; may be that of --guard."
    )
    audit: Path | None = option(None, "Write an audit log to this file.")
    episode: int = option(
        6000, "An episode ends after so many rows: between two it learns and is saved.", min=1
    )
    socket: Path | None = option(None, "Listen to a UNIX socket.")
    udp: int | None = option(
        None, "Listen to this port on 127.0.0.1; 0 for any that is free.", min=0, max=65535
    )
    zenoh: str | None = option(None, "Rows are put under KEY/row, decisions under KEY/decision.")
    heartbeat: float | None = option(
        None, "Say so many seconds after the last message that it is there."
    )
    warm: bool = option(False, "Compile before the first row comes.")

    def packages(self) -> dict[str, str]:
        """What carries the messages."""
        recorded = {"mcap": "mcap"} if self._is_recorded else {}
        return recorded | ({} if self.zenoh is None else {"zenoh": "zenoh"})

    @property
    def _is_recorded(self) -> bool:
        return self.file is not None and self.file.suffix == ".mcap"

    def run(self) -> int | None:
        """Serve until the input ends or it is stopped; 1 where nobody reads what it says."""
        from evofsm.cli.monitor.carriers import Station, silence_output
        from evofsm.cli.monitor.decider import Decider
        from evofsm.cli.monitor.state import State
        from evofsm.fsm import positive

        if (
            len([one for one in (self.file, self.socket, self.udp, self.zenoh) if one is not None])
            > 1
        ):
            raise ValueError("give one of FILE, --socket, --udp and --zenoh")
        if self.traffic and (self.guard or self.state or self.learn):
            raise ValueError(
                "--traffic learns nothing: it goes with none of --guard, --state and --learn"
            )
        heartbeat = None if self.heartbeat is None else positive("--heartbeat", self.heartbeat)
        with ExitStack() as stack:
            state = None
            if self.state is None:
                guard = self._fresh()
                if self.learn:
                    _say("nothing of what is learnt is kept; --state FILE keeps it")
            else:
                state = State(self.state, self._settings())
                stack.callback(state.close)
                guard = state.guard(self._fresh)
            self._prepare(guard, stack)
            decider = Decider(guard, proposal=self.proposal, episode=self.episode)
            if self.warm:
                _compile(guard)
            if state is not None:
                again = state.begin(decider)
                decider.keeper = state
                if decider.n:
                    _say(f"goes on after decision {decider.n} ({again} rows taken in again)")
            station = Station(decider, heartbeat)
            try:
                with station.stoppable():
                    self._serve(station, stack)
            except BrokenPipeError:
                silence_output()
                _say("nobody reads the decisions any more")
                return 1
            finally:
                if state is None and decider.rows:
                    decider.end()
        return None

    # -- The guard ------------------------------------------------------------------------------

    def _fresh(self) -> Guard:
        from evofsm.cli.monitor.defaults import guard_of_monitor, guard_of_traffic
        from evofsm.guard import Guard

        if self.traffic:
            return guard_of_traffic(self.interval, self.brakes)
        if self.guard is not None:
            return Guard.load(self.guard)
        return guard_of_monitor(self.interval, self.brakes)

    def _settings(self) -> dict[str, object]:
        """What decisions depend on; a guard that is the state itself is told by nothing."""
        from evofsm.fleet.checkpoint import fingerprints

        assert self.state is not None
        given = None
        if self.guard is not None and self.guard.resolve() != self.state.resolve():
            given = fingerprints([self.guard])[0]["sha256_of_ends"]
        made = {"interval": self.interval, "brakes": self.brakes} if self.guard is None else {}
        names = ("mode", "proposal", "learn", "episode")
        return {"guard": given, **made, **{name: getattr(self, name) for name in names}}

    def _prepare(self, guard: Guard, stack: ExitStack) -> None:
        """Set how far it goes, whether it learns, and who writes it down."""
        from evofsm.fleet.sealed import Sync
        from evofsm.guard import ActionReviser, AuditLog, Mode

        mode = chosen_mode(self.mode)
        if isinstance(guard.reviser, ActionReviser):
            guard.reviser.mode = mode
        elif mode is not Mode.ACT:
            name = type(guard.reviser).__name__
            raise ValueError(f"a {name} knows no --mode {self.mode}: what it says is executed")
        guard.learn = self.learn
        if self.audit is not None:
            guard.audit = stack.enter_context(AuditLog(self.audit, sync=Sync.EPISODE))

    # -- Messages -------------------------------------------------------------------------------

    def _serve(self, station: Station, stack: ExitStack) -> None:
        from evofsm.cli.monitor.carriers import SocketServer, UdpServer, ZenohServer, serve_stream

        if self.socket is not None:
            server = stack.enter_context(closing(SocketServer(self.socket)))
            _say(f"listens to {self.socket}")
            server.serve(station)
        elif self.udp is not None:
            by_udp = stack.enter_context(closing(UdpServer(self.udp)))
            _say(f"listens to UDP port {by_udp.port}")
            by_udp.serve(station)
        elif self.zenoh is not None:
            by_zenoh = stack.enter_context(closing(ZenohServer(self.zenoh)))
            _say(f"listens to {self.zenoh}/row")
            by_zenoh.serve(station)
        elif self._is_recorded:
            assert self.file is not None
            for line in _rows_of(self.file):
                with station.waiting():
                    pass
                sys.stdout.buffer.write(station.answer([line]))
            sys.stdout.buffer.flush()
        elif self.file is not None:
            with open(self.file, "rb") as source:
                serve_stream(station, source, sys.stdout.buffer)
        else:
            if station.heartbeat is not None and sys.platform == "win32":
                raise ValueError("on Windows --heartbeat needs --udp or --zenoh")
            serve_stream(station, sys.stdin.buffer, sys.stdout.buffer)


def _compile(guard: Guard) -> None:
    """Decide a few times on a copy, which then is thrown away."""
    import numpy as np

    from evofsm.cli.monitor.schema import Form
    from evofsm.driving import Object, Scene

    twin = guard.copy()
    count = len(twin.variables) or (0 if twin.machine is None else twin.machine.n_variables)
    seen = np.array([30.0, 20.0, 20.0]) if count == 3 else np.ones(max(1, count))
    if Form.of(guard).scenes:
        own, other = Object("", 0.0, 0.0, 20.0), Object("", 30.0, 0.0, 10.0)
        seen = Scene(own, [other, other._replace(x=-20.0)]).rows(2)
    for k in range(4):
        twin.decide(seen + 0.1 * k, None)
    twin.end(observation=seen)
    _say("compiled")


def _rows_of(run: Path) -> Iterator[bytes]:
    """The rows of a recorded run, and the ends of its episodes, as messages."""
    import json
    import math

    from evofsm.driving import VARIABLES
    from evofsm.io import read_run

    for episode in read_run(run).episodes:
        names = {"time": "time", **dict(zip(VARIABLES, VARIABLES, strict=True))}
        columns = [episode.columns[name].tolist() for name in (*names, "proposed")]
        for values in zip(*columns, strict=True):
            known = (None if math.isnan(value) else value for value in values)
            yield json.dumps(dict(zip((*names, "proposal"), known, strict=True))).encode()
        last = dict(zip(VARIABLES, episode.end.tolist(), strict=True))
        yield json.dumps({"end": True, "failed": bool(episode.collided), **last}).encode()


def _say(text: str) -> None:
    print(f"evofsm: {text}", file=sys.stderr, flush=True)
