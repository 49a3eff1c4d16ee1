import math
from itertools import pairwise

import pytest

from evofsm import IntervalActions

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


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"low": math.nan}, "low is nan"),
        ({"high": math.inf}, "high is inf"),
        ({"width": 0.0}, "width is 0.0"),
        ({"low": 2.5}, "low must be below high"),
        ({"outside": "ignore"}, "outside is 'ignore'"),
        ({"low": 0.0, "high": 1e-10, "width": 1e-11}, "larger unit"),
    ],
)
def test_settings_that_make_no_sense_are_refused(change, words):
    with pytest.raises(ValueError, match=words):
        IntervalActions(**{**PAPER, **change})


def test_labels_show_which_edges_belong_to_the_interval():
    for outside, ends in (("error", ("[-2.5, -2.2)", "[2.3, 2.5]")), ("clip", ("< -2.2", "≥ 2.3"))):
        actions = IntervalActions(**PAPER, outside=outside)
        assert [actions.label(i) for i in (0, 8, 16)] == [ends[0], "[-0.1, 0.2)", ends[1]]
