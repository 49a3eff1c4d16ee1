"""Pipes, sockets, datagrams and Zenoh bring the same answers; peers that misbehave end nothing."""

import io
import json
import os
import queue
import re
import signal
import socket
import sys
import threading
import time
import unittest.mock
from contextlib import contextmanager

import pytest
import zenoh
from tests.cli.monitor.test_decider import answers_to

from evofsm.cli.monitor.decider import Decider
from evofsm.cli.monitor.messages import LONGEST
from evofsm.cli.monitor.slots import Slots
from evofsm.cli.monitor.transports import Server, SocketTransport, Stream, ZenohTransport
from evofsm.driving.cars import guard_of_monitor
from evofsm.io import LogColumns
from evofsm.io.logs import Resample
from monitor_rows import JUNK, closing_in, line

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="sockets and signals of POSIX")
ROWS = [line(row) + b"\n" for row in closing_in(40)]
PATIENCE = 20.0


@pytest.fixture(scope="module")
def plain():
    """What is to be answered to `ROWS`."""
    return answers_to(ROWS)


@contextmanager
def served(transport):
    """What listens in a thread, until it is closed."""
    server = Server(Decider(guard_of_monitor(0.1, 6.0)))
    thread = threading.Thread(target=server.run, args=(transport,))
    with unittest.mock.patch("signal.signal"):  # which another thread may not call
        thread.start()
        yield transport
        server._over.set()
        thread.join(PATIENCE)
    assert not thread.is_alive()


class Pieces(io.BytesIO):
    """A stream that comes in pieces of a size."""

    size = 1 << 20

    def read(self, _):
        return super().read(self.size)


def answered(data, size=1 << 20):
    source, sink = Pieces(data), io.BytesIO()
    source.size = size
    Server(Decider(guard_of_monitor(0.1, 6.0))).run(Stream(source, sink))
    return [json.loads(one) for one in sink.getvalue().splitlines()]


def test_a_pipe_is_answered_line_by_line_whatever_comes_between(plain):
    pairs = zip(JUNK * 9, ROWS, strict=False)
    answers = answered(b"".join(one + b"\n" + row for one, row in pairs))
    assert answers[1::2] == plain
    assert {one["kind"] for one in answers[::2]} == {"error"}
    cut = answered(b"time,gap,v_follower,v_leader,a_follower\n0,30,20,20,0\n0.1,30,20,20,-0")
    assert [one["kind"] for one in cut] == ["waiting", "decision", "error"]


@pytest.mark.parametrize("size", [53, 1000, 1 << 20])
def test_lines_are_the_same_however_they_are_cut(plain, size):
    data = ROWS[0][:-1] + b"\r\n\n" + b"x" * 90_000 + b"\n" + ROWS[1][:-1]
    first, empty, long, last = answered(data, size)
    assert [first, last] == plain[:2]
    assert empty["error"] == "line 2: is empty"
    assert long["error"] == f"line 3: is longer than {LONGEST} bytes"


def test_it_ends_after_the_message_under_way_however_many_came_at_once(monkeypatch):
    server = Server(Decider(guard_of_monitor(0.1, 6.0)))
    monkeypatch.setattr(server.decider, "answer", lambda *_, **__: time.sleep(0.02) or {})
    threading.Timer(0.3, os.kill, [os.getpid(), signal.SIGINT]).start()
    begun = time.monotonic()
    server.run(Stream(Pieces(b"x\n" * 5000), io.BytesIO()))
    assert time.monotonic() - begun < PATIENCE


def test_what_waits_for_its_slot_is_decided_on_where_nothing_comes_and_rows_after_it_are_late():
    slots = Slots(LogColumns(resample=Resample(0.3)))
    decider = Decider(guard_of_monitor(0.3, 6.0), slots=slots)
    (source, feed), (drain, sink) = os.pipe(), os.pipe()
    reader, writer = (os.fdopen(end, mode, 0) for end, mode in ((source, "rb"), (sink, "wb")))
    server = Server(decider)
    thread = threading.Thread(target=server.run, args=(Stream(reader, writer),))
    with os.fdopen(drain) as answers, reader, writer, unittest.mock.patch("signal.signal"):
        thread.start()
        os.write(feed, b"".join(ROWS[:4]))  # of 0.0 to 0.3 s
        kinds = [json.loads(answers.readline())["kind"] for _ in range(4)]
        assert kinds == ["waiting", "waiting", "waiting", "decision"]
        late = json.loads(answers.readline())  # nobody asked for it
        assert (late["kind"], late["n"], late["time"]) == ("decision", 2, pytest.approx(0.6))
        os.write(feed, ROWS[4] + ROWS[6])
        refused, waiting = (json.loads(answers.readline()) for _ in range(2))
        assert "comes after its 0.3 s were decided on" in refused["error"]
        assert waiting["kind"] == "waiting"
        os.close(feed)
        assert json.loads(answers.readline())["n"] == 3  # as the input ends
        thread.join(PATIENCE)


