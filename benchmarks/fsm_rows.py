"""Rows of the machine: a batch, one call a step, river's clusterers, hundreds of states."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from importlib.metadata import version
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from evofsm.driving.world import KinematicWorld
from evofsm.fsm.machine import EvolvingFSM
from evofsm.fsm.rules import Novelty
from evofsm.paper.runs import Settings
from reference import NumpyFSM
from timing import Result, Work, compare, timed

# One state for each point of a lattice of edge 1: observations scatter by less than half the
# radius around a point, and points lie farther apart than the radius.
_JITTER = 0.12
LATTICE_RADIUS = 0.6
# How far a belief reaches over the lattice; docs/speed.md has the perplexity that comes of it.
LATTICE_SPREAD = 1.9
# Rows for which an action is held; in the paper's runs it is 150.
_HELD = 10
LATTICE_RULE = Novelty(radius=LATTICE_RADIUS, spread=LATTICE_SPREAD)
# Number of states, and the lattice that has so many points.
LATTICES = {7: (7, 1, 1), 32: (4, 4, 2), 64: (4, 4, 4), 256: (8, 8, 4), 1024: (16, 8, 8)}


class Stream(NamedTuple):
    """T observations of m variables and the action after each, all in one episode."""

    observations: NDArray[np.float64]  # (T, m)
    actions: NDArray[np.int64]  # (T,)

    def part(self, begin: int, end: int) -> Stream:
        return Stream(self.observations[begin:end], self.actions[begin:end])


# Rows of the paper's four cases, once each.
PAPER_ROUND = 13_322


def paper_stream(rows: int) -> Stream:
    """The paper's four cases, over and over, until there are enough rows."""
    settings = Settings.load()
    world = KinematicWorld()
    episodes = [world.run(settings.scenario, driver) for driver in settings.drivers.values()]
    observations = np.concatenate([episode.observations for episode in episodes])
    commanded = np.concatenate([episode.accelerations for episode in episodes])
    times = -(-rows // len(observations))
    return Stream(
        np.tile(observations, (times, 1))[:rows],
        np.tile(settings.actions.encode(commanded), times)[:rows],
    )


def lattice_stream(
    n_states: int, rows: int, n_actions: int = 17, *, seed: int = 0, held: int = _HELD
) -> Stream:
    """A visit to each point of a lattice, then a walk over it: one step along an axis each row."""
    shape = np.array(LATTICES[n_states])
    rng = np.random.default_rng(seed)
    tour = np.stack(np.unravel_index(np.arange(n_states), shape), axis=1)
    moves = np.zeros((rows, len(shape)), np.int64)
    axes = rng.choice(np.flatnonzero(shape > 1), rows)
    moves[np.arange(rows), axes] = rng.choice([-1, 1], rows)
    unbounded = np.cumsum(moves, axis=0) % (2 * shape)
    walk = np.minimum(unbounded, 2 * shape - 1 - unbounded)  # turns back at the edges
    points = np.concatenate([tour, walk])[:rows]
    return Stream(
        points + rng.uniform(-_JITTER, _JITTER, points.shape),
        rng.integers(0, n_actions, rows).repeat(held)[:rows],
    )


_BATCH_ROWS = 1_000_000
_CALL_ROWS = 50_000
_LOOP_ROWS = 20_000


def batch(n_states: int, repeats: int, short: bool) -> Result:
    """`learn_many` against the loop."""
    rows = _sized(_BATCH_ROWS, short)
    machine, reference, stream = pair(n_states, rows)
    return compare(
        f"{rows:,} rows by learn_many, {n_states} states",
        lambda: timed(lambda: machine.learn_many(*stream), rows),
        "NumPy loop",
        numpy_loop(reference, stream.part(0, _sized(_LOOP_ROWS, short))),
        repeats,
    )


def call(n_states: int, repeats: int, short: bool) -> Result:
    """`learn_one` against the loop."""
    rows = _sized(_CALL_ROWS, short)
    machine, reference, stream = pair(n_states, rows)
    return compare(
        f"one call of learn_one(z, i) a step, {n_states} states",
        one_call_each(machine.learn_one, stream),
        "NumPy loop",
        numpy_loop(reference, stream.part(0, _sized(_LOOP_ROWS, short))),
        repeats,
    )


def pair(n_states: int, rows: int) -> tuple[EvolvingFSM, NumpyFSM, Stream]:
    """A machine and the reference, both taught all states, and ``rows`` rows to go on with.

    7 states are the paper's, by the paper's rule; others those of a lattice, one a point.
    """
    if n_states == 7:
        stream, taught = paper_stream(PAPER_ROUND + rows), PAPER_ROUND
        machine, reference = EvolvingFSM.paper(), NumpyFSM(17)
    else:
        taught = 20 * n_states
        stream = lattice_stream(n_states, taught + rows)
        machine = EvolvingFSM(17, rule=LATTICE_RULE)
        reference = NumpyFSM(17, spread=LATTICE_SPREAD, novelty_radius=LATTICE_RADIUS)
    lesson = stream.part(0, taught)
    machine.learn_many(*lesson)
    numpy_loop(reference, lesson)()
    assert machine.n_states == len(reference.centers) == n_states
    return machine, reference, stream.part(taught, taught + rows)


def one_call_each(learn: Callable[[Any, int], object], stream: Stream) -> Work:
    """A call for every row, as a controller would make it: an array, and an action."""
    rows, actions = list(stream.observations), stream.actions.tolist()

    def loop() -> None:
        for z, action in zip(rows, actions, strict=True):
            learn(z, action)

    return lambda: timed(loop, len(rows))


def numpy_loop(reference: NumpyFSM, stream: Stream) -> Work:
    """The reference, row by row."""

    def learn(z: Any, action: int) -> None:
        reference.observe(z)
        reference.act(action)

    return one_call_each(learn, stream)


def _sized(rows: int, short: bool) -> int:
    return rows // 100 if short else rows


_NAMES = ("gap", "v_follower", "v_leader")
_OURS = "learn_one: finds states, recognises one, forecasts by action, learns transitions"


def stream_k_means(repeats: int, short: bool) -> Result:
    """River's STREAMKMeans, told the number of clusters."""
    from river import cluster

    return _against_river(
        "STREAMKMeans",
        partial(cluster.STREAMKMeans, n_clusters=7, seed=0),
        {},
        repeats,
        short,
        "learn_one + predict_one: 7 clusters, as told; no transitions, no forecast",
    )


def db_stream(repeats: int, short: bool) -> Result:
    """River's DBSTREAM, with a memory that holds about as many clusters as there are states."""
    from river import cluster

    return _against_river(
        "DBSTREAM",
        # By default, 0.01, all is forgotten within seconds of a stream at 100 Hz, and with it all
        # clusters but one or two; with 3e-4 there are more in every round, and it grows slower.
        partial(cluster.DBSTREAM, fading_factor=5e-4),
        {"DBSTREAM as it is by default, holding 1 to 2 clusters": cluster.DBSTREAM},
        repeats,
        short,
        "learn_one + predict_one: finds 8 clusters; no transitions, no forecast",
    )


def _against_river(
    name: str,
    make: Callable[[], Any],
    others: dict[str, Callable[[], Any]],
    repeats: int,
    short: bool,
    does: str,
) -> Result:
    rows = 200 if short else PAPER_ROUND
    machine, _, stream = pair(7, rows)
    samples = [dict(zip(_NAMES, z, strict=True)) for z in stream.observations.tolist()]
    states = machine.copy().learn_many(*stream).state
    return compare(
        "one call a sample, 7 states, on the paper's runs",
        one_call_each(machine.learn_one, stream),
        f"river {version('river')} {name}",
        learn_and_predict(make(), samples),
        repeats,
        beside={what: learn_and_predict(kind(), samples) for what, kind in others.items()}
        | {f"deeptime {version('deeptime')}, counting transitions in batch": counting(states)},
        notes=[
            f"ours: {_OURS}",
            f"river: {does}",
            "deeptime: counts transitions between states found before; needs all rows at once",
        ],
    )


def learn_and_predict(model: Any, samples: list[dict[str, float]]) -> Work:
    """A call of each for every sample, as river's users make them."""

    def loop() -> None:
        for sample in samples:
            model.learn_one(sample)
            model.predict_one(sample)

    return lambda: timed(loop, len(samples))


def counting(states: Any) -> Work:
    """How often each state follows each, in one pass over them all."""
    from deeptime.markov import TransitionCountEstimator

    estimator = TransitionCountEstimator(lagtime=1, count_mode="sliding")
    return lambda: timed(lambda: estimator.fit(states).fetch_model(), len(states))


_TOLERANCE = 1e-6
# Rows a turn: about as many steps as take a second without a tolerance.
_ROWS = {7: 1_000_000, 32: 500_000, 64: 200_000, 256: 10_000, 1024: 500}


def many_states(repeats: int, short: bool) -> Result:
    """A step at 1,024 states with a tolerance, against one at 64 states without."""
    few, many = (7, 32) if short else (64, 1024)
    sparse, dense = walked(many, 17, _TOLERANCE), walked(many, 17)
    spread = perplexity(dense.copy(), walk(many, 17, 1_000, seed=1))
    return compare(
        f"learn_many, {many:,} states, belief within {_TOLERANCE:g}",
        learning(sparse, short),
        f"{few} states, exact",
        learning(walked(few, 17), short),
        repeats,
        beside={
            f"{many:,} states, exact": learning(dense, short),
            "another action in every row: no matrix in the cache": learning(sparse, short, held=1),
        },
        notes=[
            f"perplexity of the belief: median {np.median(spread):.1f}, largest {spread.max():.1f}"
        ],
    )


def cost_and_memory(repeats: int, short: bool) -> str:
    """For each number of states and actions: a step exact and with the tolerance, and memory."""
    lines = [
        f"{'states':>6}{'actions':>9}{'exact':>13}{f'within {_TOLERANCE:g}':>16}"
        f"{'all actions used':>19}{'one used':>12}"
    ]
    for n_actions in (17, 64):
        for n_states in (7, 32) if short else LATTICES:
            exact = walked(n_states, n_actions)
            tolerant = walked(n_states, n_actions, _TOLERANCE)
            result = compare(
                "a step", learning(tolerant, short), "exact", learning(exact, short), repeats
            )
            one_used = toured(n_states, n_actions)
            lines.append(
                f"{n_states:>6,}{n_actions:>9}{1e6 * result['reference_s']:>10,.2f} µs"
                f"{1e6 * result['ours_s']:>13,.2f} µs"
                f"{exact.nbytes / 1e3:>16,.0f} kB{one_used.nbytes / 1e3:>9,.0f} kB"
            )
    return "\n".join(lines)


def toured(n_states: int, n_actions: int, tolerance: float = 0.0) -> EvolvingFSM:
    """A machine that was at each point of a lattice once, always with the same action."""
    machine = EvolvingFSM(n_actions, rule=LATTICE_RULE, belief_tolerance=tolerance)
    tour = lattice_stream(n_states, n_states)
    machine.learn_many(tour.observations, np.zeros(n_states, np.int64))
    assert machine.n_states == n_states
    return machine


def walked(n_states: int, n_actions: int, tolerance: float = 0.0) -> EvolvingFSM:
    """The same after a walk on which every action was used."""
    machine = toured(n_states, n_actions, tolerance)
    stream = walk(n_states, n_actions, 2 * n_actions)
    every_action = np.arange(2 * n_actions) % n_actions
    machine.learn_many(stream.observations, every_action)
    return machine


def walk(n_states: int, n_actions: int, rows: int, **given: int) -> Stream:
    """A walk over a lattice, without the tour before it."""
    stream = lattice_stream(n_states, n_states + rows, n_actions, **given)
    return stream.part(n_states, n_states + rows)


def learning(machine: EvolvingFSM, short: bool, **given: int) -> Work:
    """A walk that the machine learns from, as a whole array."""
    rows = 100 if short else _ROWS[machine.n_states]
    stream = walk(machine.n_states, machine.n_actions, rows, seed=2, **given)
    return lambda: timed(lambda: machine.learn_many(*stream), rows)


def perplexity(machine: EvolvingFSM, stream: Stream) -> NDArray[np.float64]:
    """(T,) how many states would be as uncertain if the belief were uniform over them."""
    belief = machine.learn_many(*stream, belief=True).belief
    assert belief is not None
    logarithms = np.log2(belief, where=belief > 0.0, out=np.zeros_like(belief))
    perplexities: NDArray[np.float64] = 2.0 ** -(belief * logarithms).sum(axis=1)
    return perplexities
