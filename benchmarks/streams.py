"""What is learnt from while the clock runs: the paper's runs, and walks over as many states as
wanted."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from evofsm.driving.world import KinematicWorld
from evofsm.fsm.rules import Novelty
from evofsm.paper.runs import Settings

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
