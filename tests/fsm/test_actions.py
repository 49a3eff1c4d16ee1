import math
import re
from itertools import pairwise

import pytest

from evofsm import Category, Event, EvolvingFSM, IntervalActions, ObservationEncoder

PAPER = {"low": -2.5, "high": 2.5, "width": 0.3}
# Edges as a person writes them, not as floating point computes them.
PAPER_EDGES = [-2.5, -2.2, -1.9, -1.6, -1.3, -1.0, -0.7, -0.4, -0.1]
PAPER_EDGES += [0.2, 0.5, 0.8, 1.1, 1.4, 1.7, 2.0, 2.3, 2.5]
BEYOND = r"outside \[-2.5, 2.5\].*clip"


def test_intervals_meet_and_an_inner_edge_belongs_to_the_one_that_it_begins():
    actions = IntervalActions(**PAPER)
    assert (actions.n_actions, actions.edges.tolist()) == (17, PAPER_EDGES)
    for k, edge in enumerate(PAPER_EDGES[1:-1]):
        assert actions.encode(edge) == actions.encode([edge])[0] == k + 1
        assert actions.encode(math.nextafter(edge, -math.inf)) == k
    intervals = [actions.interval(i) for i in range(17)]
    assert all(a[1] == b[0] for a, b in pairwise(intervals))
    assert [actions.center(i) for i in (0, 8, 16)] == [-2.35, 0.05, 2.4]
    assert [actions.encode(actions.center(i)) for i in range(17)] == list(range(17))


@pytest.mark.parametrize(
    ("low", "high", "width", "count"),
    [(0.0, 0.3, 0.1, 3), (0.0, 2.1, 0.3, 7), (-1.0, 1.0, 3.0, 1), (0.0, 1.0, 0.4, 3)],
)
def test_the_range_is_covered_by_as_many_intervals_as_arithmetic_on_paper_says(
    low, high, width, count
):
    actions = IntervalActions(low, high, width)
    assert actions.n_actions == count
    assert (actions.edges[0], actions.edges[-1]) == (low, high)


def test_values_beyond_the_range_fall_into_the_end_intervals_when_clipped():
    actions = IntervalActions(**PAPER, outside="clip")
    beyond = [-math.inf, -9.0, -2.6, 2.6, 9.0, math.inf]
    assert actions.encode(beyond).tolist() == [0, 0, 0, 16, 16, 16]


@pytest.mark.parametrize(
    ("outside", "value", "error", "words"),
    [
        *(("error", value, ValueError, BEYOND) for value in (2.6, -math.inf)),
        ("error", [0.0, math.nextafter(2.5, 3)], ValueError, BEYOND),
        *((outside, [0.0, math.nan], ValueError, "NaN") for outside in ("error", "clip")),
        ("error", None, TypeError, "action is None; it must be a real number"),
        ("error", 1j, TypeError, "action is 1j; it must be a real number"),
        ("error", ["0.5", "1"], TypeError, "action has dtype <U3; it must be a real number"),
        ("error", [0.0, None], TypeError, "action has dtype object; it must be a real number"),
    ],
)
def test_values_beyond_the_range_are_refused_and_what_is_no_number_always(
    outside, value, error, words
):
    with pytest.raises(error, match=words):
        IntervalActions(**PAPER, outside=outside).encode(value)


@pytest.mark.parametrize("i", [-1, 17])
def test_an_interval_that_does_not_exist_is_refused(i):
    actions = IntervalActions(**PAPER)
    for method in (actions.interval, actions.center, actions.label):
        with pytest.raises(ValueError, match=f"interval is {i}; there are intervals 0 to 16"):
            method(i)


def test_labels_show_which_edges_belong_to_the_interval():
    for outside, ends in (("error", ("[-2.5, -2.2)", "[2.3, 2.5]")), ("clip", ("< -2.2", "≥ 2.3"))):
        actions = IntervalActions(**PAPER, outside=outside)
        assert [actions.label(i) for i in (0, 8, 16)] == [ends[0], "[-0.1, 0.2)", ends[1]]


# -- Observations ----------------------------------------------------------------------------------

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
        (lambda: IntervalActions(math.nan, 2.5, 0.3), "low is nan"),
        (lambda: IntervalActions(-2.5, math.inf, 0.3), "high is inf"),
        (lambda: IntervalActions(-2.5, 2.5, 0.0), "width is 0.0"),
        (lambda: IntervalActions(2.5, 2.5, 0.3), "low must be below high"),
        (lambda: IntervalActions(**PAPER, outside="ignore"), "outside is 'ignore'"),
        (lambda: IntervalActions(0.0, 1e-10, 1e-11), "larger unit"),
        (lambda: Category("light", ("red",)), "light: needs two or more"),
        (lambda: Category("light", ("red", "red", "green")), "different values"),
        (lambda: Category("light", ("red", "green"), distance=0.0), "distance is 0.0"),
        (lambda: Category("light", ("red", "green"), distance=math.inf), "distance is inf"),
        (lambda: ObservationEncoder(), "at least one variable"),
        (lambda: ObservationEncoder("gap", "gap"), "same name twice"),
    ],
)
def test_actions_and_variables_that_make_no_sense_are_refused(make, words):
    with pytest.raises(ValueError, match=words):
        make()
