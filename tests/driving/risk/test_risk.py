import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from evofsm.driving.measures import is_dead_end, time_to_collision

SPEEDS = st.floats(0.0, 40.0)
DECELS = st.floats(1.0, 10.0)


def smallest_gap(gap, speed, leader_speed, decel, leader_decel):
    """Gap when both brake, on a fine grid of time."""
    time = np.linspace(0.0, 45.0, 200_001)
    travelled = [
        np.where(time < v / b, v * time - b * time**2 / 2, v**2 / (2 * b))
        for v, b in ((speed, decel), (leader_speed, leader_decel))
    ]
    return (gap + travelled[1] - travelled[0]).min()


@given(st.floats(0.1, 100.0), SPEEDS, SPEEDS, DECELS, DECELS)
def test_the_oracle_agrees_with_driving_it_out(gap, speed, leader_speed, decel, leader_decel):
    smallest = smallest_gap(gap, speed, leader_speed, decel, leader_decel)
    dead_end = is_dead_end(np.array([gap, speed, leader_speed]), decel, leader_decel)
    if abs(smallest) > 1e-4:
        assert dead_end == (smallest < 0.0)


def test_close_at_equal_speed_is_a_dead_end_that_ttc_does_not_see():
    observation = np.array([10.0, 24.0, 24.0])
    assert is_dead_end(observation, 4.0, 9.0)
    assert time_to_collision(observation) == np.inf


def test_ttc_is_gap_over_closing_speed():
    assert time_to_collision(np.array([10.0, 25.0, 20.0])) == 2.0
    rows = np.array([[10.0, 25.0, 20.0], [10.0, 20.0, 25.0]])
    assert time_to_collision(rows).tolist() == [2.0, np.inf]


def test_measures_take_whole_numbers_and_cars_that_have_met():
    assert time_to_collision(np.array([10, 25, 20])) == 2.0
    assert time_to_collision(np.array([-0.5, 25.0, 20.0])) == 0.0
    assert is_dead_end(np.array([0, 10, 10]), 4, 9)
