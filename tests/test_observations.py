import math
from itertools import combinations

import numpy as np
import pytest

from evofsm import Category, Event, EvolvingFSM, ObservationEncoder

LIGHT = Category("light", ("red", "amber", "green"), distance=10.0)


def test_any_two_categories_lie_the_given_distance_apart():
    encoder = ObservationEncoder("gap", LIGHT)
    points = [encoder.encode({"gap": 5.0, "light": value}) for value in LIGHT.values]
    for a, b in combinations(points, 2):
        assert math.dist(a, b) == pytest.approx(10.0, rel=1e-15)


def test_entries_follow_the_order_of_the_variables_and_are_named():
    encoder = ObservationEncoder("gap", LIGHT, "speed")
    encoded = encoder.encode({"speed": 2.0, "light": "amber", "gap": 5.0})
    assert encoder.names == ("gap", "light=red", "light=amber", "light=green", "speed")
    np.testing.assert_allclose(encoded, [5.0, 0.0, 10.0 / math.sqrt(2.0), 0.0, 2.0])


def test_no_state_lies_between_two_categories():
    encoder = ObservationEncoder("gap", LIGHT)
    machine = EvolvingFSM(n_actions=1, radius=10.0)
    rng = np.random.default_rng(0)
    for gap, light in zip(rng.normal(size=300), rng.choice(LIGHT.values, 300), strict=True):
        before = machine.centers
        step = machine.observe(encoder.encode({"gap": gap, "light": light}))
        if step.event == Event.MOVED:
            assert machine.centers[:, 1:].tolist() == before[:, 1:].tolist()
    assert machine.n_states > 1


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"light": "red"}, "lacks 'gap'; it has light"),
        ({"gap": 1.0}, "lacks 'light'"),
        ({"gap": 1.0, "light": "blue"}, "light is 'blue'; it may be red, amber, green"),
    ],
)
def test_a_missing_variable_or_unknown_category_is_named(values, words):
    with pytest.raises(ValueError, match=words):
        ObservationEncoder("gap", LIGHT).encode(values)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: Category("light", ("red",)), "light: needs two or more"),
        (lambda: Category("light", ("red", "red", "green")), "different values"),
        (lambda: Category("light", ("red", "green"), distance=0.0), "distance is 0.0"),
        (lambda: Category("light", ("red", "green"), distance=math.inf), "distance is inf"),
        (lambda: ObservationEncoder(), "at least one variable"),
        (lambda: ObservationEncoder("gap", "gap"), "same name twice"),
    ],
)
def test_variables_that_make_no_sense_are_refused(make, words):
    with pytest.raises(ValueError, match=words):
        make()
