"""The live page's server: one page, one socket, for this computer alone.

Whoever may see and steer a run must know the token in the address. Names other than this
computer's own are refused (a page elsewhere could have its name point here), and so are pages of
other origins. Nobody who looks on can hold the run up: what happens is handed over without
waiting, and whoever reads too slowly loses frames and is later shown all of it at once.
"""

from __future__ import annotations

import asyncio
import hmac
import logging
import secrets
import socket
import threading
from collections import deque
from http import HTTPStatus
from importlib.resources import files
from types import TracebackType
from typing import Annotated, Any, Self

import msgspec

from evofsm.cli.watch.player import SPEEDS, Clock, Player
from evofsm.cli.watch.shown import Frame, Graph, Start, Transition
from evofsm.cli.watch.words import tell
from evofsm.driving.naming import name_state
from evofsm.extras import needs

with needs("websockets", "watch", "the live page"):
    from websockets.asyncio.server import Server, ServerConnection, serve
    from websockets.datastructures import Headers
    from websockets.exceptions import ConnectionClosed
    from websockets.http11 import Request, Response

_HOST = "127.0.0.1"
# Who is more messages behind is shown everything anew; a run keeps so many frames.
_MOST_WAITING, _MOST_FRAMES, _MOST_CLIENTS = 64, 20_000, 200
# Under way to a client [bytes].
_MOST_SENT = 1 << 17
# A command is short [bytes].
_LONGEST_COMMAND = 512
_WELCOME = {
    "page.html": "text/html",
    "page.css": "text/css",
    **dict.fromkeys(
        ("page.js", "run.js", "road.js", "plots.js", "states.js", "paint.js"), "text/javascript"
    ),
}
# Close codes (RFC 6455).
_NOT_TEXT, _NOT_UNDERSTOOD, _TOO_MANY = 1003, 1008, 1013

_log = logging.getLogger(__name__)
_log.addHandler(logging.NullHandler())  # junk on the socket is nobody's traceback


def frame_message(frame: Frame, start: Start) -> dict[str, Any]:
    """A frame, with the story so far in words."""
    story, danger = frame.story, frame.story.danger
    dead_end = None if danger is None else danger.dead_end  # since when no braking helps [s]
    return {
        **frame._asdict(),
        "here": name_state(frame.observation),
        "danger": danger._asdict() if danger and story.in_danger else None,
        "story": {**story._asdict(), "danger": None, "dead_end": dead_end},
        "told": tell(frame, start)._asdict(),
    }


def encode(message: Any) -> str:
    """As JSON, numbers with five decimals; what is no finite number becomes null.

    >>> encode({"kind": "clock", "speed": float("inf")})
    '{"kind":"clock","speed":null}'
    """
    return msgspec.json.encode(_rounded(message)).decode()


def _rounded(value: Any) -> Any:
    if isinstance(value, float):
        return round(value, 5)
    if hasattr(value, "_asdict") and not isinstance(value, Transition):
        value = value._asdict()
    if isinstance(value, dict):
        return {name: _rounded(part) for name, part in value.items()}
    return [_rounded(part) for part in value] if isinstance(value, list | tuple) else value


