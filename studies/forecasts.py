"""How far ahead states and failures are foreseen, and against whom.

States: a machine and `evofsm.Forecasts` learn drives, each row once; then all is frozen, and every
method forecasts the same rows of held-out drives. Failures: of tasks that others set, ours and
three rivals learn the same episodes of mixed controllers, and say how likely it is to fail within
so many steps if an action is taken now.

Frame ``rows``: a ``method`` on a ``source``, so many seconds ahead (``horizon``). ``skill`` (of the
mean divergence from the belief that came) and ``log_skill`` (of the mean log score) are those
against persistence in the same states, with 95 % intervals over test episodes; ``over_batch`` is
the skill against the batch fit, ``worst`` that of the worst learning seed or part of the runs.

Frame ``failures``: a ``method`` on a ``task`` within so many ``steps``, with the Brier score of
calibrated probabilities; ``base`` is that of always saying the share of failures.
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
from scipy.spatial import KDTree
from scipy.special import expit
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
from evofsm.guard import BELIEF_TOLERANCE, LearntRisk
from evofsm.io import episodes_of, read_traces
from evofsm.paper import Page, Table
from studies import lib
from studies.lib import Frames, Study, Target, at_least
from studies.systems import Action, Box, Start, System, make_system

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
Indices = NDArray[np.intp]

_NO_ACTION = -1

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
    indices = np.full(len(taken), _NO_ACTION)
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


# -- Episodes of tasks ----------------------------------------------------------------------------

#: Steps within which a failure counts.
HORIZONS = (10, 25, 50)
#: Controllers beside those of the system: actions drawn anew in each step, or held for a while, and
#: feedback that would hold the system, were three in ten of its actions not drawn.
RANDOM, WANDER, HOLDS = "random", "wander", "holds"
# How likely the one that wanders takes another action, and how likely any action is drawn instead,
# in general and of the one that holds.
_CHANGES, _DRAWN, _DRAWN_HOLDING = 0.1, 0.1, 0.3
# Feedback that holds a task; the controllers of these lose it almost always within a second or two,
# so that without it there would be nothing to foresee.
_FEEDBACK: dict[str, Callable[[Floats], Action]] = {
    "cartpole": lambda z: int(z @ np.array([0.05, 0.1, 1.0, 0.5]) > 0.0),
    "pendulum": lambda z: float(np.clip(-10.0 * z[0] - 2.0 * z[1], -2.0, 2.0)),
}


class Run(NamedTuple):
    """One episode: T actions, and the observations before and after each."""

    observations: Floats  #: (T + 1, m)
    actions: Floats  #: (T, a) executed; of choices a one among zeros, else in [-1, 1]
    executed: tuple[Action, ...]  #: the same T actions as the system took them
    failed: bool  #: by the last action


class Cases(NamedTuple):
    """n steps of some episodes, in their order; what was known there, and what came."""

    z: Floats  #: (n, m) observation
    change: Floats  #: (n, m) since the one before
    earlier: Floats  #: (n, m) change before that one
    before: Floats  #: (n, a) action before
    action: Floats  #: (n, a) that is taken now
    left: Floats  #: (n,) steps to the failure; infinite where none came
    seen: Floats  #: (n,) steps that were seen after this one
    episode: Indices  #: (n,) from 0

    def where(self, rows: Bools) -> Cases:
        """Some of them."""
        columns: Any = (column[rows] for column in self)
        return Cases(*columns)

    def known(self, steps: int) -> Bools:
        """(n,) whether it is known what came within so many steps: not where time was up before."""
        return np.asarray(np.isfinite(self.left) | (self.seen >= steps))


def gather(name: str, starts: Sequence[Start]) -> list[Run]:
    """Run episodes, each with a controller drawn for it: one of the system's, or of ours here."""
    system = make_system(name)
    kinds = list(dict.fromkeys((*system.controllers, RANDOM, WANDER)))
    kinds += [HOLDS] if name in _FEEDBACK else []
    return [_run(system, start, kinds) for start in starts]


