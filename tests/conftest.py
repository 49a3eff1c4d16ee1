import faulthandler
import hashlib
import json
import re
import shutil
import signal
from contextlib import contextmanager
from html import unescape
from html.parser import HTMLParser
from io import BytesIO

import hypothesis
import numpy as np
import pytest

import one_machine
from evofsm import EvolvingFSM

# The same examples in every run, so that a red build is red again on the next machine.
hypothesis.settings.register_profile("evofsm", deadline=None, derandomize=True, database=None)
hypothesis.settings.load_profile("evofsm")


@pytest.fixture(scope="session")
def sumo_road():
    """Writes a straight road of one lane, at 20 m/s, for SUMO."""

    def write(folder, length):
        (folder / "road.net.xml").write_text(
            f"""<net version="1.20">
  <edge id="road" from="begin" to="end" priority="1">
    <lane id="road_0" index="0" speed="20" length="{length}" shape="0,0 {length},0"/>
  </edge>
  <junction id="begin" type="dead_end" x="0" y="0" incLanes="" intLanes="" shape="0,0 0,3.2"/>
  <junction id="end" type="dead_end" x="{length}" y="0" incLanes="road_0" intLanes=""
            shape="{length},0 {length},3.2"/>
</net>"""
        )

    return write


@pytest.fixture(scope="session")
def ends_in_time():
    """Ends the process where something takes a minute: nothing interrupts compiled loops."""

    @contextmanager
    def within():
        faulthandler.dump_traceback_later(60.0, exit=True)
        try:
            yield
        finally:
            faulthandler.cancel_dump_traceback_later()

    return within


@pytest.fixture(scope="session")
def full_at():
    """No file may grow beyond so many bytes, which the system reports like a full disk."""
    resource = pytest.importorskip("resource")

    @contextmanager
    def full(size):
        soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
        handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
        try:
            yield
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
            signal.signal(signal.SIGXFSZ, handler)

    return full


@pytest.fixture(scope="session")
def compiled():
    """All that a watched run needs is compiled, for tests that wait for some seconds only."""
    from evofsm.cli.watch.session import OnRoads, Session, learn_first
    from evofsm.driving import KinematicWorld, load_family

    roads = OnRoads(load_family("paper"), KinematicWorld())
    learn_first(roads, 2)
    with Session(roads) as session:
        while not session.step().over:
            session.graph()


@pytest.fixture(scope="session")
def snapshot():
    """All that a machine, a judge or a guard holds, byte for byte: what it writes to a file."""
    return one_machine.saved


@pytest.fixture(scope="session")
def reloaded():
    """The same guard, machine or judge, as its file brings it back."""

    def load(one, **how):
        one.save(file := BytesIO())
        return type(one).load(BytesIO(file.getvalue()), **how)

    return load


@pytest.fixture(scope="session")
def forge():
    """Change a file so that its checksum is right: settings and arrays by name, to a value (of an
    array its first numbers) or by a function of what it was, or whatever a function does to what
    its header tells, its entries and its numbers.
    """
    kinds = {"F64": "<f8", "I64": "<i8", "U8": "|u1", "BOOL": "|b1"}

    def change(path, changes):
        data = path.read_bytes()
        length = int.from_bytes(data[:8], "little")
        entries, numbers = json.loads(data[8 : 8 + length]), bytearray(data[8 + length :])
        told = json.loads(entries.pop("__metadata__")["evofsm"])
        if callable(changes):
            changes(told, entries, numbers)
            changes = {}
        for name, value in changes.items():
            if name not in entries:
                settings = told["settings"]
                settings[name] = value(settings[name]) if callable(value) else value
                continue
            entry, place = entries[name], 0
            part = slice(*entry["data_offsets"])
            array = np.frombuffer(numbers[part], kinds[entry["dtype"]]).reshape(entry["shape"])
            if callable(value):
                array = value(array).astype(array.dtype)
            else:
                array.flat[: np.size(value)] = value
            numbers[part] = array.tobytes()
            entry |= {"shape": array.shape, "data_offsets": [part.start, part.start + array.nbytes]}
            for one in entries.values():  # those behind it begin elsewhere
                begin, end = one["data_offsets"]
                one["data_offsets"] = [place, place := place + end - begin]
        metadata = {"sha256": "0" * 64, "evofsm": json.dumps(told)}
        header = json.dumps({"__metadata__": metadata, **entries}).encode()
        header += b" " * (-len(header) % 8)
        digest = hashlib.sha256(header + numbers).hexdigest().encode()
        signed = header.replace(b"0" * 64, digest, 1)
        path.write_bytes(len(header).to_bytes(8, "little") + signed + numbers)

    return change


