import math
import re

import pytest

from evofsm import Category, Event, EvolvingFSM, ObservationEncoder

LIGHT = Category("light", ("red", "amber", "green"), distance=10.0)


# At equality some of these move by rounding: 10.0 does not, 16.9 does.
@pytest.mark.parametrize("radius", [0.3, 5.25, 9.58, 10.0, 15.18, 16.9])
def test_above_the_radius_a_category_founds_a_state_and_below_it_moves_one(radius):
    for distance, n_states in ((radius * (1 + 1e-12), 2), (radius * 0.99, 1)):
        encoder = ObservationEncoder(Category("light", ("red", "green"), distance))
        machine = EvolvingFSM(n_actions=1, radius=radius)
        machine.observe(encoder.encode({"light": "red"}))
        events = [machine.observe(encoder.encode({"light": "green"})).event for _ in range(9)]
        assert Event.MOVED in events or Event.CREATED in events
        assert machine.n_states == n_states


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


@pytest.mark.parametrize("value", ["abc", "1.5", b"1.5", "", None, 1j, [1.0], object])
def test_a_value_that_is_no_number_is_named(value):
    with pytest.raises(TypeError, match=re.escape(f"gap is {value!r}; it must be a number")):
        ObservationEncoder("gap", LIGHT).encode({"gap": value, "light": "red"})


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
