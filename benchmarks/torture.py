"""What kill -9, a full disk and damaged files do to what was learnt: nothing, it is hoped.

``make torture`` runs it, prints what was found and ends with 1 where there is anything but zeros.
Needs Linux or macOS: it forks a process that is warm, so that a kill costs no more than the work.
"""

from __future__ import annotations

import argparse
import hashlib
import io
import json
import logging
import os
import resource
import signal
import sys
import tempfile
import threading
import time
import tracemalloc
from collections import Counter
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, suppress
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

import one_guard
import one_machine
from evofsm import store
from evofsm.cli import driving as driving_module
from evofsm.cli.driving import GUARD, Results, Setup, drive_in_turn, make_guard
from evofsm.cli.monitor.decider import Decider
from evofsm.cli.monitor.state import State
from evofsm.cli.monitor.transports import Server, Stream
from evofsm.driving.cars import guard_for_cars
from evofsm.driving.family import load_family
from evofsm.driving.judge import LatentRisk
from evofsm.fsm.arrays import MACHINE
from evofsm.fsm.machine import EvolvingFSM
from evofsm.fsm.model import FSMModel
from evofsm.guard import Guard, warm

#: What must not happen, in the order in which it is printed.
WRONG = (
    "broken files",
    "refused loads",
    "results that differ",
    "loaded silently",
    "crashes",
    "over-allocations",
    "left behind",
    "lost observations",
    "locks held",
    "over their time",
    "stuck monitors",
    "states not of one owner",
)
_REFUSED, _CRASHED = 3, 4

#: One way of damaging what is in a file.
Way = Callable[[bytes, np.random.Generator], bytes]
# A damaged file may take so much more memory than the whole one: a share, and bytes.
_MORE, _SPARE = 2.0, 1 << 20


# -- Work that is stopped ------------------------------------------------------------------------


@dataclass(frozen=True)
class Work:
    """Something that learns, and goes on from what it kept."""

    run: Callable[[Path], bytes]  #: from the folder of what it keeps to all that came of it
    expected: bytes  #: what came of it when nothing stopped it
    seconds: float  #: that it took then


def driving(folder: Path) -> Work:
    """Driving and learning, done once before to be warm."""
    _drive(folder / "warm")
    began = time.perf_counter()
    expected = _drive(folder / "whole")
    return Work(_drive, expected, time.perf_counter() - began)


def _drive(path: Path) -> bytes:
    setup = Setup(load_family("emergency"))
    with closing(Results(setup, make_guard(setup), path)) as results:
        told = json.dumps(asdict(drive_in_turn(results, 4)))
    return (path / "episodes.csv").read_bytes() + _saved(results.guard.machine) + told.encode()


def _saved(learnt: Any) -> bytes:
    file = io.BytesIO()
    learnt.save(file)
    return file.getvalue()


def _fork(work: Work, kept: Path, result: Path, room: int | None) -> int:
    """Do the work in another process, with so much room for a file; answers its number."""
    if (child := os.fork()) > 0:
        return child
    code = _CRASHED
    try:
        logging.disable()  # that a guard could not be written is what is tried here
        if room is not None:
            signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
            resource.setrlimit(resource.RLIMIT_FSIZE, (room, resource.RLIM_INFINITY))
        came = work.run(kept)
        if room is not None:
            resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY,) * 2)
        result.write_bytes(came)
        code = 0
    except OSError:
        code = _REFUSED
    finally:
        os._exit(code)


def _is_broken(folder: Path) -> bool:
    file = folder / GUARD
    if not file.exists():
        return False  # it was stopped before there was anything to keep
    try:
        Guard.load(file)
    except (ValueError, OSError):
        return True
    return False


