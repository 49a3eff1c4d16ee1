"""How messages come and go: pipes, files, a UNIX socket, UDP on this computer, Zenoh.

Each transport hands lines to a `Server` and its answers back, until the input ends or the process
is asked to stop. A peer that sends junk, vanishes or does not read is no reason to end.
"""

from __future__ import annotations

import os
import queue
import select
import selectors
import signal
import socket
import stat
import sys
import threading
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import FrameType
from typing import Any, BinaryIO, Self

import msgspec

from evofsm.cli.monitor.decider import Answer, Decider
from evofsm.cli.monitor.messages import LONGEST
from evofsm.extras import needs
from evofsm.fsm.naming import visible

# So much is read at once; a peer that leaves more unread is cut off [byte].
_CHUNK, _UNREAD = 1 << 16, 1 << 20
# So many lines may come in one datagram or sample.
_MOST_LINES = 100
# Messages of Zenoh that wait, at most.
_WAITING = 1000
# Longer than this it never waits at once: the system knows no longer times [s].
_LONGEST_WAIT = 3600.0


class StoppedError(Exception):
    """The process was asked to end."""


class Lines:
    r"""Cuts what comes in into lines; one that is too long is cut off, and so refused."""

    def __init__(self) -> None:
        self._begun = b""

    def feed(self, data: bytes) -> list[bytes]:
        """The lines that are whole with this; with nothing, which is the end, the rest."""
        *whole, begun = (self._begun + (data or b"\n" * bool(self._begun))).split(b"\n")
        self._begun = begun[: LONGEST + 1]  # however long it gets
        return [line.removesuffix(b"\r") for line in whole]


class Server:
    """A decider as transports see it: lines in, lines out, a sign of life where nothing comes."""

    def __init__(self, decider: Decider, heartbeat: float | None = None) -> None:
        self.decider = decider
        self.heartbeat = heartbeat
        self._heard = self._said = time.monotonic()
        self.stopped = self._waits = False

    def answer(self, lines: Iterable[bytes]) -> bytes:
        """What is answered to lines, each with an end."""
        answers = b"".join([_line(self.decider.answer(line)) for line in lines])
        self._heard = self._said = time.monotonic()
        return answers

    def answer_packet(self, data: bytes | None) -> bytes:
        """What is answered to some lines that came at once, or where none came in time."""
        if data is None:
            return self.beat()
        lines = data.removesuffix(b"\n").split(b"\n")
        if len(lines) > _MOST_LINES:
            return self.refuse(f"is one of {len(lines)} at once; at most {_MOST_LINES} may be")
        return self.answer(lines)

    def refuse(self, what: str) -> bytes:
        """Say that something was wrong with lines that are not looked at."""
        return _line(self.decider.error("line", what))

    @property
    def patience(self) -> float | None:
        """How long to wait for a message [s]; None for as long as it takes."""
        if self.heartbeat is None:
            return None
        left = self._said + self.heartbeat - time.monotonic()
        return min(max(0.0, left), _LONGEST_WAIT)

    def beat(self) -> bytes:
        """The sign of life that is due; empty where none is."""
        now = time.monotonic()
        if self.heartbeat is None or now - self._said < self.heartbeat:
            return b""
        self._said = now
        return _line(self.decider.heartbeat(round(now - self._heard, 3)))

    # -- Its end --------------------------------------------------------------------------------

    @contextmanager
    def stoppable(self) -> Iterator[Self]:
        """Let SIGTERM and Ctrl-C end it while it waits, never while it decides.

        What whoever started it let it ignore, as nohup does, it ignores.
        """
        names = ("SIGTERM", "SIGINT", "SIGHUP")
        signals = [getattr(signal, name) for name in names if hasattr(signal, name)]
        signals = [one for one in signals if signal.getsignal(one) is not signal.SIG_IGN]
        if threading.current_thread() is not threading.main_thread():
            signals = []
        before = {one: signal.signal(one, self._asked) for one in signals}
        try:
            with suppress(StoppedError):
                yield self
        finally:
            for one, handler in before.items():
                signal.signal(one, handler)

    @contextmanager
    def waiting(self) -> Iterator[None]:
        """In this it may be stopped, by a `StoppedError`."""
        self._waits = True
        try:
            if self.stopped:
                raise StoppedError
            yield
        finally:
            self._waits = False

    def _asked(self, number: int, frame: FrameType | None) -> None:
        self.stopped = True
        if self._waits:
            raise StoppedError


