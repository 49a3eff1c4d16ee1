"""What threads and Ctrl-C do to one machine; a part of ``make torture``."""

from __future__ import annotations

import io
import itertools
import linecache
import os
import sys
import threading
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from types import FrameType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

import evofsm
from evofsm.fsm.machine import EvolvingFSM
from evofsm.fsm.rules import Novelty

_PACKAGE = str(Path(evofsm.__file__).parent)
_ACTIONS, _VARIABLES = 3, 2
# So short that threads change places amid growth [s].
_INTERVAL = 1e-6

Observations = NDArray[np.float64]


def saved(machine: EvolvingFSM) -> bytes:
    """All that a machine holds."""
    file = io.BytesIO()
    machine.save(file)
    return file.getvalue()


def spread_out(rows: int, seed: int = 0) -> Observations:
    """Observations most of which create a state by `growing`'s rule, so that it grows often."""
    return np.random.default_rng(seed).uniform(-50.0, 50.0, (rows, _VARIABLES))


def growing() -> EvolvingFSM:
    """A machine with nothing in it yet."""
    return EvolvingFSM(_ACTIONS, rule=Novelty(radius=1.0))


def compile_all() -> None:
    """Call all that `share` calls once: threads would slow the compiler."""
    machine, z = growing(), np.zeros(_VARIABLES)
    machine.learn_one(z, 0)
    machine.observe(z, failed=True)
    machine.learn_many([z], [0])
    machine.model()
    EvolvingFSM.load(io.BytesIO(saved(machine)))


# -- Threads --------------------------------------------------------------------------------------


def share(machine: EvolvingFSM, threads: int, rows: int, interval: float, seed: int = 0) -> int:
    """Let threads learn with one machine, and one more look at it; returns observations lost."""
    waiting, over = threading.Barrier(threads + 1), threading.Event()
    errors: list[BaseException] = []

    def learn(which: int) -> None:
        waiting.wait()
        for k, z in enumerate(spread_out(rows, seed + which)):
            match k % 3:
                case 0:
                    machine.learn_one(z, k % _ACTIONS)
                case 1:
                    machine.observe(z, failed=k % 6 == 1)
                case _:
                    machine.learn_many([z], [k % _ACTIONS])

    def look() -> None:
        waiting.wait()
        while not over.is_set():
            machine.model()  # whose parts must be of one moment, or it refuses them
            EvolvingFSM.load(io.BytesIO(saved(machine)))
            twin = machine.copy()
            assert np.isclose(twin.belief.sum(), float(twin.n_states > 0))

    def guarded(work: Callable[[], None]) -> None:
        try:
            work()
        except BaseException as error:
            errors.append(error)

    learners = [
        threading.Thread(target=guarded, args=[partial(learn, which)]) for which in range(threads)
    ]
    looker = threading.Thread(target=guarded, args=[look])
    before = sys.getswitchinterval()
    sys.setswitchinterval(interval)
    try:
        for thread in (*learners, looker):
            thread.start()
        for thread in learners:
            thread.join()
        over.set()
        looker.join()
    finally:
        sys.setswitchinterval(before)
    if errors:
        raise errors[0]
    return threads * rows - int(machine.visits.sum())


def threads(times: int, _folder: Path, random: np.random.Generator) -> Counter[str]:
    """Four threads on a machine, each time in a process of its own, for that may be destroyed."""
    found: Counter[str] = Counter()
    compile_all()
    for _ in range(times):
        seed = int(random.integers(1 << 31))
        found["shared machines"] += 1
        if (child := os.fork()) == 0:
            try:
                os._exit(int(share(growing(), 4, 100, _INTERVAL, seed) != 0))
            finally:
                os._exit(2)
        _, status = os.waitpid(child, 0)
        code = os.waitstatus_to_exitcode(status)
        found["lost observations"] += code == 1
        found["crashes"] += code not in (0, 1)
    return found


# -- Interrupts -----------------------------------------------------------------------------------


class Interrupter:
    """Raises KeyboardInterrupt at one line of the package, the ``line``-th that is come to."""

    def __init__(self, line: int, error: type[BaseException] = KeyboardInterrupt) -> None:
        self.left, self._error = line, error
        self._entered: set[tuple[FrameType, int]] = set()

    def __enter__(self) -> Interrupter:
        self._before = sys.gettrace()
        sys.settrace(self._call)
        return self

    def __exit__(self, *_: object) -> None:
        sys.settrace(self._before)
        self._entered.clear()

    def _call(self, frame: FrameType, event: str, arg: Any) -> Any:
        return self._line if frame.f_code.co_filename.startswith(_PACKAGE) else None

    def _line(self, frame: FrameType, event: str, arg: Any) -> Any:
        if event == "line" and not self._leaves_with(frame):
            self.left -= 1
            if self.left == 0:
                raise self._error
        return self._line

    def _leaves_with(self, frame: FrameType) -> bool:
        """Whether it is at the line of a ``with`` again to leave it.

        Python handles no signal there until that is done, but it lets a tracer raise.
        """
        text = linecache.getline(frame.f_code.co_filename, frame.f_lineno)
        if not text.lstrip().startswith("with "):
            return False
        here = (frame, frame.f_lineno)
        if here in self._entered:
            return True
        self._entered.add(here)
        return False


