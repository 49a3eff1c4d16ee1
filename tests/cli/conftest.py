"""What tests of commands share."""

import math
import random
import sys
import threading
import time
from contextlib import contextmanager, suppress
from datetime import datetime, timedelta

import polars
import pytest
from typer.testing import CliRunner

from evofsm.cli import application
from evofsm.cli.watch.server import LivePage, Player


@pytest.fixture(autouse=True)
def _in_a_folder_of_its_own(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


@pytest.fixture(scope="session")
def evofsm():
    """Run a command as on the command line."""
    return lambda *words: CliRunner().invoke(application(), [*map(str, words)])


@pytest.fixture(scope="session")
def refused(evofsm):
    """The one line in which a command refuses."""

    def refuse(*words):
        result = evofsm(*words)
        assert (result.exit_code, result.stdout) == (2, "")
        (line,) = result.stderr.splitlines()
        assert line.startswith("evofsm: ")
        return line

    return refuse


@pytest.fixture(scope="session")
def pump():
    """A log of a row every 5 s or so: now and then vibration grows until the pump trips at 7.1."""

    def make(runs=14):
        chance, rows, at = random.Random(1), [], datetime(2025, 3, 10, 6, 0, 11)
        for run in range(runs):
            slow, grows = chance.uniform(150, 250), 1.0 if run % 2 else 5.5
            for k in range(400):
                vibration = 2.8 + math.sin(k / 40) / 3 + max(0.0, k - 150) / slow * grows
                vibration += chance.gauss(0.0, 0.08)
                bearing = 60 + 4 * math.sin(k / 90) + chance.gauss(0.0, 0.2)
                status = "Störung" if vibration > 7.1 else "Betrieb"
                rows.append((at, vibration, bearing, 1480 + chance.gauss(0.0, 9.0), status))
                at += timedelta(seconds=5 + chance.uniform(-1, 1) + 40 * (chance.random() < 0.01))
                if vibration > 7.1:
                    break
            for _ in range(60):
                stands = status if status == "Störung" else "Stillstand"
                rows.append((at, 0.1, 40.0, 0.0, stands))
                at += timedelta(seconds=5 + chance.uniform(-1, 1))
        columns = "Zeit", "Schwingung, mm/s", "Lagertemperatur °C", "Drehzahl", "Status"
        return polars.DataFrame(rows, columns, orient="row")

    return make


@pytest.fixture
def shown():
    """Serve a page, and play on it in a thread, as it is set."""

    def played(player):
        with suppress(SystemExit):
            player.play()

    @contextmanager
    def show(opened, **settings):
        with opened() as watched, LivePage() as page:
            page.player = player = Player(watched, page)
            player.__dict__ |= {f"_{name}": v for name, v in ({"awaits": False} | settings).items()}
            playing = threading.Thread(target=played, args=[player])
            playing.start()
            try:
                while "known" not in page._latest:
                    time.sleep(0.01)
                yield page
            finally:
                player._watched.restart = sys.exit
                player.restart()
                playing.join()

    return show
