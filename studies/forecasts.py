"""How far ahead states are foreseen, and against whom.

A machine and `evofsm.Forecasts` learn drives, each row once; then all is frozen, and every method
forecasts the same rows of held-out drives.

Frame ``rows``: a ``method`` on a ``source``, so many seconds ahead (``horizon``). ``skill`` (of the
mean divergence from the belief that came) and ``log_skill`` (of the mean log score) are those
against persistence in the same states, with 95 % intervals over test episodes; ``over_batch`` is
the skill against the batch fit, ``worst`` that of the worst learning seed or part of the runs.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import product
from pathlib import Path
from typing import Annotated, Any, ClassVar, NamedTuple, Self

import numpy as np
import polars as pl
from numpy.typing import NDArray
from typer import Option

from evofsm.driving import (
    SAFETY_RULE,
    Draw,
    Family,
    KinematicWorld,
    held_out,
    load_family,
    training,
)
from evofsm.fsm import (
    EvolvingFSM,
    Forecasts,
    FSMModel,
    IntervalActions,
    StateRule,
    jensen_shannon,
)
from evofsm.guard import BELIEF_TOLERANCE
from evofsm.io import episodes_of, read_traces
from evofsm.paper import Page, Table
from studies import lib
from studies.lib import Frames, Study, at_least

Floats = NDArray[np.float64]
Indices = NDArray[np.intp]

# -- Drives ---------------------------------------------------------------------------------------

#: Families that are driven.
FAMILIES = ("emergency", "stop_and_go", "cut_in", "rare")
#: The actions of real drives [m/s²]: those of the paper.
LOG_ACTIONS = IntervalActions(low=-2.5, high=2.5, width=0.3, outside="clip")
_LOGGED = ("time", "gap", "v_follower", "v_leader", "a_follower")


class Pace(NamedTuple):
    """How often something is observed, how far it is forecast, and how often [s]."""

    dt: float
    horizons: tuple[float, ...]
    every: float

    def steps(self, seconds: float) -> int:
        """How many observations later that is."""
        return round(seconds / self.dt)


FINE = Pace(0.01, (0.01, 0.1), 0.25)
DECISIONS = Pace(0.25, (0.5, 1.0, 2.0, 5.0), 0.25)
LOGS = Pace(0.1, (0.1, 0.5, 1.0, 2.0, 5.0), 0.5)


class Episode(NamedTuple):
    """T observations of one drive, evenly spaced."""

    observations: Floats  #: (T, 3) gap [m], v_follower [m/s], v_leader [m/s]
    actions: NDArray[np.int64]  #: (T,) taken after each; -1 for none


class Source(NamedTuple):
    """Drives to learn from, and drives that nothing is learnt from."""

    name: str
    pace: Pace
    n_actions: int
    train: Sequence[Episode]
    test: Sequence[Episode]
    part: int = 0  #: which part of the runs is held out


class Logs(NamedTuple):
    """Files of one origin, each a run."""

    name: str
    files: tuple[str, ...]


def drive(name: str, pace: Pace, seed: int, learning_seed: int, train: int, test: int) -> Source:
    """Drive a family; training draws depend on both seeds, held-out ones on the first."""
    family = load_family(name)
    drawn = training(family, seed, learning_seed, train), held_out(family, seed, test)
    learnt, judged = ([_driven(family, pace, draw) for draw in draws] for draws in drawn)
    return Source(name, pace, family.actions.n_actions, learnt, judged)


def _driven(family: Family, pace: Pace, draw: Draw) -> Episode:
    episode = KinematicWorld().run(draw.scenario, draw.controller)
    rows = slice(None, None, draw.scenario.steps(pace.dt))
    return Episode(
        np.ascontiguousarray(episode.observations[rows]),
        _encode(family.actions, episode.accelerations[rows]),
    )


def _encode(actions: IntervalActions, taken: Floats) -> NDArray[np.int64]:
    indices = np.full(len(taken), -1)
    known = np.isfinite(taken)
    indices[known] = actions.encode(taken[known])
    return indices


def logs_in(folder: Path) -> list[Logs]:
    """The logs in a folder, each file a run, by what stands before the first ``_`` of their names.

    It refuses a folder with nothing that could be split by run.
    """
    found = defaultdict(list)
    for path in sorted(folder.glob("*")):
        if path.name.endswith((".csv", ".csv.gz", ".parquet")):
            scan = pl.scan_parquet if path.suffix == ".parquet" else pl.scan_csv
            if set(_LOGGED) <= set(scan(path).collect_schema()):
                found[path.name.partition("_")[0].partition(".")[0]].append(str(path))
    logs = [Logs(name, tuple(files)) for name, files in found.items() if len(files) > 1]
    if not logs:
        raise ValueError(
            f"{folder} has no two logs of one origin, with columns {', '.join(_LOGGED)} (files of "
            "one origin are named alike up to the first _)"
        )
    return logs


def read_part(logs: Logs, seed: int, part: int, parts: int) -> Source:
    """Runs to learn from, and those of one of several parts, which are held out."""
    order = np.random.default_rng(seed).permutation(len(logs.files))
    out = {int(place) for place in order[part::parts]}
    learnt, judged = (
        [
            episode
            for place, name in enumerate(logs.files)
            if (place in out) == is_out
            for episode in _read(name)
        ]
        for is_out in (False, True)
    )
    return Source(logs.name, LOGS, LOG_ACTIONS.n_actions, learnt, judged, part)


def _read(path: str) -> Iterator[Episode]:
    for whole in episodes_of(read_traces([path])):
        if not np.isclose(whole.dt, LOGS.dt):
            raise ValueError(f"{path} has a row every {whole.dt:g} s; {LOGS.dt:g} s are needed")
        yield Episode(whole.observations, _encode(LOG_ACTIONS, whole.actions))


# -- Who forecasts states -------------------------------------------------------------------------

OURS, BATCH, STAYS = "evofsm", "batch", "persistence"
#: The paper's machine, matrices and powers; and the references in its states.
PAPER, PAPER_BATCH, PAPER_STAYS = "evofsm-paper", "batch-paper", "persistence-paper"
#: For each method, whom it is compared with, in the same states.
REFERENCES = {
    **dict.fromkeys((OURS, BATCH, STAYS), (STAYS, BATCH)),
    **dict.fromkeys((PAPER, PAPER_BATCH, PAPER_STAYS), (PAPER_STAYS, PAPER_BATCH)),
}

#: Makes forecasts: of (T, n) beliefs and (T,) actions, (T, n) of what comes.
Forecaster = Callable[[Floats, NDArray[np.int64]], Floats]


class Taught(NamedTuple):
    """A machine that has learnt the training episodes, frozen."""

    model: FSMModel
    train: list[Floats]  #: beliefs of each training episode


def teach(source: Source, rule: StateRule | None, beside: Forecasts | None = None) -> Taught:
    """Teach a machine, and forecasts beside it, one training episode after another."""
    # Beliefs that are exact to the last digit would cost most of the time.
    tolerance = 0.0 if rule is None else BELIEF_TOLERANCE
    machine = EvolvingFSM(source.n_actions, rule=rule, belief_tolerance=tolerance)
    for episode in source.train:
        machine.start_episode()
        machine.learn_many(*episode)
        if beside is not None:
            beside.learn(machine.model(), *episode)
    model = machine.model(dt=source.pace.dt)
    return Taught(model, [model.recognise(one.observations) for one in source.train])


def stays(beliefs: Floats, actions: NDArray[np.int64]) -> Floats:
    """Persistence."""
    return beliefs


def powers(model: FSMModel, steps: int) -> Forecaster:
    """The machine's own matrices: one step under the action, the others under any."""
    average = model.marginal_matrix
    then = np.linalg.matrix_power(average, steps - 1)
    first = [*model.transition_matrices, average]  # the last is that of none, -1

    def forecast(beliefs: Floats, actions: NDArray[np.int64]) -> Floats:
        predicted = np.empty_like(beliefs)
        for action in np.unique(actions):
            rows = actions == action
            predicted[rows] = beliefs[rows] @ (first[action] @ then)
        return predicted

    return forecast