def kill(work: Work, times: int, folder: Path, random: np.random.Generator) -> Counter[str]:
    """Kill it at random moments, and start it again until it ends; then begin anew."""
    found: Counter[str] = Counter()
    while found["kills"] < times:
        with tempfile.TemporaryDirectory(dir=folder) as name:
            kept, result = Path(name) / "kept", Path(name) / "result"
            while not result.exists() and not found["crashes"]:
                child = _fork(work, kept, result, None)
                if found["kills"] < times:
                    time.sleep(random.uniform(0.0, 0.5 * work.seconds))
                    os.kill(child, signal.SIGKILL)
                _, status = os.waitpid(child, 0)
                found["kills"] += os.WIFSIGNALED(status)
                found["crashes"] += os.WIFEXITED(status) and os.WEXITSTATUS(status) != 0
                found["broken files"] += _is_broken(kept)
                if os.WIFSIGNALED(status) and result.exists():
                    result.unlink()  # perhaps half of it
            if found["crashes"]:
                return found
            found["results"] += 1
            found["results that differ"] += result.read_bytes() != work.expected
            found["left behind"] += len(list(Path(name).rglob(".*.part")))
    return found


def fill(work: Work, times: int, folder: Path, random: np.random.Generator) -> Counter[str]:
    """Let the disk be full at some size of what is kept, then make room and go on."""
    found: Counter[str] = Counter()
    with tempfile.TemporaryDirectory(dir=folder) as name:
        work.run(whole := Path(name) / "whole")
        size = (whole / GUARD).stat().st_size
    for _ in range(times):
        with tempfile.TemporaryDirectory(dir=folder) as name:
            kept, result = Path(name) / "kept", Path(name) / "result"
            for room in (int(random.integers(1, size)), None):
                result.unlink(missing_ok=True)
                _, status = os.waitpid(_fork(work, kept, result, room), 0)
                code = os.WEXITSTATUS(status) if os.WIFEXITED(status) else _CRASHED
                # Where what was done cannot be kept it says so, and ends.
                refused = code == _REFUSED and room is not None
                found["refused"] += refused
                found["crashes"] += code != 0 and not refused
                found["broken files"] += _is_broken(kept)
                if code == 0:
                    found["results"] += 1
                    found["results that differ"] += result.read_bytes() != work.expected
            found["left behind"] += len(list(Path(name).rglob(".*.part")))
        found["full disks"] += 1
    return found


# -- Several that write the same file ------------------------------------------------------------


def share(apart: bool, times: int, folder: Path, random: np.random.Generator) -> Counter[str]:
    """Load a file again and again that two threads, or two processes apart, save all the while."""
    found: Counter[str] = Counter()
    machines = []
    for rows in (60, 600):  # of two sizes
        machine = EvolvingFSM(3, radius=0.5)
        machine.learn_many(random.normal(size=(rows, 2)).cumsum(axis=0), np.arange(rows) % 3)
        machines.append(machine)
    with tempfile.TemporaryDirectory(dir=folder) as name:
        path, done = Path(name) / "machine", threading.Event()
        machines[0].save(path)
        kind = _Child if apart else _Thread
        writers = [kind(partial(_save_until, done, machine, path)) for machine in machines]
        while found["loads"] < times:
            found["loads"] += 1
            try:
                store.read(path, MACHINE)
            except (OSError, ValueError):
                found["refused loads"] += 1
        done.set()
        found["crashes"] += sum(writer.has_crashed() for writer in writers)
        store.sweep(path)
        found["left behind"] += len(list(Path(name).rglob(".*.part")))
    return found


def _save_until(done: threading.Event, machine: EvolvingFSM, path: Path) -> None:
    while not done.is_set():
        machine.save(path)


class _Thread:
    """Works beside all others until it is told to end."""

    def __init__(self, work: Callable[[], None]) -> None:
        self._pool = ThreadPoolExecutor(1)
        self._work = self._pool.submit(work)

    def has_crashed(self) -> bool:
        """Whether it ended in an error."""
        return self._work.exception() is not None


