import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from evofsm.fsm.machine import EvolvingFSM
from evofsm.fsm.states.novelty import Novelty
from evofsm.fsm.step import Event


@given(st.integers(0, 2**32 - 1), st.sampled_from([0.3, 1.0, 4.0]))
def test_no_observation_is_farther_than_the_radius_from_every_centre(seed, radius):
    scales = np.array([2.0, 0.25])
    machine = EvolvingFSM(n_actions=1, rule=Novelty(radius, tuple(scales)))
    Z = np.cumsum(np.random.default_rng(seed).normal(size=(100, 2)), axis=0)
    for z in Z:
        event = machine.observe(z).event
        distances = np.linalg.norm((machine.centers - z) / scales, axis=1)
        assert distances.min() <= radius
        assert (event == Event.CREATED) == (
            distances[-1] == 0.0 and (distances[:-1] > radius).all()
        )


def test_centres_never_move_and_are_observations_to_the_last_bit():
    machine = EvolvingFSM(n_actions=1, rule=Novelty(radius=1.0, scales=(0.3, 7.0)))
    Z = np.random.default_rng(0).normal(size=(500, 2)) * [1.0, 20.0]
    trace = machine.learn_many(Z, [0] * 500)
    assert set(trace.event.tolist()) == {Event.NONE, Event.CREATED}
    assert machine.centers.tobytes() == Z[trace.event == Event.CREATED].tobytes()


def test_exactly_the_radius_away_is_not_farther():
    machine = EvolvingFSM(n_actions=1, rule=Novelty(radius=2.0))
    assert machine.learn_many([[0.0], [2.0], [-2.0]], [0] * 3).n_states.tolist() == [1, 1, 1]
    assert machine.observe([2.0001]).event == Event.CREATED


def test_belief_falls_with_scaled_distance_however_much_was_seen():
    machine = EvolvingFSM(n_actions=1, rule=Novelty(radius=2.0, scales=(10.0, 1.0), spread=0.5))
    for wide in (10.0, 1000.0):
        machine.learn_many(np.random.default_rng(0).normal(size=(50, 2)) * wide, [0] * 50)
        z = np.array([7.0, 3.0])
        belief = machine.observe(z).belief
        squared = (((machine.centers - z) / [10.0, 1.0]) ** 2).sum(axis=1)
        similarity = np.exp(-squared / (0.5 * 2.0**2))
        np.testing.assert_allclose(belief, similarity / similarity.sum(), rtol=1e-10, atol=1e-300)


def test_scales_do_as_if_the_observations_had_been_divided():
    Z = np.random.default_rng(1).normal(size=(300, 2)) * [4.0, 1.0]
    I = np.arange(300) % 2
    scaled = EvolvingFSM(n_actions=2, rule=Novelty(1.0, scales=(4.0, 0.5)))
    divided = EvolvingFSM(n_actions=2, rule=Novelty(1.0))
    a = scaled.learn_many(Z, I, belief=True)
    b = divided.learn_many(Z / [4.0, 0.5], I, belief=True)
    for one, other in zip(a, b, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-12, atol=0.0)  # powers of 2: exact
    np.testing.assert_array_equal(scaled.centers, divided.centers * [4.0, 0.5])
    np.testing.assert_allclose(scaled.potentials, divided.potentials, rtol=1e-12)


def test_the_machine_shows_the_radius_and_spread_of_the_rule():
    machine = EvolvingFSM(n_actions=1, rule=Novelty(radius=2.0, spread=0.5))
    assert (machine.radius, machine.spread) == (2.0, 0.5)


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


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"radius": 0.0}, "radius is 0.0; it must be a positive"),
        ({"spread": -1.0}, "spread is -1.0; it must be a positive"),
        ({"scales": (1.0, 0.0)}, "a scale is 0.0; it must be a positive"),
        ({"scales": (1e-30,)}, "a scale is 1e-30; it must lie between"),
        ({"scales": (1e30,)}, r"a scale is 1e\+30; it must lie between"),
    ],
)
def test_settings_that_cannot_be_right(settings, words):
    with pytest.raises(ValueError, match=words):
        Novelty(**settings)


def test_any_numbers_will_do_as_scales_and_the_rule_stays_hashable():
    rule = Novelty(1, scales=np.array([2, 1]))
    assert rule == Novelty(1.0, (2.0, 1.0), 1.0)
    assert hash(rule) == hash(Novelty(scales=[2.0, 1.0]))


@pytest.mark.parametrize("size", [1e100, 1e-100])
def test_numbers_of_every_size_leave_distributions(size):
    machine = EvolvingFSM(n_actions=1, rule=Novelty(radius=1e3, scales=(1e-20,)))
    machine.learn_many(np.linspace(-size, size, 9)[:, None], [0] * 9)
    assert machine.belief.sum() == pytest.approx(1.0)
    np.testing.assert_allclose(machine.transition_matrices.sum(axis=2), 1.0)
