"""The live page's server: who gets in, and that nobody who looks on can harm the run."""

import json
import math
import socket
import threading
import time
from contextlib import closing, suppress
from http.client import HTTPConnection
from urllib.parse import urlsplit

import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

from evofsm.cli.watch.session import OnRoads, Session
from evofsm.driving import KinematicWorld, load_family

pytestmark = pytest.mark.usefixtures("compiled")


@pytest.fixture
def page(shown):
    """A page that shows a run, which waits."""
    with shown(session, paused=True) as page:
        yield page


def session():
    return Session(OnRoads(load_family("paper"), KinematicWorld()))


def get(page, path, host=None):
    """Status, headers and body of a request."""
    with closing(HTTPConnection("127.0.0.1", page.port, timeout=60)) as connection:
        connection.request("GET", path, headers={"Host": host or f"127.0.0.1:{page.port}"})
        answer = connection.getresponse()
        return answer.status, dict(answer.getheaders()), answer.read()


def looking_on(page, *, origin=None, token=None, sock=None, host=None):
    own = f"127.0.0.1:{page.port}"
    return connect(
        f"ws://{host or own}/{token or page.token}/socket",
        origin=origin or f"http://{own}",
        sock=sock or socket.create_connection(("127.0.0.1", page.port)),
        proxy=None,
        open_timeout=60,
        close_timeout=1,
    )


def told(client, kind):
    """The next message of a kind."""
    while True:
        message = json.loads(client.recv(timeout=60))
        for part in message.get("parts", [message]):
            if part["kind"] == kind:
                return part


# -- Who gets in ----------------------------------------------------------------------------------


def test_the_page_and_all_that_it_needs_are_served_under_its_address(page):
    folder = urlsplit(page.address).path
    for query in ("", "?from=here"):
        status, headers, body = get(page, folder + query)
        assert (status, b"<!doctype html>" in body) == (200, True)
        status, moved, _ = get(page, folder.rstrip("/") + query)
        assert (status, moved["Location"]) == (308, f"{page.token}/")
    assert body.count(b'data-status="unjudged"') == body.count(b"<noscript>") == 1
    assert "default-src 'none'" in headers["Content-Security-Policy"]
    assert b"http:" not in body
    assert b"https:" not in body
    for name in page._files:
        status, headers, body = get(page, folder + name)
        assert status == 200
        assert headers["X-Content-Type-Options"] == "nosniff"
        assert body


FOREIGN = ("evil.example:9000", "localhost.evil:80", "127.0.0.1.evil", "a@localhost", "[::2]:80")


def test_without_the_token_or_by_other_names_nothing_is_served_nor_files_beside_the_page(page):
    for path in ("/", "/wrong/", "/wrong/page.js", "/%00/", "//", "/socket"):
        assert get(page, path)[0] == 403
    for name in ("server.py", "../live/page.html", "..%2f..%2fpage.py", "words.py", "socket/x"):
        assert get(page, f"/{page.token}/{name}")[0] in (403, 404)
    for host in FOREIGN:  # a page elsewhere may let its name point to this computer (DNS rebinding)
        status, _, said = get(page, f"/{page.token}/", host=host)
        assert (status, b"ssh -L 9000:127.0.0.1:%d" % page.port in said) == (403, True)


@pytest.mark.parametrize("name", ["localhost", "127.0.0.1", "[::1]"])
@pytest.mark.parametrize("rewrites", [False, True])
def test_own_names_are_let_in_at_any_port(page, name, rewrites):
    """As through a tunnel, of ssh, an editor or a container, to another port of this computer."""
    there = f"{name}:9000"
    host = f"127.0.0.1:{page.port}" if rewrites else there  # which some tunnels put there
    status, headers, _ = get(page, f"/{page.token}/page.js", host)
    assert status == 200
    assert "connect-src 'self'" in headers["Content-Security-Policy"]
    with looking_on(page, origin=f"http://{there}", host=host) as client:
        assert told(client, "start")["case"] == 0
    for origin in FOREIGN:
        with pytest.raises(InvalidStatus):
            looking_on(page, origin=f"http://{origin}", host=host)


def test_a_socket_needs_the_token_and_an_origin_of_its_own(page):
    for wrong in ({"token": "A" * 32}, {"origin": "null"}, {"origin": "https://127.0.0.1"}):
        with pytest.raises(InvalidStatus) as refused:
            looking_on(page, **wrong)
        assert refused.value.response.status_code == 403
    with pytest.raises(InvalidStatus):
        connect(f"ws://127.0.0.1:{page.port}/{page.token}/socket", proxy=None)


def test_it_listens_on_this_computer_only(page, shown):
    own = {info[4][0] for info in socket.getaddrinfo(socket.gethostname(), None, socket.AF_INET)}
    for address in {*own, "127.0.0.2"} - {"127.0.0.1", "127.0.1.1"}:
        with pytest.raises(ConnectionRefusedError):
            socket.create_connection((address, page.port), timeout=5).close()
    with shown(session) as other:
        assert page.token != other.token
        assert len(page.token) >= 32


# -- What is shown, and done ----------------------------------------------------------------------


def test_who_connects_and_says_nothing_does_not_hold_up_the_end(shown):
    with shown(session) as page:
        silent = socket.create_connection(("127.0.0.1", page.port), timeout=5)
        time.sleep(0.1)
        began = time.monotonic()
    assert time.monotonic() - began < 4.0
    silent.close()