def _line(answer: Answer) -> bytes:
    line = msgspec.json.encode(answer) + b"\n"
    return line if line.isascii() else visible(line.decode()[:-1]).encode() + b"\n"


# -- Pipes and files ------------------------------------------------------------------------------


def serve_stream(server: Server, source: BinaryIO, sink: BinaryIO) -> None:
    """Read lines to the end of a pipe or a file."""
    lines = Lines()
    for stream in (source, sink):
        with suppress(OSError, ValueError):  # ours wait, however whoever started it left them
            os.set_blocking(stream.fileno(), True)
    while True:
        with server.waiting():
            data = _read(source, server.patience)
        answers = server.beat() if data is None else server.answer(lines.feed(data))
        if answers:
            sink.write(answers)
            sink.flush()
        if data == b"":
            return


def _read(source: BinaryIO, patience: float | None) -> bytes | None:
    """What there is; empty at the end, None where nothing came in time."""
    if patience is not None and not select.select([source], [], [], patience)[0]:
        return None
    return source.read1(_CHUNK)  # type: ignore[attr-defined,no-any-return]


def silence_output() -> None:
    """Nobody reads it any more: nothing is to fail as the process ends."""
    with suppress(OSError, ValueError), open(os.devnull, "wb") as nothing:
        os.dup2(nothing.fileno(), sys.stdout.fileno())


# -- A UNIX socket --------------------------------------------------------------------------------


class _Peer:
    """Whoever is connected, with what it has not read yet."""

    def __init__(self, connection: socket.socket) -> None:
        self.connection = connection
        self.lines = Lines()
        self.unread = b""

    def send(self, data: bytes) -> bool:
        """Send what goes; False where the peer is gone, or leaves too much unread."""
        self.unread += data
        try:
            while self.unread:
                self.unread = self.unread[self.connection.send(self.unread) :]
        except (BlockingIOError, InterruptedError):
            return len(self.unread) <= _UNREAD
        except OSError:
            return False
        return True


class SocketTransport:
    """Answers whoever connects to a UNIX socket; several peers speak of the same car."""

    def __init__(self, path: Path) -> None:
        if not hasattr(socket, "AF_UNIX"):
            raise ValueError("this system has no UNIX sockets; --udp PORT carries the same")
        self.path = path
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            _make_way(path)
            self._socket.bind(os.fspath(path))
            path.chmod(0o600)
            self._socket.listen()
            self._socket.setblocking(False)
        except OSError as error:
            self._socket.close()
            where = error.filename or os.fspath(path)
            raise OSError(error.errno, error.strerror or str(error), where) from error
        except ValueError:
            self._socket.close()
            raise
        self._selector = selectors.DefaultSelector()
        self._selector.register(self._socket, selectors.EVENT_READ)

    def serve(self, server: Server) -> None:
        """Serve until it is stopped."""
        while True:
            with server.waiting():
                ready = self._selector.select(server.patience)
            for key, events in ready:
                if key.data is None:
                    self._accept()
                else:
                    self._attend(key.data, events, server)
            if beat := server.beat():
                for peer in self._peers():
                    self._send(peer, beat)

    def close(self) -> None:
        """Let go of all peers, and remove the socket."""
        for peer in self._peers():
            self._let_go(peer)
        self._selector.close()
        self._socket.close()
        self.path.unlink(missing_ok=True)

    def _peers(self) -> list[_Peer]:
        return [key.data for key in self._selector.get_map().values() if key.data is not None]

    def _accept(self) -> None:
        with suppress(OSError):  # gone already
            connection, _ = self._socket.accept()
            connection.setblocking(False)
            self._selector.register(connection, selectors.EVENT_READ, _Peer(connection))

    def _attend(self, peer: _Peer, events: int, server: Server) -> None:
        answers = b""
        if events & selectors.EVENT_READ:
            try:
                data = peer.connection.recv(_CHUNK)
            except (BlockingIOError, InterruptedError):
                return
            except OSError:
                data = b""
            answers = server.answer(peer.lines.feed(data))
            if not data:
                peer.send(answers)
                self._let_go(peer)
                return
        self._send(peer, answers)

    def _send(self, peer: _Peer, data: bytes) -> None:
        if not peer.send(data):
            self._let_go(peer)
            return
        events = selectors.EVENT_READ | (selectors.EVENT_WRITE if peer.unread else 0)
        self._selector.modify(peer.connection, events, peer)

    def _let_go(self, peer: _Peer) -> None:
        self._selector.unregister(peer.connection)
        peer.connection.close()


