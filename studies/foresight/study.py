"""The study: ours and its rivals learn the same episodes, and foresee the same held-out ones.

Each learning seed has its own training and calibration episodes, all have the same held-out ones;
numbers are means over seeds, and the bootstrap draws held-out episodes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from studies.foresight.amounts import HORIZONS, Amounts
from studies.foresight.data import Cases, cases, gather
from studies.foresight.measures import Scored, ece, measured, scored
from studies.foresight.ours import Learnt
from studies.foresight.rivals import Logistic, Neighbours, Taylor
from studies.old.frame import Frame, Progress, silent
from studies.old.scores import auroc
from studies.old.shim import in_order, split_names
from studies.systems import Start, make_system

#: Who foresees: ours first, and of ours the one that all others are held against.
OURS = ("evofsm-replay", "evofsm-counts", "evofsm-chain")
RIVALS = ("logistic", "neighbours", "taylor")

# Calibration episodes are those of the training split from this one on.
_APART = 100_000

_Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Row:
    """One who foresees, on one task, within one horizon; None where a number does not apply."""

    task: str
    method: str
    steps: int  #: of the horizon
    brier: float  #: of the calibrated probability
    brier_low: float  #: 95 % interval (bootstrap over held-out episodes), as all of them
    brier_high: float
    ece: float  #: expected calibration error, ten bins
    ece_low: float
    ece_high: float
    ece_own: float | None  #: of its own probability; None of what is none
    f1: float  #: at the threshold that was best on calibration episodes
    f1_low: float
    f1_high: float
    false_95: float  #: false-alarm rate at a recall of 95 %
    false_95_low: float
    false_95_high: float
    lead: float  #: median lead time at a false-alarm rate of 5 % on calibration episodes [s]
    lead_low: float
    lead_high: float
    auroc: float
    base: float  #: Brier score of always saying the share of failures
    share: float  #: of cases that failed in time
    cases: int
    episodes: int  #: held out
    failed: int  #: of those
    seeds: int


@dataclass(frozen=True)
class Foresight:
    """All that was found."""

    plan: Amounts
    rows: list[Row]

    @property
    def frame(self) -> Frame:
        """Every row."""
        return Frame(self.rows)

    @property
    def tasks(self) -> list[str]:
        """Names, in their order."""
        return list(dict.fromkeys(row.task for row in self.rows))


class _Said(NamedTuple):
    """What one said of the held-out episodes with one learning seed."""

    task: str
    method: str
    steps: int
    scored: Scored
    own: bool  #: whether its score is a probability


def run_foresight(
    plan: Amounts, progress: Progress = silent, workers: int | None = None
) -> Foresight:
    """Let all foresee all tasks; see `Study.run`.

    Raises
    ------
    ValueError
        If there is no such system.
    """
    names = split_names(plan.tasks)
    for name in names:  # so that a wrong name shows at once
        make_system(name)
    tasks = [
        partial(_of_task, name, plan, seed) for name, seed in product(names, range(plan.seeds))
    ]
    found = [one for said in in_order(tasks, workers, progress) for one in said]
    by_key: dict[tuple[str, str, int], list[_Said]] = {}
    for one in found:
        by_key.setdefault((one.task, one.method, one.steps), []).append(one)
    rows = [_row(plan, every) for every in by_key.values()]
    order = {name: k for k, name in enumerate((*OURS, *RIVALS))}
    return Foresight(
        plan, sorted(rows, key=lambda r: (names.index(r.task), r.steps, order[r.method]))
    )


def _of_task(name: str, plan: Amounts, seed: int) -> list[_Said]:
    first = [Start.training(plan.seed, seed, k) for k in range(plan.train)]
    then = [Start.training(plan.seed, seed, _APART + k) for k in range(plan.calibration)]
    last = [Start.held_out(plan.seed, k) for k in range(plan.test)]
    train, calibration, test = (gather(name, starts) for starts in (first, then, last))
    every = cases(train, 1)
    others, judged = cases(calibration, plan.every), cases(test, plan.every)
    learnt = Learnt(name, train)
    found = []
    for steps in HORIZONS:
        for method, said, own in _methods(learnt, every, others, steps):
            before, now = said(others), said(judged)
            found.append(
                _Said(name, method, steps, scored(now, judged, before, others, steps), own)
            )
    return found


def _methods(
    learnt: Learnt, train: Cases, others: Cases, steps: int
) -> Iterator[tuple[str, Callable[[Cases], _Floats], bool]]:
    """Each with what it says of cases, and whether that is a probability."""
    known = train.judged(steps)
    fitted = train.where(known), train.truth(steps)[known]
    own = others.judged(steps)
    yield "evofsm-replay", lambda some: learnt.replays(some, steps), True
    yield "evofsm-counts", lambda some: learnt.counts(some, steps), True
    yield "evofsm-chain", lambda some: learnt.chain(some, steps), True
    yield "logistic", Logistic(*fitted), True
    yield "neighbours", Neighbours(*fitted, others.where(own), others.truth(steps)[own]), True
    extrapolated = [Taylor(learnt.sides, order) for order in (1, 2)]
    truth = others.truth(steps)[own]
    best = max(extrapolated, key=lambda one: np.nan_to_num(auroc(one(others)[own], truth)))
    yield "taylor", best, False


def _row(plan: Amounts, every: list[_Said]) -> Row:
    """All learning seeds in one."""
    task, method, steps, one, own = every[0]
    said = [each.scored for each in every]
    numbers = measured(said, plan.test, plan.rounds, plan.seed)
    share = float(one.truth.mean())
    interval = make_system(task).interval
    values: dict[str, float] = {}
    for name, number in numbers.items():
        unit = interval if name == "lead" else 1.0
        ends = ("", "_low", "_high")
        values |= {
            f"{name}{end}": unit * float(part) for end, part in zip(ends, number, strict=True)
        }
    return Row(
        task=task,
        method=method,
        steps=steps,
        **values,
        ece_own=float(np.mean([ece(each.score, each.truth) for each in said])) if own else None,
        auroc=float(np.mean([auroc(each.score, each.truth) for each in said])),
        base=share * (1.0 - share),
        share=share,
        cases=len(one.truth),
        episodes=plan.test,
        failed=len(np.unique(one.episode[np.isfinite(one.left)])),
        seeds=len(every),
    )