@pytest.fixture
def grown():
    """A machine in mid-episode, with an action pending and every array in use."""
    machine, row = EvolvingFSM(n_actions=3, radius=0.01), np.arange(40)
    radius = 8.0 * (1.0 - row / 40) * (-1.0) ** row  # so that every second one founds a state
    machine.learn_many(np.column_stack([radius, 0.5 * radius]), row % 3, [0, 25])
    assert machine.n_states > 8
    return machine


# -- Pages as readers and browsers meet them -------------------------------------------------------

BROWSERS = ("chromium", "chromium-browser", "google-chrome")


class Page(HTMLParser):
    """What a page loads, links to and says, and whether its tags are closed in order."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.html = html
        self.links: list[str] = []
        self.loads: list[str] = []
        self.alts: list[str | None] = []
        self.ids: list[str] = []
        self.headers_without_scope = 0
        self.is_closed = True
        self._open: list[str] = []
        self.feed(html)

    def handle_starttag(self, tag, attrs):
        given = dict(attrs)
        if tag == "a":
            self.links.append(given.get("href", ""))
        else:
            self.loads += [given[name] for name in ("src", "href", "data") if name in given]
        if tag == "img":
            self.alts.append(given.get("alt"))
        if tag == "th" and given.get("scope") not in ("row", "col"):
            self.headers_without_scope += 1
        if "id" in given:
            self.ids.append(given["id"])
        if tag not in ("meta", "img", "br", "link", "input", "hr"):
            self._open.append(tag)

    def handle_endtag(self, tag):
        self.is_closed &= self._open[-1:] == [tag]
        del self._open[-1:]

    @property
    def text(self) -> str:
        """What a reader sees, with single spaces."""
        body = re.sub(r"<(style|script)>.*?</\1>", "", self.html, flags=re.DOTALL)
        body = re.sub(r'<span class="unseen">.*?</span>', "", body)
        body = re.sub(r"</t[hd]>|<small>", " ", body)
        return re.sub(r"\s+", " ", unescape(re.sub(r"<[^>]+>", "", body)))

    def is_sound(self) -> None:
        """Fails where it loads anything, a link or tag ends nowhere, or a name is given twice."""
        assert self.is_closed
        assert not self._open
        assert all(address.startswith("data:image/svg+xml;base64,") for address in self.loads)
        assert not re.search(r"@import|url\(|<script [^>]", self.html)
        assert len(set(self.ids)) == len(self.ids)
        assert {link[1:] for link in self.links if link.startswith("#")} <= set(self.ids)
        assert self.headers_without_scope == 0


@pytest.fixture(scope="session")
def read_page():
    """Reads a file, or markup, as a `Page`."""
    return lambda page: Page(page if isinstance(page, str) else page.read_text(encoding="utf-8"))


@pytest.fixture(scope="module")  # while one is open, no other loop can run in this thread
def browser():
    """Chromium, if one is installed."""
    from playwright.sync_api import sync_playwright

    found = next((path for path in map(shutil.which, BROWSERS) if path), None)
    if found is None:
        pytest.skip(f"none of {', '.join(BROWSERS)} is installed to look at pages with")
    flags = ["--no-sandbox", "--disable-quic", "--no-first-run", "--disable-background-networking"]
    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=found, args=[*flags, "--disable-gpu"])
        yield browser
        browser.close()
