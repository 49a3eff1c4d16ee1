"""State rules: what each makes of observations, and what holds for all of them."""

from dataclasses import dataclass
from fractions import Fraction
from random import Random

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from evofsm import Event, EvolvingFSM, Novelty, Paper, register_rule
from evofsm.fsm.rules import describe_rule
from evofsm.guard.check import check_results

# -- All rules -------------------------------------------------------------------------------------


def test_the_names_and_settings_in_a_file_are_these():
    novelty = {"name": "novelty", "radius": 2.0, "scales": (1.0, 4.0), "spread": 1.0}
    assert describe_rule(Novelty(2.0, (1.0, 4.0))) == novelty
    assert describe_rule(Paper()) == {"name": "paper"}


@pytest.mark.parametrize("rule", [Novelty, "novelty", 1, object()])
def test_what_is_no_rule_is_refused(rule):
    with pytest.raises(TypeError, match=r"rule is .*; it must be an object: Paper\(...\), Novelty"):
        EvolvingFSM(1, rule=rule)


@pytest.mark.parametrize("table", [{"rule": 7}, {"radius": 1.0}, {"rule": 1, "radiu": 1.0}])
def test_a_table_that_no_kernel_knows_is_refused(monkeypatch, table):
    monkeypatch.setattr(Paper, "table", table)
    words = r"table of Paper\(\) is {.*its rule must be one of \(0, 1"
    with pytest.raises(ValueError, match=words):
        EvolvingFSM(1, rule=Paper())
    assert not check_results(Paper())[-1].passed


def test_a_rule_is_registered_once_under_its_name():
    register_rule("novelty", Novelty)
    with pytest.raises(ValueError, match="a state rule 'novelty' already: Novelty"):
        register_rule("novelty", Paper)
    with pytest.raises(TypeError, match="is no state rule"):
        register_rule("something", int)
    with pytest.raises(TypeError, match="and `scales`"):
        register_rule("something", dataclass(frozen=True)(type("Bare", (), {"table": {}})))


# -- Novelty ---------------------------------------------------------------------------------------


@given(st.integers(0, 2**32 - 1), st.sampled_from([0.3, 1.0, 4.0]))
def test_no_observation_is_farther_than_the_radius_from_every_centre(seed, radius):
    scales = np.array([2.0, 0.25])
    machine = EvolvingFSM(n_actions=1, rule=Novelty(radius, tuple(scales)))
    Z = np.cumsum(np.random.default_rng(seed).normal(size=(100, 2)), axis=0)
    for z in Z:
        event = machine.observe(z).event
        distances = np.linalg.norm((machine.centers - z) / scales, axis=1)
        assert distances.min() <= radius
        is_new = distances[-1] == 0.0 and (distances[:-1] > radius).all()
        assert (event == Event.CREATED) == is_new


def test_belief_falls_with_scaled_distance_however_much_was_seen():
    machine = EvolvingFSM(n_actions=1, rule=Novelty(radius=2.0, scales=(10.0, 1.0), spread=0.5))
    for wide in (10.0, 1000.0):
        machine.learn_many(np.random.default_rng(0).normal(size=(50, 2)) * wide, [0] * 50)
        z = np.array([7.0, 3.0])
        belief = machine.observe(z).belief
        squared = (((machine.centers - z) / [10.0, 1.0]) ** 2).sum(axis=1)
        similarity = np.exp(-squared / (0.5 * 2.0**2))
        np.testing.assert_allclose(belief, similarity / similarity.sum(), rtol=1e-10, atol=1e-300)


@pytest.mark.parametrize("name", ["radius", "spread"])
def test_a_machine_and_its_rule_may_not_contradict_each_other(name):
    rule = Novelty(radius=2.0, spread=2.0)
    with pytest.raises(ValueError, match=rf"{name} is 5.0, but the rule has its own: Novelty\("):
        EvolvingFSM(1, rule=rule, **{name: 5.0})
    assert getattr(EvolvingFSM(1, rule=rule, **{name: 2.0}), name) == 2.0


def test_as_many_scales_as_variables(snapshot):
    machine = EvolvingFSM(n_actions=1, rule=Novelty(scales=(1.0, 2.0, 3.0)))
    before = snapshot(machine)
    for learn in (lambda z: machine.observe(z), lambda z: machine.learn_many([z], [0])):
        with pytest.raises(ValueError, match="observation has 2 variables, but there are 3 in Nov"):
            learn([0.0, 1.0])
    assert snapshot(machine) == before
    assert machine.observe([0.0, 1.0, 2.0]).event == Event.CREATED


def test_a_scale_of_a_rule_of_ones_own_is_positive():
    @dataclass(frozen=True)
    class Flat(Paper):
        scales = np.array([0.0, 1.0])

    register_rule("flat", Flat)
    with pytest.raises(ValueError, match=r"a scale is 0.0; it must be a positive"):
        EvolvingFSM(1, rule=Flat()).observe([0.0, 1.0])


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"radius": 0.0}, "radius is 0.0; it must be a positive"),
        ({"spread": -1.0}, "spread is -1.0; it must be a positive"),
        ({"scales": (1.0, 0.0)}, "a scale is 0.0; it must be a positive"),
        ({"scales": (1e-30,)}, r"rule\.scales of 1e-30 cannot be right"),
        ({"scales": (1e30,)}, r"rule\.scales of 1e\+30 cannot be right"),
    ],
)
def test_settings_that_cannot_be_right(settings, words):
    with pytest.raises(ValueError, match=words):
        EvolvingFSM(1, rule=Novelty(**settings))


# -- Ties ----------------------------------------------------------------------------------------
# Observations from a grid are often exactly as dense as a centre, or exactly a radius away. What
# then happens to the states must not depend on rounding: it is held against exact arithmetic.


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


def on_a_grid(seed, grid):
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
    for Z, radius, distance_weight in on_a_grid(grid, grid):
        machine = EvolvingFSM(1, radius=radius, distance_weight=distance_weight)
        expected, ties = events_by_the_paper(Z, radius, distance_weight)
        assert machine.learn_many(Z, [0] * len(Z)).event.tolist() == expected
        tied += ties
    assert tied > STREAMS / 4


def test_exactly_a_radius_away_is_not_farther():
    pairs = [(k / 10, (k + 3) / 10) for k in range(-40, 200)]
    assert len({np.sign(abs(a - b) - 0.3) for a, b in pairs}) == 3  # by rounding it is all three
    for a, b in pairs:
        machine = EvolvingFSM(1, rule=Novelty(radius=0.3))
        machine.learn_many([[a], [b]], [0, 0])
        assert machine.n_states == 1
