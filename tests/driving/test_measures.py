from dataclasses import fields, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.driving.test_judge import smallest_gap

from evofsm import Guard, IntervalActions
from evofsm.driving import EnvelopeReviser, measures
from evofsm.driving.measures import DecelerationToAvoidCollision, FuzzySafety, is_dead_end

MATCHED = measures.ResponsibilitySensitiveSafety.matched(2.5, 4.5)
MEASURES = [*measures.FIXED_MEASURES.values(), MATCHED]
CAN_BE_ZERO = {"reaction", "response", "accel", "margin"}
EVERY_MEASURE = pytest.mark.parametrize("measure", MEASURES, ids=repr)

ACTIONS = IntervalActions(low=-2.5, high=2.5, width=0.3)
DT = 0.1
SPEEDS = st.floats(0.0, 60.0)
DECELS = st.floats(1.0, 10.0)
ROWS = st.tuples(st.floats(-10.0, 500.0), SPEEDS, SPEEDS)
EPISODES = st.lists(ROWS, min_size=1, max_size=8).map(np.array)
AT_EQUAL_SPEED = np.array([[10.0, 24.0, 24.0]])


@pytest.mark.slow
@EVERY_MEASURE
@given(EPISODES, st.data())
def test_every_row_gets_a_score_whatever_comes_later_and_observations_stay(measure, episode, data):
    before, rows = episode.copy(), data.draw(st.integers(1, len(episode)))
    scores = measure.score(episode, DT)
    assert scores.shape == (len(episode),)
    assert scores.dtype == np.float64
    assert not np.isnan(scores).any()
    np.testing.assert_array_equal(episode, before)
    np.testing.assert_array_equal(scores[:rows], measure.score(episode[:rows], DT))


@pytest.mark.slow
@EVERY_MEASURE
@given(EPISODES, SPEEDS, SPEEDS, st.floats(-10.0, 0.0))
def test_nothing_is_more_dangerous_than_to_have_met(measure, episode, speed, leader, gap):
    met = measure.score(np.vstack([episode, [[gap, speed, leader]]]), DT)
    assert met[-1] > 0.0
    assert met[-1] == met.max()


@pytest.mark.slow
@EVERY_MEASURE
@given(EPISODES, st.sampled_from([(0, -1.0), (1, 1.0), (2, -1.0)]), st.floats(0.0, 50.0))
def test_closer_faster_or_behind_a_slower_leader_is_not_safer(measure, episode, how, much):
    column, sign = how
    worse = episode.copy()
    worse[-1, column] += sign * much
    if column != 2 or worse[-1, 2] >= 0.0:
        larger, smaller = (measure.score(rows, DT)[-1] for rows in (worse, episode))
        assert larger >= smaller or np.isclose(larger, smaller, rtol=1e-9, atol=1e-9)


@EVERY_MEASURE
def test_all_call_for_braking_close_behind_who_stands_or_comes_and_none_where_nothing_is(measure):
    assert measure.score(np.array([[200, 20, 25]]), DT) <= 0.0
    free = np.array([[30.0, 20.0, 18.0], [np.inf, 20.0, 20.0], [np.inf, 20.0, 20.0]])
    with np.errstate(all="raise"):
        assert (measure.score(free, DT)[1:] <= 0.0).all()
    away = np.array([[0.65, -4.8, -1.0]])  # who rolls backwards needs no way ahead
    assert measure.score(away, DT) <= 0.0
    assert not is_dead_end(away, 6.0, 6.0)
    assert measure.score(np.array([[3, 20, 0]]), DT) > 0.0
    assert measure.score(np.array([[9, 10, -10]]), DT) > 0.0


@EVERY_MEASURE
@pytest.mark.parametrize("unseen", range(3))
def test_who_does_not_see_brakes_and_once_it_sees_again_no_more(measure, unseen):
    guard = Guard.of(EnvelopeReviser(measure, ACTIONS, DT), interval=DT)
    rows = [[5.0, 20.0, 0.0], [200.0, 20.0, 25.0]]
    rows[0][unseen] = np.nan
    blind, seeing = (guard.decide(row, 1.0) for row in rows)
    assert (blind.executed, seeing.executed) == (-2.5, 1.0)
    assert unseen or blind.reason.startswith("not seen: gap")
    assert np.isnan(measures.time_to_collision(np.array(rows[0])))


def test_who_comes_towards_one_needs_as_much_room_as_oneself():
    one, both = MATCHED.safe_distance(np.array([[9.0, 10.0, 0.0], [9.0, 10.0, -10.0]]))
    assert both == 2.0 * one
    head_on = [[30.0, 10.0, -10.0], [13.0, 10.0, -10.0]]
    assert is_dead_end(head_on, 6.0, 9.0).tolist() == [False, True]