def _make_way(path: Path) -> None:
    """Remove the socket of a process that is gone."""
    try:
        mode = path.stat().st_mode
    except FileNotFoundError:
        return
    if not stat.S_ISSOCK(mode):
        raise ValueError(f"{path} is there, and is no socket; name another file")
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        if probe.connect_ex(os.fspath(path)) == 0:
            raise ValueError(f"{path}: another process listens there")
    path.unlink(missing_ok=True)


# -- UDP ------------------------------------------------------------------------------------------


class UdpTransport:
    """Answers datagrams from this computer, a line or some of them in each, to their senders."""

    def __init__(self, port: int) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.bind(("127.0.0.1", port))
        except OSError as error:
            self._socket.close()
            error.filename = f"UDP port {port}"
            raise
        self.port: int = self._socket.getsockname()[1]
        self._sender: Any = None

    def serve(self, server: Server) -> None:
        """Serve until it is stopped."""
        while True:
            self._socket.settimeout(server.patience or (None if server.heartbeat is None else 1e-3))
            data = None
            with suppress(OSError), server.waiting():  # nothing in time; or the sender is gone
                data, self._sender = self._socket.recvfrom(_CHUNK)
            answers = server.answer_packet(data)
            for answer in answers.splitlines(keepends=True) if self._sender else ():
                with suppress(OSError):
                    self._socket.sendto(answer, self._sender)

    def close(self) -> None:
        """Let others have the port."""
        self._socket.close()


# -- Zenoh ----------------------------------------------------------------------------------------


class ZenohTransport:
    """Takes messages that are put under ``KEY/row``, and puts answers under ``KEY/decision``.

    The session is configured by the file that the variable ``ZENOH_CONFIG`` names, where it is
    set; else it finds peers and routers of its network by itself.
    """

    def __init__(self, key: str) -> None:
        with needs("eclipse-zenoh", "zenoh", "Zenoh"):
            import zenoh
        self._came: queue.Queue[bytes] = queue.Queue(_WAITING)
        self._dropped = 0
        try:
            file = os.environ.get("ZENOH_CONFIG")
            config = zenoh.Config.from_file(file) if file else zenoh.Config()
            self._session = zenoh.open(config)
        except zenoh.ZError as error:
            raise ValueError(f"Zenoh: {error}") from None
        try:
            self._publisher = self._session.declare_publisher(
                f"{key}/decision", express=True, priority=zenoh.Priority.REAL_TIME
            )
            self._subscriber = self._session.declare_subscriber(f"{key}/row", self._take)
        except zenoh.ZError as error:
            self.close()
            raise ValueError(f"--zenoh {key}: {error}") from None

    def serve(self, server: Server) -> None:
        """Serve until it is stopped."""
        while True:
            data = None
            with suppress(queue.Empty), server.waiting():
                data = self._came.get(timeout=server.patience)
            answers = server.answer_packet(data)
            dropped, self._dropped = self._dropped, 0
            if dropped:
                answers += server.refuse(f"{dropped} messages came too fast, and were left out")
            for answer in answers.splitlines():
                self._publisher.put(answer)

    def close(self) -> None:
        """Leave the network."""
        self._session.close()  # type: ignore[no-untyped-call]

    def _take(self, sample: Any) -> None:
        """In a thread of Zenoh's."""
        try:
            self._came.put_nowait(sample.payload.to_bytes())
        except queue.Full:
            self._dropped += 1
