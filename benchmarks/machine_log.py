"""Learning from a machine's log of 10 million rows, beside polars reading and resampling it.

``python benchmarks/machine_log.py [ROWS]`` writes a German export of a pump, and prints how long
each takes, from start to end of its process, in seconds of the clock and of the processors, and
their peak of memory.
"""

from __future__ import annotations

import datetime
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import polars

_STEP, _LIMIT = "20s", 100.0
_READ = f"""
import sys, polars as pl
read = pl.read_csv(sys.argv[1], separator=";", decimal_comma=True)
at = pl.col("Zeit").str.to_datetime("%d.%m.%Y %H:%M:%S")
runs = read.with_columns(at).filter(pl.col("Drehzahl") > {_LIMIT})
runs.group_by_dynamic("Zeit", every="{_STEP}").agg(pl.col("Schwingung", "Lager").mean())
"""
_LEARN = [
    *("--observe", "Schwingung,Lager", "--action", "", "--time", "Zeit", "--resample", _STEP),
    *("--hole", "5min", "--where", f"Drehzahl>{_LIMIT:g}", "--failed", "Status==Störung"),
    *("--rule", "novelty", "--scale", "Schwingung=1", "--scale", "Lager=2"),
]


def write_log(path: Path, rows: int) -> None:
    """Runs of 5,000 rows, of which every other one trips."""
    chance = np.random.default_rng(0)
    seconds = np.cumsum(chance.uniform(4.0, 6.0, rows))
    began, row = datetime.datetime(2025, 1, 1), np.arange(rows)
    grows, stands = (row // 5000) % 2, row % 5000 > 4800
    vibration = chance.normal(3.0, 0.1, rows) + 1e-3 * grows * np.maximum(row % 5000 - 1500, 0)
    frame = polars.DataFrame(
        {
            "Zeit": polars.Series((1e6 * seconds).astype(np.int64)).cast(polars.Duration("us")),
            "Schwingung": np.where(stands, 0.1, vibration).round(2),
            "Lager": chance.normal(60.0, 2.0, rows).round(1),
            "Drehzahl": np.where(stands, 0.0, chance.normal(1480.0, 9.0, rows)).round(),
            "Status": np.where(stands, np.where(grows, "Störung", "Stillstand"), "Betrieb"),
        }
    )
    when = (polars.lit(began) + polars.col("Zeit")).dt.strftime("%d.%m.%Y %H:%M:%S")
    frame.with_columns(when.alias("Zeit")).write_csv(path, separator=";", decimal_comma=True)


def measured(command: list[str]) -> tuple[float, float, float]:
    """Seconds of the clock and of processors, and the peak of memory [MB]."""
    code = (
        "import resource as r, subprocess, sys;"
        "subprocess.run(sys.argv[1:], check=True, stdout=subprocess.DEVNULL);"
        "u = r.getrusage(r.RUSAGE_CHILDREN);"
        "print(u.ru_utime + u.ru_stime, u.ru_maxrss / 1024)"
    )
    began = time.monotonic()
    done = subprocess.run([sys.executable, "-c", code, *command], check=True, capture_output=True)
    took = time.monotonic() - began
    used, peak = map(float, done.stdout.split())
    return took, used, peak


def main() -> None:
    """Measure both, and print them."""
    rows = int(float(sys.argv[1])) if len(sys.argv) > 1 else 10_000_000
    learn = [sys.executable, "-m", "evofsm", "learn"]
    with tempfile.TemporaryDirectory() as folder:
        log, small = Path(folder) / "pump.csv", Path(folder) / "small.csv"
        write_log(log, rows)
        write_log(small, 20_000)
        measured([*learn, str(small), *_LEARN])  # compiles, once
        read = measured([sys.executable, "-c", _READ, str(log)])
        ours = measured([*learn, str(log), *_LEARN])
    for name, (took, used, peak) in (("polars", read), ("evofsm learn", ours)):
        print(f"{name:<14}{took:7.1f} s {used:7.1f} s of processors {peak:7.0f} MB")
    print(f"{'ratio':<14}{ours[0] / read[0]:7.2f}   {ours[1] / read[1]:7.2f}")


if __name__ == "__main__":
    main()
