"""Pages in Chromium: tables sort, figures open large, nothing is loaded, nothing goes wrong."""

from contextlib import closing

import pytest

from evofsm.cli.text.table import Table
from evofsm.paper.report.chapter import Chapter, write_chapters
from evofsm.paper.report.drawing import Drawing
from evofsm.paper.report.html import Setting

pytestmark = pytest.mark.slow

SVG = '<svg xmlns="http://www.w3.org/2000/svg" width="{}" height="200"><path d="M0 0h90"/></svg>'
# Where the image of the dialog lies.
IMAGE = "document.querySelector('dialog img').getBoundingClientRect()"
ROWS = (
    # name, rate with its interval, count, a time or never, words
    ("rss-r157", "−0.5 % (−0.7–0.1)\n3 of 90", "1,200", "10 s", "zeta"),
    ("ttc", "10.0 %", "90", "never", "alpha"),
    ("evofsm 2", "2.0 % (0.3 to 4.0)", "1,200", "9 s", "alpha"),
    ("evofsm 10", "2.0 % (0.1 to 0.4)", "–", "2.5 s", "mu"),
    ("aeb", "1.2e-03 %", "7", "–", "alpha"),
)


@pytest.fixture(scope="module")
def address(tmp_path_factory):
    folder = tmp_path_factory.mktemp("page")
    figures = []
    for name, width in (("wide", 900), ("small", 200)):
        path = folder / f"{name}.svg"
        path.write_text(SVG.format(width))
        figures.append(
            Drawing(name, f"A {name} one", "Caption.", f"What {name} shows.", {"svg": path})
        )
    header = ("policy", "rate", "count", "until", "word")
    many = tuple((f"row {place}", *[f"{place}.25"] * 12) for place in range(40))
    chapter = Chapter(
        id="made",
        title="Does it?",
        about="",
        headline="It does.",
        answer=(),
        losses=(),
        tables=(
            Table("Sorted", header, ROWS, "A note.", ours=(2, 3)),
            Table("Long", ("name", *(f"a number of {c}" for c in range(12))), many),
        ),
        figures=tuple(figures),
        plan=(Setting("seed", "0"),),
        command="python -m studies made",
    )
    return write_chapters(folder / "index.html", [chapter], command="x").as_uri()


@pytest.fixture
def page(browser, address):
    """The page, open; at its end nothing has gone wrong and nothing was asked for but itself."""
    wrong, asked = [], []
    with closing(browser.new_context(viewport={"width": 390, "height": 844})) as context:
        opened = context.new_page()
        opened.on("console", lambda said: wrong.append(said.text))
        opened.on("pageerror", lambda error: wrong.append(str(error)))
        opened.on("request", lambda request: asked.append(request.url))
        opened.goto(address)
        yield opened
    assert wrong == []
    assert [url for url in asked if not url.startswith("data:")] == [address]


def names(page):
    return [
        text.split(":")[-1].strip()
        for text in page.locator("#table-1 + .scroll tbody th").all_text_contents()
    ]


ORIGINAL = [row[0] for row in ROWS]


SORTED = {
    "policy": ["aeb", "evofsm 2", "evofsm 10", "rss-r157", "ttc"],
    "rate": ["rss-r157", "aeb", "evofsm 10", "evofsm 2", "ttc"],
    # Equal ones keep their order both ways, and where there is nothing it stays at the end.
    "count": ["aeb", "ttc", "rss-r157", "evofsm 2", "evofsm 10"],
    "until": ["evofsm 10", "evofsm 2", "rss-r157", "ttc", "aeb"],
    "word": ["ttc", "evofsm 2", "aeb", "evofsm 10", "rss-r157"],
}
DESCENDING = {
    "count": ["rss-r157", "evofsm 2", "ttc", "aeb", "evofsm 10"],
    "until": ["ttc", "rss-r157", "evofsm 2", "evofsm 10", "aeb"],
    "word": ["rss-r157", "evofsm 10", "ttc", "evofsm 2", "aeb"],
}


