"""Ours and a reference timed in turns: what else the machine does then slows both alike."""

from __future__ import annotations

import os
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

# One row of the table, as it stands in the JSON.
Result = dict[str, Any]
# Does its work once; answers seconds a step.
Work = Callable[[], float]


def compare(
    what: str,
    ours: Work,
    reference: str,
    theirs: Work,
    repeats: int,
    beside: Mapping[str, Work] | None = None,
    notes: Sequence[str] = (),
) -> Result:
    """Median seconds a step of ours, of the reference, and of what is worth seeing beside them."""
    works = {"ours": ours, "theirs": theirs, **(beside or {})}
    for work in works.values():
        work()  # compiles what is not compiled yet, and fills the caches
    turns: dict[str, list[float]] = {name: [] for name in works}
    for _ in range(repeats):
        for name, work in works.items():
            turns[name].append(work())
    return {
        "what": what,
        "ours_s": statistics.median(turns["ours"]),
        "reference": reference,
        "reference_s": statistics.median(turns["theirs"]),
        "beside": {name: statistics.median(turns[name]) for name in beside or {}},
        "notes": list(notes),
        "ours_turns_s": turns["ours"],
        "reference_turns_s": turns["theirs"],
    }


def timed(work: Callable[[], object], steps: int) -> float:
    """Seconds a step."""
    begin = time.perf_counter()
    work()
    return (time.perf_counter() - begin) / steps


# Ratios of one machine differ by up to a tenth from run to run, those of a busy one by more. A
# change that matters, such as an allocation in a step, costs more than a quarter.
MARGIN = 0.25

_FASTER, _COST = "reference_s / ours_s", "ours_s / reference_s"

HEADER = f"""\
Medians of turns, ours and the reference in turn; a step is one with forecast and divergence.
Ratio: 'x faster' is reference / ours, more is better; 'x the cost' is ours / reference, less is.

{"":<19}{"ours":>11}{"reference":>12}{"ratio":>19}{"target":>9}        the reference
"""


class Row(NamedTuple):
    """How a row is measured, in so many turns, short or in full, and what it should reach."""

    measure: Callable[[int, bool], Result]
    # ">=": how many times as fast as the reference; "<=": how many times its cost; "s": seconds
    better: str
    target: float | None = None


def judged(id_: str, row: Row, measured: Result) -> Result:
    """What was measured as it goes into the JSON: with its ratio, and whether that is enough."""
    ours, reference = float(measured["ours_s"]), float(measured["reference_s"])
    faster = row.better == ">="
    ratio = reference / ours if faster else ours / reference
    target = row.target
    compared = ours if row.better == "s" else ratio
    reached = target is None or (compared >= target if faster else compared <= target)
    return {
        "id": id_,
        **measured,
        "ratio": ratio,
        "ratio_is": _FASTER if faster else _COST,
        "target": None if target is None else _told(row.better, target),
        "reached": reached,
        "cores": os.cpu_count(),
    }


def _told(better: str, target: float) -> str:
    return f"<= {duration(target).strip()}" if better == "s" else f"{better} {target:g}"


def worsened(result: Result, last: list[Result]) -> str | None:
    """How the ratio is worse than in an earlier run by more than the margin, in words.

    Ratios depend on the number of cores, so a run on another number of them tells nothing.
    """
    for before in last:
        if (before["id"], before["cores"]) == (result["id"], result["cores"]):
            worse = before["ratio"] / result["ratio"]
            if result["ratio_is"] == _COST:
                worse = 1.0 / worse
            if worse > 1.0 + MARGIN:
                return f"WORSE than the {before['ratio']:.3g} of the last run by {worse - 1.0:.0%}"
    return None


def shown(result: Result, worse: str | None) -> str:
    """A row of the table, and what stands beside it, no wider than 100 columns."""
    ratio = f"{result['ratio']:.2f}" if result["ratio"] < 10.0 else f"{result['ratio']:.0f}"
    ratio += "x faster   " if result["ratio_is"] == _FASTER else "x the cost "
    target = result["target"] or ""
    lines = [
        f"{result['id']:<19}{duration(result['ours_s']):>11}{duration(result['reference_s']):>12}"
        f"{ratio:>19}{target:>9} {'' if result['reached'] else 'missed':<7}{result['reference']}",
        f"  {result['what']}",
    ]
    for what, seconds in result.get("beside", {}).items():
        lines.append(f"{duration(seconds):>30}  {what}")
    lines += [f"    {note}" for note in result.get("notes", [])]
    if worse:
        lines.append(f"    {worse}")
    return "\n".join(lines) + "\n"


def duration(seconds: float) -> str:
    """Three digits and a unit."""
    for unit, size in (("s ", 1.0), ("ms", 1e-3), ("µs", 1e-6)):
        if seconds >= size:
            return f"{seconds / size:.3g} {unit}"
    return f"{seconds / 1e-9:.3g} ns"
