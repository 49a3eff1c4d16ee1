"""Scenes: which objects one may meet, as pairs."""

import numpy as np
import pytest

from evofsm.driving import Object, Role, Scene, pairs_of

ME = Object("me", x=100.0, y=0.0, vx=20.0)


def only(*others):
    (pair,) = Scene(ME, others).pairs()
    return pair


def test_who_is_ahead_is_the_leader():
    pair = only(Object("lorry", x=130.0, y=0.3, vx=15.0, length=12.0))
    assert pair == (Role.AHEAD, 1, 30.0 - 2.5 - 6.0, 20.0, 15.0)


def test_who_is_behind_follows():
    pair = only(Object("van", x=90.0, y=0.0, vx=25.0))
    assert pair == (Role.BEHIND, 1, 5.0, 25.0, 20.0)


def test_who_keeps_to_the_lane_beside_is_in_nobodys_way():
    assert Scene(ME, [Object("bus", x=105.0, y=3.5, vx=20.0)]).pairs() == []


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_who_comes_over_cuts_in(side):
    pair = only(Object("car", x=115.0, y=3.5 * side, vx=20.0, vy=-1.0 * side))
    assert pair.role is Role.CUTTING_IN
    assert Scene(ME, [Object("car", 115.0, 3.5 * side, 20.0, vy=1.0 * side)]).pairs() == []


def test_one_may_move_over_oneself():
    me = ME._replace(vy=1.0)
    (pair,) = Scene(me, [Object("car", x=115.0, y=3.5, vx=20.0)]).pairs()
    assert pair.role is Role.CUTTING_IN


def test_who_crosses_is_as_long_along_the_road_as_it_is_wide():
    pair = only(Object("bike", x=120.0, y=-6.0, vx=0.0, vy=4.0, length=2.0, width=0.6))
    assert pair == (Role.CROSSING, 1, 20.0 - 2.5 - 0.3, 20.0, 0.0)
    assert Scene(ME, [Object("bike", 80.0, -6.0, 0.0, vy=4.0)]).pairs() == []


def test_the_closest_come_first_whatever_their_order():
    far, near = Object("far", 180.0, 0.0, 20.0), Object("near", 120.0, 0.0, 20.0)
    assert [pair.gap for pair in Scene(ME, [far, near]).pairs()] == [15.0, 75.0]


def test_rows_hold_the_closest_and_zeros_where_there_is_none():
    far, near = Object("far", 180.0, 0.0, 20.0), Object("near", 120.0, 0.0, 20.0)
    rows = Scene(ME, [far, near]).rows(most=1).reshape(2, 7)
    assert rows[1].tolist() == [1.0, 120.0, 0.0, 20.0, 0.0, 5.0, 1.8]
    assert not Scene(ME).rows(most=3)[7:].any()


def test_a_row_that_was_not_seen_whole_is_left_out():
    rows = Scene(ME, [Object("car", 120.0, 0.0, 20.0)]).rows(most=1)
    rows[8] = np.nan
    assert pairs_of(rows) == []


def test_numbers_that_are_no_rows_are_refused():
    with pytest.raises(ValueError, match="no rows of 7"):
        pairs_of([1.0, 2.0])
