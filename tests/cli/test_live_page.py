"""The live page in a browser: what someone who looks on sees, and can do."""

import math
import re
import threading
import time
from contextlib import ExitStack, closing
from pathlib import Path

import pytest
from playwright import sync_api as playwright
from typer.testing import CliRunner

from evofsm import Guard
from evofsm.cli import application
from evofsm.cli.options import reading_of
from evofsm.cli.watch.session import OnRoads, Session, learn_first, read_simulated, watched_log
from evofsm.driving import KinematicWorld, load_family

DISC = str(Path(__file__).parents[2] / "examples/watched_disc.py")
# Notes where each canvas has words, until it is wiped; answers which of them touch.
NOTED = """
const words = new Map();
const { fillText, clearRect } = CanvasRenderingContext2D.prototype;
CanvasRenderingContext2D.prototype.clearRect = function (...box) {
  words.set(this.canvas.id, []);
  clearRect.apply(this, box);
};
CanvasRenderingContext2D.prototype.fillText = function (text, x, y) {
  const wide = this.measureText(text).width, high = parseFloat(this.font.match(/([0-9.]+)px/)[1]);
  const left = x - { left: 0, center: wide / 2, right: wide }[this.textAlign];
  const [top, bottom] = [y - 0.38 * high, y + 0.38 * high];
  words.get(this.canvas.id)?.push({ text, left, right: left + wide, top, bottom });
  fillText.call(this, text, x, y);
};
window.touching = () => [...words].flatMap(([id, all]) => all.flatMap((a, k) => all.slice(k + 1)
  .filter((b) => a.left < b.right && b.left < a.right && a.top < b.bottom && b.top < a.bottom)
  .map((b) => `${id}: ${a.text} / ${b.text}`)));
"""
SCALES = "[...document.querySelectorAll('canvas')].map((one) => one.height - one.clientHeight)"

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("compiled")]


def cars():
    roads = OnRoads(load_family("paper"), KinematicWorld())
    learn_first(roads, 6)
    return Session(roads)


def environment(what):
    def session():
        system = read_simulated(what)
        learn_first(system, 12)
        return Session(system)

    return session


def logged():
    """A machine that heats up until it trips, now and then."""
    times = [(run, k, f"2026-03-0{run + 1} 06:{k:02}:00") for run in range(8) for k in range(60)]
    rows = [(run, time, 20 + k * (run % 2), math.sin(k)) for run, k, time in times]
    lines = ["run,t,a variable of a long name,load", *(",".join(map(str, r)) for r in rows)]
    Path("log.csv").write_text("\n".join(lines))
    read = {"observe": "a variable of a long name,load", "action": "", "time": "t"}
    read["failed"] = '"a variable of a long name">78'
    words = [word for name, value in read.items() for word in (f"--{name}", value)]
    learn = ["learn", "log.csv", *words, "--guard", "guard"]
    assert CliRunner().invoke(application(), learn).exit_code == 0
    return watched_log("log.csv", reading_of(**read), guard=Guard.load("guard"))


@pytest.fixture
def seen(browser, shown):
    """Opens the page on a run; it must not complain, nor ask anyone else for anything."""
    wrong = []

    with ExitStack() as stack:

        def see(width=1280, height=800, session=cars, **settings):
            live = stack.enter_context(shown(session, **settings))
            context = browser.new_context(viewport={"width": width, "height": height})
            stack.callback(context.close)
            page = context.new_page()
            page.add_init_script(NOTED)
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


def test_switched_on_the_reviser_prevents_the_collision_that_happens_with_it_off(seen):
    page = seen(speed=math.inf)
    shows(page, "headline", "No collision")
    began = re.search(r"Danger began at (\d+\.\d)", text(page, "when"))
    assert began
    assert "would have failed" in text(page, "alone")  # which is folded
    assert "The reviser stepped in" in text(page, "done")

    page.keyboard.press("r")
    shows(page, "reviser-state", "off")
    page.keyboard.press("n")
    shows(page, "headline", "Collision")
    assert "Collision at 31.4" in text(page, "outcome")
    assert began[0] in text(page, "when")
    assert "the reviser is off" in text(page, "done")

    page.locator("#reviser").click()
    page.locator("#pause").click()  # again
    shows(page, "headline", "No collision")


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


