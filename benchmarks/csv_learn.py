"""Learning from a CSV of 10 million rows, against polars only reading and parsing it.

Each side runs in fresh processes, which take turns, on a file that is in the page cache. A process
first works on a small file, so that neither imports nor compiling count; what the command takes
with all that is measured beside it.
"""

from __future__ import annotations

import json
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from timing import Result

_ROWS, _WARM_UP_ROWS = 10_000_000, 10_000


def measure(repeats: int, rows: int = _ROWS) -> Result:
    """Median seconds for the whole file, and the largest peak of memory [MB]."""
    with tempfile.TemporaryDirectory() as folder:
        path, small = Path(folder) / "log.csv", Path(folder) / "small.csv"
        write_log(path, rows)
        write_log(small, min(rows, _WARM_UP_ROWS))
        turns: dict[str, list[dict[str, float]]] = {"learn": [], "parse": [], "command": []}
        for turn in range(1 + repeats):
            for side in ("learn", "parse"):
                again = [sys.executable, __file__, side, str(path), str(small)]
                answer = subprocess.run(again, check=True, capture_output=True, text=True)
                turns[side].append(json.loads(answer.stdout))
            turns["command"].append(command(path))
            if turn == 0:  # may have had to compile
                turns = {side: [] for side in turns}
    seconds = {side: statistics.median(turn["s"] for turn in turns[side]) for side in turns}
    peak = {side: max(turn["mb"] for turn in turns[side]) for side in turns}
    return {
        "what": f"learning from a CSV of {rows:,} rows, all of it",
        "ours_s": seconds["learn"],
        "reference": "polars, streaming, only reading and parsing",
        "reference_s": seconds["parse"],
        "notes": [
            f"{rows / seconds['learn']:,.0f} rows/s, {peak['learn']:.0f} MB at most",
            f"the command, from its start: {seconds['command']:.2f} s, {peak['command']:.0f} MB",
        ],
        "ours_turns_s": [turn["s"] for turn in turns["learn"]],
        "reference_turns_s": [turn["s"] for turn in turns["parse"]],
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
    side, whole, little = sys.argv[1:]
    work = {"learn": learn, "parse": parse}[side]
    work(little)
    begun = time.perf_counter()
    work(whole)
    print(json.dumps({"s": time.perf_counter() - begun, "mb": _peak()}))