class _Child:
    """Another process, which works until it is killed."""

    def __init__(self, work: Callable[[], None]) -> None:
        self.number = os.fork()
        if self.number == 0:
            try:
                work()
            finally:
                os._exit(_CRASHED)

    def has_crashed(self) -> bool:
        """Whether it ended before it was killed."""
        os.kill(self.number, signal.SIGKILL)
        return os.WIFEXITED(os.waitpid(self.number, 0)[1])


# -- Monitors -------------------------------------------------------------------------------------

# So many rows come at once.
_ROWS = 620
# What no guard of two variables takes at its end.
_REFUSED_ENDS = ("[3.4e38, 0]", "[1e100, 1]", "[1, 2, 3]", "[null]")


def restart(times: int, folder: Path, random: np.random.Generator) -> Counter[str]:
    """Kill a monitor that refuses ends, again and again; each begins where the last one was."""
    found: Counter[str] = Counter()
    warm()  # before it is forked
    with tempfile.TemporaryDirectory(dir=folder) as name:
        path, n = Path(name) / "state", 0
        for _ in range(times):
            read, write = os.pipe()
            work = partial(_monitor, path, write, int(random.integers(1, 6)))
            child = _Child(work)
            os.close(write)
            with open(read, "rb") as told:  # until it ends by its own hand
                counts = [int(line) for line in told]
            found["restarts"] += 1
            found["stuck monitors"] += child.has_crashed() or not counts
            found["lost observations"] += bool(counts) and counts[0] != n
            n = counts[-1] if counts else n
        found["decisions"] = n
    return found


def _monitor(path: Path, write: int, rows: int) -> None:
    """Say how many decisions there are, after each answer, and die."""
    logging.disable()
    state = State(path, {})
    decider = Decider(state.guard(lambda: Guard(n_actions=2, interval=0.1)), episode=40)
    state.begin(decider)
    os.write(write, f"{decider.n}\n".encode())
    for k in range(decider.n, decider.n + rows):
        row = {"time": 0.1 * k, "observation": [k % 7, k % 5], "proposal": k % 2}
        kinds = [decider.answer(json.dumps(row).encode())["kind"]]
        for seen in _REFUSED_ENDS:
            end = f'{{"end": true, "failed": true, "observation": {seen}}}'
            kinds.append(decider.answer(end.encode())["kind"])
        if kinds != ["decision"] + ["error"] * len(_REFUSED_ENDS):
            return
        os.write(write, f"{decider.n}\n".encode())
    os.kill(os.getpid(), signal.SIGKILL)