def test_where_nothing_comes_any_more_nothing_is_called_safe(seen):
    goes, session = threading.Event(), cars()
    step = session.step
    session.step = lambda: goes.wait(60) and step()
    goes.set()
    page = seen(session=lambda: session)
    shows(page, "headline", "No danger known")
    page.evaluate("at = performance.now(); performance.now = () => at - 1e4")  # it waits for 10 s
    goes.clear()
    shows(page, "lost", "No decision comes")
    shows(page, "headline", "Not watched now")
    page.keyboard.press("Home")
    shows(page, "headline", "No danger known")  # which it was then
    session.step = lambda: 1 / 0
    goes.set()
    page.keyboard.press("l")
    shows(page, "lost", "The run broke off: ZeroDivisionError")
    playwright.expect(page.locator("#status")).to_have_attribute("data-status", "unjudged")
    page.evaluate("delete performance.now")
    session.step = step
    page.get_by_role("button", name="Again").click()
    shows(page, "headline", "No danger known")


def test_a_page_whose_socket_is_refused_says_so(browser, shown, monkeypatch):
    monkeypatch.setattr("evofsm.cli.watch.server._OWN_PAGE", re.compile("none"))
    with shown(cars, paused=True) as live, closing(browser.new_page()) as page:
        page.goto(live.address)
        shows(page, "lost", "No connection to evofsm: it has ended, or refuses this address.")
        assert (text(page, "headline"), text(page, "mode")) == ("Not watched now", "lost")
        monkeypatch.undo()
        shows(page, "headline", "Waiting for the run")


def test_states_and_help_are_shown_and_the_theme_changes(seen):
    page = seen(speed=math.inf)
    shows(page, "headline", "No collision")
    assert "states; now in number" in page.locator("#map-canvas").get_attribute("aria-label")
    page.keyboard.press("t")
    playwright.expect(page.locator("html")).to_have_class("dark")
    page.keyboard.press("?")
    playwright.expect(page.get_by_role("dialog")).to_be_visible()
    page.keyboard.press("Escape")
    playwright.expect(page.get_by_role("dialog")).to_be_hidden()
    page.locator("#case").select_option("case 4")
    shows(page, "about", "case 4")


@pytest.mark.parametrize("session", [cars, environment("CartPole-v1"), environment(DISC), logged])
def test_words_never_touch_and_nothing_is_larger_than_the_screen(seen, session):
    page = seen(session=session, speed=math.inf)
    status = page.locator("#status")
    for width, height in ((1280, 800), (900, 700), (360, 800)):
        page.set_viewport_size({"width": width, "height": height})
        page.reload()
        playwright.expect(status).to_have_attribute(
            "data-status", re.compile("ended|failure"), timeout=60_000
        )
        page.wait_for_timeout(300)
        assert page.evaluate("touching()") == []
        assert page.evaluate("document.documentElement.scrollWidth") <= width
        assert width < 1280 or page.evaluate("document.documentElement.scrollHeight") <= height
        for name in ("headline", "pause", *(["reviser"] * (session is not logged))):
            playwright.expect(page.locator(f"#{name}")).to_be_in_viewport()
        for fold in page.locator("summary").all():
            fold.click()
        playwright.expect(page.locator("#decision")).not_to_be_empty()
        assert page.evaluate("document.documentElement.scrollWidth") <= width
        page.wait_for_timeout(300)  # drawings keep their scale where folds take their room
        assert {*page.evaluate(SCALES)} <= {0, 150}  # which is that of a canvas that is not drawn
