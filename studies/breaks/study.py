"""The study: every family under every judge, by splitting and by plain sampling.

Nothing depends on the number of processes.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from itertools import accumulate
from typing import Any

import numpy as np

from evofsm.extras import needs
from evofsm.fleet import in_order
from studies.breaks.amounts import NOBODY, TOY, Amounts
from studies.breaks.cases import FoundCase, found_case, ordinary
from studies.breaks.splitting import Amount, Case, Split, plain, split
from studies.breaks.subjects import KNOWN, Subject, check_learnt, load, subject_of
from studies.old.frame import Frame, Progress, silent

with needs("scipy", "study", "the study"):
    from scipy.stats import binomtest
    from scipy.stats import t as student

_SURE = 0.95
# Of what must not happen by chance: two ways to estimate the same differ by more.
_SURER = 0.99
# Plain samples in a task: some seconds. Those under a guard take twenty times as long.
_PLAIN, _GUARDED = 5_000, 250
# What the seeds of splitting and of plain sampling differ in.
_SPLIT, _SAMPLE = 0, 1
# So many failures let plain sampling see.
SEEN = 10


@dataclass(frozen=True)
class Row:
    """One family under one judge."""

    family: str
    judge: str
    probability: float  #: of failing, by splitting: the mean over runs
    low: float  #: 95 % interval of the mean over runs (Student's t), 0 at least
    high: float
    runs: tuple[float, ...]  #: what each run came to; 0 where it found no failure
    ended: tuple[str, ...]  #: how each run ended, see `Split`
    tried: int  #: cases that all runs played
    accepted: float  #: share of moves that were
    worst: float  #: highest score without a failure: braking that was needed [m/s²]
    reached: float  #: probability of the last level, at the least over runs
    found: int  #: different cases that failed
    plain: int  #: plain samples
    plain_failed: int
    plain_low: float  #: 95 % interval (Clopper and Pearson 1934)
    plain_high: float
    known: float | None  #: the true probability, where it is known

    @property
    def name(self) -> str:
        """The family and who judges."""
        return self.family if self.family == TOY else f"{self.family}, {_WHO[self.judge]}"

    @property
    def plain_probability(self) -> float:
        """The share of plain samples that failed; NaN without any."""
        return self.plain_failed / self.plain if self.plain else math.nan

    @property
    def is_seen(self) -> bool:
        """Whether both splitting and plain sampling saw failures enough to be compared."""
        return self.probability > 0.0 and self.plain_failed >= SEEN

    @property
    def agrees(self) -> bool | None:
        """Whether both differ by no more than chance (99 %); None where one of them is blind."""
        if not self.is_seen:
            return None
        share = self.plain_probability
        return self._is_within(share, math.sqrt(share * (1.0 - share) / self.plain))

    @property
    def hits(self) -> bool | None:
        """Whether splitting and the truth differ by no more than chance; None if it is unknown."""
        return None if self.known is None else self._is_within(self.known, 0.0)

    def _is_within(self, other: float, error: float) -> bool:
        own = float(np.std(self.runs, ddof=1)) / math.sqrt(len(self.runs))
        times = float(student.ppf(0.5 + 0.5 * _SURER, len(self.runs) - 1))
        return abs(self.probability - other) <= times * math.hypot(own, error)


_WHO = {NOBODY: "no guard", "kinematic": "kinematic", "learnt": "learnt"}


@dataclass(frozen=True)
class Breaks:
    """All that was found."""

    plan: Amounts
    rows: list[Row]
    cases: list[list[FoundCase]]  #: of each row, those that are kept
    raw: list[list[Case]]  #: the same, as splitting has them
    splits: list[list[Split]]  #: of each row, each run

    @property
    def frame(self) -> Frame:
        """Every row."""
        return Frame(self.rows)


def run_breaks(plan: Amounts, progress: Progress = silent, workers: int | None = None) -> Breaks:
    """Search all that the plan names; see `Study.run`.

    Raises
    ------
    ValueError
        If there is no such family, switch or judge.
    """
    asked = []
    for family in plan.families:
        if family != TOY:
            load(family, plan.switches)  # if there is none of this name, it shows here
        judges = (NOBODY,) if family == TOY else plan.judges
        for judge in judges if family != TOY else ():
            check_learnt(plan.learnt, judge)
        asked += [(family, judge) for judge in judges]
    work = [_tasks(plan, place, *who) for place, who in enumerate(asked)]
    every: list[partial[Any]] = [task for tasks in work for task in tasks]
    results = in_order(every, workers, progress)
    ends = [*accumulate(map(len, work))]
    parts = [results[end - len(tasks) : end] for end, tasks in zip(ends, work, strict=True)]
    rows, cases, raw, splits = [], [], [], []
    for (family, judge), part in zip(asked, parts, strict=True):
        runs = [one for one in part if isinstance(one, Split)]
        failed = [one for one in part if isinstance(one, int)]
        n = _samples(plan, judge)
        rows.append(_row(family, judge, runs, n, sum(failed)))
        raw.append(ordinary((case for run in runs for case in run.failed), plan.keep))
        cases.append([found_case(family, plan.switches, case) for case in raw[-1]])
        splits.append(runs)
    return Breaks(plan, rows, cases, raw, splits)


def _tasks(
    plan: Amounts, place: int, family: str, judge: str
) -> list[partial[Split] | partial[int]]:
    """Runs of splitting and batches of plain samples, each a task."""
    subject = subject_of(family, judge, plan.switches, plan.train, plan.learnt, plan.seed)
    amount = Amount(plan.cases, plan.moves, plan.least)
    runs = [
        partial(run_split, subject, amount, (plan.seed, place, _SPLIT, k)) for k in range(plan.runs)
    ]
    size, n = _GUARDED if judge != NOBODY else _PLAIN, _samples(plan, judge)
    samples = [
        partial(run_plain, subject, min(size, n - first), (plan.seed, place, _SAMPLE, first))
        for first in range(0, n, size)
    ]
    return [*runs, *samples]


def run_split(subject: Subject, amount: Amount, seed: tuple[int, ...]) -> Split:
    """One run of splitting, in a worker."""
    return split(subject.score, amount, seed)


def run_plain(subject: Subject, n: int, seed: tuple[int, ...]) -> int:
    """How many plain samples fail, in a worker."""
    return plain(subject.score, n, seed)


def _samples(plan: Amounts, judge: str) -> int:
    return plan.plain if judge == NOBODY else plan.guarded


def _row(family: str, judge: str, runs: Sequence[Split], n: int, failed: int) -> Row:
    values = [run.probability for run in runs]
    mean = float(np.mean(values))
    times = float(student.ppf(0.5 + 0.5 * _SURE, len(values) - 1)) / math.sqrt(len(values))
    half = times * float(np.std(values, ddof=1))
    exact = binomtest(failed, n).proportion_ci(_SURE, method="exact") if n else None
    moves = [level.accepted for run in runs for level in run.levels]
    return Row(
        family,
        judge,
        mean,
        max(0.0, mean - half),
        min(1.0, mean + half),
        tuple(values),
        tuple(run.ended for run in runs),
        sum(run.tried for run in runs),
        float(np.mean(moves)) if moves else math.nan,
        max(run.best for run in runs),
        min((run.levels[-1].probability for run in runs if run.levels), default=1.0),
        sum(len(run.failed) for run in runs),
        n,
        failed,
        float(exact.low) if exact else 0.0,
        float(exact.high) if exact else 1.0,
        KNOWN if family == TOY else None,
    )