@pytest.mark.slow
def test_a_table_sorts_both_ways_and_back(page):
    assert names(page) == ORIGINAL
    for column, ascending in SORTED.items():
        header = page.locator("#table-1 + .scroll thead th").filter(has_text=column)
        for key, order, said in (
            ("Enter", ascending, "ascending"),
            ("Space", DESCENDING.get(column, ascending[::-1]), "descending"),
            ("Enter", ORIGINAL, None),
        ):
            header.locator("button").press(key)
            assert names(page) == order, (column, said)
            assert header.get_attribute("aria-sort") == said


def test_one_column_at_a_time_says_that_it_sorts(page):
    buttons = page.locator("#table-1 + .scroll thead button")
    buttons.nth(1).click()
    buttons.nth(2).click()
    assert page.locator("#table-1 + .scroll [aria-sort]").count() == 1


def test_the_page_is_never_wider_than_a_phone_and_a_long_table_keeps_its_header(page):
    assert page.evaluate("document.documentElement.scrollWidth") == 390
    box = page.locator("#table-2 + .scroll")
    top = (
        "e => e.querySelector('thead th').getBoundingClientRect().top - e.getBoundingClientRect().y"
    )
    before = box.evaluate(top)
    box.evaluate("e => e.scrollTo(300, 600)")
    assert box.evaluate("e => [e.scrollLeft, e.scrollTop]") == [300, 600]
    assert box.evaluate(top) == before
    left = box.evaluate("e => e.querySelector('tbody th').getBoundingClientRect().left")
    assert left >= 0


def test_a_figure_opens_large_zooms_and_closes_by_keyboard(page):
    opener = page.get_by_role("button", name="Open large: Figure 1. A wide one. What wide shows.")
    dialog = page.locator("dialog")
    width = f"{IMAGE}.width"
    opener.press("Enter")
    assert dialog.is_visible()
    assert page.locator("dialog h2").text_content() == "Figure 1. A wide one"
    page.wait_for_function(f"{width} === 390")  # all of it, as large as there is room for
    for key in ("+", "+", "ArrowRight"):
        page.keyboard.press(key)
    assert page.evaluate(width) == pytest.approx(390 * 1.4**2, abs=0.1)
    page.keyboard.press("-")
    assert page.evaluate(width) == pytest.approx(390 * 1.4, abs=0.1)
    page.keyboard.press("0")
    assert page.evaluate(width) == 390
    page.keyboard.press("Escape")
    assert not dialog.is_visible()
    assert opener.evaluate("one => one === document.activeElement")


@pytest.fixture
def opened(page):
    """The page with its second figure opened; answers where the image lies and how wide it is."""
    page.locator("figure button").nth(1).click()
    page.wait_for_function(f"{IMAGE}.width > 0")
    return lambda: page.evaluate(f"[{IMAGE}.left, {IMAGE}.top, {IMAGE}.width]")


def test_the_wheel_zooms_where_the_pointer_is_and_dragging_moves(page, opened):
    left, _, width = opened()
    page.mouse.move(left + width / 4, 400)
    page.mouse.wheel(0, -800)
    page.wait_for_function(f"{IMAGE}.width > {4 * width}")
    zoomed, top, large = opened()
    assert (left + width / 4 - zoomed) / large == pytest.approx(1 / 4, abs=0.01)
    page.mouse.down()
    page.mouse.move(left + width / 4 - 40, 380)
    page.mouse.up()
    assert opened() == pytest.approx([zoomed - 40, top - 20, large], abs=0.5)
    page.locator("dialog").get_by_role("button", name="Close").click()
    assert not page.locator("dialog").is_visible()


def test_two_fingers_zoom(page, opened):
    _, _, width = opened()
    touch = page.context.new_cdp_session(page)

    def fingers(kind, *places):
        points = [{"x": x, "y": 400, "id": finger} for finger, x in enumerate(places)]
        touch.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})

    fingers("touchStart", 180, 210)
    fingers("touchMove", 165, 225)
    fingers("touchEnd")
    assert opened()[2] == pytest.approx(2 * width, rel=0.01)


def test_without_a_script_it_is_a_plain_page(browser, address):
    with closing(browser.new_context(java_script_enabled=False)) as context:
        page = context.new_page()
        page.goto(address)
        assert page.locator("button").count() == 0
        assert page.locator("figure .card > img").count() == 2
        assert names(page) == ORIGINAL
