"""Two ways of doing the same work, timed in turns: what else runs then slows both alike."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

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
