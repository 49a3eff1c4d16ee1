"""The page holds everything, in one file that loads nothing."""

import base64
import re
import subprocess
import sys
from dataclasses import replace
from html import unescape
from html.parser import HTMLParser
from pathlib import Path

import pytest

import evofsm
from evofsm.report.figures import Drawing
from evofsm.report.page import write_page
from evofsm.studies.paper import (
    Claim,
    PaperStudy,
    Settings,
    check_claims,
    context_tables,
    run_paper,
)
from evofsm.studies.table import Table
from evofsm.worlds.kinematic import KinematicWorld

_SVG = b'<svg xmlns="http://www.w3.org/2000/svg"/>'


@pytest.fixture(scope="module")
def study() -> PaperStudy:
    return run_paper(KinematicWorld(), "kinematic", Settings.load(), rounds=2)


@pytest.fixture(scope="module")
def claims(study: PaperStudy) -> tuple[Claim, ...]:
    return check_claims(study)


@pytest.fixture(scope="module")
def figure(tmp_path_factory: pytest.TempPathFactory) -> Drawing:
    path = tmp_path_factory.mktemp("figure") / "a.svg"
    path.write_bytes(_SVG)
    return Drawing("a", "A title", "A caption.", 'What "it" shows.', {"svg": path, "png": path})


@pytest.fixture(scope="module")
def html(
    study: PaperStudy,
    claims: tuple[Claim, ...],
    figure: Drawing,
    tmp_path_factory: pytest.TempPathFactory,
) -> str:
    folder = tmp_path_factory.mktemp("page") / "made when missing"
    page = write_page(study, claims, context_tables(study), [figure], folder)
    assert page == folder / "index.html"
    assert [path.name for path in folder.iterdir()] == ["index.html"]
    return page.read_text(encoding="utf-8")


class _Reader(HTMLParser):
    """Collects what the page loads or links to, and checks that tags are closed in order."""

    def __init__(self) -> None:
        super().__init__()
        self.links: list[str] = []
        self.loads: list[str] = []
        self.alts: list[str | None] = []
        self.ids: list[str] = []
        self.open: list[str] = []
        self.headers_without_scope = 0

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = dict(attrs)
        if tag == "a":
            self.links.append(given["href"] or "")
        else:
            self.loads += [given[name] or "" for name in ("src", "href", "data") if name in given]
        if tag == "img":
            self.alts.append(given.get("alt"))
        if tag == "th" and given.get("scope") not in ("row", "col"):
            self.headers_without_scope += 1
        if "id" in given:
            self.ids.append(given["id"] or "")
        if tag not in ("meta", "img", "br", "link", "input", "hr"):
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


def _read(html: str) -> _Reader:
    reader = _Reader()
    reader.feed(html)
    assert not reader.open
    return reader


def _text(html: str) -> str:
    """What a reader sees, with single spaces."""
    body = re.sub(r"<style>.*?</style>", "", html, flags=re.DOTALL)
    return re.sub(r"\s+", " ", unescape(re.sub(r"<[^>]+>", "", re.sub(r"</t[hd]>", " ", body))))


def test_the_page_loads_nothing(html: str) -> None:
    reader = _read(html)
    assert all(address.startswith("data:image/svg+xml;base64,") for address in reader.loads)
    assert [link for link in reader.links if not link.startswith("#")] == [
        "https://arxiv.org/abs/1908.10823"
    ]
    assert not re.search(r"<script|@import|url\(", html)


def test_figures_are_inside(html: str, figure: Drawing) -> None:
    reader = _read(html)
    assert base64.b64decode(reader.loads[0].split(",")[1]) == _SVG
    assert reader.alts == [figure.alt]
    assert "Figure 1. A title" in _text(html)
    assert figure.caption in _text(html)


def test_links_within_the_page_lead_somewhere_and_names_are_unique(html: str) -> None:
    reader = _read(html)
    assert len(set(reader.ids)) == len(reader.ids)
    assert {link[1:] for link in reader.links if link.startswith("#")} <= set(reader.ids)
    assert reader.headers_without_scope == 0


