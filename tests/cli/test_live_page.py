"""The live page in a browser: what someone who looks on sees, and can do."""

import math
import re
import time
from contextlib import ExitStack, contextmanager

import pytest

pytest.importorskip("websockets")
pytest.importorskip("playwright.sync_api")

from playwright import sync_api as playwright

from evofsm.cli.watch.session import Session, learn_first, watched_guard
from evofsm.driving import KinematicWorld, load_family

PAPER = load_family("paper")

pytestmark = pytest.mark.usefixtures("compiled")


@pytest.fixture
def seen(browser, shown):
    """Opens the page on a run; it must not complain, nor ask anyone else for anything."""
    wrong = []

    @contextmanager
    def session():
        guard = watched_guard(PAPER)
        learn_first(guard, PAPER, 6)
        with Session(PAPER, guard, KinematicWorld()) as opened:
            yield opened

    with ExitStack() as stack:

        def see(width=1280, height=800, **settings):
            live = stack.enter_context(shown(session, **settings))
            context = browser.new_context(viewport={"width": width, "height": height})
            stack.callback(context.close)
            page = context.new_page()
            page.set_default_timeout(60_000)

            def asked(url):
                if live.token not in url and not url.startswith("data:"):
                    wrong.append(url)

            page.on("console", lambda message: wrong.append(message.text))
            page.on("pageerror", lambda error: wrong.append(str(error)))
            page.on("request", lambda request: asked(request.url))
            page.on("websocket", lambda opened: asked(opened.url))
            page.goto(live.address)
            return page

        yield see
    assert wrong == []


def text(page, name):
    return page.locator(f"#{name}").text_content()


def shows(page, name, words):
    playwright.expect(page.locator(f"#{name}")).to_contain_text(words, timeout=60_000)


def time_shown(page):
    return float(text(page, "time").split()[0])


@pytest.mark.slow
def test_the_cars_move_smoothly_and_can_be_stopped(seen):
    page = seen(speed=2.0)
    shows(page, "mode", "live")
    shows(page, "time", "1.")
    road = page.locator("#road-canvas")
    before = road.get_attribute("aria-label")
    times, end = set(), time.monotonic() + 1.5
    while time.monotonic() < end:
        times.add(text(page, "time"))
    # Two seconds of the run and more have eight decisions, and many pictures between them.
    assert len(times) > 12
    assert road.get_attribute("aria-label") != before
    page.keyboard.press(" ")
    shows(page, "mode", "paused")
    page.wait_for_timeout(250)
    stopped = time_shown(page)
    page.wait_for_timeout(250)
    assert time_shown(page) == stopped
    page.keyboard.press("ArrowRight")  # one decision
    page.wait_for_timeout(400)
    assert time_shown(page) == pytest.approx(stopped + 0.25, abs=0.11)
    page.keyboard.press("+")
    playwright.expect(page.locator("#speed")).to_have_value("4")


@pytest.mark.slow
def test_switched_on_the_reviser_prevents_the_collision_that_happens_with_it_off(seen):
    page = seen(speed=math.inf)
    shows(page, "headline", "No collision")
    began = re.search(r"Danger began at (\d+\.\d)", text(page, "when"))
    assert began
    assert "would have hit the leader" in text(page, "alone")
    assert "The reviser stepped in" in text(page, "done")

    page.keyboard.press("r")
    shows(page, "reviser-state", "off")
    page.keyboard.press("n")
    shows(page, "headline", "Collision")
    assert "Collision at 31.4" in text(page, "outcome")
    assert began[0] in text(page, "when")
    assert "the reviser is off" in text(page, "done")
    assert re.search(r"did at 30\.\d.s, 2\d\.\d.s after", text(page, "others"))

    page.locator("#reviser").click()
    page.locator("#pause").click()  # again
    shows(page, "headline", "No collision")


@pytest.mark.slow
def test_the_past_can_be_looked_at_and_left(seen):
    page = seen(speed=math.inf)
    shows(page, "headline", "No collision")
    end = time_shown(page)
    page.keyboard.press("Home")
    shows(page, "mode", "past")
    shows(page, "when", "No danger so far.")
    assert time_shown(page) == 0.0
    for _ in range(3):
        page.keyboard.press("Shift+ArrowRight")
    shows(page, "time", "7.5 s")
    assert "Danger began" in text(page, "when")
    page.keyboard.press("ArrowLeft")
    playwright.expect(page.locator("#time")).to_have_text(re.compile(r"^7\.[23] s"))
    plots = page.locator("#plots-canvas").bounding_box()
    page.mouse.click(plots["x"] + 0.5 * plots["width"], plots["y"] + 150)
    playwright.expect(page.locator("#time")).to_have_text(re.compile(r"^[12]\d\.\d s"))
    page.get_by_role("button", name="back to now").click()
    shows(page, "time", f"{end:.1f}")
    assert text(page, "mode").strip() == "ended"


@pytest.mark.slow
def test_states_and_help_are_shown_and_the_theme_changes(seen):
    page = seen(speed=math.inf)
    shows(page, "headline", "No collision")
    assert page.locator("#belief li").first.text_content().startswith("#")
    assert "states; now in number" in page.locator("#map-canvas").get_attribute("aria-label")
    root = page.locator("html")
    page.keyboard.press("t")
    playwright.expect(root).to_have_class("dark")
    page.keyboard.press("?")
    playwright.expect(page.get_by_role("dialog")).to_be_visible()
    page.keyboard.press("Escape")
    playwright.expect(page.get_by_role("dialog")).to_be_hidden()
    page.locator("#case").select_option("case 4")
    shows(page, "about", "case 4")


@pytest.mark.slow
@pytest.mark.parametrize(("width", "height"), [(1280, 720), (1366, 768), (1100, 800)])
def test_the_longest_story_is_shown_to_its_end(seen, width, height):
    """No column hides words below its edge, whether the reviser acts or not."""
    page = seen(width, height, speed=math.inf)
    shows(page, "headline", "No collision")
    story = page.locator("#story")
    hidden = "one => one.scrollHeight - one.clientHeight"
    assert story.evaluate(hidden) <= 0
    page.keyboard.press("r")
    shows(page, "reviser-state", "off")
    page.keyboard.press("n")
    shows(page, "headline", "Collision")
    assert story.evaluate(hidden) <= 0
    for _ in range(5):
        page.keyboard.press("Shift+ArrowLeft")
    shows(page, "headline", "Dead end, if the leader brakes hard now")
    assert story.evaluate(hidden) <= 0


@pytest.mark.slow
def test_on_a_phone_nothing_is_wider_than_the_screen(seen):
    page = seen(390, 844, speed=math.inf)
    shows(page, "headline", "No collision")
    assert page.evaluate("() => document.documentElement.scrollWidth") <= 390
    for name in ("road-canvas", "headline", "pause", "reviser"):
        playwright.expect(page.locator(f"#{name}")).to_be_in_viewport()
