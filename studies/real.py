"""Real drives: whether what was learnt on some foretells danger in others; how leaders brake.

Human drivers and cruise controls command nothing that we could see, so only watching is possible:
the acceleration that is learnt from is the one that was realised.

`Real`, frame ``rows``: one ``measure``, asked whether an event (``target``) comes within a
``horizon`` [s]; both areas with 95 % intervals by bootstrap over runs, and ``over_ttc``, its AUROC
minus that of time to collision. ``prevalence`` is the share of decisions after which the event
came; ``enough`` says whether there were events enough, in enough runs, to compare anything.

`Leaders`, frame ``rows``: hard brakes of the leaders of one ``source``, or of all; frame
``alarms``: what shadow mode would have alarmed beside their followers, by what it was told.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import groupby, pairwise
from pathlib import Path
from typing import Annotated, Any, ClassVar, NamedTuple, Self

import numpy as np
import polars as pl
from numpy.typing import NDArray
from typer import Option

from evofsm.driving import (
    REAL_DRIVES,
    SAFETY_RULE,
    LatentRisk,
    LeaderBrakes,
    measures,
)
from evofsm.fsm import EvolvingFSM, FSMModel, IntervalActions, Novelty
from evofsm.guard import (
    BELIEF_TOLERANCE,
    TOLERANCE,
    ActionReviser,
    Guard,
    Mode,
    RiskMeasure,
    is_spoken,
)
from evofsm.paper import Page, Table
from studies import lib
from studies.drives import Episode, checksums_in, read_runs, runs_in
from studies.lib import Frames, Study, at_least, frame_of

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

# -- What is asked --------------------------------------------------------------------------------

#: Time between decisions [s].
INTERVAL = 0.2
#: How far is looked ahead [s].
HORIZONS = (1.0, 2.0, 5.0)
#: Slower than this a short time to collision is mostly creeping to a stop [m/s].
CREEPING = 5.0
#: Of fewer events, or events in fewer runs, nothing can be concluded.
FEWEST_EVENTS, FEWEST_RUNS = 10, 5
# Accelerations are taken over so many decisions: 0.4 s.
_SPAN = 2


def _is_close(episode: Episode) -> Bools:
    """(T,) time to collision below 3 s, while driving."""
    seen = episode.observations
    return (measures.time_to_collision(seen) < 3.0) & (seen[:, 1] > CREEPING)


def _brakes_hard(episode: Episode) -> Bools:
    """(T,) the follower brakes harder than 3 m/s²."""
    return np.asarray(episode.accelerations < -3.0)


#: Events by name: whether they happen in each row.
TARGETS: Mapping[str, Callable[[Episode], Bools]] = {"ttc-3": _is_close, "braking-3": _brakes_hard}


class Question(NamedTuple):
    """An event, and how far is looked ahead."""

    target: str
    horizon: float  #: [s]


QUESTIONS = tuple(Question(target, horizon) for target in TARGETS for horizon in HORIZONS)


class Coming(NamedTuple):
    """Whether an event came within a horizon after each row."""

    came: Bools  #: (T,)
    known: Bools  #: (T,) False where it is happening already, or the episode ends first


def coming(happens: Bools, steps: int) -> Coming:
    """Look so many rows ahead from each row, that row itself left out.

    >>> came, known = coming(np.array([False, False, True, False, False]), steps=2)
    >>> came.tolist(), known.tolist()
    ([True, True, False, False, False], [True, True, False, False, False])
    """
    rows = len(happens)
    so_far = np.append(0, np.cumsum(happens))
    row = np.arange(rows)
    came = so_far[np.minimum(row + steps, rows - 1) + 1] > so_far[row + 1]
    return Coming(came, (came | (row + steps < rows)) & ~happens)


class Case(NamedTuple):
    """An episode of one pair as T decisions, with what came after each."""

    run: str
    pair: str
    times: Floats  #: (T,) [s]
    observations: Floats  #: (T, 3) gap [m], both speeds [m/s]
    answers: dict[Question, Coming]  #: of T decisions each; known only above `CREEPING`
    begins: dict[str, Floats]  #: by target: times at which events begin [s]


def case_of(episode: Episode) -> Case:
    """Decisions of an episode; what came is looked up in all its rows."""
    stride = round(INTERVAL / episode.dt)
    if stride < 1 or abs(stride * episode.dt - INTERVAL) > 0.02 * INTERVAL:
        raise ValueError(
            f"{episode.run}, {episode.pair}: a row every {episode.dt:g} s cannot be read every "
            f"{INTERVAL:g} s; resample it"
        )
    chosen = slice(0, None, stride)
    moves = episode.observations[chosen, 1] > CREEPING
    answers, begins = {}, {}
    for target, happening in TARGETS.items():
        happens = happening(episode)
        # One that an episode begins with has no beginning.
        begins[target] = episode.times[np.flatnonzero(happens[1:] & ~happens[:-1]) + 1]
        for horizon in HORIZONS:
            came, known = coming(happens, round(horizon / episode.dt))
            answers[Question(target, horizon)] = Coming(came[chosen], known[chosen] & moves)
    seen = episode.times[chosen], episode.observations[chosen]
    return Case(episode.run, episode.pair, *seen, answers, begins)


def recent_acceleration(speed: Floats) -> Floats:
    """(T,) mean acceleration over the latest 0.4 s [m/s²]; 0 where too little was seen.

    >>> recent_acceleration(np.array([10.0, 10.0, 9.0, 8.0]))
    array([ 0. ,  0. , -2.5, -5. ])
    """
    found = np.zeros(len(speed))
    found[_SPAN:] = (speed[_SPAN:] - speed[:-_SPAN]) / (_SPAN * INTERVAL)
    return found


# -- What is compared -----------------------------------------------------------------------------

#: Hardest braking taken as possible; what cars could do was never shown [m/s²].
LOWEST = -6.0
#: Every measure is compared with this one.
REFERENCE = "ttc"
#: The one of ours that the others are compared with.
SHOWN = "evofsm-approach"
FIXED: Mapping[str, RiskMeasure] = {
    "ttc": measures.TimeToCollision(),
    "mttc": measures.ModifiedTimeToCollision(),
    "headway": measures.TimeHeadway(),
    "rss-r157": measures.ResponsibilitySensitiveSafety.r157(),
}
# Cases of the overall share that are added to those of a state.
_LEAN = 2.0
# Closing rate [1/s], leader's acceleration [m/s²] and logarithm of the time headway in which a
# situation differs so much that it is another one.
_APPROACH_RULE = Novelty(radius=1.0, scales=(0.05, 0.7, 0.4))
# Below this speed a time headway says nothing [m/s].
_SLOWEST = 1.0
# Of the logistic regression: penalty of each weight, for an event.
_RIDGE = 1e-3

#: What a measure says of the decisions of a case, (T,) for each question.
Scores = dict[Question, Floats]
#: What one learner says of held-out cases: by measure, one for each case.
Learnt = dict[str, list[Scores]]


def _whatever_is_asked(score: Floats) -> Scores:
    return dict.fromkeys(QUESTIONS, score)


def score_fixed(cases: Sequence[Case]) -> Learnt:
    """Scores of what learns nothing."""
    found = {
        name: [_whatever_is_asked(one.score(case.observations, INTERVAL)) for case in cases]
        for name, one in FIXED.items()
    }
    leaders = [-recent_acceleration(case.observations[:, 2]) for case in cases]
    return found | {"leader-braking": [_whatever_is_asked(score) for score in leaders]}


def learn_risk(training: Sequence[Case], held_out: Sequence[Case]) -> Learnt:
    """Watch the training runs, and score held-out ones by the latent risk."""
    risk = LatentRisk(LOWEST, INTERVAL)
    for case in training:
        realised = np.append(np.diff(case.observations[:, 1]) / INTERVAL, 0.0)
        for row, acceleration in zip(case.observations, realised.tolist(), strict=True):
            risk.learn(row, acceleration)
        risk.end(None, failed=False)
    return {"evofsm": [_whatever_is_asked(risk.score(case.observations)) for case in held_out]}


def as_they_are(case: Case) -> Floats:
    """Gap [m] and both speeds [m/s], as the paper observes."""
    return case.observations


def approach(case: Case) -> Floats:
    """(T, 3) what danger hangs on: how the follower approaches.

    Closing speed over gap [1/s], the inverse of the time to collision; the leader's acceleration
    over the latest 0.4 s [m/s²]; the natural logarithm of the time headway [s].
    """
    gap, speed, leader = case.observations.T
    headway = np.log(gap / np.maximum(speed, _SLOWEST))
    return np.column_stack([(speed - leader) / gap, recent_acceleration(leader), headway])


#: By measure: what a machine observes, and its rule; None for the paper's.
OBSERVERS: Mapping[str, tuple[Callable[[Case], Floats], Novelty | None]] = {
    "evofsm-paper": (as_they_are, None),
    "evofsm-states": (as_they_are, SAFETY_RULE),
    "evofsm-approach": (approach, _APPROACH_RULE),
}


class ComingByState:
    """How often each event followed within each horizon, by state of a model."""

    def __init__(self, model: FSMModel) -> None:
        self.model = model
        self.cases = np.zeros((len(QUESTIONS), model.n_states))
        self.came = np.zeros((len(QUESTIONS), model.n_states))

    def learn(self, observations: Floats, case: Case) -> None:
        """Take in the decisions of a case, observed as the model's machine observes."""
        belief = self.model.recognise(observations)
        known = np.array([case.answers[question].known for question in QUESTIONS])
        came = np.array([case.answers[question].came for question in QUESTIONS])
        self.cases += known @ belief
        self.came += (known & came) @ belief

    def score(self, observations: Floats) -> Scores:
        """Probability of each event within each horizon."""
        belief = self.model.recognise(observations)
        anywhere = (self.came.sum(axis=1) + 0.5) / (self.cases.sum(axis=1) + 1.0)
        came = belief @ self.came.T + _LEAN * anywhere
        return dict(zip(QUESTIONS, (came / (belief @ self.cases.T + _LEAN)).T, strict=True))


