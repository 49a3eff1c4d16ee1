"""How messages come and go: pipes, files, a UNIX socket, Zenoh.

A peer that sends junk, vanishes or does not read is no reason to end.
"""

from __future__ import annotations

import math
import os
import signal
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterable
from contextlib import ExitStack, suppress
from copy import copy
from itertools import takewhile
from pathlib import Path
from typing import Any

import msgspec

from evofsm.cli.journal import asked_to_stop
from evofsm.cli.monitor.decider import Answer, Decider
from evofsm.cli.monitor.messages import LONGEST
from evofsm.cli.monitor.slots import CsvRows
from evofsm.extras import needs
from evofsm.fsm.naming import visible

_CHUNK = 1 << 16  # so much is read at once [byte]
_MOST_LINES = 100  # so many lines may come in one sample
_POLL = 0.005  # what would block is tried again after so long [s]
_LONGEST_WAIT = 0.5  # a signal that another thread took is seen after so long [s]


def json_line(answer: Answer) -> bytes:
    """An answer as a line of JSON."""
    line = msgspec.json.encode(answer) + b"\n"
    return line if line.isascii() else visible(line.decode()[:-1]).encode() + b"\n"


class Server:
    """A decider that threads share: lines in, lines out."""

    def __init__(
        self, decider: Decider, *, keeps: bool = False, line: Callable[[Answer], bytes] = json_line
    ) -> None:
        self.decider = decider
        self._line = line  # of an answer
        self.keeps = keeps  #: what waits as the input ends, for whoever goes on
        self._heard = time.monotonic()
        self._turn = threading.Lock()
        self._over, self._ends = threading.Event(), False
        self._failure: Exception | None = None

    def answer(
        self, lines: Iterable[bytes], csv: CsvRows | None = None, *, is_cut: bool = False
    ) -> bytes:
        """What is answered to lines, each with an end."""
        with self._turn:
            going_on = takewhile(lambda _: not self._ends, lines)
            replies = (self.decider.answer(line, csv, is_cut=is_cut) for line in going_on)
            answers = b"".join(map(self._line, replies))
            self._heard = time.monotonic()
        return answers

    def converse(
        self,
        read: Callable[[int], bytes],
        write: Callable[[bytes], object],
        csv: CsvRows | None = None,
    ) -> None:
        """Answer the lines of a stream to its end; one that is too long is refused.

        Each is answered before the next is decided on: of those that were and nobody heard of, as
        it is killed, there are never more than are known again when they are sent again.
        """
        fragment, data = b"", b"\n"
        while data:
            data = read(_CHUNK)
            *whole, fragment = (fragment + data).split(b"\n")
            fragment = fragment[: LONGEST + 1]  # however long it gets
            for line in whole:
                write(self.answer([line.removesuffix(b"\r")], csv))
        if fragment:
            write(self.answer([fragment.removesuffix(b"\r")], csv, is_cut=True))

    def answer_packet(self, data: bytes) -> bytes:
        """What is answered to some lines that came at once."""
        lines = data.removesuffix(b"\n").split(b"\n")
        if len(lines) <= _MOST_LINES:
            return self.answer(lines)
        with self._turn:
            fault = f"is one of {len(lines)} at once; at most {_MOST_LINES} may be"
            return self._line(self.decider.error("line", fault))

    def run(self, transport: Transport) -> None:
        """Serve until the input ends, SIGTERM, SIGHUP or Ctrl-C; no decision is cut short."""
        try:
            with asked_to_stop(signal.default_int_handler), suppress(KeyboardInterrupt):
                threading.Thread(target=self._serve, args=(transport,), daemon=True).start()
                while not self._over.wait(_LONGEST_WAIT):
                    if time.monotonic() - self._heard > (self.decider.slots.step or math.inf):
                        transport.send(self._lapse())
        finally:
            self._ends = True  # after the message under way
            self._turn.acquire()  # for good: nothing is decided any more
            transport.close()
        if self._failure is not None:
            raise self._failure

    def _serve(self, transport: Transport) -> None:
        try:
            transport.serve(self)
            if not self.keeps:
                transport.send(self._lapse())
        except Exception as error:
            self._failure = error
        self._over.set()

    def _lapse(self) -> bytes:
        """What is decided on rows that wait, as nothing comes."""
        with self._turn:
            answer = self.decider.lapse()
        return b"" if answer is None else self._line(answer)


class Stream:
    """A pipe or a file, to its end."""

    def __init__(self, source: Any, sink: Any) -> None:
        # A buffer that a thread waits in would not let the process end.
        self.source, self._sink = (getattr(file, "raw", file) for file in (source, sink))
        self._writing = threading.Lock()

    def serve(self, server: Server) -> None:
        """Answer line by line."""
        server.converse(self._read, self.send)

    def _read(self, count: int) -> bytes:
        while (data := self.source.read(count)) is None:  # made so by whoever shares it
            time.sleep(_POLL)
        return bytes(data)

    def send(self, line: bytes) -> None:
        """Write it."""
        with self._writing:
            while line:
                if (count := self._sink.write(line)) is None:
                    time.sleep(_POLL)
                line = line[count or 0 :]

    def close(self) -> None:
        """Others opened them."""