def test_every_claim_and_table_is_there(
    html: str, study: PaperStudy, claims: tuple[Claim, ...]
) -> None:
    text = _text(html)
    for claim in claims:
        for part in (claim.claim, claim.paper, claim.measured):
            assert part in text
    for table in context_tables(study):
        assert table.title in text
        assert table.note in text
        for row in (table.header, *table.rows):
            assert all(value in text for value in row)


def test_settings_versions_command_and_paper_are_there(html: str) -> None:
    text = _text(html)
    for part in (
        "9 m/s² on reaching 24.2 m/s",
        "learning rate φ 0.01",
        "17 intervals of 0.3 m/s² from −2.5 to 2.5 m/s²",
        "case 3 from 15 s",
        "−4 to 2.5",
        f"evofsm {evofsm.__version__}",
        "numba",
        "make paper",
        "arXiv:1908.10823",
        "8 runs and 2 extra ones in the kinematic world",
    ):
        assert part in text
    assert "libsumo" not in text


def test_all_holds_is_said_on_top_and_a_failing_claim_cannot_be_missed(
    study: PaperStudy, claims: tuple[Claim, ...], tmp_path: Path
) -> None:
    good = [replace(claim, holds=True) for claim in claims]
    page = write_page(study, good, (), (), tmp_path).read_text(encoding="utf-8")
    assert f"{len(good)} of {len(good)} claims hold in the kinematic world" in _text(page)
    assert "fails" not in _text(page)
    assert "Not reproduced" not in _text(page)

    bad = [replace(good[0], holds=False, measured="quite the contrary"), *good[1:]]
    page = write_page(study, bad, (), (), tmp_path).read_text(encoding="utf-8")
    text = _text(page)
    assert f"{len(bad) - 1} of {len(bad)} claims hold" in text
    assert text.index("Not reproduced") < text.index("quite the contrary") < text.index("Claims ")
    assert text.count("✗ fails") == 1
    assert f'<tr id="claim-{bad[0].id}" class="fails">' in page


def test_what_is_told_is_text_and_never_markup(study: PaperStudy, tmp_path: Path) -> None:
    evil = '<script>alert("1 & 2")</script>'
    claims = [Claim("x", evil, evil, evil, holds=False)]
    tables = [Table(evil, (evil,), ((evil,),), evil)]
    path = tmp_path / "a.svg"
    path.write_bytes(_SVG)
    figure = Drawing("a", evil, evil, f'"{evil}', {"svg": path})
    odd = replace(study, world=evil)
    page = write_page(odd, claims, tables, [figure], tmp_path, command=f"do {evil}")
    html = page.read_text(encoding="utf-8")
    _read(html)
    assert "<script" not in html
    assert _text(html).count(evil) >= 10


def test_sumo_is_named_with_its_version(study: PaperStudy, tmp_path: Path) -> None:
    page = write_page(replace(study, world="sumo"), (), (), (), tmp_path)
    assert "SUMO (libsumo)" in page.read_text(encoding="utf-8")


@pytest.mark.parametrize("settings", ["", "[leader]\nbrake_decel = 2.0\n"])
def test_one_round_with_or_without_a_collision(
    settings: str, figure: Drawing, tmp_path: Path
) -> None:
    path = tmp_path / "settings.toml"
    path.write_text(settings)
    study = run_paper(KinematicWorld(), "kinematic", Settings.load(path), rounds=1)
    assert (study.dead_end == -1) == bool(settings)
    page = write_page(study, check_claims(study), (), [figure], tmp_path)
    assert "4 runs of four cases" in _text(page.read_text(encoding="utf-8"))


def test_a_missing_jinja2_is_named() -> None:
    code = """
import sys
sys.modules["jinja2"] = None
try:
    import evofsm.report.page
except ModuleNotFoundError as error:
    print(error)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "pip install 'evofsm[plot]'" in done.stdout
