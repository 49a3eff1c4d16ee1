"""Sets of actions: what lies in them, what is put into them, and how far apart two actions are."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from evofsm import IntervalActions
from evofsm.guard.actions import (
    BoxActions,
    Choices,
    change,
    distances,
    is_usable,
    nearest_bounds,
    put_into,
    same_action,
)

BOX = BoxActions((-1.0, 0.0), (1.0, 4.0))


@st.composite
def boxes(draw):
    low = draw(st.lists(st.floats(-100.0, 100.0), min_size=1, max_size=5))
    ranges = [draw(st.floats(0.01, 50.0)) for _ in low]
    return BoxActions(tuple(low), tuple(a + b for a, b in zip(low, ranges, strict=True)))


@pytest.mark.parametrize(
    ("dimensions", "levels"),
    [(1, (17,)), (2, (9, 9)), (3, (4,) * 3), (4, (3,) * 4), (5, (2,) * 5), (8, (2,) * 6 + (1, 1))],
)
def test_a_grid_has_as_many_levels_as_make_81_cells_at_most(dimensions, levels):
    box = BoxActions((0.0,) * dimensions, (1.0,) * dimensions)
    assert box.levels == levels
    assert box.n_actions == math.prod(levels) <= 81


@given(boxes(), st.data())
def test_an_action_lies_in_the_cell_that_it_is_encoded_as(box, data):
    shares = np.array([data.draw(st.floats(0.0, 1.0)) for _ in box.low])
    action = box.clip(box.bounds[0] + shares * 2.0 * box.half)
    lowest, highest = box.cells[:, box.encode(action)]
    slack = 1e-9 * np.abs(box.bounds).max()
    assert (lowest - slack <= action).all()
    assert (action <= highest + slack).all()
    assert action in box


def test_every_cell_is_encoded_by_its_middle_and_beyond_lies_the_edge():
    middles = BOX.cells[:, : BOX.n_actions].mean(axis=0)
    assert [BOX.encode(middle) for middle in middles] == list(range(81))
    assert BOX.encode([-9.0, -9.0]) == 0
    assert BOX.encode([9.0, math.inf]) == 80
    for action, why in (([0.0, math.nan], "NaN"), ([0.0], "it must have 2")):
        with pytest.raises(ValueError, match=why):
            BOX.encode(action)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"low": (0.0,), "high": (1.0, 2.0)}, "1 components and high has 2"),
        ({"low": (0.0, 2.0), "high": (1.0, 2.0)}, "in component 1; low must be below high"),
        ({"low": (-math.inf,), "high": (1.0,)}, "low is .* must be finite"),
        ({"low": (), "high": ()}, "not empty"),
        ({"low": 0.0, "high": 1.0}, "low has shape"),
        ({"low": ("a",), "high": (1.0,)}, "low"),
    ],
)
def test_what_is_no_box_is_refused(settings, message):
    with pytest.raises((TypeError, ValueError), match=message):
        BoxActions(**settings)


def test_options_are_the_nearest_of_each_cell_and_the_corners():
    lowest, highest = nearest_bounds(BOX)
    nearest = np.minimum(np.maximum([0.3, 1.0], lowest), highest)
    assert len(nearest) == 1 + 81 + 4
    assert nearest[0].tolist() == [0.3, 1.0]
    assert nearest[-4:].tolist() == [[-1.0, 0.0], [-1.0, 4.0], [1.0, 0.0], [1.0, 4.0]]
    assert all(one in BOX for one in nearest)


@given(boxes(), st.data())
def test_whatever_is_finite_is_put_into_a_box(box, data):
    action = np.array([data.draw(st.floats()) for _ in box.low])
    assert is_usable(box, action) == np.isfinite(action).all()
    assert not is_usable(box, np.append(action, 0.0))
    if is_usable(box, action):
        inside = put_into(box, action)
        assert inside in box
        assert same_action(inside, action) == (action in box)


def test_how_far_apart_actions_are():
    assert distances(BOX, np.array([[0.0, 0.0], [0.0, 4.0]]), [0.0, 2.0]).tolist() == [1.0, 1.0]
    assert change(BOX, np.array([-1.0, 0.0]), np.array([1.0, 4.0])) == pytest.approx(8.0**0.5)
    assert change(IntervalActions(0.0, 4.0, 1.0), 1.0, 2.0) == 0.5
    assert [change(Choices(9), 1, other) for other in (1, 2, 8)] == [0.0, 1.0, 1.0]
    assert not same_action(np.array([math.nan, 1.0]), np.array([math.nan, 1.0]))
