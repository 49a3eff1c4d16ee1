"""Pipes, sockets, datagrams and Zenoh bring the same answers; peers that misbehave end nothing."""

import io
import json
import os
import socket
import sys
import threading
import time

import pytest

from evofsm.cli.monitor.decider import Decider, guard_of_monitor
from evofsm.cli.monitor.messages import LONGEST
from evofsm.cli.monitor.transports import (
    Lines,
    Server,
    SocketTransport,
    StoppedError,
    UdpTransport,
    ZenohTransport,
    serve_stream,
)
from monitor_rows import JUNK, closing_in, line

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="sockets and signals of POSIX")
ROWS = [line(row) + b"\n" for row in closing_in(40)]
PATIENCE = 20.0


@pytest.fixture(scope="module")
def plain():
    """What is to be answered to `ROWS`."""
    decider = Decider(guard_of_monitor(0.1, 6.0))
    return [decider.answer(row) for row in ROWS]


def made(heartbeat=None):
    return Server(Decider(guard_of_monitor(0.1, 6.0)), heartbeat)


def served(transport, server):
    """Serve in a thread; returns what ends it."""

    def serve():
        try:
            transport.serve(server)
        except StoppedError:
            transport.close()

    thread = threading.Thread(target=serve, daemon=True)
    thread.start()

    def stop(knock):
        server.stopped = True
        knock()
        thread.join(PATIENCE)
        assert not thread.is_alive()

    return stop


def told(data):
    return [json.loads(one) for one in data.splitlines()]


@pytest.mark.parametrize("size", [53, 1000, 1 << 20])
def test_lines_are_the_same_however_they_are_cut(size):
    data, lines, found = b"one\r\n\ntwo\n" + b"x" * 90_000 + b"\nthree", Lines(), []
    for k in range(0, len(data), size):
        found += lines.feed(data[k : k + size])
    found += lines.feed(b"")
    assert [one[:10] for one in found] == [b"one", b"", b"two", b"x" * 10, b"three"]
    assert LONGEST < len(found[3])
    for _ in range(100):
        assert lines.feed(b"x" * LONGEST) == []
    assert len(lines._begun) == LONGEST + 1


def test_a_pipe_is_answered_line_by_line_whatever_comes_between(plain):
    sink = io.BytesIO()
    serve_stream(made(), io.BytesIO(b"".join(ROWS)[:-1]), sink)
    assert told(sink.getvalue()) == plain
    data = b"".join(one + b"\n" + row for one, row in zip(JUNK * 9, ROWS, strict=False))
    sink = io.BytesIO()
    serve_stream(made(), io.BytesIO(data), sink)
    answers = told(sink.getvalue())
    assert answers[1::2] == plain
    assert {one["kind"] for one in answers[::2]} == {"error"}


def test_a_heartbeat_where_nothing_comes():
    ours, theirs = os.pipe()
    os.set_blocking(ours, False)  # as some parents leave it
    with open(ours, "rb") as source, open(theirs, "wb", buffering=0) as writer:
        sink, server = io.BytesIO(), made(heartbeat=0.05)
        thread = threading.Thread(target=serve_stream, args=(server, source, sink))
        thread.start()
        writer.write(ROWS[0])
        deadline = time.monotonic() + PATIENCE
        while sink.getvalue().count(b"heartbeat") < 2 and time.monotonic() < deadline:
            time.sleep(0.01)
        writer.close()
        thread.join(PATIENCE)
    first, *beats = told(sink.getvalue())
    assert first["kind"] == "decision"
    assert {(beat["kind"], beat["n"], beat["time"]) for beat in beats} == {("heartbeat", 1, 0.0)}
    assert beats[0]["silent"] < beats[1]["silent"]
    assert made(heartbeat=1e10).patience < 1e6  # the system knows no longer times


def connected(path):
    peer = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    peer.settimeout(PATIENCE)
    peer.connect(os.fspath(path))
    return peer


def asked(peer, row):
    peer.sendall(row)
    data = b""
    while not data.endswith(b"\n"):
        data += peer.recv(1 << 16)
    return json.loads(data)


