"""The study: every run is judged once, by what other runs taught.

The others are those of the other folds, or those of another folder.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from studies.datasets.checksums import find_checksums
from studies.datasets.layouts import Layout, read_episodes
from studies.old.frame import Frame, Progress, silent
from studies.old.scores import Ranked, interval, resampled
from studies.old.shim import in_order
from studies.real.amounts import Amounts
from studies.real.cases import INTERVAL, QUESTIONS, Case, Question, case_of, runs_in
from studies.real.measures import (
    MEASURES,
    OBSERVERS,
    Learnt,
    StateShare,
    learn_logistic,
    learn_risk,
    learn_states,
    score_fixed,
)
from studies.real.moments import Moment, Warned, alarm_threshold, leads, telling_moments
from studies.real.targets import Target

#: Of fewer events, or events in fewer runs, nothing can be concluded.
FEWEST_EVENTS, FEWEST_RUNS = 10, 5
#: Beside this one every measure is held.
REFERENCE = "ttc"
#: Of ours, the one that is shown in figures and moments.
SHOWN = "evofsm-approach"
#: By this event moments are chosen and states are named: the most frequent one.
SHOWN_QUESTION = Question("braking-3", 2.0)
#: Warnings are looked at for events that are frequent enough, at this horizon [s].
WARNED_OF, WARNED_HORIZON = ("ttc-3", "braking-3"), 5.0
# Of the first fold so many states are kept, the most dangerous ones.
_KEPT = 60


@dataclass(frozen=True)
class Row:
    """One measure, asked one question."""

    target: str
    horizon: float  #: [s]
    measure: str
    auroc: float
    low: float  #: 95 %, bootstrap over runs
    high: float
    auprc: float
    auprc_low: float
    auprc_high: float
    over_ttc: float  #: AUROC minus that of `REFERENCE` in the same runs
    over_ttc_low: float
    over_ttc_high: float
    prevalence: float  #: share of decisions after which the event came
    runs: int  #: judged
    runs_with_events: int
    events: int  #: that began in them and could have been foretold
    decisions: int
    enough: bool  #: events, in enough runs, for a comparison to mean something


class Drives(NamedTuple):
    """How much was driven."""

    runs: int
    hours: float


@dataclass(frozen=True)
class RealStudy:
    """All that was measured."""

    plan: Amounts
    runs: tuple[str, ...]
    verified: int  #: files whose checksum was held against a list
    episodes: int
    hours: float
    rows: list[Row]
    warned: list[Warned]
    states: dict[str, tuple[int, int]]  #: fewest and most states of a fold, by measure
    shares: list[StateShare]  #: the most dangerous states of gap and speeds, as first learnt
    moments: list[Moment]
    taught_by: Drives | None = None  #: of another folder; None where folds taught each other

    @property
    def frame(self) -> Frame:
        """Every row."""
        return Frame(self.rows)

    @property
    def comparable(self) -> list[Row]:
        """Rows that rest on enough events."""
        return [row for row in self.rows if row.enough]

    def is_enough(self, target: Target) -> bool:
        """Whether there were events enough of a target, within some horizon."""
        return any(row.target == target.name for row in self.comparable)

    def of(self, target: str, horizon: float) -> list[Row]:
        """The rows of one question."""
        return [row for row in self.rows if (row.target, row.horizon) == (target, horizon)]

    def row(self, target: str, horizon: float, measure: str) -> Row:
        """The row of one measure and one question."""
        return next(row for row in self.of(target, horizon) if row.measure == measure)


def read_folder(folder: Path, plan: Amounts, *, dealt: bool = True) -> tuple[list[Case], int]:
    """Decisions of all runs in a folder, and how many files were held against a checksum.

    Parameters
    ----------
    folder : Path
        Holds ``*.csv`` or ``*.csv.gz`` in the layout `evofsm.io.Layout.PAIRS`, one file
        a run; lists of checksums and of segments in capital letters are no runs.
    plan : Amounts
        Tells how many runs at most.
    dealt : bool
        Whether its runs will be dealt to folds, each of which needs one.

    Raises
    ------
    NotADirectoryError
        If there is no such folder.
    ValueError
        If there is no run, or fewer than folds, or a file is not what it should be.
    """
    paths = runs_in(folder)
    if plan.most_runs is not None and len(paths) > plan.most_runs:
        rng = np.random.default_rng(plan.seed)
        chosen = rng.choice(len(paths), size=plan.most_runs, replace=False)
        paths = [paths[k] for k in sorted(chosen.tolist())]
    if dealt and len(paths) < plan.folds:
        raise ValueError(
            f"{folder} holds {len(paths)} runs (*.csv, *.csv.gz); {plan.folds} folds need as many"
        )
    listed = find_checksums(folder)
    verified = sum(path.name in listed for path in paths)
    return [case_of(episode) for episode in read_episodes(paths, Layout.PAIRS)], verified


def fold_of_runs(runs: Sequence[str], folds: int, seed: int) -> dict[str, int]:
    """Deal runs to folds, shuffled by the seed, those of one source evenly.

    The source of a run is its name up to the first underscore.

    Examples
    --------
    >>> folds = fold_of_runs(["a_1", "a_2", "b_1", "b_2"], folds=2, seed=0)
    >>> [len({folds[f"{source}_1"], folds[f"{source}_2"]}) for source in "ab"]
    [2, 2]
    """
    shuffled = [runs[k] for k in np.random.default_rng(seed).permutation(len(runs))]
    dealt = sorted(shuffled, key=lambda run: run.split("_")[0])
    return {run: place % folds for place, run in enumerate(dealt)}


def run_real(
    cases: Sequence[Case],
    plan: Amounts,
    verified: int = 0,
    progress: Progress = silent,
    workers: int | None = None,
    training: Sequence[Case] | None = None,
) -> RealStudy:
    """Learn on some runs and judge on others, until every run was judged once.

    Parameters
    ----------
    cases : sequence of Case
    plan : Amounts
    verified : int
        Files whose checksum was held against a list; told on, no more.
    progress, workers
        As `Study.run` takes them.
    training : sequence of Case, optional
        All that is learnt from, and all of ``cases`` are judged by it. Without it the runs of
        ``cases`` are dealt to folds, and each fold is judged by what the others taught.

    Raises
    ------
    ValueError
        If there are fewer runs than folds, or than 2; if a recording is in ``cases`` and in
        ``training``.
    """
    runs = tuple(sorted({case.run for case in cases}))
    parts = _folds(cases, runs, plan) if training is None else [_apart(training, cases)]
    tasks = [
        (part, partial(learner, part.training, [cases[k] for k in part.judged]))
        for part in parts
        for learner in _LEARNERS
    ]
    scores: dict[str, list[dict[Question, NDArray[np.float64]]]] = {
        name: [dict.fromkeys(QUESTIONS, score) for score in each]
        for name, each in score_fixed(cases).items()
    }
    states: dict[str, list[int]] = {}
    shares: list[StateShare] = []
    results = in_order([task for _, task in tasks], workers, progress)
    for (part, _), learnt in zip(tasks, results, strict=True):
        for name, found in learnt.scores.items():
            every = scores.setdefault(name, [{} for _ in cases])
            for k, one in zip(part.judged, found, strict=True):
                every[k] = one
            if learnt.states:
                states.setdefault(name, []).append(learnt.states)
            if part is parts[0] and name == "evofsm-states":
                shares = list(learnt.shares)
    asked = {
        (name, question): [one[question] for one in scores[name]]
        for name in (measure.name for measure in MEASURES)
        for question in QUESTIONS
    }
    return RealStudy(
        plan,
        runs,
        verified,
        len(cases),
        _hours(cases),
        [row for question in QUESTIONS for row in _rows(cases, runs, question, asked, plan)],
        [
            _warned(cases, asked, target, measure.name)
            for target in WARNED_OF
            for measure in MEASURES
        ],
        {name: (min(counts), max(counts)) for name, counts in states.items()},
        shares,
        telling_moments(
            cases,
            *SHOWN_QUESTION,
            asked[SHOWN, SHOWN_QUESTION],
            asked[REFERENCE, SHOWN_QUESTION],
        ),
        None
        if training is None
        else Drives(len({case.run for case in training}), _hours(training)),
    )


def _hours(cases: Iterable[Case]) -> float:
    return sum(len(case.times) for case in cases) * INTERVAL / 3600.0


_LEARNERS: tuple[Callable[[Sequence[Case], Sequence[Case]], Learnt], ...] = (
    learn_risk,
    *(partial(learn_states, name, SHOWN_QUESTION, _KEPT) for name in OBSERVERS),
    learn_logistic,
)


class _Part(NamedTuple):
    """What is learnt from, and the places of the cases that are judged by it."""

    training: list[Case]
    judged: list[int]


def _folds(cases: Sequence[Case], runs: Sequence[str], plan: Amounts) -> list[_Part]:
    """Each fold judged by what the others taught."""
    if not 2 <= plan.folds <= len(runs):
        raise ValueError(f"{len(runs)} runs cannot be dealt to {plan.folds} folds")
    folds = fold_of_runs(runs, plan.folds, plan.seed)
    return [
        _Part(
            [case for case in cases if folds[case.run] != fold],
            [k for k, case in enumerate(cases) if folds[case.run] == fold],
        )
        for fold in range(plan.folds)
    ]


def _apart(training: Sequence[Case], cases: Sequence[Case]) -> _Part:
    """All judged by what other recordings taught."""
    taught = {case.observations.tobytes(): case for case in training}
    for case in cases:
        if (same := taught.get(case.observations.tobytes())) is not None:
            raise ValueError(
                f"{case.run}, {case.pair} is judged and learnt from (as {same.run}, {same.pair}): "
                "what is judged must not be among what teaches"
            )
    return _Part(list(training), list(range(len(cases))))


def _rows(
    cases: Sequence[Case],
    runs: Sequence[str],
    question: Question,
    asked: dict[tuple[str, Question], list[NDArray[np.float64]]],
    plan: Amounts,
) -> Iterable[Row]:
    """All measures, asked one question, with the same draws of runs."""
    place = {run: k for k, run in enumerate(runs)}
    answers = [case.answers[question] for case in cases]
    came = np.concatenate([answer.came[answer.known] for answer in answers])
    of_run = np.repeat(
        [place[case.run] for case in cases], [int(answer.known.sum()) for answer in answers]
    )
    draws = resampled(len(runs), plan.rounds, plan.seed)
    weights = [np.ones(len(runs)), *(np.bincount(d, minlength=len(runs)) for d in draws)]
    found: dict[str, NDArray[np.float64]] = {}
    for measure in MEASURES:
        scores = asked[measure.name, question]
        score = np.concatenate([one[a.known] for one, a in zip(scores, answers, strict=True)])
        ranked = Ranked(score, came, of_run)
        found[measure.name] = np.array([ranked.areas(weight) for weight in weights])
    events, with_events = _foretellable(cases, question)
    for name, areas_found in found.items():
        over = areas_found[:, 0] - found[REFERENCE][:, 0]
        yield Row(
            *question,
            name,
            float(areas_found[0, 0]),
            *interval(areas_found[1:, 0]),
            float(areas_found[0, 1]),
            *interval(areas_found[1:, 1]),
            float(over[0]),
            *interval(over[1:]),
            float(came.mean()) if len(came) else np.nan,
            len(runs),
            with_events,
            events,
            len(came),
            events >= FEWEST_EVENTS and with_events >= FEWEST_RUNS,
        )


def _foretellable(cases: Sequence[Case], question: Question) -> tuple[int, int]:
    """Events before which a decision was asked, and the number of runs that they are in."""
    events, runs = 0, set()
    for case in cases:
        came, known = case.answers[question]
        asked = case.times[came & known]
        for begin in case.begins[question.target].tolist():
            if ((asked < begin) & (asked >= begin - question.horizon - 1e-6)).any():
                events += 1
                runs.add(case.run)
    return events, len(runs)


def _warned(
    cases: Sequence[Case],
    asked: dict[tuple[str, Question], list[NDArray[np.float64]]],
    target: str,
    measure: str,
) -> Warned:
    scores = asked[measure, Question(target, WARNED_HORIZON)]
    threshold = alarm_threshold(scores, cases, target, WARNED_HORIZON)
    found = leads(scores, threshold, cases, target)
    warned = [lead for lead in found if lead > 0.0]
    median = float(np.median(warned)) if warned else np.nan
    return Warned(target, measure, len(found), len(warned), median, tuple(found))
