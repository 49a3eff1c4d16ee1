"""Pages as readers and browsers meet them."""

import re
import shutil
from html import unescape
from html.parser import HTMLParser

import pytest

BROWSERS = ("chromium", "chromium-browser", "google-chrome")


class Page(HTMLParser):
    """What a page loads, links to and says; reading it checks that tags are closed in order."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.html = html
        self.links: list[str] = []
        self.loads: list[str] = []
        self.alts: list[str | None] = []
        self.ids: list[str] = []
        self.headers_without_scope = 0
        self._open: list[str] = []
        self.feed(html)
        assert not self._open

    def handle_starttag(self, tag, attrs):
        given = dict(attrs)
        if tag == "a":
            self.links.append(given["href"])
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
        assert self._open.pop() == tag

    @property
    def text(self) -> str:
        """What a reader sees, with single spaces."""
        body = re.sub(r"<(style|script)>.*?</\1>", "", self.html, flags=re.DOTALL)
        body = re.sub(r'<span class="unseen">.*?</span>', "", body)
        body = re.sub(r"</t[hd]>|<small>", " ", body)
        return re.sub(r"\s+", " ", unescape(re.sub(r"<[^>]+>", "", body)))

    @property
    def verdict(self) -> str:
        """The answer at the top, as markup."""
        return re.search(r'<div class="verdict.*?</div>', self.html, flags=re.DOTALL)[0]

    def is_sound(self) -> None:
        """Fails where it loads anything, a link leads nowhere, or a name is given twice."""
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
    playwright = pytest.importorskip("playwright.sync_api")
    found = next((path for path in map(shutil.which, BROWSERS) if path), None)
    if found is None:
        pytest.skip(f"none of {', '.join(BROWSERS)} is installed to look at pages with")
    flags = ["--no-sandbox", "--disable-quic", "--no-first-run", "--disable-background-networking"]
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=found, args=[*flags, "--disable-gpu"])
        yield browser
        browser.close()