Work = Callable[[EvolvingFSM], object]


class Deed(NamedTuple):
    """Something that may be done to a machine, as a whole or, bit for bit alike, in parts."""

    start: Callable[[], EvolvingFSM]
    do: Work
    parts: Sequence[Work]


def at_once(start: Callable[[], EvolvingFSM], do: Work) -> Deed:
    """A deed that is done as a whole or not at all."""
    return Deed(start, do, [do])


def full() -> EvolvingFSM:
    """A machine amid an episode that has no room for another state, nor for its pending action."""
    machine = growing()
    machine.learn_many([[3.0 * k, 0.0] for k in range(8)], [0] * 8)
    machine.act(1)
    return machine


_NEXT = np.array([-9.0, 4.0])
_ROWS = np.array([[-9.0, 4.0 * k] for k in range(1, 7)])
_ROWS_ACTIONS = np.arange(len(_ROWS)) % _ACTIONS

DEEDS = {
    "first observation": at_once(growing, lambda machine: machine.learn_one(_NEXT, 2)),
    "observe": at_once(full, lambda machine: machine.observe(_NEXT)),
    "learn_one": at_once(full, lambda machine: machine.learn_one(_NEXT, 2)),
    "failed": at_once(full, lambda machine: machine.observe(_NEXT, failed=True)),
    "missing": at_once(full, lambda machine: machine.observe([np.nan, 4.0], partial=True)),
    "missing, failed": at_once(
        full, lambda machine: machine.observe([9.0, np.nan], partial=True, failed=True)
    ),
    "fail": at_once(full, lambda machine: machine.fail()),
    "start_episode": at_once(full, lambda machine: machine.start_episode()),
    "act": at_once(full, lambda machine: machine.act(2)),
    "model": at_once(full, lambda machine: machine.model()),
    "learn_many": Deed(
        full,
        lambda machine: machine.learn_many(_ROWS, _ROWS_ACTIONS),
        [
            partial(EvolvingFSM.learn_one, z=z, i=i)
            for z, i in zip(_ROWS, _ROWS_ACTIONS.tolist(), strict=True)
        ],
    ),
}


def harms(deed: Deed, every: int = 1) -> Iterator[str]:
    """What an interrupt at each line of a deed does to the machine; nothing, it is hoped.

    Of the lines it takes one in ``every``.
    """
    start = deed.start()
    stages, expected = _undisturbed(deed)
    loads: set[int] = set()
    for machine in _interrupted(start, deed.do, every):
        if not _is_free(machine):
            yield "locks held"
        elif (content := _content(machine)) not in stages:
            yield "results that differ" if _loads(machine) else "broken files"
        else:
            stage = stages.index(content)
            if stage not in loads and not _loads(machine):
                yield "broken files"
            loads.add(stage)
            for part in deed.parts[stage:]:
                part(machine)
            whole = _content(machine) == stages[-1] and _gone_on(machine) == expected
            yield "" if whole else "results that differ"


def _undisturbed(deed: Deed) -> tuple[list[object], object]:
    """What the machine holds before, between and after the parts, and once it went on."""
    machine = deed.start()
    stages = [_content(machine)]
    for part in deed.parts:
        part(machine)
        stages.append(_content(machine))
    whole = deed.start()
    deed.do(whole)
    assert _content(whole) == stages[-1]
    return stages, _gone_on(machine)


def _interrupted(start: EvolvingFSM, do: Work, every: int) -> Iterator[EvolvingFSM]:
    """Copies of a machine after an interrupt at the first line of what is done, the second ..."""
    for line in itertools.count(1, every):
        machine = start.copy()
        try:
            with Interrupter(line):
                do(machine)
        except KeyboardInterrupt:
            yield machine
        else:
            return


def _content(machine: EvolvingFSM) -> object:
    """All that a machine has learnt; None where that cannot be told."""
    if machine.n_states == 0:
        return ()
    return saved(machine)


def _loads(machine: EvolvingFSM) -> bool:
    try:
        EvolvingFSM.load(io.BytesIO(saved(machine)))
    except ValueError:
        return False
    return True


def _gone_on(machine: EvolvingFSM) -> object:
    machine.learn_many(spread_out(10), np.arange(10) % _ACTIONS)
    return _content(machine)


def _is_free(machine: EvolvingFSM) -> bool:
    """Whether another thread could go on with it."""
    got: list[bool] = []

    def try_it() -> None:
        got.append(machine._lock.acquire(blocking=False))
        if got[0]:
            machine._lock.release()

    other = threading.Thread(target=try_it)
    other.start()
    other.join()
    return got[0]


def interrupts(_folder: Path, _random: np.random.Generator, *, every: int = 1) -> Counter[str]:
    """An interrupt at so many of the lines of all that makes a machine grow or changes it."""
    found = Counter(harm for deed in DEEDS.values() for harm in harms(deed, every))
    return Counter({"interrupts": found.total(), **{k: n for k, n in found.items() if k}})