class SocketTransport:
    """Answers whoever connects to a UNIX socket; who does not read waits for itself alone."""

    def __init__(self, path: Path) -> None:
        if not hasattr(socket, "AF_UNIX"):
            raise ValueError("this system has no UNIX sockets; --zenoh KEY carries the same")
        self.path = path
        self._peers: dict[socket.socket, threading.Lock] = {}
        _make_way(path)
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            self._socket.bind(os.fspath(path))
            path.chmod(0o600)
            self._socket.listen()
        except OSError as error:
            self._socket.close()
            where = error.filename or os.fspath(path)
            raise OSError(error.errno, error.strerror or str(error), where) from error

    def serve(self, server: Server) -> None:
        """Serve each peer in a thread, until it is closed."""
        while self._socket.fileno() >= 0:
            try:
                peer, _ = self._socket.accept()
            except OSError:  # gone already, or no more files may be open
                time.sleep(0.1)
                continue
            self._peers[peer] = threading.Lock()
            threading.Thread(target=self._attend, args=(peer, server), daemon=True).start()

    def send(self, line: bytes) -> None:
        """Pass it to all that are not being answered; who does not read is let go."""
        for peer, lock in list(self._peers.items()):
            if not lock.acquire(blocking=False):
                continue
            with suppress(OSError):  # gone meanwhile
                count = 0
                with suppress(BlockingIOError):
                    count = peer.send(line, socket.MSG_DONTWAIT)
                if count < len(line):
                    peer.shutdown(socket.SHUT_RDWR)
            lock.release()

    def close(self) -> None:
        """Remove the socket."""
        self._socket.close()
        self.path.unlink(missing_ok=True)

    def _attend(self, peer: socket.socket, server: Server) -> None:
        def send(answers: bytes) -> None:
            with self._peers[peer]:
                peer.sendall(answers)

        with suppress(OSError), peer:
            server.converse(peer.recv, send, copy(server.decider.csv))  # by names of its own
        del self._peers[peer]


def _make_way(path: Path) -> None:
    """Remove the socket of a process that is gone."""
    if not path.exists():
        return
    if not path.is_socket():
        raise ValueError(f"{path} is there, and is no socket; name another file")
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        if probe.connect_ex(os.fspath(path)) == 0:
            raise ValueError(f"{path}: another process listens there")
    path.unlink(missing_ok=True)


class ZenohTransport:
    """Takes messages under ``KEY/row``, and puts answers under ``KEY/decision``."""

    def __init__(self, key: str) -> None:
        with needs("eclipse-zenoh", "zenoh", "Zenoh"):
            import zenoh
        if "*" in key:
            fault = "names several machines, and each needs a monitor of its own"
            raise ValueError(f"--zenoh {key}: a KEY with * {fault}")
        file = os.environ.get("ZENOH_CONFIG")
        try:
            zenoh.KeyExpr(key)
            config = zenoh.Config.from_file(file) if file else zenoh.Config()
            self._session = zenoh.open(config)
            self._publisher = self._session.declare_publisher(
                f"{key}/decision", express=True, priority=zenoh.Priority.REAL_TIME
            )
            self._rows = self._session.declare_subscriber(f"{key}/row")
        except zenoh.ZError as error:
            fault = str(error).rsplit(" at ", 1)[0]  # behind it is a line of Zenoh's own
            where = f", by ZENOH_CONFIG={file}" if file else ""
            raise ValueError(f"--zenoh {key}{where}: {fault}") from None

    def serve(self, server: Server) -> None:
        """Answer what comes, until it is closed."""
        for sample in self._rows:
            self.send(server.answer_packet(sample.payload.to_bytes()))

    def send(self, line: bytes) -> None:
        """Publish each line."""
        for part in line.splitlines():
            self._publisher.put(part)

    def close(self) -> None:
        """Leave the network."""
        self._session.close()  # type: ignore[no-untyped-call]


Transport = Stream | SocketTransport | ZenohTransport


def transport_of(
    file: Path | None, unix: Path | None, zenoh: str | None, stack: ExitStack
) -> tuple[Transport, str]:
    """Where rows come from, and that in words."""
    if unix is not None:
        return SocketTransport(unix), f"listens to {unix}"
    if zenoh is not None:
        return ZenohTransport(zenoh), f"listens to {zenoh}/row"
    if file is None and sys.stdin is None:
        raise ValueError("standard input is closed; give FILE, --socket or --zenoh")
    if not sys.stdout.writable():  # it is closed
        raise ValueError("standard output is closed; give --socket or --zenoh")
    source = sys.stdin.buffer if file is None else stack.enter_context(file.open("rb"))
    return Stream(source, sys.stdout.buffer), f"reads {file or 'standard input'}"
