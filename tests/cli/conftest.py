"""What tests of commands share."""

import asyncio
import queue
import threading
from contextlib import contextmanager

import pytest


@pytest.fixture(scope="session")
def evofsm():
    """Run a command as on the command line."""
    pytest.importorskip("typer")
    pytest.importorskip("rich")
    from typer.testing import CliRunner

    from evofsm.cli.app import application

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


@pytest.fixture
def shown():
    """Serve a page in a thread, and play on it; settings are those of `Player`."""
    pytest.importorskip("websockets")
    from evofsm.cli.watch.player import Player
    from evofsm.cli.watch.server import LivePage

    @contextmanager
    def show(opened, port=0, **settings):
        served = queue.Queue()

        async def serve():
            try:
                with opened() as watched:
                    async with LivePage(port) as page:
                        page.player = Player(watched, page, **settings)
                        stop = asyncio.Event()
                        playing = asyncio.create_task(page.player.play())
                        served.put((page, asyncio.get_running_loop(), stop))
                        await stop.wait()
                        playing.cancel()
            except Exception as error:
                served.put(error)

        thread = threading.Thread(target=lambda: asyncio.run(serve()))
        thread.start()
        if isinstance(found := served.get(timeout=60), Exception):
            raise found
        page, loop, stop = found
        try:
            yield page
        finally:
            loop.call_soon_threadsafe(stop.set)
            thread.join()

    return show