def batch(taught: Taught, lag: int) -> Forecaster:
    """Deeptime's maximum likelihood for the most probable states, at the lag of the horizon.

    Its rows are those of its counts, sliding over all training rows; a state that is never left,
    nor seen again after that time, stays as it is.
    """
    from deeptime.markov import TransitionCountEstimator

    n = taught.model.n_states
    paths = [beliefs.argmax(axis=1) for beliefs in taught.train]
    long = [path for path in paths if len(path) > lag]
    estimator = TransitionCountEstimator(lagtime=lag, count_mode="sliding", n_states=n)
    counts = np.asarray(estimator.fit_fetch(long).count_matrix) if long else np.zeros((n, n))
    totals = counts.sum(axis=1, keepdims=True)
    matrix = np.where(totals > 0.0, counts / np.maximum(totals, 1.0), np.eye(n))
    return lambda beliefs, actions: beliefs @ matrix


# -- How forecasts of states are scored -----------------------------------------------------------
# The divergence of Jensen and Shannon between the forecast q and the belief gamma that came, and
# the log score -sum gamma log2 q [bit], which none gets below the entropy of gamma. The skill of
# either is 1 - (score - best) / (reference - best): 1 where the forecast is what came, 0 where it
# is as good as the reference (D. Wilks, "Statistical Methods in the Atmospheric Sciences").

