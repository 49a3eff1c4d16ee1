"""The live page's server and its player: one page, one socket, for this computer alone.

Whoever may see and steer a run must know the token in the address; names other than this computer's
own are refused, and pages of other origins. Who reads too slowly is cut off, and comes again.
"""

from __future__ import annotations

import asyncio
import hmac
import logging
import math
import re
import secrets
import time
from collections import deque
from collections.abc import Callable
from http import HTTPStatus
from importlib.resources import files
from threading import Event, Thread
from typing import Any, NamedTuple, Self

import msgspec

from evofsm.cli.show import plain, warn
from evofsm.cli.watch.session import Session
from evofsm.cli.watch.shown import Frame, Start
from evofsm.cli.watch.words import introduce, tell
from evofsm.driving.family import line_of
from evofsm.extras import needs

with needs("websockets", "watch", "the live page"):
    from websockets.asyncio.server import ServerConnection, broadcast, serve
    from websockets.datastructures import Headers
    from websockets.exceptions import ConnectionClosed
    from websockets.http11 import Request, Response

_HOST = "127.0.0.1"
# Names that no page elsewhere can have, and pages from there.
_OWN = re.compile(r"(127\.0\.0\.1|localhost|\[::1\])(:\d{1,5})?")
_OWN_PAGE = re.compile(f"http://{_OWN.pattern}")
_FOREIGN = (
    "This page answers to the names of its own computer only. From another one, forward a port to "
    "it, ssh -L 9000:127.0.0.1:{} NAME, and open the same address with localhost:9000."
)
_MOST_FRAMES = 20_000  # a run keeps so many frames
# Who leaves more unread is cut off, all of a run is less; a command is short [bytes].
_MOST_UNREAD, _LONGEST_COMMAND = 1 << 26, 512
_KINDS = {"html": "text/html", "css": "text/css", "js": "text/javascript"}
_NOT_TEXT, _NOT_UNDERSTOOD = 1003, 1008  # close codes (RFC 6455)

_GRAPH_EVERY = 8  # between two graphs, unless a state was created [decisions]
_FOLLOWED = 12.5  # decisions in a second that can be followed
_LATE = 0.1  # who is late by more does not hurry to make up for it [s]
_LISTENS = 0.5  # between two looks whether it is interrupted, which not every system wakes for [s]

_log = logging.getLogger(__name__)
_log.addHandler(logging.NullHandler())  # junk on the socket is nobody's traceback


class Clock(NamedTuple):
    """How the run is being played."""

    paused: bool
    speed: float  #: multiple of real time; infinite for as fast as it goes
    revising: bool
    over: bool


class Player:
    """Plays what is watched at a pace, once someone attends, and does as it is told.

    ``audience`` is told "start", "frame", "graph", "known" and "clock", with what is called so, and
    "failed" with why it broke off. `play` may run in one thread, and be told in another.
    """

    fault = ""  #: why the latest run broke off; empty where it did not

    def __init__(self, watched: Session, audience: Callable[[str, Any], object]) -> None:
        # Real time, but no more decisions in a second than can be followed.
        speeds, pace = watched.start.speeds, _FOLLOWED * watched.start.interval
        pace = min(1.0, pace) if 1.0 in speeds else pace
        self._speed = max((rate for rate in speeds if rate <= pace), default=speeds[0])
        self._watched, self._audience, self._awaits = watched, audience, True
        self._paused = self._over = False
        self._steps = False  # once, although it is paused
        self._revising = watched.revising
        self._due = 0.0  # when the next frame is [s]
        self._since = self._states = 0  # frames since the latest graph, and its states
        self._orders: deque[int | None] = deque(maxlen=1)  # the latest case to begin
        self._news = Event()

    def attend(self) -> None:
        """Someone looks on: play, if that was waited for."""
        if self._awaits:
            self.set(awaits=False)

    def set(self, **changes: bool | float) -> None:
        """Play on otherwise: ``paused``, ``revising``, at a ``speed``; or ``steps`` once."""
        for name, value in changes.items():
            setattr(self, f"_{name}", value)
        self._news.set()

    def restart(self, case: int | None = None) -> None:
        """Begin anew, or another case; and go on if it waited."""
        self._orders.append(case)
        self._news.set()

    def play(self) -> None:
        """Play until it is interrupted; a run that breaks off can be begun anew."""
        self._begin()
        while True:
            if self._news.wait(min(self._patience(), _LISTENS)):
                self._news.clear()
                self._due = time.monotonic()
                self._audience("clock", self._clock())
            try:
                self._go_on()
            except Exception as error:
                # Whoever looks on must learn why nothing moves any more.
                place = line_of(error)
                self.fault = f"{place}{': ' * bool(place)}{type(error).__name__}: {error}"
                self._over = True
                warn(f"the run broke off: {self.fault}")
                self._audience("clock", self._clock())
                self._audience("failed", self.fault)

    def _go_on(self) -> None:
        """Do what is due."""
        if self._orders:
            self._watched.restart(self._orders.pop())
            self._paused = False
            self._begin()
        elif self._patience() <= 0.0:
            self._steps = False
            interval = self._watched.start.interval / self._speed
            # What came late is not made up for.
            self._due = max(self._due, time.monotonic() - _LATE) + interval
            self._watched.revising = self._revising
            frame = self._watched.step()
            if frame.time < self._watched.start.begins:
                self._due = time.monotonic()
            self._show(frame)

    def _patience(self) -> float:
        """Time until the next frame [s]; infinite where none comes by itself."""
        if self._over or self._awaits or (self._paused and not self._steps):
            return math.inf
        return 0.0 if self._paused else self._due - time.monotonic()

    def _begin(self) -> None:
        self._over, self.fault, self._due = False, "", time.monotonic()
        self._audience("start", self._watched.start)
        self._audience("clock", self._clock())
        self._draw()
        self._audience("known", self._watched.known())

    def _draw(self) -> None:
        graph = self._watched.graph()
        self._audience("graph", graph)
        self._since, self._states = 0, len(graph.states)

    def _show(self, frame: Frame) -> None:
        self._audience("frame", frame)
        self._since += 1
        is_new = frame.state is not None and frame.state >= self._states
        if is_new or frame.over or self._since >= _GRAPH_EVERY:
            self._draw()
        if frame.over:
            self._over = True
            self._audience("known", self._watched.known())
            self._audience("clock", self._clock())

    def _clock(self) -> Clock:
        return Clock(self._paused, self._speed, self._revising, self._over)


