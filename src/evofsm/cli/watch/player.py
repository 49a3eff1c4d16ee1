"""The clock of a run that is watched: pause, step, speed, restart; in the page's own loop."""

from __future__ import annotations

import asyncio
import math
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any, NamedTuple

from evofsm.cli.watch.session import Session
from evofsm.cli.watch.shown import Frame

# Between two graphs, unless a state was created [decisions].
_GRAPH_EVERY = 8
# Decisions in a second that can be followed.
_FOLLOWED = 12.5
# Who is late by more does not hurry to make up for it [s].
_LATE = 0.1


class Clock(NamedTuple):
    """How the run is being played."""

    paused: bool
    speed: float  #: multiple of real time; infinite for as fast as it goes
    revising: bool
    over: bool


class Player:
    """Plays what is watched at a pace, and does as it is told before the next decision.

    ``audience`` is told what happens: "start" with a `Start`, "frame" with a `Frame`, "graph" with
    a `Graph`, "known" with what is `Known`, "clock" with a `Clock`, and "failed" with why it broke
    off. It waits until someone attends.
    """

    def __init__(self, watched: Session, audience: Callable[[str, Any], object]) -> None:
        # Real time, but no more decisions in a second than can be followed.
        speeds, pace = watched.start.speeds, _FOLLOWED * watched.start.interval
        pace = min(1.0, pace) if 1.0 in speeds else pace
        self._speed = max((rate for rate in speeds if rate <= pace), default=speeds[0])
        self._watched, self._audience, self._awaits = watched, audience, True
        self._paused = self._over = False
        self._steps = False  # once, although it is paused
        self._due = 0.0  # when the next frame is [s]
        self._since = self._states = 0  # frames since the latest graph, and its states
        self._order: Callable[[], object] | None = None  # of what may take time, the latest
        self._news = asyncio.Event()

    def attend(self) -> None:
        """Someone looks on: play, if that was waited for."""
        if self._awaits:
            self.set(awaits=False)

    def set(self, **changes: bool | float) -> None:
        """Play on otherwise: ``paused``, or at a ``speed``; with ``steps`` once, though paused."""
        for name, value in changes.items():
            setattr(self, f"_{name}", value)
        self._due = time.monotonic()
        self._audience("clock", self._clock())
        self._news.set()

    def revise(self, on: bool) -> None:
        """Switch the reviser on or off."""
        self._watched.revising = on
        self.set()

    def restart(self, case: int | None = None) -> None:
        """Begin anew, or another case; and go on if it waited."""
        self._order = lambda: self._watched.restart(case)
        self._news.set()

    async def play(self) -> None:
        """Play until it is cancelled, or breaks off."""
        try:
            self._begin()
            while True:
                await self._wait()
                if self._order is not None:
                    order, self._order = self._order, None
                    order()
                    self._paused = False
                    self._begin()
                elif self._patience() <= 0.0:
                    self._steps = False
                    interval = self._watched.start.interval / self._speed
                    # What came late is not made up for.
                    self._due = max(self._due, time.monotonic() - _LATE) + interval
                    frame = self._watched.step()
                    if frame.time < self._watched.start.begins:
                        self._due = time.monotonic()
                    self._show(frame)
        except Exception as error:
            # Whoever looks on must learn why nothing moves any more.
            self._audience("failed", f"{type(error).__name__}: {error}")

    async def _wait(self) -> None:
        """Until the next frame, or until something was told; others have their turn."""
        wait = max(0.0, self._patience())
        with suppress(TimeoutError):
            await asyncio.wait_for(self._news.wait(), None if math.isinf(wait) else wait)
        self._news.clear()

    def _patience(self) -> float:
        """Time until the next frame [s]; infinite where none comes by itself."""
        if self._over or self._awaits or (self._paused and not self._steps):
            return math.inf
        return 0.0 if self._paused else self._due - time.monotonic()

    def _begin(self) -> None:
        self._over, self._due = False, time.monotonic()
        self._audience("start", self._watched.start)
        self._audience("clock", self._clock())
        self._draw()
        self._audience("known", self._watched.known())

    def _draw(self) -> None:
        graph = self._watched.graph()
        self._audience("graph", graph)
        self._since, self._states = 0, len(graph.states)

    def _show(self, frame: Frame) -> None:
        self._audience("frame", frame)
        self._since += 1
        is_new = frame.state is not None and frame.state >= self._states
        if is_new or frame.over or self._since >= _GRAPH_EVERY:
            self._draw()
        if frame.over:
            self._over = True
            self._audience("known", self._watched.known())
            self._audience("clock", self._clock())

    def _clock(self) -> Clock:
        return Clock(self._paused, self._speed, self._watched.revising, self._over)
