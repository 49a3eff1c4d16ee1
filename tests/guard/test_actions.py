"""Boxes of actions and their cells."""

import math

import numpy as np
import pytest

from evofsm.guard.actions import BoxActions, nearest_bounds

BOX = BoxActions((-1.0, 0.0), (1.0, 4.0))


@pytest.mark.parametrize(
    ("dimensions", "levels"),
    [(1, (17,)), (2, (9, 9)), (3, (4,) * 3), (4, (3,) * 4), (5, (2,) * 5), (8, (2,) * 6 + (1, 1))],
)
def test_a_grid_has_as_many_levels_as_make_81_cells_at_most(dimensions, levels):
    box = BoxActions((0.0,) * dimensions, (1.0,) * dimensions)
    assert box.levels == levels
    assert box.n_actions == math.prod(levels) <= 81


def test_every_cell_is_encoded_by_its_middle_and_beyond_lies_the_edge():
    middles = BOX.cells[:, : BOX.n_actions].mean(axis=0)
    assert [BOX.encode(middle) for middle in middles] == list(range(81))
    assert BOX.encode([-9.0, -9.0]) == 0
    assert BOX.encode([9.0, math.inf]) == 80
    for action, why in (([0.0, math.nan], "NaN"), ([0.0], "it must have 2")):
        with pytest.raises(ValueError, match=why):
            BOX.encode(action)


def test_options_are_the_nearest_of_each_cell_and_the_corners():
    lowest, highest = nearest_bounds(BOX)
    nearest = np.minimum(np.maximum([0.3, 1.0], lowest), highest)
    assert len(nearest) == 1 + 81 + 4
    assert nearest[0].tolist() == [0.3, 1.0]
    assert nearest[-4:].tolist() == [[-1.0, 0.0], [-1.0, 4.0], [1.0, 0.0], [1.0, 4.0]]
    assert (nearest == BOX.clip(nearest)).all()