def message(kind: str, what: Any, start: Start | None = None) -> str:
    """What a `Player` tells, as a page reads it: JSON, null for what is no finite number.

    >>> message("failed", "no road")
    '{"kind":"failed","text":"no road"}'
    """
    body: dict[str, Any] = what._asdict() if hasattr(what, "_asdict") else {"text": what}
    if isinstance(what, Start):
        body |= introduce(what)
    elif isinstance(what, Frame):
        assert start is not None
        story, danger = what.story, what.story.danger
        body["danger"] = None
        dead_end = None if danger is None else danger.dead_end  # since when no braking helps [s]
        if danger is not None and story.in_danger:
            body["danger"] = {"since": danger.began.time, "last": danger.last, "dead_end": dead_end}
        body["story"] = {**story._asdict(), "danger": None, "dead_end": dead_end}
        body["told"] = tell(what, start)
    return msgspec.json.encode(plain({"kind": kind, **body}, digits=5)).decode()


class LivePage:
    """Serves a run to browsers on this computer; the audience of a `Player`.

    In ``async with`` it serves in that loop, in ``with`` in a thread of its own.
    """

    def __init__(self) -> None:
        self.token = secrets.token_urlsafe(24)
        self.player: Player | None = None  #: does what pages ask for
        self.port = 0  #: where it listens
        self._latest: dict[str, str] = {}  # messages of the present run, for who comes later
        self._frames: deque[str] = deque(maxlen=_MOST_FRAMES)
        self._clients: set[ServerConnection] = set()
        self._start: Start | None = None
        paths = (files(__package__) / "live").iterdir()
        self._files = {file.name: file.read_bytes() for file in paths}

    @property
    def address(self) -> str:
        """To be opened in a browser; who has it may steer the run."""
        return f"http://{_HOST}:{self.port}/{self.token}/"

    def __enter__(self) -> Self:
        loop = asyncio.new_event_loop()
        self._thread = Thread(target=loop.run_forever, daemon=True)
        self._thread.start()
        return asyncio.run_coroutine_threadsafe(self.__aenter__(), loop).result()

    def __exit__(self, *error: object) -> None:
        asyncio.run_coroutine_threadsafe(self.__aexit__(), self._loop).result()
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()

    async def __aenter__(self) -> Self:
        self._loop = asyncio.get_running_loop()
        self._server = await serve(
            self._attend,
            _HOST,
            0,  # any port that is free
            process_request=self._answer,
            compression=None,
            max_size=_LONGEST_COMMAND,
            max_queue=4,
            open_timeout=2,
            close_timeout=1,
            server_header=None,
            logger=_log,
        )
        (listener,) = self._server.sockets
        self.port = int(listener.getsockname()[1])
        return self

    async def __aexit__(self, *error: object) -> None:
        self._server.close()
        await self._server.wait_closed()

    def __call__(self, kind: str, what: Any) -> None:
        """What the player tells."""
        if isinstance(what, Start):
            self._start = what
        self._loop.call_soon_threadsafe(self._send, kind, message(kind, what, self._start))

    def _send(self, kind: str, text: str) -> None:
        if kind == "start":
            self._frames.clear()
            self._latest.clear()
        if kind in ("frame", "failed"):  # in their order
            self._frames.append(text)
        else:
            self._latest[kind] = text
        for client in self._clients:
            if client.transport.get_write_buffer_size() > _MOST_UNREAD:
                client.transport.abort()
        broadcast(self._clients, text)

    def _answer(self, connection: ServerConnection, request: Request) -> Response | None:
        """The files of the page; None lets a socket be opened."""
        token, slash, name = request.path.partition("?")[0].removeprefix("/").partition("/")
        hosts, origins = (request.headers.get_all(header) for header in ("Host", "Origin"))
        if len(hosts) != 1 or not _OWN.fullmatch(hosts[0]):
            return _refusal(HTTPStatus.FORBIDDEN, _FOREIGN.format(self.port))
        if not hmac.compare_digest(token.encode(), self.token.encode()):
            return _refusal(HTTPStatus.FORBIDDEN, "The address lacks its token, or has another.")
        if name == "socket":
            # Not compared with the host, which a tunnel may have put there.
            if len(origins) != 1 or not _OWN_PAGE.fullmatch(origins[0]):
                return _refusal(HTTPStatus.FORBIDDEN, "Only the page itself may open the socket.")
            return None
        if not slash:  # below which its files are
            answer = _refusal(HTTPStatus.PERMANENT_REDIRECT, "The address ends with a slash.")
            answer.headers["Location"] = f"{token}/"
            return answer
        name = name or "page.html"
        if name not in self._files:
            return _refusal(HTTPStatus.NOT_FOUND, "There is no such file.")
        # No policy knows addresses in brackets; 'self' does.
        sockets = "" if hosts[0].startswith("[") else f"ws://{hosts[0]}"
        kind = _KINDS[name.rpartition(".")[2]]
        return _response(HTTPStatus.OK, self._files[name], kind, sockets)

    async def _attend(self, connection: ServerConnection) -> None:
        parts = ",".join([*self._latest.values(), *self._frames])  # the start first
        broadcast([connection], f'{{"kind":"whole","parts":[{parts}]}}')
        self._clients.add(connection)
        if self.player is not None:
            self.player.attend()
        try:
            async for text in connection:
                if not isinstance(text, str):
                    await connection.close(_NOT_TEXT, "commands are text")
                    return
                self._obey(msgspec.json.decode(text, type=_Command))
        except ConnectionClosed:
            pass
        except (msgspec.MsgspecError, ValueError, RecursionError):
            await connection.close(_NOT_UNDERSTOOD, "no such command")
        finally:
            self._clients.discard(connection)

    def _obey(self, command: _Command) -> None:
        if self.player is None or self._start is None:
            return
        match (command.do, command.value):
            case ("pause", bool(paused)):
                self.player.set(paused=paused)
            case ("step", None):
                self.player.set(paused=True, steps=True)
            case ("speed", float(speed)) if speed in self._start.speeds:
                self.player.set(speed=speed)
            case ("revise", bool(on)) if self._start.live:
                self.player.set(revising=on)
            case ("restart", None):
                self.player.restart()
            case ("case", float(case)) if case in range(len(self._start.cases)):
                self.player.restart(int(case))
            case _:
                raise ValueError(command.do)


class _Command(msgspec.Struct, forbid_unknown_fields=True):
    do: str
    value: bool | float | None = None


def _refusal(status: HTTPStatus, text: str) -> Response:
    return _response(status, f"{text}\n".encode(), "text/plain", "")


def _response(status: HTTPStatus, body: bytes, kind: str, sockets: str) -> Response:
    policy = (
        f"default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self' {sockets}; "
        "img-src data:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    )
    headers = {
        "Content-Type": f"{kind}; charset=utf-8",
        "Content-Length": str(len(body)),
        "Content-Security-Policy": policy,
        "Cross-Origin-Opener-Policy": "same-origin",
        "Cross-Origin-Resource-Policy": "same-origin",
        "Referrer-Policy": "no-referrer",
        "X-Content-Type-Options": "nosniff",
        "Cache-Control": "no-store",
        "Connection": "close",
    }
    return Response(status.value, status.phrase, Headers(headers), body)
