"""Who forecasts: ours, the paper's machine, and the references, each in the states of a machine."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from enum import StrEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from evofsm.driving import SAFETY_RULE
from evofsm.extras import needs
from evofsm.fsm import EvolvingFSM, Forecasts, FSMModel, Novelty, Policy, StateRule
from evofsm.fsm.arrays import NO_ACTION
from evofsm.guard import BELIEF_TOLERANCE
from studies.prediction.scoring import Forecaster
from studies.prediction.sources import Episode, Source

# Beliefs that are exact to the last digit would cost most of the time.
# Training episodes from which the blend is tuned.
_FOR_TUNING = 40
_BLENDS = np.array([0.0, 0.003, 0.01, 0.03, 0.1, 0.2, 0.4, 0.7, 1.0])


class Method(StrEnum):
    """Who forecasts."""

    EVOFSM = "evofsm"  #: `Forecasts`, in the states of the safety rule
    BLEND = "blend"  #: persistence and the mean belief, in the best proportion
    BATCH = "batch"  #: a Markov model of the most probable states, fitted to all training rows
    PERSISTENCE = "persistence"  #: the belief stays as it is
    PAPER = "evofsm-paper"  #: the paper's machine, matrices and powers
    PAPER_BATCH = "batch-paper"  #: as `BATCH`, in the paper's states
    PAPER_PERSISTENCE = "persistence-paper"  #: as `PERSISTENCE`, in the paper's states


#: For each method, who it is compared with: persistence and batch, in the same states.
REFERENCES = {
    method: (Method.PAPER_PERSISTENCE, Method.PAPER_BATCH)
    if method.value.endswith("-paper")
    else (Method.PERSISTENCE, Method.BATCH)
    for method in Method
}


class Variant(StrEnum):
    """What is changed in the ablation, one thing at a time."""

    PAPER = "the paper's machine"
    STATES = "safety rule's states"
    HOLD = "... action held"
    PRODUCT = "direct, counted as products"
    CHAIN = "posterior counts, to a power"
    DIRECT = "direct posterior counts"
    ACTIONS = "... by action: evofsm"
    RELUCTANT = "evofsm, evidence 3"
    MOVING = "evofsm, moved 0.1"
    SHARP = "evofsm, sharper beliefs"
    FINE = "evofsm, smaller states"
    PAPER_STATES = "evofsm, paper's states"


#: Forecasters by name, who share a machine.
Together = dict[str, Forecaster]


class Taught(NamedTuple):
    """A machine that has learnt the training episodes, frozen, and what learnt beside it."""

    model: FSMModel
    forecasts: dict[str, Forecasts]
    train: Sequence[Episode]

    def judged(
        self, episodes: Sequence[Episode]
    ) -> Iterator[tuple[NDArray[np.float64], NDArray[np.int64]]]:
        """Beliefs and actions of episodes, by the frozen machine."""
        return ((self.model.recognise(one.observations), one.actions) for one in episodes)

    def beliefs(self, most: int | None = None) -> Iterator[NDArray[np.float64]]:
        """Beliefs of training episodes, of so many at most, evenly chosen."""
        step = 1 if most is None else -(-len(self.train) // most)
        return (self.model.recognise(one.observations) for one in self.train[::step])


def teach(
    source: Source, rule: StateRule | None, beside: dict[str, Forecasts] | None = None
) -> Taught:
    """Teach a machine, and forecasts beside it, one training episode after another."""
    machine = EvolvingFSM(
        source.n_actions, rule=rule, belief_tolerance=0.0 if rule is None else BELIEF_TOLERANCE
    )
    beside = beside or {}
    for episode in source.train:
        machine.start_episode()
        machine.learn_many(*episode)
        if beside:
            model = machine.model()
            for forecasts in beside.values():
                forecasts.learn(model, *episode)
    return Taught(machine.model(dt=source.pace.dt), beside, source.train)


def ours(source: Source, **settings: float) -> Forecasts:
    """Forecasts over the horizons of a source."""
    steps = [source.pace.steps(seconds) for seconds in source.pace.horizons]
    return Forecasts(source.n_actions, steps, **settings)


# -- Each a forecaster ----------------------------------------------------------------------------


def stays(beliefs: NDArray[np.float64], actions: NDArray[np.int64]) -> NDArray[np.float64]:
    """Persistence."""
    return beliefs


def of_matrix(matrix: NDArray[np.float64]) -> Forecaster:
    """The same matrix, whatever the action."""
    return lambda beliefs, actions: beliefs @ matrix


def of_matrices(matrices: dict[int, NDArray[np.float64]]) -> Forecaster:
    """A matrix for each action, and for none."""

    def forecast(beliefs: NDArray[np.float64], actions: NDArray[np.int64]) -> NDArray[np.float64]:
        predicted = np.empty_like(beliefs)
        for action in np.unique(actions):
            rows = actions == action
            predicted[rows] = beliefs[rows] @ matrices[int(action)]
        return predicted

    return forecast


def direct(forecasts: Forecasts, steps: int, n: int, *, by_action: bool = True) -> Forecaster:
    """Our forecasts over one horizon, among n states."""
    everything = np.eye(n)
    together = forecasts.predict(everything, None, steps)
    if not by_action:
        return of_matrix(together)
    matrices = {NO_ACTION: together}
    for action in range(forecasts.n_actions):
        matrices[action] = forecasts.predict(everything, np.full(n, action), steps)
    return of_matrices(matrices)


def powers(model: FSMModel, steps: int, policy: Policy) -> Forecaster:
    """The machine's own matrices: one step under the action, the others by a policy."""
    then = model.averaged_matrix("marginal" if policy == "hold" else policy)
    average = np.linalg.matrix_power(then, steps - 1)
    matrices = {NO_ACTION: np.linalg.matrix_power(then, steps)}
    for action, matrix in enumerate(model.transition_matrices):
        held = np.linalg.matrix_power(matrix, steps - 1) if policy == "hold" else average
        matrices[action] = matrix @ held
    return of_matrices(matrices)