# Share of every forecast, whoever makes it, that is spread evenly: a 0 would cost infinitely much.
_SPREAD_OUT = 1e-6


def score(
    forecasters: dict[str, Forecaster],
    episodes: Sequence[tuple[Floats, NDArray[np.int64]]],
    steps: int,
    every: int,
) -> Iterator[dict[str, Any]]:
    """Let forecasters say what comes ``steps`` later, from every so many rows on.

    Yields the sums of each over each episode, of (T, n) beliefs and (T,) actions; ``excess`` is the
    log score above the best one that there could be.
    """
    for number, (beliefs, actions) in enumerate(episodes):
        origins = np.arange(0, len(beliefs) - steps, every)
        if len(origins) == 0:
            continue
        came = beliefs[origins + steps]
        best = _log_scores(came, came, spread_out=0.0)
        for name, forecaster in forecasters.items():
            predicted = forecaster(beliefs[origins], actions[origins])
            logs = _log_scores(predicted, came)
            yield {
                "method": name,
                "episode": number,
                "divergence": float(np.sum(jensen_shannon(predicted, came))),
                "excess": float((logs - best).sum()),
                "forecasts": len(origins),
            }


def _log_scores(predicted: Floats, came: Floats, spread_out: float = _SPREAD_OUT) -> Floats:
    everywhere = (1.0 - spread_out) * predicted + spread_out / predicted.shape[1]
    logs = np.log2(everywhere, where=everywhere > 0.0, out=np.zeros_like(everywhere))
    return np.asarray(-(came * logs).sum(axis=1))


def compare(make: Callable[[], Source], learning_seed: int = 0) -> list[dict[str, Any]]:
    """Let all methods forecast one source, in the safety rule's states and in the paper's."""
    source = make()
    pace = source.pace
    own = Forecasts(source.n_actions, [pace.steps(seconds) for seconds in pace.horizons])
    safe, paper = teach(source, SAFETY_RULE, own), teach(source, None)
    judged = [
        [(taught.model.recognise(one.observations), one.actions) for one in source.test]
        for taught in (safe, paper)
    ]
    found = []
    for seconds in pace.horizons:
        steps = pace.steps(seconds)
        in_safe: dict[str, Forecaster] = {
            OURS: partial(own.predict, steps=steps),
            BATCH: batch(safe, steps),
            STAYS: stays,
        }
        in_paper: dict[str, Forecaster] = {
            PAPER: powers(paper.model, steps),
            PAPER_BATCH: batch(paper, steps),
            PAPER_STAYS: stays,
        }
        about = {"source": source.name, "horizon": seconds, "round": learning_seed + source.part}
        about["part"] = source.part
        for forecasters, episodes in zip((in_safe, in_paper), judged, strict=True):
            scored = score(forecasters, episodes, steps, pace.steps(pace.every))
            found += [about | one for one in scored]
    return found