def learn_states(name: str, training: Sequence[Case], held_out: Sequence[Case]) -> Learnt:
    """Grow states in the training runs, count what followed in them, and score held-out runs."""
    observe, rule = OBSERVERS[name]
    machine = EvolvingFSM(n_actions=1, rule=rule, belief_tolerance=BELIEF_TOLERANCE)
    for case in training:
        seen = observe(case)
        machine.learn_many(seen, np.full(len(seen), -1), [0])
    counts = ComingByState(machine.model())
    for case in training:
        counts.learn(observe(case), case)
    return {name: [counts.score(observe(case)) for case in held_out]}


def learn_logistic(training: Sequence[Case], held_out: Sequence[Case]) -> Learnt:
    """To be fair: logistic regression on `approach`, fitted for each question."""
    features = [approach(case) for case in training]
    every = np.concatenate(features)
    mean, spread = every.mean(axis=0), np.maximum(every.std(axis=0), 1e-9)

    def design(rows: Floats) -> Floats:
        return np.column_stack([(rows - mean) / spread, np.ones(len(rows))])

    designs, tests = map(design, features), [design(approach(case)) for case in held_out]
    learning = list(zip(designs, training, strict=True))
    scores: list[Scores] = [{} for _ in held_out]
    for question in QUESTIONS:
        rows = np.concatenate([x[case.answers[question].known] for x, case in learning])
        answers = [case.answers[question] for case in training]
        came = np.concatenate([a.came[a.known] for a in answers])
        ridge = np.full(rows.shape[1], _RIDGE * max(float(came.sum()), 1.0))
        weights = lib.logistic(rows, came, ridge)
        for test, found in zip(tests, scores, strict=True):
            found[question] = test @ weights
    return {"logistic": scores}