def batch(taught: Taught, lags: Sequence[int]) -> list[Forecaster]:
    """Deeptime's maximum likelihood for the most probable states, at the lag of each horizon.

    Its rows are those of its counts, sliding over all training rows; a state that is never left,
    nor seen again after that time, stays as it is.
    """
    with needs("deeptime", "dev", "the batch-fitted Markov model"):
        from deeptime.markov import TransitionCountEstimator
    n = taught.model.n_states
    paths = [beliefs.argmax(axis=1) for beliefs in taught.beliefs()]
    found = []
    for lag in lags:
        long = [path for path in paths if len(path) > lag]
        estimator = TransitionCountEstimator(lagtime=lag, count_mode="sliding", n_states=n)
        counts = np.asarray(estimator.fit_fetch(long).count_matrix) if long else np.zeros((n, n))
        totals = counts.sum(axis=1, keepdims=True)
        fitted = np.where(totals > 0.0, counts / np.maximum(totals, 1.0), np.eye(n))
        found.append(of_matrix(fitted))
    return found


def products(taught: Taught, steps: int) -> Forecaster:
    """The paper's way of counting, from beliefs straight to those that come after the horizon."""
    n = taught.model.n_states
    counts = np.full((n, n), 1e-3)
    for beliefs in taught.beliefs():
        counts += beliefs[:-steps].T @ beliefs[steps:]
    return of_matrix(counts / counts.sum(axis=1, keepdims=True))


def blend(taught: Taught, steps: int) -> Forecaster:
    """A share of the mean belief of training rows, the best for them in log score."""
    beliefs = list(taught.beliefs(_FOR_TUNING))
    mean = np.concatenate(beliefs).mean(axis=0)
    pairs = [(rows[:-steps], rows[steps:]) for rows in beliefs if len(rows) > steps]
    if not pairs:
        return stays
    costs = [
        -sum(
            float((after * np.log(np.maximum((1.0 - w) * before + w * mean, 1e-12))).sum())
            for before, after in pairs
        )
        for w in _BLENDS
    ]
    best = _BLENDS[int(np.argmin(costs))]
    return lambda beliefs, actions: (1.0 - best) * beliefs + best * mean