def skill(scores: Any, reference: Any) -> float:
    """1 for a perfect forecast, 0 for one as good as the reference; NaN where that is perfect."""
    rival = float(reference.sum())
    return 1.0 - float(scores.sum()) / rival if rival > 0.0 else math.nan


def add_up(sums: pl.DataFrame, rounds: int, seed: int) -> Iterator[dict[str, Any]]:
    """A row for each method at each horizon: what an episode got in several rounds is added up."""
    key = ["source", "horizon", "method"]
    parts = sums.partition_by(*key, as_dict=True, maintain_order=True)
    added = {
        name: part.group_by("part", "episode", maintain_order=True)
        .agg(pl.col("divergence", "excess", "forecasts").sum())
        .sort("part", "episode")
        for name, part in parts.items()
    }
    by_round = {
        name: part.group_by("round", maintain_order=True).agg(pl.col("divergence").sum())
        for name, part in parts.items()
    }
    for (source, horizon, method), mine in added.items():
        still, rival = ((source, horizon, name) for name in REFERENCES[str(method)])
        n = int(mine["forecasts"].sum())
        row = dict(zip(key, (source, horizon, method), strict=True))
        for kind, prefix in (("divergence", ""), ("excess", "log_")):
            scores, reference = mine[kind].to_numpy(), added[still][kind].to_numpy()
            drawn = partial(_skill_of, scores, reference)
            low, high = lib.bootstrap(drawn, len(scores), rounds, seed)
            row |= {f"{prefix}skill": skill(scores, reference)}
            row |= {f"{prefix}low": low, f"{prefix}high": high}
        row["over_batch"] = skill(mine["divergence"], added[rival]["divergence"])
        pairs = zip(
            by_round[source, horizon, method]["divergence"],
            by_round[still]["divergence"],
            strict=True,
        )
        row["worst"] = min(skill(np.array([a]), np.array([b])) for a, b in pairs)
        yield row | {"forecasts": n, "episodes": len(mine)}


def _skill_of(scores: Floats, reference: Floats, chosen: Indices) -> float:
    return skill(scores[chosen], reference[chosen])


# -- The study ------------------------------------------------------------------------------------

#: The horizons that were asked about [s]; shorter ones show where the paper's test is made.
_ASKED = 0.5