def _run(system: System, start: Start, kinds: Sequence[str]) -> Run:
    draw = start.rng(7)
    kind = kinds[int(draw.integers(len(kinds)))]
    propose = _controller(system, kind, draw)
    share = _DRAWN_HOLDING if kind == HOLDS else _DRAWN
    observations, over, failed = [system.reset(options={"start": start})[0]], False, False
    executed: list[Action] = []
    while not over:
        action = propose(observations[-1])
        if draw.random() < share:
            action = system.actions.drawn(draw)
        observation, _, failed, truncated, _ = system.step(action)
        executed.append(action)
        observations.append(observation)
        over = failed or truncated
    actions = np.array([_encoded(system, one) for one in executed])
    return Run(np.array(observations), actions, tuple(executed), failed)


def _controller(system: System, kind: str, draw: np.random.Generator) -> Callable[[Floats], Action]:
    if kind in system.controllers:
        return system.controllers[kind]
    if kind == HOLDS:
        return _FEEDBACK[system.name]
    held = system.actions.drawn(draw)

    def propose(z: Floats) -> Action:
        nonlocal held
        if kind == RANDOM or draw.random() < _CHANGES:
            held = system.actions.drawn(draw)
        return held

    return propose


def _encoded(system: System, action: Action) -> Floats:
    """(a,) of choices a one among zeros, else in [-1, 1]."""
    actions = system.actions
    if not isinstance(actions, Box):
        return np.asarray(np.eye(actions.n_actions)[int(action)])
    low, high = np.array(actions.low), np.array(actions.high)
    return np.asarray(2.0 * (np.atleast_1d(action) - low) / (high - low) - 1.0)


def cases(runs: Sequence[Run], every: int) -> Cases:
    """Every so many steps of each episode, the last one before a failure included.

    Steps are counted back from the end, and the first two are left out: extrapolation needs them.
    """
    parts = []
    for number, run in enumerate(runs):
        z, T = run.observations, len(run.actions)
        t = np.arange(T - 1, 1, -every)[::-1]
        left = (T - t).astype(np.float64)
        ends = left if run.failed else np.full(len(t), np.inf)
        moved = z[t] - z[t - 1], z[t - 1] - z[t - 2]
        done = run.actions[t - 1], run.actions[t]
        parts.append((z[t], *moved, *done, ends, left, np.full(len(t), number)))
    columns: Any = (np.concatenate(column) for column in zip(*parts, strict=True))
    return Cases(*columns)


# -- Who foresees failures ------------------------------------------------------------------------

REPLAY = "evofsm-replay"  #: ours
# Recorded behaviours that are replayed after an action, and neighbours that are asked.
_BEHAVIOURS, _NEIGHBOURS = 8, 25
# Of the logistic regression: penalty of each standardised weight.
_RIDGE = 1e-2
# Extrapolation looks so far [steps].
_FARTHEST = 200


class Replays:
    """Ours: what a learnt judge expects after some episodes of a system."""

    def __init__(self, name: str, runs: Sequence[Run]) -> None:
        self.runs = runs
        settings = make_system(name).actions.settings
        judge = LearntRisk(1.0, **settings, horizon=float(max(HORIZONS)))
        for run in runs:
            for t, z in enumerate(run.observations):
                judge.observe(z)
                if t < len(run.actions):
                    judge.act(run.executed[t])
            judge.end(None, failed=run.failed)
        self.judge = judge
        self._rate = judge.remembered.number / judge.state.n_seen
        self._replayed: dict[int, Floats] = {}

    def __call__(self, some: Cases, steps: int) -> Floats:
        """(n,) probability: the action is taken, then what was done after the likest steps.

        Each recorded behaviour is replayed as if nothing began, and amid each of the disturbances
        that are remembered; these count by how often one begins within the horizon.
        """
        if id(some) not in self._replayed:  # one replay serves all horizons
            self._replayed[id(some)] = self._lasts(some)
        failed = self._replayed[id(some)] <= steps
        alone = failed[:, :, 0].mean(axis=1)
        if failed.shape[2] == 1:
            return np.asarray(alone)
        amid = failed[:, :, 1:].mean(axis=(1, 2))
        begins = -np.expm1(-self._rate * steps)
        return np.asarray((1.0 - begins) * alone + begins * amid)

    def _lasts(self, some: Cases) -> Floats:
        """(n, behaviours, disturbances) steps until it fails, in each replay."""
        lengths = [len(run.actions) for run in self.runs]
        done = np.concatenate([run.actions for run in self.runs])
        ends = np.repeat(np.cumsum(lengths), lengths)  # of the episode of each action
        at = np.concatenate([run.observations[:-1] for run in self.runs])
        scale = np.maximum(at.std(axis=0), 1e-9)
        tree = KDTree(np.column_stack([at / scale, done]))
        count = min(_BEHAVIOURS, len(done))
        _, near = tree.query(np.column_stack([some.z / scale, some.action]), count)
        horizon = max(HORIZONS)
        found = []
        for r, behaviours in enumerate(np.reshape(near, (-1, count))):
            situation = np.concatenate([some.z[r], some.change[r], some.before[r]])
            for begin in behaviours:
                plan = done[np.minimum(begin + np.arange(horizon), ends[begin] - 1)]
                plan[0] = some.action[r]
                found.append(self.judge.fails_after(situation, plan))
        return np.reshape(found, (len(near), count, -1))