def test_who_comes_late_is_shown_all_of_it(page):
    with looking_on(page) as first:
        for number in range(3):
            first.send('{"do": "step"}')
            assert told(first, "frame")["number"] == number
    with looking_on(page) as later:
        whole = json.loads(later.recv(timeout=60))
    kinds = [part["kind"] for part in whole["parts"]]
    assert kinds[0] == "start"
    assert kinds.count("frame") == 3
    assert {"clock", "graph"} <= set(kinds)


def test_a_page_is_served_while_what_is_watched_hangs_or_broke_off(page, monkeypatch):
    goes, why = threading.Event(), "ZeroDivisionError: division by zero"
    monkeypatch.setattr(page.player._watched, "step", lambda: goes.wait(60) and 1 / 0)
    with looking_on(page) as first:
        first.send('{"do": "step"}')
        assert get(page, f"/{page.token}/")[0] == 200
        with looking_on(page) as later:
            assert told(later, "start")["case"] == 0
        assert not page._frames
        goes.set()
        while not told(first, "clock")["over"]:
            pass
        assert told(first, "failed")["text"] == page.player.fault == why
        monkeypatch.undo()
        first.send('{"do": "restart"}')
        assert told(first, "frame")["number"] == 0
        assert page.player.fault == ""


def test_a_run_waits_for_the_first_who_looks_on(shown):
    with shown(session, speed=math.inf, awaits=True) as page:
        assert get(page, f"/{page.token}/")[0] == 200  # who loads the page only sees nothing yet
        assert not page._frames
        with looking_on(page) as client:
            frames = [told(client, "frame")]
            while not frames[-1]["over"]:
                frames.append(told(client, "frame"))
            assert [frame["number"] for frame in frames] == [*range(len(frames))]
            assert told(client, "clock")["over"]


# -- Who looks on cannot harm it ------------------------------------------------------------------

_JUNK = [
    "hello",
    "[]",
    '{"do": "explode"}',
    '{"do": "\\ud800"}',  # half a character, which no reason can hold
    '{"do": "\\ud83d\\ude00"}',
    '{"do": "speed", "value": 3.21}',
    '{"do": "speed", "value": NaN}',
    '{"do": "case", "value": 1e400}',
    '{"do": "case", "value": -1}',
    '{"do": "pause"}',
    '{"do": "pause", "value": 1, "also": 2}',
    '{"do": ["pause"]}',
    "[" * 500,
]


@pytest.mark.parametrize(
    ("junk", "code"), [*((one, 1008) for one in _JUNK), (b"\x00\x01", 1003), ("x" * 10_000, 1009)]
)
def test_what_is_no_command_closes_the_socket_and_says_so(page, junk, code):
    with looking_on(page) as client:
        told(client, "start")
        client.send(junk)
        with pytest.raises(ConnectionClosed) as closed:
            told(client, "nothing")
    assert closed.value.rcvd.code == code
    assert code != 1008 or "command" in closed.value.rcvd.reason


def test_junk_on_the_wire_is_survived(page):
    request = f"GET /{page.token}/socket HTTP/1.1\r\nHost: 127.0.0.1:{page.port}\r\n"
    upgraded = (
        f"{request}Origin: http://127.0.0.1:{page.port}\r\nUpgrade: websocket\r\n"
        "Connection: Upgrade\r\nSec-WebSocket-Version: 13\r\n"
        "Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n\r\n"
    )
    for junk in (
        b"\x16\x03\x01\x02\x00\x01" * 50,  # as if it were TLS
        b"GET / HTTP/1.1\r\n" + b"A: b\r\n" * 500,
        b"GET /\xff/ HTTP/1.1\r\n\r\n",
        f"GET /{'x' * 5000}/ HTTP/1.1\r\nHost: 127.0.0.1:{page.port}\r\n\r\n".encode(),
        f"GET /\xff/ HTTP/1.1\r\nHost: 127.0.0.1:{page.port}\r\n\r\n".encode("latin-1"),
        b"POST / HTTP/1.1\r\nContent-Length: 9\r\n\r\n",
        b"\x00" * 100_000,
        request.encode(),  # and then nothing
        upgraded.encode() + b"\xff" * 1000,  # no frame at all
        upgraded.encode() + b"\x81\x05hello",  # not masked
        upgraded.encode() + b"\x81\xff" + b"\x7f" * 12,  # as if 2^62 bytes followed
    ):
        wire = socket.create_connection(("127.0.0.1", page.port), timeout=5)
        with wire, suppress(OSError):
            wire.sendall(junk)
            wire.settimeout(0.05)
            wire.recv(100)
    with looking_on(page) as client:
        client.send('{"do": "step"}')
        assert told(client, "frame")["number"] == 0


@pytest.mark.slow
def test_who_does_not_read_does_not_hold_the_run_up_and_is_later_shown_all_of_it(
    shown, monkeypatch
):
    monkeypatch.setattr("evofsm.cli.watch.server._MOST_UNREAD", 1 << 14)
    narrow = socket.socket()
    narrow.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    with shown(session, paused=True) as page:
        narrow.connect(("127.0.0.1", page.port))
        with looking_on(page, sock=narrow), looking_on(page) as client:
            while len(page._clients) == 2:  # the buffers on the way hold some megabytes
                page("long", "x" * 400_000)
                told(client, "long")
                client.send('{"do": "step"}')
                assert not told(client, "frame")["over"]
        with looking_on(page) as again:
            assert json.loads(again.recv(timeout=60))["parts"][0]["kind"] == "start"