@dataclass(frozen=True, kw_only=True)
class ForecastStudy(Study):
    """How far ahead states are foreseen."""

    name: ClassVar[str] = "forecasts"
    needed: ClassVar[dict[str, str]] = {"deeptime": "dev"}

    data: Annotated[
        Path | None, Option(help="Folder of real logs, a run each; without it simulation alone.")
    ] = None
    seeds: Annotated[int, Option(min=1, help="Learning seeds.")] = 20
    train: int = 100  #: training episodes of a learning seed
    test: int = 100  #: held-out episodes
    fine_train: int = 20  #: the same, where every step of 0.01 s is observed
    fine_test: int = 20
    parts: int = 3  #: into which runs are split
    runs: int | None = None  #: of one origin at most; None for all
    rounds: int = 1000  #: of the bootstrap

    def shortened(self) -> Self:
        """A look: two learning seeds, and a quarter of the episodes."""
        few = self.smaller(seeds=2, train=40, test=30, fine_train=5, fine_test=5, rounds=200)
        return few.smaller(parts=2, runs=12)

    def run(self, workers: int | None = None) -> dict[str, pl.DataFrame]:
        """Let all forecast drives."""
        tasks: list[partial[list[dict[str, Any]]]] = []
        for logs in logs_in(self.data) if self.data else []:
            most = min(self.runs or len(logs.files), len(logs.files))
            files = [logs.files[k * len(logs.files) // most] for k in range(most)]
            some = Logs(logs.name, tuple(files))
            parts = min(self.parts, most)
            made = (partial(read_part, some, self.seed, part, parts) for part in range(parts))
            tasks += [partial(compare, one) for one in made]
        for pace, train, test, seeds in (
            (DECISIONS, self.train, self.test, self.seeds),
            (FINE, self.fine_train, self.fine_test, -(-self.seeds // 4)),
        ):
            for name, seed in product(FAMILIES, range(seeds)):
                made_of = partial(drive, name, pace, self.seed, seed, train, test)
                tasks.append(partial(compare, made_of, seed))
        sums = [one for some in lib.parallel(tasks, workers, "Forecasting") for one in some]
        rows = lib.frame_of(add_up(lib.frame_of(sums), self.rounds, self.seed))
        return {"rows": rows.sort("source", "horizon", maintain_order=True)}

    def page(self, found: Frames) -> Page:
        """Skills of forecasts of states, and where others do better."""
        rows, is_ours, key = found["rows"], pl.col("method") == OURS, ["source", "horizon"]
        ours = rows.filter(is_ours)
        for name in (BATCH, PAPER):
            rival = rows.filter(method=name).select(
                *key, pl.col("skill", "log_skill").name.suffix(f"_{name}")
            )
            ours = ours.join(rival, on=key, maintain_order="left")
        where = {"source": "{source}", "horizon [s]": "{horizon:g}"}
        skills = {
            "evofsm (95 %)": "{skill:.2f} ({low:.2f}–{high:.2f})",
            "log score (95 %)": "{log_skill:.2f} ({log_low:.2f}–{log_high:.2f})",
        }
        asked = ours.filter(pl.col("horizon") >= _ASKED)
        rivals = lib.compared(rows, is_ours, key).filter(pl.col("method").is_in([BATCH, STAYS]))
        better = (pl.col("skill") > pl.col("skill_ours")) | (
            pl.col("log_skill") > pl.col("log_skill_ours")
        )
        return self.shown(
            _ABOUT,
            [
                Table(
                    "Skill against persistence",
                    ours,
                    where
                    | skills
                    | {"over batch": "{over_batch:.2f}", "worst": "{worst:.2f}"}
                    | {"batch": f"{{skill_{BATCH}:.2f}}", "paper": f"{{skill_{PAPER}:.2f}}"},
                    "By divergence, where nothing else is said. Over batch: ours against the batch "
                    "fit; the paper's machine is held against persistence in its own states. "
                    "Worst: of a learning seed, or of a part of the runs.",
                ),
            ],
            lost=[
                Table(
                    "From 0.5 s on: intervals of the skill that hold 0",
                    asked.filter((pl.col("low") <= 0.0) | (pl.col("log_low") <= 0.0)),
                    where | skills,
                ),
                Table(
                    "References that are better by divergence or log score",
                    rivals.filter(better),
                    where
                    | {"reference": "{method}"}
                    | {"skill": "{skill:.2f} against {skill_ours:.2f}"}
                    | {"log score": "{log_skill:.2f} against {log_skill_ours:.2f}"},
                    "Theirs against ours.",
                ),
            ],
            targets=[
                at_least(
                    f"cases surely better than persistence from 0.5 s on, by {what}",
                    int((asked[low] > 0.0).sum()),
                    len(asked),
                )
                for what, low in (("divergence", "low"), ("log score", "log_low"))
            ],
            packages=("scipy", "deeptime"),
        )


_ABOUT = """How far ahead are states foreseen?

Forecasts of the distribution over states, on drives that nothing was learnt from; logs are split by
run, and every run is held out once. A skill is 1 for a perfect forecast and 0 for one as good as
persistence, the belief that stays as it is. batch is deeptime's count of transitions between the
most probable states at the lag of the horizon; paper is the paper's machine, its matrices raised to
a power. Up to 0.1 s machines of simulated drives observe every 0.01 s, else every 0.25 s. How
useful a forecast is depends on how fine the states are, and finer ones are harder to foresee."""