_LEARNERS: tuple[Callable[[Sequence[Case], Sequence[Case]], Learnt], ...] = (
    learn_logistic,
    learn_risk,
    *(partial(learn_states, name) for name in OBSERVERS),
)

# -- The study ------------------------------------------------------------------------------------

_DATA = (
    "Folder of runs, a CSV file each (gzipped or not): pair, segment, time, gap, v_follower, "
    "v_leader, a_follower. See docs/real-data.md."
)


@dataclass(frozen=True, kw_only=True)
class Real(Study):
    """Whether what was learnt on some real drives foretells danger in others."""

    name: ClassVar[str] = "real"

    data: Annotated[Path, Option(help=_DATA)]
    train: Annotated[
        Path | None,
        Option(
            help="Another folder of runs: all that is learnt from, and all of --data is judged. "
            "Without it the runs of --data are dealt to folds."
        ),
    ] = None
    folds: Annotated[
        int, Option(min=2, help="Each run is judged by what the other folds taught (no --train).")
    ] = 5
    rounds: int = 500  #: of the bootstrap
    most_runs: int | None = None  #: as many runs at most, drawn with the seed; None for all

    def shortened(self) -> Self:
        """Ten runs: too few for conclusions."""
        return self.smaller(folds=2, rounds=100, most_runs=10)

    def run(self, workers: int | None = None) -> dict[str, pl.DataFrame]:
        """Learn on some runs of ``data``, or on those of ``train``, and judge on the others."""
        cases = self.cases_in(self.data, dealt=self.train is None)
        if self.train is not None:
            parts = [_apart(self.cases_in(self.train), cases)]
        else:
            parts = _dealt(cases, self.folds, self.seed)
        tasks = [
            partial(learner, training, [cases[k] for k in judged])
            for training, judged in parts
            for learner in _LEARNERS
        ]
        results = lib.parallel(tasks, workers, "Learning and judging")
        scores = score_fixed(cases)
        for place, learnt in enumerate(results):
            judged = parts[place // len(_LEARNERS)][1]
            for name, found in learnt.items():
                every = scores.setdefault(name, [{} for _ in cases])
                for k, one in zip(judged, found, strict=True):
                    every[k] = one
        rows = [row for one in QUESTIONS for row in self._rows(cases, one, scores)]
        return {"rows": frame_of(rows)}

    def cases_in(self, folder: Path, *, dealt: bool = False) -> list[Case]:
        """Decisions of the runs in a folder; where they are dealt to folds, each needs one."""
        paths = runs_in(folder)
        if self.most_runs is not None and len(paths) > self.most_runs:
            rng = np.random.default_rng(self.seed)
            chosen = rng.choice(len(paths), size=self.most_runs, replace=False)
            paths = [paths[k] for k in sorted(chosen.tolist())]
        if dealt and len(paths) < self.folds:
            raise ValueError(
                f"{folder} holds {len(paths)} runs (*.csv, *.csv.gz); {self.folds} folds need as "
                "many"
            )
        return [case_of(episode) for episode in read_runs(paths)]

    def _rows(
        self, cases: Sequence[Case], question: Question, scores: Learnt
    ) -> Iterator[dict[str, Any]]:
        """All measures, asked one question, with the same draws of runs."""
        runs = sorted({case.run for case in cases})
        answers = [case.answers[question] for case in cases]
        came = np.concatenate([answer.came[answer.known] for answer in answers])
        known = [int(answer.known.sum()) for answer in answers]
        of_run = np.repeat([runs.index(case.run) for case in cases], known)
        draws = lib.resampled(len(runs), self.rounds, self.seed)
        weights = [np.ones(len(runs)), *(np.bincount(d, minlength=len(runs)) for d in draws)]
        found: dict[str, Floats] = {}
        for name, of_cases in scores.items():
            pairs = zip(of_cases, answers, strict=True)
            score = np.concatenate([one[question][answer.known] for one, answer in pairs])
            ranked = lib.Ranked(score, came, of_run)
            found[name] = np.array([ranked.areas(weight) for weight in weights])
        events, with_events = foretellable(cases, question)
        for name, areas in found.items():
            row = {"target": question.target, "horizon": question.horizon, "measure": name}
            over = areas[:, 0] - found[REFERENCE][:, 0]
            for kind, values in (
                ("auroc", areas[:, 0]),
                ("auprc", areas[:, 1]),
                ("over_ttc", over),
            ):
                low, high = lib.interval(values[1:])
                row |= {kind: float(values[0]), f"{kind}_low": low, f"{kind}_high": high}
            yield row | {
                "prevalence": float(came.mean()) if len(came) else math.nan,
                "runs": len(runs),
                "runs_with_events": with_events,
                "events": events,
                "decisions": len(came),
                "enough": events >= FEWEST_EVENTS and with_events >= FEWEST_RUNS,
            }

    def page(self, found: Frames) -> Page:
        """How well each measure ranks moments before events, and which rank them better."""
        rows = found["rows"]
        is_ours = pl.col("measure").str.starts_with("evofsm")
        enough = rows.filter("enough")
        shown = enough.filter(measure=SHOWN)
        clear = int((shown["over_ttc_low"] > 0.0).sum())
        both = lib.compared(enough, pl.col("measure") == SHOWN, ["target", "horizon"])
        better = (pl.col("auroc") > pl.col("auroc_ours")) | (pl.col("auprc") > pl.col("auprc_ours"))
        asked = {"event": "{target}", "within [s]": "{horizon:g}"}
        columns = {
            "measure": "{measure}",
            "AUROC (95 %)": "{auroc:.3f} ({auroc_low:.2f}–{auroc_high:.2f})",
            "over ttc (95 %)": "{over_ttc:+.3f} ({over_ttc_low:+.3f} to {over_ttc_high:+.3f})",
            "AUPRC (95 %)": "{auprc:.3f} ({auprc_low:.2f}–{auprc_high:.2f})",
        }
        counted = ["events", "runs_with_events", "runs", "decisions", "prevalence", "enough"]
        return self.shown(
            _ABOUT,
            [
                Table(
                    "What was asked",
                    rows.select("target", "horizon", *counted).unique(maintain_order=True),
                    asked
                    | {"events": "{events} in {runs_with_events} of {runs} runs"}
                    | {"decisions": "{decisions}", "came": "{prevalence:%}"}
                    | {"enough": "{enough}"},
                    "Events that could be foretold; came: share of decisions after which the event "
                    f"came. Enough: {FEWEST_EVENTS} events in {FEWEST_RUNS} runs; of fewer, rows "
                    "order by chance.",
                ),
                Table(
                    "How well moments before events are ranked",
                    rows,
                    asked | columns,
                    "Over ttc: AUROC minus that of time to collision, in the same runs.",
                    pl.when(is_ours).then(pl.lit("ours")),
                ),
            ],
            lost=[
                Table(
                    "Measures that rank better than evofsm-approach",
                    both.filter(better & ~is_ours),
                    asked
                    | {"measure": "{measure}", "AUROC": "{auroc:.3f} against {auroc_ours:.3f}"}
                    | {"AUPRC": "{auprc:.3f} against {auprc_ours:.3f}"},
                    "Theirs against ours.",
                ),
                Table(
                    "Ours that rank worse than time to collision",
                    enough.filter(is_ours & (pl.col("over_ttc") < 0.0)),
                    asked | columns,
                ),
            ],
            targets=[at_least(_ASKED, clear, len(shown))] if len(shown) else [],
            facts={"checksums": f"{len(checksums_in(self.data))} in the list"},
            verdict="" if len(shown) else "Too few events in these runs to compare anything",
        )


_ABOUT = f"""Does what was learnt on some real drives foretell danger in others?

A decision is made every {INTERVAL:g} s; what came within {HORIZONS[0]:g}, {HORIZONS[1]:g} and
{HORIZONS[2]:g} s is the truth. Each run is judged once, by what was learnt on the runs of the other
folds, or of the other folder. Left out are decisions at {CREEPING:g} m/s or slower, those at which
the event is under way already, and those whose outcome the end of an episode hides. Intervals
(95 %) draw whole runs; runs of one day may share cars and drivers, so they are still too narrow.

Nobody commanded anything that could be seen, so only watching is possible: full braking is never
observed, and {-LOWEST:g} m/s² is assumed to be commandable. Only logistic and ours learn anything
from the training runs."""
_ASKED = f"questions in which {SHOWN} surely ranks better than time to collision"


def _dealt(cases: Sequence[Case], folds: int, seed: int) -> list[tuple[list[Case], list[int]]]:
    """For each fold what the others teach, and the places of its own cases."""
    fold = fold_of_runs(sorted({case.run for case in cases}), folds, seed)
    return [
        (
            [case for case in cases if fold[case.run] != out],
            [k for k, case in enumerate(cases) if fold[case.run] == out],
        )
        for out in range(folds)
    ]


def fold_of_runs(runs: Sequence[str], folds: int, seed: int) -> dict[str, int]:
    """Deal runs to folds, shuffled by the seed, those of one source evenly.

    The source of a run is its name up to the first underscore.

    >>> folds = fold_of_runs(["a_1", "a_2", "b_1", "b_2"], folds=2, seed=0)
    >>> [len({folds[f"{source}_1"], folds[f"{source}_2"]}) for source in "ab"]
    [2, 2]
    """
    shuffled = [runs[k] for k in np.random.default_rng(seed).permutation(len(runs))]
    dealt = sorted(shuffled, key=lambda run: run.split("_")[0])
    return {run: place % folds for place, run in enumerate(dealt)}


def _apart(training: list[Case], cases: Sequence[Case]) -> tuple[list[Case], list[int]]:
    """All judged by what other recordings taught."""
    taught = {case.observations.tobytes(): case for case in training}
    for case in cases:
        if (same := taught.get(case.observations.tobytes())) is not None:
            raise ValueError(
                f"{case.run}, {case.pair} is judged and learnt from (as {same.run}, {same.pair}): "
                "what is judged must not be among what teaches"
            )
    return training, list(range(len(cases)))


def foretellable(cases: Sequence[Case], question: Question) -> tuple[int, int]:
    """Events before which a decision was asked, and the number of runs that they are in."""
    runs = []
    for case in cases:
        came, known = case.answers[question]
        asked = case.times[came & known]
        for begin in case.begins[question.target].tolist():
            if ((asked < begin) & (asked >= begin - question.horizon - 1e-6)).any():
                runs.append(case.run)
    return len(runs), len(set(runs))


# -- Leaders' hard brakes, and alarms beside ordinary driving -------------------------------------

#: What is taken to be known in shadow mode, in the order in which it is reported.
TOLD = ("nothing", "own brakes", "and the shipped table", "and leaders of the other runs")
# Brakes of one run that are closer in time are of one wave, whoever brakes [s].
_ONE_WAVE = 10.0
# As `LeaderBrakes` counts: braking from which on it is hard, and the width of a bin [m/s²].
_HARD, _BIN_WIDTH = 2.5, 0.25
# No driver in a car does more [m/s²].
_HIGHEST, _WIDTH = 12.0, 0.5
# So many are to be seen until an assumed one weighs no more than the tolerance.
_NEEDED = math.ceil(1.0 / TOLERANCE - 1e-9) - 1


class Watched(NamedTuple):
    """Leaders of one run."""

    source: str  #: the name of the run up to its first underscore
    braked: tuple[tuple[float, float], ...]  #: time [s] and deceleration [m/s²] of hard brakes
    gentle: int
    hours: float


@dataclass(frozen=True, kw_only=True)
class Leaders(Study):
    """How hard leaders brake in real drives, and how often shadow mode would alarm beside them.

    Leaders are watched as a follower's latent risk watches them. In shadow mode every row is a
    decision, and the driver's own acceleration the proposal.
    """

    name: ClassVar[str] = "leaders"

    data: Annotated[Path, Option(help=_DATA)]
    first: Annotated[
        int | None, Option(min=1, help="Count alarms in so many runs, the first by name.")
    ] = None
    lowest: Annotated[
        float, Option(max=-0.1, help="Hardest braking that can be commanded [m/s²].")
    ] = -8.0
    decel: Annotated[
        float, Option(min=0.1, help="What it brings, where own brakes are told [m/s²].")
    ] = 7.0

    def shortened(self) -> Self:
        """Alarms in three runs."""
        return self.smaller(first=3)

    def run(self, workers: int | None = None) -> dict[str, pl.DataFrame]:
        """Count hard brakes in all runs, and alarms in the first ones."""
        paths = runs_in(self.data)
        runs = lib.parallel([partial(watch_leaders, path) for path in paths], workers, "Watching")
        asked = [(k, told) for k in range(len(paths[: self.first])) for told in TOLD]
        tasks = [
            partial(
                shadow,
                paths[k],
                self.lowest,
                None if told == TOLD[0] else self.decel,
                _table(runs, k, told),
            )
            for k, told in asked
        ]
        counted = [
            {"source": runs[k].source, "told": told, "runs": 1, **counts}
            for (k, told), counts in zip(asked, lib.parallel(tasks, workers), strict=True)
        ]
        alarms = frame_of(counted)
        whole = alarms.with_columns(source=pl.lit("all"))
        added = pl.concat([alarms, whole]).group_by("source", "told", maintain_order=True).sum()
        sources = dict.fromkeys(run.source for run in runs)
        rows = [
            _braked(source, [run for run in runs if run.source == source]) for source in sources
        ]
        return {"rows": frame_of([*rows, _braked("all", runs)]), "alarms": added}

    def page(self, found: Frames) -> Page:
        """Brakes by source and by how hard they were, and alarms by what was told."""
        rows = found["rows"]
        every = rows.row(-1, named=True)
        bins = range(max(len(every["counts"]), len(REAL_DRIVES.counts)))
        counts = {"here": every["counts"], "shipped": list(REAL_DRIVES.counts)}
        by_bin = pl.DataFrame(
            {"harder": [_HARD + _BIN_WIDTH * k for k in bins]}
            | {name: [*some, *[0] * (len(bins) - len(some))] for name, some in counts.items()}
        )
        share = (pl.col("alarms") / pl.col("decisions")).alias("share")
        alarms = found["alarms"].with_columns(share).pivot("told", index="source", values="share")
        return self.shown(
            _ABOUT_LEADERS,
            [
                Table(
                    "Hard brakes of leaders, 2.5 m/s² and more",
                    rows,
                    {"drives": "{source}", "runs": "{runs}", "hours": "{hours:.1f}"}
                    | {"gentle": "{gentle}", "hard": "{hard}", "waves": "{waves}"}
                    | {"hardest [m/s²]": "{hardest:.1f}", f"hours to {_NEEDED}": "{needed:.1f}"},
                    f"With {_NEEDED} remembered, a leader who is only assumed weighs no more than "
                    f"{TOLERANCE:.0%}. Waves: hard brakes less than 10 s apart in a run count "
                    "once.",
                ),
                Table(
                    "The same by how hard they were",
                    by_bin,
                    {"harder than [m/s²]": "{harder:.2f}", "in these drives": "{here}"}
                    | {"in the shipped table": "{shipped}"},
                    f"Shipped: {REAL_DRIVES.source}; {REAL_DRIVES.hours:g} h. That none of "
                    f"{every['hard']} was harder than the hardest says that at most "
                    f"{_unseen(every['hard'])} % are (95 %), if each is drawn by itself; brakes of "
                    "one wave are not.",
                ),
                Table(
                    "Rows that alarm in shadow mode",
                    alarms,
                    {"drives": "{source}"} | {told: f"{{{told}:%}}" for told in TOLD},
                    f"Tolerance {TOLERANCE:.0%}. Own brakes: {self.decel:g} m/s² of "
                    f"{-self.lowest:g} that can be commanded; untold, 60 % are assumed. The "
                    "shipped table may come from these very drives; leaders of the other runs "
                    "leave out the run that is judged.",
                ),
            ],
        )


_ABOUT_LEADERS = """How hard do leaders brake in real drives, and how often would shadow mode alarm?

Leaders are watched as a follower's latent risk watches them. In shadow mode every row is a
decision, and the driver's own acceleration the proposal."""


def _by_pair(path: Path) -> Iterator[list[Episode]]:
    """Episodes of a run, those of a pair together."""
    episodes = sorted(read_runs([path]), key=lambda one: one.pair)
    for _, of_pair in groupby(episodes, key=lambda one: one.pair):
        yield list(of_pair)


def watch_leaders(path: Path) -> Watched:
    """Every leader of a run, as a follower's `LatentRisk` sees it."""
    braked: list[tuple[float, float]] = []
    gentle, seconds, run = 0, 0.0, ""
    for episodes in _by_pair(path):
        risk = LatentRisk(-8.0, episodes[0].dt)

        def learn(do: Callable[[], Any], time: float, risk: LatentRisk = risk) -> None:
            before = len(risk.manoeuvres)
            do()
            if len(risk.manoeuvres) > before:
                braked.append((time, risk.manoeuvres.decels[-1]))

        for episode in episodes:
            for time, row in zip(episode.times.tolist(), episode.observations, strict=True):
                learn(partial(risk.learn, row, 0.0), time)
            learn(risk.start_episode, float(episode.times[-1]))
            seconds += len(episode.times) * episode.dt
            run = episode.run
        gentle += risk.manoeuvres.gentle
    return Watched(run.split("_")[0], tuple(sorted(braked)), gentle, seconds / 3600.0)


def shadow(
    path: Path, lowest: float, decel: float | None, leaders: LeaderBrakes | None
) -> dict[str, int]:
    """Decisions beside every driver of a run, and alarms; own brakes are told by ``decel``."""
    decisions = alarms = 0
    actions = IntervalActions(low=lowest, high=_HIGHEST, width=_WIDTH, outside="clip")
    for episodes in _by_pair(path):
        dt = episodes[0].dt
        risk = LatentRisk(lowest, dt, leaders=leaders)
        if decel is not None:
            risk.brakes.trust(decel)
        reviser = ActionReviser(risk, actions, mode=Mode.SHADOW)
        guard = Guard.of(reviser, interval=dt)
        for episode in episodes:
            guard.begin()
            rows = (episode.times.tolist(), episode.observations, episode.accelerations.tolist())
            for time, row, did in zip(*rows, strict=True):
                alarms += is_spoken(reviser, guard.decide(row, did, time))
            guard.end()
            decisions += len(episode.times)
    return {"decisions": decisions, "alarms": alarms}


def _table(runs: Sequence[Watched], k: int, told: str) -> LeaderBrakes | None:
    """Leaders' brakes to begin with in run ``k``."""
    if told == TOLD[2]:
        return REAL_DRIVES
    return _counted([*runs[:k], *runs[k + 1 :]]) if told == TOLD[3] and len(runs) > 1 else None


def _counted(runs: Sequence[Watched]) -> LeaderBrakes:
    decels = [decel for run in runs for _, decel in run.braked]
    gentle, hours = sum(run.gentle for run in runs), sum(run.hours for run in runs)
    bins = ((np.array(decels) - _HARD) / _BIN_WIDTH).astype(np.int64)
    counts = tuple(np.bincount(bins).tolist())
    return LeaderBrakes(counts, gentle, hours, f"{len(runs)} runs")


def _braked(source: str, runs: Sequence[Watched]) -> dict[str, Any]:
    """A row: the leaders of some runs."""
    brakes, waves = _counted(runs), 0
    for run in runs:
        times = [time for time, _ in run.braked]
        waves += bool(times) + sum(b - a >= _ONE_WAVE for a, b in pairwise(times))
    hard = sum(brakes.counts)
    return {
        "source": source,
        "runs": len(runs),
        "hours": brakes.hours,
        "gentle": brakes.gentle,
        "hard": hard,
        "waves": waves,
        "hardest": max((decel for run in runs for _, decel in run.braked), default=None),
        "needed": _NEEDED * brakes.hours / hard if hard else math.inf,
        "counts": list(brakes.counts),
    }


def _unseen(seen: int) -> float:
    """At most so many percent are harder than the hardest of those seen (95 %), rounded up."""
    return math.ceil(1000.0 * (1.0 - 0.025 ** (1.0 / seen) if seen else 1.0)) / 10.0