@EVERY_MEASURE
@pytest.mark.parametrize("wrong", [-1.0, 0.0, float("nan"), float("inf"), "1"])
def test_wrong_arguments_are_named(measure, wrong):
    for field in fields(measure):
        if wrong == 0.0 and field.name in CAN_BE_ZERO:
            continue
        with pytest.raises(ValueError, match=f"{type(measure).__name__} {field.name} is"):
            replace(measure, **{field.name: wrong})
    if isinstance(measure, measures.ModifiedTimeToCollision | FuzzySafety):  # which need the step
        with pytest.raises(ValueError, match=r"dt is 0\.0"):
            measure.score(AT_EQUAL_SPEED, 0.0)


def test_at_equal_speed_some_are_blind_and_others_see():
    blind = {measures.TimeToCollision, measures.ModifiedTimeToCollision}
    blind |= {DecelerationToAvoidCollision, measures.PerformanceModel}
    assert is_dead_end(AT_EQUAL_SPEED, 4.0, 9.0)
    assert measures.time_to_collision(AT_EQUAL_SPEED) == np.inf
    for measure in MEASURES:
        sees = measure.score(AT_EQUAL_SPEED, DT)[0] > 0.0
        assert sees == (type(measure) not in blind)


def test_mttc_solves_for_the_first_meeting():
    # Opening at 1 m/s, but 2 m/s² faster and faster: t² - t = 6.
    rows = np.array([[6.0, 10.0, 13.0], [6.0, 10.0, 11.0]])
    assert measures.modified_time_to_collision(rows, 1.0)[1] == pytest.approx(3.0)
    # Closing at 5 m/s, but braking by 2 m/s²: 5t - t² = 6, first at 2 s and never again.
    rows = np.array([[6.0, 17.0, 10.0], [6.0, 15.0, 10.0]])
    assert measures.modified_time_to_collision(rows, 1.0)[1] == pytest.approx(2.0)
    rows[1, 0] = 6.5
    assert measures.modified_time_to_collision(rows, 1.0)[1] == np.inf


def test_drac_is_what_stops_the_closing_within_the_gap():
    rows = np.array([[10.0, 30.0, 20.0], [10.0, 20.0, 30.0], [0.0, 20.0, 30.0]])
    assert measures.deceleration_to_avoid_collision(rows).tolist() == [5.0, 0.0, np.inf]
    assert DecelerationToAvoidCollision(5.0).score(rows, DT).tolist() == [0.0, -5.0, np.inf]


def test_pfs_falls_from_the_unsafe_to_the_safe_distance():
    # Unsafe below 20 m and safe from 32 m on, behind a margin of 2 m.
    gaps = np.array([21.0, 22.0, 28.0, 33.9, 34.0, 40.0, 0.0, -1.0])
    rows = np.column_stack([gaps, np.full(8, 20.0), np.full(8, 20.0)])
    pfs = FuzzySafety(1.0, 4.0, 5.0, 5.0, margin=2.0).proactive(rows)
    assert pfs == pytest.approx([1.0, 1.0, 0.5, 0.1 / 12.0, 0.0, 0.0, 1.0, 1.0])


def test_cfs_falls_from_what_hard_to_what_comfortable_braking_needs_and_trusts_the_latter():
    # 10 m of reaction, then 10 m or 12.5 m of braking.
    gaps = np.array([19.0, 20.0, 21.0, 22.5, 30.0])
    rows = np.column_stack([gaps, np.full(5, 20.0), np.full(5, 10.0)])
    assert FuzzySafety(1.0, 4.0, 5.0).critical(rows, DT).tolist() == [1.0, 1.0, 0.6, 0.0, 0.0]
    # Braking that is under way is trusted: by 3 m/s², 2 m/s too fast, 2²/6 m are needed.
    rows = np.array([[9.0, 13.0, 8.0], [0.7, 10.0, 8.0], [0.6, 7.0, 5.0]])
    assert FuzzySafety(1.0, 4.0, 5.0).critical(rows, 1.0)[1:].tolist() == [0.0, 1.0]
    # Braking by 8 m/s², taken for 4 m/s²: from 10 to 6 m/s in 8 m, then 36/10 or 36/8 m.
    rows = np.array([[99.0, 28.0, 10.0], [12.05, 20.0, 10.0]])
    assert FuzzySafety(1.0, 4.0, 5.0).critical(rows, 1.0)[1] == pytest.approx(0.45 / 0.9)


@settings(max_examples=500)
@given(st.floats(0.1, 100.0), SPEEDS, SPEEDS, DECELS, DECELS)
def test_the_oracle_agrees_with_driving_it_out(gap, speed, leader_speed, decel, leader_decel):
    brakes = -decel, -decel, decel, 0.0
    smallest = smallest_gap(gap, speed, leader_speed, *brakes, leader_decel)
    dead_end = is_dead_end(np.array([gap, speed, leader_speed]), decel, leader_decel)
    if abs(smallest) > 1e-4:
        assert dead_end == (smallest < 0.0)