class LivePage:
    """Serves a run to browsers on this computer; the audience of a `Player`.

    ``port`` may be 0, for any that is free; ``live`` says whether the run can be acted on.
    """

    def __init__(self, port: int = 0, *, live: bool = True) -> None:
        self.token = secrets.token_urlsafe(24)
        self.player: Player | None = None  #: does what pages ask for
        self._live = live
        self._port = port
        self._shown = _Shown(live)
        self._clients: set[_Client] = set()
        self._start: Start | None = None
        self._ready = threading.Event()
        self._error: Exception | None = None
        self._thread = threading.Thread(target=self._serve, name="evofsm-live-page", daemon=True)
        self._files = {name: (files(__package__) / "live" / name).read_bytes() for name in _WELCOME}

    @property
    def port(self) -> int:
        """Where it listens."""
        return self._port

    @property
    def address(self) -> str:
        """To be opened in a browser; who has it may steer the run."""
        return f"http://{_HOST}:{self._port}/{self.token}/"

    @property
    def clients(self) -> int:
        """How many look on."""
        return len(self._clients)

    def __enter__(self) -> Self:
        self._thread.start()
        self._ready.wait()
        if self._error is not None:
            self._thread.join()
            raise self._error
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._loop.call_soon_threadsafe(self._stop.set)
        self._thread.join()

    # -- What the player tells; never waits -------------------------------------------------------

    def began(self, start: Start, clock: Clock) -> None:
        """A run begins."""
        self._start = start
        self._hand_over("start", {**start._asdict(), "live": self._live, "speeds": SPEEDS})
        self.ticked(clock)

    def saw(self, frame: Frame) -> None:
        """The next frame."""
        assert self._start is not None
        self._hand_over("frame", frame_message(frame, self._start))

    def grew(self, graph: Graph) -> None:
        """States, or ways between them, have changed."""
        states = [{**one._asdict(), "name": name_state(one.center, 1)} for one in graph.states]
        self._hand_over("graph", {**graph._asdict(), "states": states})

    def ticked(self, clock: Clock) -> None:
        """It is played otherwise."""
        self._hand_over("clock", clock._asdict())

    def failed(self, text: str) -> None:
        """It broke off with an error."""
        self._hand_over("failed", {"text": text})

    def _hand_over(self, kind: str, message: dict[str, Any]) -> None:
        self._loop.call_soon_threadsafe(self._publish, kind, encode({"kind": kind, **message}))

    # -- In the server's own thread ---------------------------------------------------------------

    def _publish(self, kind: str, text: str) -> None:
        self._shown.add(kind, text)
        for client in self._clients:
            client.offer(text)

    def _serve(self) -> None:
        asyncio.run(self._listen())

    async def _listen(self) -> None:
        self._loop, self._stop = asyncio.get_running_loop(), asyncio.Event()
        try:
            server = await serve(
                self._attend,
                _HOST,
                self._port,
                process_request=self._answer,
                compression=None,
                max_size=_LONGEST_COMMAND,
                max_queue=4,
                open_timeout=2,
                close_timeout=1,
                server_header=None,
                logger=_log,
            )
        except Exception as error:  # a port that is taken, or none at all
            self._error = error
            self._ready.set()
            return
        async with server:
            self._port = _port_of(server)
            self._ready.set()
            await self._stop.wait()

    def _answer(self, connection: ServerConnection, request: Request) -> Response | None:
        """The files of the page; None lets a socket be opened."""
        token, _, name = request.path.removeprefix("/").partition("/")
        if request.headers.get_all("Host") not in [[host] for host in self._hosts()]:
            return _refusal(HTTPStatus.FORBIDDEN, "This page answers under its own address only.")
        if not hmac.compare_digest(token.encode(), self.token.encode()):
            return _refusal(HTTPStatus.FORBIDDEN, "The address lacks its token, or has another.")
        origins = request.headers.get_all("Origin")
        if name == "socket":
            if origins not in [[f"http://{host}"] for host in self._hosts()]:
                return _refusal(HTTPStatus.FORBIDDEN, "Only the page itself may open the socket.")
            return None
        name = name or "page.html"
        if name not in self._files:
            return _refusal(HTTPStatus.NOT_FOUND, "There is no such file.")
        return _response(HTTPStatus.OK, self._files[name], _WELCOME[name], self._sources())

    def _hosts(self) -> list[str]:
        return [f"{name}:{self._port}" for name in (_HOST, "localhost")]

    def _sources(self) -> str:
        return " ".join(f"ws://{host}" for host in self._hosts())

    async def _attend(self, connection: ServerConnection) -> None:
        if len(self._clients) >= _MOST_CLIENTS:
            await connection.close(_TOO_MANY, "too many look on already")
            return
        # The system must not take in more than a little for one who does not read.
        wire = connection.transport.get_extra_info("socket")
        wire.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _MOST_SENT)
        client = _Client(connection, self._shown)
        self._clients.add(client)
        if self.player is not None:
            self.player.attend()
        feeding = asyncio.create_task(client.feed())
        try:
            await self._obey_all(connection)
        except ConnectionClosed:
            pass
        finally:
            self._clients.discard(client)
            feeding.cancel()
            await asyncio.gather(feeding, return_exceptions=True)

    async def _obey_all(self, connection: ServerConnection) -> None:
        async for text in connection:
            if not isinstance(text, str):
                await connection.close(_NOT_TEXT, "commands are text")
                return
            try:
                self._obey(Command.parse(text))
            except ValueError as error:
                await connection.close(_NOT_UNDERSTOOD, str(error))
                return

    def _obey(self, command: Command) -> None:
        if self.player is None or self._start is None:
            return
        match (command.do, command.value):
            case ("pause", bool(paused)):
                self.player.pause(paused)
            case ("step", None):
                self.player.step()
            case ("speed", float(speed)) if speed in SPEEDS:
                self.player.speed(speed)
            case ("revise", bool(on)) if self._live:
                self.player.revise(on)
            case ("restart", None):
                self.player.restart()
            case ("case", float(case)) if case in range(len(self._start.cases)):
                self.player.restart(int(case))
            case _:
                raise ValueError(f"no such command: {command.do}")


