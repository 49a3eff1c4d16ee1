"""The study: every score under an alarm that adapts and one that does not, family by family.

Each family and learning seed is a stream: thresholds are chosen on calibration draws, which the
adaptive alarm takes as its first updates, then come held-out episodes, and those after a change if
there is one. What came of a window is known one window later.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from evofsm.guard import ConformalAlarm
from studies.alarms.amounts import Amounts, Errors
from studies.alarms.windows import Windows, stages
from studies.old.frame import Frame, Progress, silent
from studies.old.scores import bootstrap, share_of
from studies.old.shim import in_order

#: Kinds of alarms: a threshold that adapts, and one that is chosen once.
ADAPTIVE, FIXED = "adaptive", "fixed"
#: What came of a window is known so many windows later.
DELAY = 1


@dataclass(frozen=True)
class Row:
    """One alarm on one score in one world, of all learning seeds."""

    world: str
    changed: bool  #: whether thresholds were chosen in another world
    score: str
    alarm: str
    of: str  #: whose rate is held, ``"false alarms"`` or ``"misses"``
    stated: float
    realised: float
    low: float  #: 95 %: bootstrap over episodes; Clopper and Pearson (1934) where all are alike
    high: float
    farthest: float  #: realised rate of the learning seed that is farthest from the stated one
    most: float | None  #: guaranteed before anything was seen; None where nothing is
    errors: int
    windows: int  #: that count
    other: float | None  #: rate of errors of the other kind; None where none could be made
    episodes: int
    seeds: int

    @property
    def holds(self) -> bool:
        """Whether the stated rate lies in the interval."""
        return self.low <= self.stated <= self.high


@dataclass(frozen=True)
class Found:
    """All that was found."""

    plan: Amounts
    rows: list[Row]

    @property
    def frame(self) -> Frame:
        """Every row."""
        return Frame(self.rows)

    def of(self, alarm: str, of: Errors | None = None, changed: bool | None = None) -> list[Row]:
        """Rows of an alarm."""
        return [
            row
            for row in self.rows
            if row.alarm == alarm and of in (None, row.of) and changed in (None, row.changed)
        ]


class _Said(NamedTuple):
    """What an alarm said of the windows of one stage, with one learning seed."""

    key: tuple[str, bool, str, str, Errors]  #: world, changed, score, alarm, of
    alarmed: NDArray[np.bool_]  #: (n,)
    windows: Windows
    most: float | None  #: errors that are guaranteed


def run_alarms(plan: Amounts, progress: Progress = silent, workers: int | None = None) -> Found:
    """Let every alarm judge every score; see `Study.run`."""
    tasks = [
        partial(_of_stream, name, plan, plan.seed + k)
        for name, k in product(plan.families, range(plan.seeds))
    ]
    said = [one for found in in_order(tasks, workers, progress) for one in found]
    by_key: dict[tuple[str, bool, str, str, Errors], list[_Said]] = {}
    for one in said:
        by_key.setdefault(one.key, []).append(one)
    return Found(plan, [_row(plan, every) for every in by_key.values()])


def _of_stream(name: str, plan: Amounts, seed: int) -> list[_Said]:
    chosen_on, then = stages(name, plan, seed)
    found = []
    for score, of in product(chosen_on, plan.stated):
        rate = plan.stated[of]
        adaptive = ConformalAlarm(rate, of=of, step=plan.step, memory=plan.memory)
        list(said_by(adaptive, chosen_on[score]))
        once = threshold(chosen_on[score], rate, of)
        for stage in then:
            seen = stage.windows[score]
            # As the level is now; see the proof in `evofsm.guard.alarms`.
            most = adaptive.level / plan.step + 1.0 - rate + DELAY
            key = stage.name, stage.changed, score
            alarmed = np.array(list(said_by(adaptive, seen)), np.bool_)
            found.append(_Said((*key, ADAPTIVE, of), alarmed, seen, most))
            above = seen.score > once if of == "false alarms" else seen.score >= once
            found.append(_Said((*key, FIXED, of), above, seen, None))
    return found


def said_by(alarm: ConformalAlarm, windows: Windows) -> Iterator[bool]:
    """What an adaptive alarm says of each window, told one window later what came of it."""
    waiting: list[tuple[float, bool, bool]] = []
    for score, happened in zip(windows.score.tolist(), windows.happened.tolist(), strict=True):
        alarmed = alarm.alarms(score)
        waiting.append((score, happened, alarmed))
        if len(waiting) > DELAY:
            before, came, said = waiting.pop(0)
            alarm.update(before, came, alarmed=said)
        yield alarmed
    for before, came, said in waiting:
        alarm.update(before, came, alarmed=said)


def threshold(windows: Windows, rate: float, of: Errors) -> float:
    """Chosen once, so that the rate is held as long as nothing changes (split conformal).

    Infinite, or minus infinite, where there are too few windows for that.
    """
    of_safe = of == "false alarms"
    values = np.sort(
        windows.score[~windows.happened] if of_safe else -windows.score[windows.happened]
    )
    rank = math.ceil(round((1.0 - rate) * (len(values) + 1), 9))
    quantile = float(values[rank - 1]) if rank <= len(values) else math.inf
    return quantile if of_safe else -quantile


def _row(plan: Amounts, every: list[_Said]) -> Row:
    """All learning seeds in one."""
    world, changed, score, alarm, of = every[0].key
    wrong = of == "false alarms"
    counts = [_by_episode(one.alarmed == wrong, one.windows, of == "misses") for one in every]
    others = [_by_episode(one.alarmed != wrong, one.windows, of != "misses") for one in every]
    errors, windows = np.concatenate(counts, axis=1)
    made, could = (int(number) for number in np.concatenate(others, axis=1).sum(axis=1))
    rates = [float(one[0].sum() / max(1.0, one[1].sum())) for one in counts]
    stated, total = plan.stated[of], float(windows.sum())
    if 0.0 < errors.sum() < total:
        low, high = bootstrap(
            lambda chosen: _share(errors[chosen].sum(), windows[chosen].sum()),
            len(errors),
            plan.rounds,
            plan.seed,
        )
    else:
        low, high = share_of(np.arange(total) < errors.sum())[2:]
    known = [one.most for one in every if one.most is not None]
    return Row(
        world=world,
        changed=changed,
        score=score,
        alarm=alarm,
        of=of,
        stated=stated,
        realised=_share(errors.sum(), total),
        low=low,
        high=high,
        farthest=max(rates, key=lambda rate: abs(rate - stated)),
        most=stated + sum(known) / total if known and total else None,
        errors=int(errors.sum()),
        windows=int(total),
        other=made / could if could else None,
        episodes=len(errors),
        seeds=len(every),
    )


def _by_episode(wrong: NDArray[np.bool_], windows: Windows, happened: bool) -> NDArray[np.float64]:
    """(2, episodes) errors, and windows that count, of each episode that has some window."""
    counts = windows.happened == happened
    episodes = int(windows.episode.max(initial=-1)) + 1
    made = np.bincount(windows.episode, wrong & counts, episodes)
    return np.array([made, np.bincount(windows.episode, counts, episodes)])


def _share(errors: float, windows: float) -> float:
    return float(errors / windows) if windows else math.nan
