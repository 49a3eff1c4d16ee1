"""Learning from a CSV of 10 million rows, against polars only reading and parsing it.

Usage: python benchmarks/csv_learn.py [--repeats 7] [--rows 10000000]

Each side runs in fresh processes, which take turns, on a file that is in the page cache. A process
first works on a small file, so that neither imports nor compiling count; what the command takes
with all that is measured beside it.
"""

from __future__ import annotations

import argparse
import json
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

_PROMISED_RATIO, _PROMISED_MB = 3.0, 500.0
_WARM_UP_ROWS = 10_000


def main() -> int:
    """Measure, print, and fail where it takes longer or more memory than promised."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--rows", type=int, default=10_000_000)
    parser.add_argument("--side", nargs=3, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.side:
        side, path, small = arguments.side
        print(json.dumps(once(learn if side == "ours" else parse, path, small)))
        return 0
    result = measure(arguments.repeats, arguments.rows)
    print(f"{result['what']}: {result['ours_s']:.2f} s")
    print(*result["notes"], sep="\n")
    print(f"{result['reference']}: {result['reference_s']:.2f} s")
    print(f"ratio {result['ratio']:.2f}, promised: at most {_PROMISED_RATIO:g}")
    return int(
        result["ratio"] > _PROMISED_RATIO
        or max(result["peak_mb"], result["command_mb"]) >= _PROMISED_MB
    )


def measure(repeats: int, rows: int = 10_000_000) -> dict[str, Any]:
    """Median seconds for the whole file, and the largest peak of memory [MB]."""
    with tempfile.TemporaryDirectory() as folder:
        path, small = Path(folder) / "log.csv", Path(folder) / "small.csv"
        write_log(path, rows)
        write_log(small, min(rows, _WARM_UP_ROWS))
        turns: dict[str, list[dict[str, float]]] = {"ours": [], "theirs": [], "command": []}
        for turn in range(1 + repeats):
            for side in ("ours", "theirs"):
                again = [sys.executable, __file__, "--side", side, str(path), str(small)]
                answer = subprocess.run(again, check=True, capture_output=True, text=True)
                turns[side].append(json.loads(answer.stdout))
            turns["command"].append(command(path))
            if turn == 0:  # may have had to compile
                turns = {side: [] for side in turns}
    seconds = {side: statistics.median(turn["s"] for turn in turns[side]) for side in turns}
    peak = {side: max(turn["mb"] for turn in turns[side]) for side in turns}
    return {
        "id": "csv_learn",
        "what": f"learning from a CSV of {rows:,} rows, all of it",
        "ours_s": seconds["ours"],
        "reference": "polars, streaming, only reading and parsing",
        "reference_s": seconds["theirs"],
        "ratio": seconds["ours"] / seconds["theirs"],
        "rows_per_second": rows / seconds["ours"],
        "peak_mb": peak["ours"],
        "reference_peak_mb": peak["theirs"],
        "command_s": seconds["command"],
        "command_mb": peak["command"],
        "notes": [
            f"{rows / seconds['ours']:,.0f} rows/s, {peak['ours']:.0f} MB at most",
            f"the command, from its start: {seconds['command']:.2f} s, {peak['command']:.0f} MB",
        ],
        "ours_turns_s": [turn["s"] for turn in turns["ours"]],
        "reference_turns_s": [turn["s"] for turn in turns["theirs"]],
    }


def write_log(path: Path, rows: int) -> None:
    """The paper's four cases, over and over, each time as another run."""
    import polars

    from evofsm.driving.world import KinematicWorld
    from evofsm.paper.runs import Settings

    settings = Settings.load()
    world = KinematicWorld()
    episodes = [world.run(settings.scenario, driver) for driver in settings.drivers.values()]
    columns = np.concatenate(
        [np.column_stack([e.time, e.observations, e.accelerations]) for e in episodes]
    )
    cases = np.repeat(np.arange(len(episodes)), [len(e.time) for e in episodes])
    names = ["time", "gap", "v_follower", "v_leader", "a_follower"]
    table = polars.DataFrame(dict(zip(names, columns.T, strict=True)))
    with path.open("wb") as file:
        for first in range(0, rows, len(table)):
            runs = cases + len(episodes) * (first // len(table))
            some = polars.DataFrame({"run": runs}).hstack(table).head(rows - first)
            some.write_csv(file, include_header=first == 0, float_precision=6)


def once(work: Callable[[str], None], path: str, small: str) -> dict[str, float]:
    """Seconds for the file, once all is imported and compiled, and the process's peak of memory."""
    work(small)
    begin = time.perf_counter()
    work(path)
    seconds = time.perf_counter() - begin
    return {"s": seconds, "mb": _peak()}


def _peak() -> float:
    """Most memory of this process so far [MB].

    Not ``ru_maxrss``, in which Linux counts what the process was that this one was forked from.
    """
    status = Path("/proc/self/status").read_text()
    return int(status.partition("VmHWM:")[2].split()[0]) / 1024


def learn(path: str) -> None:
    """What the command does with a log."""
    from evofsm.cli.learning import learn_traces
    from evofsm.fsm.actions import IntervalActions
    from evofsm.fsm.machine import EvolvingFSM
    from evofsm.io.logs import read_traces

    actions = IntervalActions(low=-2.5, high=2.5, width=0.3, outside="clip")
    learn_traces(read_traces([path]), EvolvingFSM.paper(), actions)


def parse(path: str) -> None:
    """The same columns into numbers, batch by batch."""
    import polars

    numbers = ["time", "gap", "v_follower", "v_leader", "a_follower"]
    schema = {"run": polars.Int64, **dict.fromkeys(numbers, polars.Float64)}
    for _ in polars.scan_csv(path, schema=schema).collect_batches():
        pass


def command(path: Path) -> dict[str, float]:
    """Seconds and peak of memory of the command, from its start to its end."""
    code = (
        "import resource, subprocess, sys;"
        "subprocess.run(sys.argv[1:], check=True, stdout=subprocess.DEVNULL);"
        "print(resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024)"
    )
    learning = [
        sys.executable,
        "-c",
        "from evofsm.__main__ import main; main()",
        "learn",
        str(path),
    ]
    begin = time.perf_counter()
    answer = subprocess.run(
        [sys.executable, "-c", code, *learning], check=True, capture_output=True, text=True
    )
    return {"s": time.perf_counter() - begin, "mb": float(answer.stdout)}


if __name__ == "__main__":
    sys.exit(main())