def connected(path):
    peer = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    peer.settimeout(PATIENCE)
    peer.connect(os.fspath(path))
    return peer


def asked(peer, row):
    peer.sendall(row)
    with peer.makefile("rb") as answers:
        return json.loads(answers.readline())


def test_a_socket_serves_peers_that_come_vanish_and_send_junk(tmp_path, plain):
    path = tmp_path / "monitor.sock"
    answers = []
    with served(SocketTransport(path)):
        assert path.stat().st_mode & 0o777 == 0o600
        for k, row in enumerate(ROWS):
            with connected(path) as vanishing:
                vanishing.sendall(JUNK[k % len(JUNK)][: 1 + k] + (b"\n" if k % 2 else b""))
            with connected(path) as peer:
                answers.append(asked(peer, row))
    assert answers == plain
    assert not path.exists()


def test_peers_name_their_columns_each_for_itself(tmp_path):
    path = tmp_path / "monitor.sock"
    with served(SocketTransport(path)), connected(path) as one, connected(path) as other:
        for peer, names in (one, b"time,gap,a_follower"), (other, b"gap,time,proposal"):
            title = asked(peer, names + b",v_follower,v_leader\n")
            assert title["kind"] == "waiting"
        answers = asked(one, b"1,30,-0.5,20,20\n"), asked(other, b"30,1,-0.5,20,20\n")
        assert [(one["time"], one["proposed"]) for one in answers] == [(1, -0.5)] * 2
        with connected(path) as nameless:
            assert asked(nameless, b"2,30,20,20,0\n")["kind"] == "error"


def test_a_peer_that_does_not_read_holds_up_no_other(tmp_path):
    path = tmp_path / "monitor.sock"
    with served(SocketTransport(path)), connected(path) as deaf, connected(path) as peer:
        deaf.settimeout(1.0)
        with pytest.raises((ConnectionError, TimeoutError)):
            deaf.sendall(b"x\n" * 1_000_000)
        assert asked(peer, ROWS[0])["n"] == 1


def test_a_socket_that_was_left_is_replaced_one_that_is_used_is_not(tmp_path):
    path = tmp_path / "monitor.sock"
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as left:
        left.bind(os.fspath(path))
    transport = SocketTransport(path)
    with pytest.raises(ValueError, match="another process listens there"):
        SocketTransport(path)
    transport.close()
    path.write_text("mine")
    with pytest.raises(ValueError, match="is no socket"):
        SocketTransport(path)
    with pytest.raises(OSError, match="No such file"):
        SocketTransport(tmp_path / "nowhere" / "monitor.sock")
    with pytest.raises(OSError, match=r"too long: .*xxx"):
        SocketTransport(tmp_path / ("x" * 200))


def test_zenoh_refuses_a_key_of_no_one_machine_and_names_what_it_lacks(monkeypatch):
    monkeypatch.setenv("ZENOH_CONFIG", "/no")
    for key, fault in (
        ("car//monitor", "empty chunks are forbidden, as well as leading and trailing slashes$"),
        ("mill/*", "names several machines, and each needs a monitor of its own$"),
        ("mill/1", r"ZENOH_CONFIG=/no: No such file or directory \(os error 2\)$"),
    ):
        with pytest.raises(ValueError, match=rf"^--zenoh {re.escape(key)}.*{fault}"):
            ZenohTransport(key)


@pytest.mark.slow
def test_zenoh_carries_the_same(tmp_path, monkeypatch, plain):
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        place = f"tcp/127.0.0.1:{free.getsockname()[1]}"
    quiet = {"scouting": {"multicast": {"enabled": False}}, "mode": "peer"}
    here = tmp_path / "zenoh.json5"
    here.write_text(json.dumps(quiet | {"listen": {"endpoints": [place]}}))
    monkeypatch.setenv("ZENOH_CONFIG", str(here))  # of this computer alone
    alone = zenoh.Config.from_json5(json.dumps(quiet | {"connect": {"endpoints": [place]}}))
    answers: queue.Queue = queue.Queue()
    with served(ZenohTransport("car/monitor")) as transport, zenoh.open(alone) as peer:
        peer.declare_subscriber("car/monitor/decision", lambda s: answers.put(s.payload.to_bytes()))
        rows = peer.declare_publisher("car/monitor/row")
        begun, found = time.monotonic(), []
        while not all(one.matching_status.matching for one in (transport._publisher, rows)):
            assert time.monotonic() - begun < PATIENCE
            time.sleep(0.01)
        for row in (b"junk", b"\n" * 60_000, *ROWS):  # one answer, however many lines
            rows.put(row)
            found.append(json.loads(answers.get(timeout=PATIENCE)))
    assert [fault["kind"] for fault in found[:2]] == ["error", "error"]
    assert found[2:] == plain