class Command(msgspec.Struct, forbid_unknown_fields=True):
    """What a page asks for."""

    do: Annotated[str, msgspec.Meta(max_length=20, pattern="^[a-z]+$")]
    value: bool | float | None = None

    @classmethod
    def parse(cls, text: str) -> Command:
        """A command from a page."""
        try:
            return msgspec.json.decode(text, type=cls)
        except (msgspec.MsgspecError, ValueError, RecursionError):
            raise ValueError("not a command") from None


class _Shown:
    """What was shown of the present run, for who comes later."""

    def __init__(self, live: bool) -> None:
        self._latest: dict[str, str] = {}
        self._frames: deque[str] = deque(maxlen=_MOST_FRAMES)

    def add(self, kind: str, text: str) -> None:
        if kind == "start":
            self._frames.clear()
            self._latest.clear()
        if kind == "frame":
            self._frames.append(text)
        else:
            self._latest[kind] = text

    def whole(self) -> str:
        """All of it in one message."""
        return f'{{"kind":"whole","parts":[{",".join([*self._parts()])}]}}'

    def _parts(self) -> list[str]:
        latest = [self._latest[kind] for kind in _ORDER if kind in self._latest]
        return [*latest, *self._frames]


_ORDER = ("start", "clock", "graph", "failed")


class _Client:
    """Someone who looks on, with what is still to be sent."""

    def __init__(self, connection: ServerConnection, shown: _Shown) -> None:
        self._connection = connection
        self._shown = shown
        self._waiting: deque[str] = deque()
        self._is_behind = True  # of all that happened before
        self._news = asyncio.Event()
        self._news.set()

    def offer(self, text: str) -> None:
        """One more message; who has too many waiting is shown everything anew instead."""
        if self._is_behind:
            return
        self._waiting.append(text)
        if len(self._waiting) > _MOST_WAITING:
            self._waiting.clear()
            self._is_behind = True
        self._news.set()

    async def feed(self) -> None:
        """Send what is waiting, as fast as it is read."""
        try:
            while True:
                await self._news.wait()
                self._news.clear()
                if self._is_behind:
                    self._is_behind = False
                    await self._connection.send(self._shown.whole())
                while self._waiting:
                    await self._connection.send(self._waiting.popleft())
        except ConnectionClosed:
            pass


def _port_of(server: Server) -> int:
    (listening,) = server.sockets
    return int(listening.getsockname()[1])


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
