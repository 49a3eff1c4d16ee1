"""How long does `evofsm monitor` take to answer? Through a pipe and through Zenoh, at 100 Hz.

Usage: python benchmarks/monitor.py [--seconds 20] [--objects 50] [--rate 100] [--carrier pipe]

A scene is sent each 10 ms to a monitor in a process of its own; the time from before the write to
the whole answer counts, the carrier and both processes' JSON lines included. The first second is
left out. Ends with 1 where the 99th percentile is above 5 ms, or a decision is lost.
"""

from __future__ import annotations

import argparse
import json
import os
import queue
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from monitor_rows import scenes

#: What has to be held: the 99th percentile [ms].
MOST = 5.0
# How long a monitor is waited for [s].
_PATIENCE = 180.0
_KEY = "bench/monitor"

Ask = Callable[[bytes], bytes]


def main() -> int:
    """Measure, and print a line for each carrier."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--objects", type=int, default=50)
    parser.add_argument("--rate", type=float, default=100.0)
    parser.add_argument("--carrier", choices=[*CARRIERS], action="append")
    arguments = parser.parse_args()
    print(f"{'carrier':<10}{'scenes':>8}{'median':>10}{'p99':>10}{'p99.9':>10}{'most':>10}  [ms]")
    held = True
    for name in arguments.carrier or CARRIERS:
        with CARRIERS[name](1.0 / arguments.rate) as ask:
            took = latencies(ask, arguments.seconds, arguments.objects, arguments.rate)
        median, p99, p999, most = np.percentile(took, [50.0, 99.0, 99.9, 100.0])
        print(
            f"{name:<10}{len(took):>8,}{median:>10.2f}{p99:>10.2f}{p999:>10.2f}{most:>10.2f}",
            flush=True,
        )
        held = held and p99 <= MOST
    return 0 if held else 1


def latencies(ask: Ask, seconds: float, objects: int, rate: float) -> list[float]:
    """How long each scene took, but for those of the first second [ms]."""
    took = []
    begun = time.perf_counter() + 0.1
    for k, scene in enumerate([*scenes(round((seconds + 1.0) * rate), 1.0 / rate, objects)]):
        while (left := begun + k / rate - time.perf_counter()) > 0.0:
            time.sleep(left)
        sent = time.perf_counter()
        answer = json.loads(ask(scene))
        took.append(1e3 * (time.perf_counter() - sent))
        if (answer["kind"], answer["n"]) != ("decision", k + 2):  # one came before, to warm up
            raise RuntimeError(f"scene {k} was answered by {answer}")
    return took[round(rate) :]


@contextmanager
def _started(dt: float, *arguments: str, **environment: str) -> Iterator[subprocess.Popen[bytes]]:
    command = [sys.executable, "-m", "evofsm", "monitor", "--interval", str(dt), "--warm"]
    process = subprocess.Popen(
        [*command, *arguments],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        env=os.environ | environment,
    )
    try:
        yield process
    finally:
        process.terminate()
        process.communicate()


def _first() -> bytes:
    """A scene before the first, once the monitor is there."""
    return next(scenes(1)).replace(b'"time": 0.0', b'"time": -1.0')


@contextmanager
def by_pipe(dt: float) -> Iterator[Ask]:
    """Standard input and output."""
    with _started(dt) as process:
        rows, decisions = process.stdin, process.stdout
        assert rows is not None
        assert decisions is not None

        def ask(scene: bytes) -> bytes:
            rows.write(scene + b"\n")
            rows.flush()
            return decisions.readline()

        ask(_first())
        yield ask


@contextmanager
def by_zenoh(dt: float) -> Iterator[Ask]:
    """Two peers on this computer, without a router between them."""
    import zenoh

    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        place = f"tcp/127.0.0.1:{free.getsockname()[1]}"
    quiet: dict[str, Any] = {"mode": "peer", "scouting": {"multicast": {"enabled": False}}}
    mine = quiet | {"listen": {"endpoints": [place]}}
    came: queue.SimpleQueue[bytes] = queue.SimpleQueue()
    with (
        tempfile.TemporaryDirectory() as folder,
        zenoh.open(zenoh.Config.from_json5(json.dumps(mine))) as session,
    ):
        theirs = Path(folder) / "zenoh.json5"
        theirs.write_text(json.dumps(quiet | {"connect": {"endpoints": [place]}}))
        session.declare_subscriber(
            f"{_KEY}/decision", lambda sample: came.put(sample.payload.to_bytes())
        )
        rows = session.declare_publisher(
            f"{_KEY}/row", express=True, priority=zenoh.Priority.REAL_TIME
        )

        def ask(scene: bytes) -> bytes:
            rows.put(scene)
            return came.get(timeout=_PATIENCE)

        with _started(dt, "--zenoh", _KEY, ZENOH_CONFIG=str(theirs)):
            deadline = time.monotonic() + _PATIENCE
            while came.empty():  # until both have found each other; sent again it counts once
                if time.monotonic() > deadline:
                    raise RuntimeError("the monitor does not answer")
                rows.put(_first())
                time.sleep(0.5)
            time.sleep(1.0)
            while not came.empty():
                came.get()
            yield ask


#: By name.
CARRIERS = {"pipe": by_pipe, "zenoh": by_zenoh}


if __name__ == "__main__":
    sys.exit(main())