def test_a_socket_serves_peers_that_come_vanish_and_send_junk(tmp_path, plain):
    path = tmp_path / "monitor.sock"
    transport = SocketTransport(path)
    assert path.stat().st_mode & 0o777 == 0o600
    stop = served(transport, made())
    answers = []
    for k, row in enumerate(ROWS):
        with connected(path) as vanishing:
            vanishing.sendall(JUNK[k % len(JUNK)][: 1 + k] + (b"\n" if k % 2 else b""))
        with connected(path) as peer:
            answers.append(asked(peer, row))
    stop(lambda: connected(path).close())
    assert answers == plain
    assert not path.exists()


def test_a_peer_that_does_not_read_is_cut_off_and_others_are_served(tmp_path):
    path = tmp_path / "monitor.sock"
    stop = served(SocketTransport(path), made())
    with connected(path) as deaf, connected(path) as peer:
        with pytest.raises((ConnectionError, TimeoutError)):
            deaf.sendall(b"x\n" * 20_000_000)
        assert asked(peer, ROWS[0])["n"] == 1
    stop(lambda: connected(path).close())


def test_a_socket_that_was_left_is_replaced_one_that_is_used_is_not(tmp_path):
    path = tmp_path / "monitor.sock"
    left = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    left.bind(os.fspath(path))
    left.close()
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


def test_datagrams_are_answered_to_their_sender(plain):
    transport, server = UdpTransport(0), made(heartbeat=0.2)
    stop = served(transport, server)
    time.sleep(0.5)  # nobody is there to hear a heartbeat yet
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as peer:
        peer.settimeout(PATIENCE)
        peer.connect(("127.0.0.1", transport.port))
        answers = []
        for row in ROWS[:-2]:
            for junk in (b"junk", b"\n" * 60_000):  # one answer, however many lines
                peer.send(junk)
                assert json.loads(peer.recv(1 << 16))["kind"] == "error"
            peer.send(row)
            answers.append(json.loads(peer.recv(1 << 16)))
        peer.send(b"".join(ROWS[-2:]))  # two in one
        answers += [json.loads(peer.recv(1 << 16)) for _ in range(2)]
        assert json.loads(peer.recv(1 << 16))["kind"] == "heartbeat"
    assert answers == plain
    stop(lambda: None)
    taken = UdpTransport(0)
    with pytest.raises(OSError, match="in use"):
        UdpTransport(taken.port)
    taken.close()


@pytest.fixture
def alone(tmp_path, monkeypatch):
    """Zenoh on this computer alone; returns the configuration of a peer."""
    zenoh = pytest.importorskip("zenoh")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        place = f"tcp/127.0.0.1:{free.getsockname()[1]}"
    quiet = {"scouting": {"multicast": {"enabled": False}}, "mode": "peer"}
    here = tmp_path / "zenoh.json5"
    here.write_text(json.dumps(quiet | {"listen": {"endpoints": [place]}}))
    monkeypatch.setenv("ZENOH_CONFIG", str(here))
    return zenoh.Config.from_json5(json.dumps(quiet | {"connect": {"endpoints": [place]}}))


@pytest.mark.slow
def test_zenoh_carries_the_same_and_refuses_a_key_that_is_none(alone, plain):
    import queue

    import zenoh

    with pytest.raises(ValueError, match="--zenoh"):
        ZenohTransport("car//monitor")
    stop = served(ZenohTransport("car/monitor"), made(heartbeat=0.2))
    answers: queue.Queue = queue.Queue()
    with zenoh.open(alone) as peer:
        peer.declare_subscriber("car/monitor/decision", lambda s: answers.put(s.payload.to_bytes()))
        rows = peer.declare_publisher("car/monitor/row")
        assert json.loads(answers.get(timeout=PATIENCE))["kind"] == "heartbeat"  # it is connected
        found = []
        for row in ROWS:
            rows.put(row)
            while (answer := json.loads(answers.get(timeout=PATIENCE)))["kind"] != "decision":
                pass
            found.append(answer)
    assert found == plain
    stop(lambda: None)
