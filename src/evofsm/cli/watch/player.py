"""The clock of a run that is watched: pause, step, speed, restart; in a thread of its own."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Any, NamedTuple, Protocol, Self

from evofsm.cli.watch.shown import Frame, Graph, Start

#: Speeds that can be chosen, as multiples of real time.
SPEEDS = (0.25, 0.5, 1.0, 2.0, 4.0, 8.0)

# Between two graphs, unless a state was created [decisions].
_GRAPH_EVERY = 8
# Who is late by more does not hurry to make up for it [s].
_LATE = 0.1


class Watched(Protocol):
    """Anything that can be watched: a session, or a run that was recorded."""

    start: Start  #: what is known as the run begins
    revising: bool  #: whether the reviser may act

    def restart(self, case: int | None = None) -> object:
        """Begin anew, or another case."""

    def step(self) -> Frame:
        """The next frame."""

    def graph(self) -> Graph:
        """The states at the latest frame."""


class Clock(NamedTuple):
    """How the run is being played."""

    paused: bool
    speed: float  #: multiple of real time; infinite for as fast as it goes
    revising: bool
    over: bool


class Player:
    """Plays what is watched at a pace, and does as it is told while it plays.

    What it is told is carried out before the next decision; telling never waits. What cannot be
    opened raises its error where the player is entered. ``audience``, which must not wait, is told
    what happens: "start" with a `Start`, "frame" with a `Frame`, "graph" with a `Graph`, "clock"
    with a `Clock`, and "failed" with why it broke off.
    """

    def __init__(
        self,
        watched: Callable[[], AbstractContextManager[Watched]],
        audience: Callable[[str, Any], object],
        *,
        paused: bool = False,
        speed: float = 1.0,
        awaits: bool = False,
    ) -> None:
        self._watched = watched
        self._audience = audience
        self._awaits = awaits
        self._paused = paused
        self._speed = speed
        self._over = False
        self._steps: float = 0  # to be taken although paused
        self._due = 0.0  # when the next frame is [s]
        self._since = 0  # frames since the latest graph
        self._told = threading.Condition()
        self._orders: dict[str, Callable[[Watched], object]] = {}  # the latest of each kind
        self._closed = False
        self._opened = threading.Event()
        self._refused: Exception | None = None  # why it could not be opened
        self._thread = threading.Thread(target=self._play, name="evofsm-player", daemon=True)

    # -- Told from any thread ---------------------------------------------------------------------

    def attend(self) -> None:
        """Someone looks on: play, if that was waited for."""
        if self._awaits:
            self._tell("attend", lambda watched: self._set(awaits=False))

    def pause(self, paused: bool) -> None:
        """Wait, or go on."""
        self._tell("pause", lambda watched: self._set(paused=paused))

    def step(self) -> None:
        """One decision, then wait."""
        self._tell("step", lambda watched: self._set(paused=True, steps=1))

    def speed(self, speed: float) -> None:
        """Play so many times as fast as real time."""
        self._tell("speed", lambda watched: self._set(speed=speed))

    def revise(self, on: bool) -> None:
        """Switch the reviser on or off."""
        self._tell("revise", lambda watched: setattr(watched, "revising", on))

    def restart(self, case: int | None = None) -> None:
        """Begin anew, or another case; and go on if it waited."""

        def order(watched: Watched) -> None:
            watched.restart(case)
            self._paused = False
            self._begin(watched)

        self._tell("restart", order)

    def _set(self, **changes: bool | float) -> None:
        for name, value in changes.items():
            setattr(self, f"_{name}", value)
        self._due = time.monotonic()

    def _tell(self, kind: str, order: Callable[[Watched], object]) -> None:
        with self._told:
            self._orders.pop(kind, None)  # what was told last comes last
            self._orders[kind] = order
            self._told.notify()

    # -- In its own thread ------------------------------------------------------------------------

    def __enter__(self) -> Self:
        self._thread.start()
        self._opened.wait()
        if self._refused is not None:
            self._thread.join()
            raise self._refused
        return self

    def __exit__(self, *error: object) -> None:
        with self._told:
            self._closed = True
            self._told.notify()
        self._thread.join()

    def _play(self) -> None:
        try:
            with self._watched() as watched:
                self._begin(watched)
                self._opened.set()
                while self._is_due(watched):
                    self._show(watched, watched.step())
        except Exception as error:
            if not self._opened.is_set():
                self._refused = error
                self._opened.set()
            # Whoever looks on must learn why nothing moves any more.
            self._audience("failed", f"{type(error).__name__}: {error}")

    def _begin(self, watched: Watched) -> None:
        self._over, self._due = False, time.monotonic()
        self._audience("start", watched.start)
        self._audience("clock", self._clock(watched))
        self._audience("graph", watched.graph())

    def _is_due(self, watched: Watched) -> bool:
        """Wait for the next frame, and do meanwhile what was told; False once closed."""
        while True:
            with self._told:
                while not (self._orders or self._closed or (wait := self._wait()) <= 0.0):
                    self._told.wait(None if math.isinf(wait) else wait)
                if self._closed:
                    return False
                orders, self._orders = self._orders, {}
            if not orders:
                break
            for order in orders.values():
                order(watched)
            self._audience("clock", self._clock(watched))
        self._steps = 0
        # What came late is not made up for.
        self._due = max(self._due, time.monotonic() - _LATE) + watched.start.interval / self._speed
        return True

    def _wait(self) -> float:
        """Time until the next frame [s]; infinite where none comes by itself."""
        if self._over or self._awaits:
            return math.inf
        if self._paused:
            return 0.0 if self._steps else math.inf
        return self._due - time.monotonic()

    def _show(self, watched: Watched, frame: Frame) -> None:
        self._audience("frame", frame)
        self._since += 1
        if frame.event == "created" or frame.over or self._since >= _GRAPH_EVERY:
            self._audience("graph", watched.graph())
            self._since = 0
        if frame.over:
            self._over = True
            self._audience("clock", self._clock(watched))

    def _clock(self, watched: Watched) -> Clock:
        return Clock(self._paused, self._speed, watched.revising, self._over)