# -- All of them ----------------------------------------------------------------------------------


def compare(source: Source) -> dict[float, list[tuple[Taught, Together]]]:
    """For each horizon [s] the methods, in the safety rule's states and in the paper's."""
    safe = teach(source, SAFETY_RULE, {Method.EVOFSM: ours(source)})
    paper = teach(source, None)
    lags = [source.pace.steps(seconds) for seconds in source.pace.horizons]
    fitted = zip(batch(safe, lags), batch(paper, lags), strict=True)
    found = {}
    for seconds, steps, (of_safe, of_paper) in zip(source.pace.horizons, lags, fitted, strict=True):
        in_safe: Together = {
            Method.EVOFSM: _beside(safe, Method.EVOFSM, steps),
            Method.BLEND: blend(safe, steps),
            Method.BATCH: of_safe,
            Method.PERSISTENCE: stays,
        }
        in_paper: Together = {
            Method.PAPER: powers(paper.model, steps, "marginal"),
            Method.PAPER_BATCH: of_paper,
            Method.PAPER_PERSISTENCE: stays,
        }
        found[seconds] = [(safe, in_safe), (paper, in_paper)]
    return found


def ablate(source: Source) -> dict[float, list[tuple[Taught, Together]]]:
    """For each horizon [s] the variants; each set has its own persistence and batch beside it."""
    scales = SAFETY_RULE.scales
    safe = teach(
        source,
        SAFETY_RULE,
        {
            Variant.ACTIONS: ours(source),
            Variant.RELUCTANT: ours(source, evidence=3.0),
            Variant.MOVING: ours(source, moved=0.1),
            Variant.CHAIN: Forecasts(source.n_actions, [1]),
        },
    )
    sharp = teach(source, Novelty(1.0, scales, spread=0.3), {Variant.SHARP: ours(source)})
    fine = teach(source, Novelty(0.7, scales), {Variant.FINE: ours(source)})
    paper = teach(source, None, {Variant.PAPER_STATES: ours(source)})
    lags = [source.pace.steps(seconds) for seconds in source.pace.horizons]
    fitted = {id(one): batch(one, lags) for one in (safe, sharp, fine, paper)}
    n = safe.model.n_states
    one_step = safe.forecasts[Variant.CHAIN].predict(np.eye(n), None, 1)
    found = {}
    for k, (seconds, steps) in enumerate(zip(source.pace.horizons, lags, strict=True)):
        together = direct(safe.forecasts[Variant.ACTIONS], steps, n, by_action=False)
        in_safe: Together = {
            Variant.STATES: powers(safe.model, steps, "marginal"),
            Variant.HOLD: powers(safe.model, steps, "hold"),
            Variant.PRODUCT: products(safe, steps),
            Variant.CHAIN: of_matrix(np.linalg.matrix_power(one_step, steps)),
            Variant.DIRECT: together,
        }
        for name in (Variant.ACTIONS, Variant.RELUCTANT, Variant.MOVING):
            in_safe[name] = _beside(safe, name, steps)
        in_paper: Together = {
            Variant.PAPER: powers(paper.model, steps, "marginal"),
            Variant.PAPER_STATES: _beside(paper, Variant.PAPER_STATES, steps),
        }
        in_sharp: Together = {Variant.SHARP: _beside(sharp, Variant.SHARP, steps)}
        in_fine: Together = {Variant.FINE: _beside(fine, Variant.FINE, steps)}
        sets = [(paper, in_paper), (safe, in_safe), (sharp, in_sharp), (fine, in_fine)]
        for taught, forecasters in sets:
            forecasters |= {Method.PERSISTENCE: stays, Method.BATCH: fitted[id(taught)][k]}
        found[seconds] = sets
    return found


def _beside(taught: Taught, name: str, steps: int) -> Forecaster:
    return direct(taught.forecasts[name], steps, taught.model.n_states)