class Logistic:
    """Logistic regression on observation, change, action and the products of all of them."""

    def __init__(self, train: Cases, truth: Bools) -> None:
        self._standardise = _standard(_products(_inputs(train)))
        X = self._features(train)
        ridge = np.append(1e-9, np.full(X.shape[1] - 1, _RIDGE))
        self.weights = lib.logistic(X, truth, ridge)

    def __call__(self, some: Cases) -> Floats:
        """(n,) probability."""
        return np.asarray(expit(self._features(some) @ self.weights))

    def _features(self, some: Cases) -> Floats:
        raw = _products(_inputs(some))
        return np.column_stack([np.ones(len(raw)), self._standardise(raw)])


class Neighbours:
    """The share of the nearest training steps that failed in time.

    Observation, change and action are standardised.
    """

    def __init__(self, train: Cases, truth: Bools) -> None:
        self._standardise = _standard(_inputs(train))
        self._tree, self._truth = KDTree(self._standardise(_inputs(train))), truth

    def __call__(self, some: Cases) -> Floats:
        """(n,) share of the neighbours."""
        count = min(_NEIGHBOURS, len(self._truth))
        _, near = self._tree.query(self._standardise(_inputs(some)), count)
        return np.asarray(self._truth[np.reshape(near, (-1, count))].mean(axis=1))


class Taylor:
    """Time until the state, extrapolated by backward differences, is beyond where it fails.

    As Henzinger et al. (arXiv 2412.16564) extrapolate what is seen of a black box, at the latest
    pace (order 1) and its latest change (order 2). Where it fails is given to it: the boundaries
    that ours found in the failures, since no task tells them.
    """

    def __init__(self, sides: Floats, order: int) -> None:
        self.sides, self.order = sides, order

    def __call__(self, some: Cases) -> Floats:
        """(n,) score: minus the steps to the first boundary; infinite where none is reached."""
        s = np.arange(1.0, _FARTHEST + 1.0)
        first = np.full(len(some.z), np.inf)
        for variable, sign, threshold, *_ in self.sides:
            j = int(variable)
            path = some.z[:, j, None] + s * some.change[:, j, None]
            if self.order > 1:
                bend = some.change[:, j] - some.earlier[:, j]
                path += 0.5 * s * (s + 1.0) * bend[:, None]
            beyond = sign * (path - threshold) >= 0.0
            reached = np.where(beyond.any(axis=1), s[beyond.argmax(axis=1)], np.inf)
            first = np.minimum(first, reached)
        return -first


def _inputs(some: Cases) -> Floats:
    """(n, 2 m + a) what everyone may know; the last of several choices follows from the others."""
    return np.column_stack([some.z, some.change, some.action])


def _products(raw: Floats) -> Floats:
    i, j = np.triu_indices(raw.shape[1])
    return np.column_stack([raw, raw[:, i] * raw[:, j]])


def _standard(raw: Floats) -> Callable[[Floats], Floats]:
    """What takes these to a mean of 0 and a standard deviation of 1."""
    mean, spread = raw.mean(axis=0), raw.std(axis=0)
    scale = np.where(spread > 1e-12, spread, 1.0)
    return lambda some: (some - mean) / scale


# -- How foresight of failures is measured --------------------------------------------------------

# Calibration episodes are those of the training split from this one on.
_CALIBRATION = 100_000


class Said(NamedTuple):
    """What one said of the cases whose truth is known, with one learning seed, and what came."""

    probability: Floats  #: (n,) calibrated on other episodes
    truth: Bools  #: (n,)
    episode: Indices  #: (n,)


