"""Observations from a grid are often exactly as dense as a centre, or exactly a radius away.

What then happens to the states must not depend on rounding: it is held against exact arithmetic.
"""

from fractions import Fraction
from random import Random

import numpy as np
import pytest

from evofsm.fsm.machine import EvolvingFSM
from evofsm.fsm.states.edges import Edges
from evofsm.fsm.states.failure import FailureSplit
from evofsm.fsm.states.novelty import Novelty
from evofsm.fsm.step import Event

STREAMS = 60


def exact(number):
    """The number that was meant: of 0.1 a tenth."""
    return Fraction(repr(number))


def events_by_the_paper(Z, radius, distance_weight):
    """The paper's equations (1) to (6) in fractions; also whether anything was a tie."""
    rows = [[exact(value) for value in z] for z in Z]
    radius, distance_weight = exact(radius), exact(distance_weight)
    centers, potentials, distances = [rows[0]], [Fraction(1)], [Fraction(0)]
    events, ties = [Event.CREATED], 0
    for t, z in enumerate(rows[1:], 2):
        before = rows[: t - 1]
        a, b = sum(value**2 for value in z), sum(value**2 for row in before for value in row)
        c = sum(value * sum(row[j] for row in before) for j, value in enumerate(z))
        potential = Fraction(t - 1) / ((t - 1) * (a + 1) - 2 * c + b)
        potentials = [
            (t - 1) * p / ((t - 2) + p * (1 + distance_weight * d))
            for p, d in zip(potentials, distances, strict=True)
        ]
        distances = [sum((x - y) ** 2 for x, y in zip(z, other, strict=True)) for other in centers]
        nearest = distances.index(min(distances))
        ties += potential == max(potentials) or distances[nearest] == radius**2
        events.append(Event.NONE)
        if potential > max(potentials):
            if distances[nearest] < radius**2:
                events[-1] = Event.MOVED
            else:
                nearest, events[-1] = len(centers), Event.CREATED
                for held in (centers, potentials, distances):
                    held.append(0)
            centers[nearest], potentials[nearest], distances[nearest] = z, potential, 0
    return events, ties


def streams(seed, grid):
    """Short streams on a grid: the observations, a radius and a distance weight."""
    random = Random(seed)
    for _ in range(STREAMS):
        m, rows, far = random.choice([1, 2]), random.randint(4, 24), random.choice([2, 4])
        origin = random.choice([0, 0, 160])
        Z = [[(origin + random.randint(-far, far)) / grid for _ in range(m)] for _ in range(rows)]
        yield Z, random.choice([0.25, 0.3, 0.5, 1.0]), random.choice([0.5, 0.85, 1.0])


@pytest.mark.parametrize("grid", [1, 8, 10])
def test_the_papers_rule_decides_ties_as_exact_arithmetic_does(grid):
    tied = 0
    for Z, radius, distance_weight in streams(grid, grid):
        machine = EvolvingFSM(1, radius=radius, distance_weight=distance_weight)
        expected, ties = events_by_the_paper(Z, radius, distance_weight)
        assert machine.learn_many(Z, [0] * len(Z)).event.tolist() == expected
        tied += ties
    assert tied > STREAMS / 4


def test_exactly_a_radius_away_is_not_farther():
    pairs = [(k / 10, (k + 3) / 10) for k in range(-40, 200)]
    assert len({np.sign(abs(a - b) - 0.3) for a, b in pairs}) == 3  # by rounding it is all three
    for rule in (Novelty(radius=0.3), Edges()):
        for a, b in pairs:
            machine = EvolvingFSM(1, rule=rule)
            machine.learn_many([[a], [b]], [0, 0])
            assert machine.n_states == 1


def test_a_failure_exactly_at_the_distance_creates_no_state():
    rule = FailureSplit(Novelty(radius=1.0), distance=0.3)
    for k in range(-40, 200):
        machine = EvolvingFSM(1, rule=rule)
        machine.learn_many([[k / 10], [(k + 3) / 10]], [0, 0], failures=[1])
        assert machine.n_states == 1
