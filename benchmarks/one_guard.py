"""What errors, Ctrl-C and a fork amid a call do to one guard; a part of ``make torture``.

Whatever breaks a call off, the guard is as before, and the same call gives what it would have
given: two guards that learnt alike get the same calls, one of them broken off at line after line.
"""

from __future__ import annotations

import copy
import io
import itertools
import os
import threading
from collections import Counter
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from evofsm import Guard
from evofsm.driving import guard_for_cars
from evofsm.guard import SceneRisk
from one_machine import Interrupter

_DT, _STEPS = 0.1, 40
Call = Callable[[Guard], Any]


class BrokenError(Exception):
    """What somebody's code may raise, which no code of ours expects."""


# -- Guards, and what is asked of them ------------------------------------------------------------


def learnt(**told: Any) -> Guard:
    """A guard that learnt of a point on a line that fails beyond 1, amid an episode."""
    guard = Guard(**(told or {"low": -1.0, "high": 1.0}), interval=_DT, horizon=1.2)
    for episode in range(4):
        push(guard, episode)
    push(guard, 9, ends=False)
    return guard


def long() -> Guard:
    """A guard amid an episode of which the next decision begins to study the first part."""
    guard, draw = learnt(), np.random.default_rng(0)
    guard.begin()
    for k in range(1024):
        guard.decide([0.3 * np.sin(0.1 * k), 0.03 * np.cos(0.1 * k)], draw.uniform(-0.2, 1.0))
    return guard


def cars() -> Guard:
    """A guard that learnt how leaders brake, amid an episode."""
    guard = guard_for_cars(-2.5, 2.5, interval=_DT)
    for k in range(60):
        guard.decide([30.0 - 0.3 * k, 15.0, 15.0 - 0.2 * k], 1.0)
    return guard


def scenes() -> Guard:
    """A guard that learnt of one object that it meets, amid an episode."""
    guard = Guard(n_actions=3, interval=_DT, judge=SceneRisk(_DT, 3))
    for episode in range(3):
        for k in range(12):
            row = [1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 12.0 - k, 0.2 * episode, -1.0, 0.0]
            guard.decide(row, k % 3)
        if episode < 2:
            guard.end(failed=True)
    return guard


def push(guard: Guard, seed: int, steps: int = _STEPS, *, ends: bool = True) -> None:
    """Push the point to the wall."""
    draw = np.random.default_rng(seed)
    z = np.array([draw.uniform(-0.3, 0.3), 0.0])
    for _ in range(steps):
        wish = int(draw.integers(3)) if guard.judge.choices else draw.uniform(-0.2, 1.0)  # type: ignore[union-attr]
        done = guard.decide(z, wish).executed
        pushed = done - 1.0 if guard.judge.choices else done  # type: ignore[union-attr]
        z = np.array([z[0] + z[1], 0.9 * z[1] + 0.02 * pushed + 0.004 * draw.normal()])
        if z[0] >= 1.0:
            break
    if ends:
        guard.end(bool(z[0] >= 1.0), z)


MAKES: dict[str, Callable[[], Guard]] = {
    "learnt": learnt,
    "choices": partial(learnt, n_actions=3),
    "long": long,
    "cars": cars,
    "scenes": scenes,
}


def calls(guard: Guard) -> dict[str, Call]:
    """Calls by name, which follow each other."""
    here = np.array(guard.situation.observation)
    late, gone = guard.situation.time + 9.0, np.where(np.arange(len(here)) == 1, np.nan, here)
    return {
        "decide": lambda one: one.decide(here + 0.01, 1.0),
        "decide more": lambda one: one.decide(here, -0.5),
        "again": lambda one: one.decide(here + 0.01, 1.0, one.situation.time),
        "incomplete": lambda one: one.decide(gone, 1.0),
        "after a gap": lambda one: one.decide(here, 0.0, late),
        "end": lambda one: one.end(True, here + 1.0),
        "first": lambda one: one.decide(here, 1.0),
        "begin": lambda one: one.begin(),
        "end at once": lambda one: one.end(terminated=True),
        "freeze": lambda one: one.freeze(),
        "decide frozen": lambda one: one.decide(here, 1.0),
    }


# -- Broken off -----------------------------------------------------------------------------------


def harms(make: str, every: int = 1, error: type[BaseException] = BrokenError) -> Iterator[str]:
    """What an error at each line of each call does to a guard; nothing, it is hoped.

    Of the lines it takes one in ``every``; of those of an end, which has many, one in 20 times it.
    """
    guard = MAKES[make]()
    other = copy.deepcopy(guard)
    for name, call in calls(other).items():
        before = held(other)
        for line in itertools.count(1, every * (20 if name.startswith("end") else 1)):
            try:
                with Interrupter(line, error):
                    came = call(guard)
                break
            except error:
                if held(guard) != before:
                    yield f"{name}: another guard after line {line}"
                    return
                yield ""
        expected = call(other)
        if (repr(came), held(guard)) != (repr(expected), held(other)):
            yield f"{name}: another answer"
            return
        if gone_on(guard) != gone_on(other):
            yield f"{name}: it goes on otherwise"
            return


def held(guard: Guard) -> object:
    """What a guard holds, but for what an episode under way has of its own."""
    guard.save(file := io.BytesIO())
    return file.getvalue(), guard.n_episodes, guard._begun, guard._decisions, guard._under_way


def gone_on(guard: Guard) -> object:
    """What a copy of a guard decides from there on, and what it has learnt then."""
    twin = copy.deepcopy(guard, {id(guard.audit): None})
    z = np.zeros(twin.machine.n_variables) + 0.1  # type: ignore[union-attr]
    said = [repr(twin.decide(z * k, 1.0)) for k in range(3)]
    twin.end(False, z)
    return said, held(twin)


def interrupts(_folder: Path, _random: np.random.Generator, *, every: int = 1) -> Counter[str]:
    """Errors and interrupts at so many of the lines of all that may be asked of a guard."""
    found: Counter[str] = Counter()
    for make, error in itertools.product(MAKES, (BrokenError, KeyboardInterrupt)):
        for harm in harms(make, every, error):
            found["broken calls"] += 1
            found["results that differ"] += bool(harm)
            if harm:
                print(f"{make}, {harm}", flush=True)
    return found


# -- Forked ---------------------------------------------------------------------------------------


def forked(times: int, _folder: Path, random: np.random.Generator) -> Counter[str]:
    """Fork while another thread is amid a call; the child's guard goes on from before it."""
    found: Counter[str] = Counter()
    guard, over = learnt(), threading.Event()

    def work() -> None:
        for episode in itertools.count(20):
            push(guard, episode)
            if over.is_set():
                return

    thread = threading.Thread(target=work)
    thread.start()
    for _ in range(times):
        over.wait(random.uniform(0.0, 0.05))
        found["forks"] += 1
        if (child := os.fork()) == 0:
            code = 1
            try:
                os._exit(int(not _is_usable(guard)))
            finally:
                os._exit(code)
        found["crashes"] += os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) != 0
    over.set()
    thread.join()
    return found


def _is_usable(guard: Guard) -> bool:
    """Whether it goes on, and what it saves loads."""
    n, known = guard.n_episodes, guard.judge.state.n_failed  # type: ignore[union-attr]
    guard.end(True, [1.1, 0.1])
    push(guard, 5)
    guard.save(file := io.BytesIO())
    again = Guard.load(io.BytesIO(file.getvalue()))
    return again.n_episodes == n + 2 and guard.judge.state.n_failed >= known + 1  # type: ignore[union-attr]