def measured(every: Sequence[Said], episodes: int, rounds: int, seed: int) -> dict[str, float]:
    """The mean Brier score of learning seeds, which share the test episodes; 95 % over these."""
    errors = np.zeros(episodes)
    cases_of = np.bincount(every[0].episode, minlength=episodes)
    for one in every:
        errors += np.bincount(one.episode, (one.probability - one.truth) ** 2, episodes)

    def brier(chosen: Indices) -> float:
        asked = cases_of[chosen].sum() * len(every)
        return float(errors[chosen].sum() / asked) if asked else math.nan

    low, high = lib.bootstrap(brier, episodes, rounds, seed)
    return {"brier": brier(np.arange(episodes)), "brier_low": low, "brier_high": high}


def foresee(
    name: str, seeds: tuple[int, int], train: int, calibration: int, test: int, every: int
) -> dict[tuple[int, str], Said]:
    """Let all learn the same episodes of a task, and foresee the same held-out ones.

    ``seeds`` are that of everything, and the learning seed.
    """
    seed, learning_seed = seeds
    first = [Start.training(seed, learning_seed, k) for k in range(train)]
    then = [Start.training(seed, learning_seed, _CALIBRATION + k) for k in range(calibration)]
    last = [Start.held_out(seed, k) for k in range(test)]
    learning, calibrating, testing = (gather(name, starts) for starts in (first, then, last))
    replays, seen = Replays(name, learning), cases(learning, 1)
    others, asked = cases(calibrating, every), cases(testing, every)
    found = {}
    for steps in HORIZONS:
        some, on = seen.where(seen.known(steps)), others.known(steps)
        truth, came, known = some.left <= steps, others.left[on] <= steps, asked.known(steps)
        orders = [Taylor(replays.judge.thresholds, order) for order in (1, 2)]
        areas = [lib.Ranked(one(others)[on], came).areas().auroc for one in orders]
        foreseers: dict[str, Callable[[Cases], Floats]] = {
            REPLAY: partial(replays, steps=steps),
            "logistic": Logistic(some, truth),
            "neighbours": Neighbours(some, truth),
            "taylor": orders[int(np.argmax(np.nan_to_num(areas)))],
        }
        for method, says in foreseers.items():
            probability = lib.isotonic(says(others)[on], came)(says(asked)[known])
            test_truth = asked.left[known] <= steps
            found[steps, method] = Said(probability, test_truth, asked.episode[known])
    return found


# -- The study ------------------------------------------------------------------------------------

#: The horizons that were asked about [s]; shorter ones show where the paper's test is made.
_ASKED = 0.5


