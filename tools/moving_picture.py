"""Film the live page: the same case with the reviser off, then on; for the README.

    .venv/bin/python tools/moving_picture.py            # writes docs/images/watch.gif

It opens the page in Chromium (`playwright`, as the tests of the page do) and keeps a picture for
every so many seconds of the run. Given is what is filmed, as `evofsm watch` takes it.
"""

import argparse
import subprocess
import sys
from io import BytesIO
from pathlib import Path

from PIL import Image
from playwright.sync_api import Page, expect, sync_playwright

ROOT = Path(__file__).parents[1]
WIDTH, HEIGHT = 840, 620
COLOURS = 40
SHOWN, HELD = 110, 2200  # each picture, and how each run ended [ms]


def film(page: Page, every: float) -> list[Image.Image]:
    """A run from its start to its end."""
    page.keyboard.press("n")
    expect(page.locator("#mode")).to_have_text("live")
    kept: list[Image.Image] = []
    due, over = 0.0, False
    while not over:
        over = page.locator("#status").get_attribute("data-status") in ("failure", "ended")
        now = float(page.locator("#time").inner_text().split()[0])
        if (now >= due and (kept or now < every)) or over:
            kept.append(Image.open(BytesIO(page.screenshot())).convert("RGB"))
            due = now + every
    return kept


def main() -> None:
    """Film both runs, one after the other."""
    given = argparse.ArgumentParser(description=__doc__)
    given.add_argument("what", nargs="*", default=[str(ROOT / "examples/watched_disc.py")])
    given.add_argument("--speed", default="0.25", help="of the page while it is filmed")
    given.add_argument("--every", type=float, default=0.1, help="between two pictures [s]")
    given.add_argument("--out", type=Path, default=ROOT / "docs/images/watch.gif")
    asked = given.parse_args()
    command = [sys.executable, "-m", "evofsm", "watch", *asked.what, "--no-browser"]
    served = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert served.stdout is not None
    with served, sync_playwright() as play:
        served.stdout.readline()
        address = served.stdout.readline().strip()
        browser = play.chromium.launch(executable_path="/usr/bin/chromium", args=["--no-sandbox"])
        page = browser.new_page(viewport={"width": WIDTH, "height": HEIGHT}, color_scheme="light")
        page.goto(address)
        page.locator("#speed").select_option(asked.speed)
        runs = []
        for _ in range(2):
            page.keyboard.press("r")  # off, and then on
            runs.append(film(page, asked.every))
        browser.close()
        served.terminate()
    pictures = [picture for run in runs for picture in run]
    lasts = [SHOWN if picture is not run[-1] else HELD for run in runs for picture in run]
    # One palette for all, of the ends of both runs; no dithering, so that little changes.
    both = Image.new("RGB", (2 * WIDTH, HEIGHT))
    for k, run in enumerate(runs):
        both.paste(run[-1], (k * WIDTH, 0))
    palette = both.quantize(COLOURS, dither=Image.Dither.NONE)
    few = [one.quantize(palette=palette, dither=Image.Dither.NONE) for one in pictures]
    few[0].save(asked.out, save_all=True, append_images=few[1:], duration=lasts, loop=0)
    size = asked.out.stat().st_size / 1e6
    print(f"{asked.out}: {len(few)} pictures, {sum(lasts) / 1e3:.1f} s, {size:.2f} MB")


if __name__ == "__main__":
    main()