def pipeline(times: int, folder: Path, random: np.random.Generator) -> Counter[str]:
    """Kill monitors beside a sender that waits for no answer; each row is learnt once."""
    found: Counter[str] = Counter()
    warm()
    rows = [
        json.dumps({"time": 0.1 * k, "observation": [k % 7, k % 5], "proposal": k % 2}).encode()
        for k in range(_ROWS)
    ]
    with tempfile.TemporaryDirectory(dir=folder) as name:
        plain = _learner(whole := State(Path(name) / "whole", {}))
        for row in rows:
            plain.answer(row)
        while found["kills"] < times:
            path, heard = Path(name) / f"state{found['kills']}", 0
            while heard < _ROWS:
                (rest, send), (hear, answers) = os.pipe(), os.pipe()
                child = _Child(partial(_serve, path, rest, answers, (send, hear)))
                os.close(rest)
                os.close(answers)
                sending = threading.Thread(target=_send, args=(send, rows[heard:]))
                sending.start()
                with open(hear, "rb") as told:
                    for _ in range(int(random.integers(3)) * (_ROWS - heard) // 2):
                        heard += told.readline().endswith(b"\n")
                    time.sleep(random.uniform(0.0, 0.5))
                    os.kill(child.number, signal.SIGKILL)
                    heard += sum(line.endswith(b"\n") for line in told)
                os.waitpid(child.number, 0)
                sending.join()
                found["kills"] += 1
            again = _learner(state := State(path, {}))
            found["results"] += 1
            found["results that differ"] += _saved(again.guard) != _saved(plain.guard)
            found["lost observations"] += abs(again.n - _ROWS)
            state.close()
        whole.close()
    return found


def _learner(state: State) -> Decider:
    decider = Decider(state.guard(lambda: Guard(n_actions=2, interval=0.1)), episode=200)
    state.begin(decider)
    return decider


def _serve(path: Path, rest: int, answers: int, others: Sequence[int]) -> None:
    for one in others:
        os.close(one)
    logging.disable()
    with open(rest, "rb", buffering=0) as source, open(answers, "wb", buffering=0) as sink:
        Server(_learner(State(path, {}))).converse(source.read, Stream(source, sink).send)
        signal.pause()  # it is killed


def _send(send: int, rows: Sequence[bytes]) -> None:
    with suppress(BrokenPipeError), open(send, "wb", buffering=0) as pipe:
        pipe.write(b"".join(row + b"\n" for row in rows))


def rival(times: int, folder: Path, random: np.random.Generator) -> Counter[str]:
    """Start two monitors at once on one state, which they know by two paths."""
    found: Counter[str] = Counter()
    for _ in range(times):
        with tempfile.TemporaryDirectory(dir=folder) as name:
            one, other = Path(name) / "a" / "state", Path(name) / "b" / "link"
            for place in (one, other):
                place.parent.mkdir()
            other.symlink_to(one)
            (read, write), (hold, go) = os.pipe(), os.pipe()
            children = [_Child(partial(_own, place, write, hold, go)) for place in (one, other)]
            os.close(write)
            os.close(hold)
            owners = sum(os.read(read, 1) == b"1" for _ in children)
            os.close(go)
            os.close(read)
            found["rivals"] += len(children)
            found["crashes"] += sum(child.has_crashed() for child in children)
            found["states not of one owner"] += owners != 1
    return found


def _own(path: Path, write: int, hold: int, go: int) -> None:
    """Say whether it owns the state, and keep it until all have said so."""
    os.close(go)
    try:
        state = State(path, {})
        state.begin(Decider(state.guard(lambda: Guard(n_actions=2, interval=0.1))))
        os.write(write, b"1")
    except ValueError:
        os.write(write, b"0")
    os.read(hold, 1)
    os.kill(os.getpid(), signal.SIGKILL)


# -- Files that are damaged -----------------------------------------------------------------------


@dataclass(frozen=True)
class Sample:
    """A file, how it is loaded, and what is done with it then."""

    name: str
    data: bytes
    load: Callable[[Path], Any]
    use: Callable[[Any], object]

    def try_it(self, path: Path) -> bytes:
        """What is in a file once it was loaded and saved again, if it can be used, too."""
        loaded = self.load(path)
        came = _saved(loaded)
        self.use(loaded)
        return came


_LOADS: dict[str, tuple[Callable[[Path], Any], Callable[[Any], object]]] = {
    "machine": (EvolvingFSM.load, lambda machine: machine.learn_one([0.0, 1.0], 0)),
    "model": (FSMModel.load, lambda model: model.explain(0)),
    "risk": (LatentRisk.load, lambda risk: risk.score([[30.0, 20.0, 18.0]])),
    "guard": (Guard.load, lambda guard: guard.decide([30.0, 20.0, 18.0], 0.5)),
}


def samples(folder: Path) -> list[Sample]:
    """One of each kind."""
    machine = EvolvingFSM(3, radius=0.5)
    random = np.random.default_rng(0)
    machine.learn_many(random.normal(size=(60, 2)).cumsum(axis=0), np.arange(60) % 3)
    risk = LatentRisk(lowest=-2.5)
    for decel in (3.0, 4.0, 6.0):
        risk.manoeuvres.remember(decel)
    machine.save(folder / "new.machine", {"files": ["a.csv"]})
    machine.model(names=("x", "y")).save(folder / "new.model")
    risk.save(folder / "new.risk")
    guard = guard_for_cars(low=-2.5, high=2.5)
    for k in range(20):
        guard.decide([30.0 - k, 20.0, 18.0], 0.5)
    guard.save(folder / "new.guard")
    paths = {kind: folder / f"new.{kind}" for kind in _LOADS}
    return [Sample(path.name, path.read_bytes(), *_LOADS[kind]) for kind, path in paths.items()]


def damaged(sample: Sample, random: np.random.Generator) -> tuple[bytes, bool]:
    """The file with one thing wrong, and whether its checksum is right."""
    ways: list[Way] = [*_ROUGH, *_FINE]
    data = sample.data
    while data == sample.data:
        way = ways[random.integers(len(ways))]
        data = way(sample.data, random)
    return data, way in _FINE


def _is_legal(came: bytes, expected: bytes) -> bool:
    """Whether no more differs than settings, each of its type still: no file can tell those."""
    (header, *numbers), (whole, *whole_numbers) = _unpacked(came), _unpacked(expected)
    told, expected_told = (one.pop("__metadata__")["evofsm"] for one in (header, whole))
    settings, expected_settings = told.pop("settings"), expected_told.pop("settings")
    pairs = [(settings[name], value) for name, value in expected_settings.items()]
    is_typed = all(None in pair or _type(pair[0]) is _type(pair[1]) for pair in pairs)
    return is_typed and (header, numbers, told) == (whole, whole_numbers, expected_told)


def _type(value: object) -> type:
    return float if type(value) is int else type(value)


def _flip(data: bytes, random: np.random.Generator) -> bytes:
    """A few bits."""
    flipped = bytearray(data)
    for place in random.integers(len(data), size=random.integers(1, 9)):
        flipped[place] ^= 1 << int(random.integers(8))
    return bytes(flipped)


def _cut(data: bytes, random: np.random.Generator) -> bytes:
    return data[: random.integers(len(data))]


def _parts(data: bytes, random: np.random.Generator) -> list[bytes]:
    """Cut at four places."""
    a, b, c, d = np.sort(random.integers(len(data) + 1, size=4)).tolist()
    return [data[:a], data[a:b], data[b:c], data[c:d], data[d:]]


def _swap(data: bytes, random: np.random.Generator) -> bytes:
    first, second, third, fourth, fifth = _parts(data, random)
    return first + fourth + third + second + fifth


def _repeat(data: bytes, random: np.random.Generator) -> bytes:
    first, second, third, *rest = _parts(data, random)
    return first + second + third + second + b"".join(rest)


def _drop(data: bytes, random: np.random.Generator) -> bytes:
    first, _, *rest = _parts(data, random)
    return first + b"".join(rest)


def _blank(data: bytes, random: np.random.Generator) -> bytes:
    """A stretch that was never written, or with something else in it."""
    first, second, *rest = _parts(data, random)
    filling = bytes(len(second)) if random.random() < 0.5 else random.bytes(len(second))
    return first + filling + b"".join(rest)


_ROUGH = (_flip, _flip, _cut, _swap, _repeat, _drop, _blank)


def _unpacked(data: bytes) -> tuple[dict[str, Any], bytes]:
    """The header of a file, and its numbers."""
    length = int.from_bytes(data[:8], "little")
    header = json.loads(data[8 : 8 + length])
    header["__metadata__"]["evofsm"] = json.loads(header["__metadata__"]["evofsm"])
    return header, data[8 + length :]


def _packed(header: dict[str, Any], numbers: bytes) -> bytes:
    """A file whose checksum is right, whatever it holds."""
    told = json.dumps(header["__metadata__"]["evofsm"])
    header = header | {"__metadata__": {"sha256": "0" * 64, "evofsm": told}}
    unsigned = json.dumps(header).encode()
    unsigned += b" " * (-len(unsigned) % 8)
    digest = hashlib.sha256(unsigned + numbers).hexdigest().encode()
    return len(unsigned).to_bytes(8, "little") + unsigned.replace(b"0" * 64, digest, 1) + numbers


def _name(header: dict[str, Any], random: np.random.Generator) -> str:
    return str(random.choice([name for name in header if name != "__metadata__"]))


def _lose_array(data: bytes, random: np.random.Generator) -> bytes:
    header, numbers = _unpacked(data)
    del header[_name(header, random)]
    return _packed(header, numbers)


def _rename_array(data: bytes, random: np.random.Generator) -> bytes:
    header, numbers = _unpacked(data)
    old = _name(header, random)
    names = ("../up", "/etc/passwd", "other", "", old.upper(), _name(header, random))
    new = names[random.integers(len(names))]
    return _packed({new if name == old else name: one for name, one in header.items()}, numbers)


def _claim(data: bytes, random: np.random.Generator) -> bytes:
    """Something else about an array: most of it far too large."""
    header, numbers = _unpacked(data)
    entry = header[_name(header, random)]
    large = int(random.integers(1 << 20, 1 << 60))
    others: dict[str, tuple[Any, ...]] = {
        "dtype": ("F32", "I64", "U8", "BOOL", None, 8),
        "shape": ([large], [large, large], [-1, -1], [0], [], None, [None], [1.0], [[]]),
        "data_offsets": ([0, large], [large, 0], [-8, 0], [], None, [0, 0, 0], "ab"),
    }
    name = str(random.choice(list(entry)))
    entry[name] = others[name][random.integers(len(others[name]))]
    return _packed(header, numbers)


def _change_setting(data: bytes, random: np.random.Generator) -> bytes:
    header, numbers = _unpacked(data)
    told = header["__metadata__"]["evofsm"]
    if random.random() < 0.5 and told["settings"]:
        told = told["settings"]
    name = random.choice([name for name in told if name != "provenance"] or list(told))
    others: tuple[Any, ...] = (
        None,
        -1,
        2,
        10**9,
        10**400,
        "x",
        [],
        {},
        {"n_actions": 10**12},
        1e308,
    )
    told[name] = others[random.integers(len(others))]
    return _packed(header, numbers)


_FINE = (_lose_array, _rename_array, _claim, _change_setting)


def damage(times: int, folder: Path, random: np.random.Generator) -> Counter[str]:
    """Load damaged files; each must be refused by name, or hold what the whole one does.

    One that was forged, so that its checksum is right, may hold other legal settings.
    """
    found: Counter[str] = Counter()
    kinds = samples(folder)
    path = folder / "damaged"
    tracemalloc.start()
    whole = []
    for sample in kinds:
        path.write_bytes(sample.data)
        sample.try_it(path)  # once before, so that nothing is counted that is made only once
        before = _in_use()
        whole.append((sample, sample.try_it(path), _peak() - before))
    for turn in range(times):
        sample, expected, needed = whole[turn % len(whole)]
        data, is_forged = damaged(sample, random)
        path.write_bytes(data)
        found["damaged files"] += 1
        before = _in_use()
        try:
            came = sample.try_it(path)
        except ValueError as error:
            found["refused"] += 1
            found["crashes"] += str(path) not in str(error)
        except Exception as error:
            print(f"{sample.name}: {error!r}", file=sys.stderr)
            found["crashes"] += 1
        else:
            is_legal = is_forged and came != expected and _is_legal(came, expected)
            found["the same"] += came == expected
            found["legal settings"] += is_legal
            found["loaded silently"] += came != expected and not is_legal
        found["over-allocations"] += _peak() - before > _MORE * needed + _SPARE
    tracemalloc.stop()
    return found


def _in_use() -> int:
    """Memory that is in use now [bytes]; the peak is counted from here on."""
    tracemalloc.reset_peak()
    return tracemalloc.get_traced_memory()[0]


def _peak() -> int:
    return tracemalloc.get_traced_memory()[1]


# -- Many variables -------------------------------------------------------------------------------

# What a decision and an end may take with 40 variables [s of the processor], and more as their
# square: all but one of a hundred decisions.
_DECIDES, _ENDS = 0.005, 0.5


def dimensions(most: int, folder: Path, random: np.random.Generator) -> Counter[str]:
    """Guard what fails where the first of m variables goes too far, for each m."""
    found: Counter[str] = Counter()
    for m in range(1, most + 1):
        guard = Guard(-1.0, 1.0, interval=0.05)
        took: list[float] = []
        ends: list[float] = []
        for _ in range(4):
            z, failed = np.zeros(m), False
            while not failed and len(took) < 200 * (1 + len(ends)):
                began = time.thread_time()
                action = float(guard.decide(z, random.uniform(-0.3, 1.0)).executed)
                took.append(time.thread_time() - began)
                z += 0.2 * (np.append(z[0], z[:-1]) - z) + 0.02 * random.normal(size=m)
                z[0] += 0.05 * action
                failed = bool(z[0] > 1.0)
            began = time.thread_time()
            guard.end(failed, z)
            ends.append(time.thread_time() - began)
        decides, room = float(np.quantile(took, 0.99)), max(1.0, m / 40.0) ** 2
        if m % 10 == 0:
            print(
                f"  {m} variables: {1e3 * decides:.1f} ms, an end {1e3 * max(ends):.0f} ms; "
                f"bounds {1e3 * room * _DECIDES:.1f} and {1e3 * room * _ENDS:.0f} ms",
                flush=True,
            )
        found["dimensions"] += 1
        found["over their time"] += (decides > room * _DECIDES) + (max(ends) > room * _ENDS)
    return found


# -- All of it ------------------------------------------------------------------------------------


def main(arguments: Sequence[str] | None = None) -> int:
    """Answers 1 where anything was wrong."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--short", action="store_true", help="few of each")
    parser.add_argument("--seed", type=int, default=0)
    asked = parser.parse_args(arguments)
    kills, disks, loads, files = (20, 4, 100, 200) if asked.short else (500, 100, 5000, 10_000)
    shared = 4 if asked.short else 200  # machines
    starts, rivals = (20, 5) if asked.short else (1000, 200)
    store._OLD = 0.0  # all that writes a file here is known
    driving_module._EVERY = 0.0
    driving_module._write_decisions = lambda path, rows: None  # polars must not be forked
    random = np.random.default_rng(asked.seed)
    total: Counter[str] = Counter()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        work = driving(folder)
        print(f"driving, not stopped: {work.seconds:.2f} s", flush=True)
        for title, run in (
            ("killed while learning", partial(kill, work, kills)),
            ("disk full while learning", partial(fill, work, disks)),
            ("two threads on one file", partial(share, False, loads)),
            ("two processes on one file", partial(share, True, loads)),
            ("monitors that refuse ends", partial(restart, starts)),
            ("a sender that waits not", partial(pipeline, starts // 2)),
            ("two monitors on one state", partial(rival, rivals)),
            ("damaged files", partial(damage, files)),
            ("many variables", partial(dimensions, 60)),
            ("four threads a machine", partial(one_machine.threads, shared)),
            (
                "interrupted at a line",
                partial(one_machine.interrupts, every=97 if asked.short else 1),
            ),
            (
                "guards broken off",
                partial(one_guard.interrupts, every=997 if asked.short else 5),
            ),
            ("forks amid a call", partial(one_guard.forked, starts // 2)),
        ):
            began = time.perf_counter()
            found = run(folder, random)
            counts = ", ".join(f"{count:,} {what}" for what, count in found.items() if count)
            print(f"{title:<25} {time.perf_counter() - began:6.1f} s  {counts}", flush=True)
            total += found
    print()
    for what in WRONG:
        print(f"{what:<25} {total[what]:6,}")
    return int(any(total[what] for what in WRONG))


if __name__ == "__main__":
    sys.exit(main())