@dataclass(frozen=True, kw_only=True)
class ForecastStudy(Study):
    """How far ahead states, and failures of tasks, are foreseen."""

    name: ClassVar[str] = "forecasts"
    needed: ClassVar[dict[str, str]] = {"deeptime": "dev", "gymnasium": "gym"}

    data: Annotated[
        Path | None, Option(help="Folder of real logs, a run each; without it simulation alone.")
    ] = None
    tasks: Annotated[str, Option(help="Systems with commas; their failures are foreseen.")] = (
        "acc,cartpole,pendulum"
    )
    seeds: Annotated[int, Option(min=1, help="Learning seeds, of tasks a quarter of them.")] = 20
    train: int = 100  #: training episodes of a learning seed
    test: int = 100  #: held-out episodes
    fine_train: int = 20  #: the same, where every step of 0.01 s is observed
    fine_test: int = 20
    parts: int = 3  #: into which runs are split
    runs: int | None = None  #: of one origin at most; None for all
    task_train: int = 80  #: training episodes of a task
    task_test: int = 80
    calibration: int = 40  #: episodes on which probabilities and thresholds are set
    every: int = 5  #: steps from a judged one to the next
    rounds: int = 1000  #: of the bootstrap; of tasks a fifth

    def shortened(self) -> Self:
        """A look: two learning seeds, and a quarter of the episodes."""
        few = self.smaller(seeds=2, train=40, test=30, fine_train=5, fine_test=5, rounds=200)
        return few.smaller(parts=2, runs=12, task_train=20, task_test=15, calibration=10)

    def run(self, workers: int | None = None) -> dict[str, pl.DataFrame]:
        """Let all forecast drives, and foresee tasks."""
        names = lib.names_in(self.tasks)
        for name in names:  # so that a wrong one shows at once
            make_system(name)
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
        rows = rows.sort("source", "horizon", maintain_order=True)
        return {"rows": rows, "failures": lib.frame_of(self._failures(names, workers))}

    def _failures(self, names: Sequence[str], workers: int | None) -> Iterator[dict[str, Any]]:
        seeds = -(-self.seeds // 4)
        episodes = self.task_train, self.calibration, self.task_test, self.every
        tasks = [
            partial(foresee, name, (self.seed, seed), *episodes)
            for name, seed in product(names, range(seeds))
        ]
        found = lib.parallel(tasks, workers, "Foreseeing")
        for place, name in enumerate(names):
            of_task = found[place * seeds : (place + 1) * seeds]
            for (steps, method), one in of_task[0].items():
                every = [said[steps, method] for said in of_task]
                row = measured(every, self.task_test, self.rounds // 5, self.seed)
                share = float(one.truth.mean())
                yield {
                    **{"task": name, "method": method, "steps": steps},
                    **row,
                    "base": share * (1.0 - share),
                    "cases": len(one.truth),
                    "episodes": self.task_test,
                }

    def page(self, found: Frames) -> Page:
        """Skills of forecasts of states, foresight of failures, and where others do better."""
        rows, failures = found["rows"], found["failures"]
        is_ours, key = pl.col("method") == OURS, ["source", "horizon"]
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
        foreseen = {"task": "{task}", "steps": "{steps}", "method": "{method}"}
        against = _against(failures)
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
                Table(
                    "Failure within so many steps",
                    failures,
                    foreseen
                    | {"Brier (95 %)": "{brier:.3f} ({brier_low:.3f}–{brier_high:.3f})"}
                    | {"base": "{base:.3f}"},
                    "Of calibrated probabilities; base: of always saying the share of failures.",
                    pl.when(pl.col("method") == REPLAY).then(pl.lit("ours")),
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
                Table(
                    "Rivals that foresee failures better",
                    against,
                    foreseen
                    | {
                        "Brier (95 %)": "{brier:.3f} ({brier_low:.3f}–{brier_high:.3f})",
                        "ours": "{brier_ours:.3f} ({brier_low_ours:.3f}–{brier_high_ours:.3f})",
                    },
                    "Theirs against evofsm-replay.",
                ),
            ],
            targets=_targets(asked, failures, against),
            packages=("scipy", "deeptime", "gymnasium"),
            sources={
                "T. Henzinger et al., Predictive monitoring of black-box dynamical systems, 2024, "
                "arXiv:2412.16564": "https://arxiv.org/abs/2412.16564"
            },
        )


_ABOUT = """How far ahead are states and failures foreseen?

States: forecasts of the distribution over states, on drives that nothing was learnt from; logs are
split by run, and every run is held out once. A skill is 1 for a perfect forecast and 0 for one as
good as persistence, the belief that stays as it is. batch is deeptime's count of transitions
between the most probable states at the lag of the horizon; paper is the paper's machine, its
matrices raised to a power. Up to 0.1 s machines of simulated drives observe every 0.01 s, else
every 0.25 s. How useful a forecast is depends on how fine the states are, and finer ones are harder
to foresee.

Failures: each task is run by a mixture of its controllers, of random actions, of random ones that
are held for a while, and on cartpole and pendulum of feedback that would hold them. All learn the
same episodes, with the actions that were executed, and say how likely it is to fail within so many
steps if an action is taken now, whatever is done after it. All probabilities are calibrated by
isotonic regression on episodes of their own."""


def _against(failures: pl.DataFrame) -> pl.DataFrame:
    """Rivals that foresee better than ours, where there is something to foresee."""
    is_ours = pl.col("method") == REPLAY
    both = lib.compared(failures.filter(pl.col("base") > 0.0), is_ours, ["task", "steps"])
    return both.filter(pl.col("brier") < pl.col("brier_ours"))


def _targets(
    asked: pl.DataFrame, failures: pl.DataFrame, against: pl.DataFrame
) -> Iterator[Target]:
    for what, low in (("divergence", "low"), ("log score", "log_low")):
        won = int((asked[low] > 0.0).sum())
        what = f"cases surely better than persistence from 0.5 s on, by {what}"
        yield at_least(what, won, len(asked))
    cases_ = failures.filter(pl.col("base") > 0.0, method=REPLAY)
    lost = against.select("task", "steps").unique()
    what = "cases of failures in which no rival has a lower Brier score"
    yield at_least(what, len(cases_) - len(lost), len(cases_))
