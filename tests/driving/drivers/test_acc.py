import math

import numpy as np
import pytest

from evofsm.driving.drivers import IDM, AdaptiveCruise
from evofsm.driving.scenarios import Leader, Scenario
from evofsm.driving.world import KinematicWorld

CRUISE = AdaptiveCruise(30.0, 2.0, 1.1)
BOUNDED = AdaptiveCruise(30.0, 2.0, 1.1, lowest=-3.5, highest=2.0)


def act(driver, *observation):
    return driver.propose(np.array(observation)).action


def test_gap_control_is_the_published_law():
    expected = 0.23 * (25.0 - 2.0 - 1.1 * 20.0) + 0.07 * (18.0 - 20.0)
    assert act(CRUISE, 25.0, 20.0, 18.0) == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize("gap", [math.inf, 1000.0])
def test_a_free_road_is_driven_at_the_set_speed(gap):
    assert act(CRUISE, gap, 25.0, 25.0) == 0.4 * 5.0
    assert act(CRUISE, gap, 30.0, 30.0) == 0.0
    assert act(CRUISE, gap, 32.0, 30.0) == pytest.approx(-0.8)


def test_at_its_gap_behind_a_leader_of_its_speed_nothing_is_to_be_done():
    assert act(CRUISE, 2.0 + 1.1 * 20.0, 20.0, 20.0) == 0.0


def test_it_settles_at_its_time_gap_behind_a_steady_leader():
    leader = Leader(IDM(1.0, 20.0, 2.0, 1.0, 2.0), brake_decel=4.0, initial_speed=20.0)
    scenario = Scenario(leader, initial_gap=60.0, duration=120.0, dt=0.1, initial_speed=20.0)
    gap, speed, _ = KinematicWorld().run(scenario, BOUNDED).observations[-1]
    assert gap == pytest.approx(2.0 + 1.1 * 20.0, abs=1e-3)
    assert speed == pytest.approx(20.0, abs=1e-3)


@pytest.mark.parametrize("gap", [0.5, 0.0, -3.0])
def test_bounds_hold_also_at_and_after_a_collision(gap):
    assert act(BOUNDED, gap, 20.0, 0.0) == -3.5
    assert act(BOUNDED, math.inf, 0.0, 0.0) == 2.0


@pytest.mark.parametrize("driver", [CRUISE, BOUNDED])
def test_the_kernel_and_the_controller_agree(driver):
    draw = np.random.default_rng(1)
    for observation in draw.uniform([-5.0, 0.0, 0.0], [150.0, 40.0, 40.0], size=(200, 3)):
        proposed = driver.propose(observation, 3.0).action
        assert proposed == driver.kernel(driver.parameters, 3.0, *observation)
        gap, speed, leader_speed = observation
        follow = 0.23 * (gap - 2.0 - 1.1 * speed) + 0.07 * (leader_speed - speed)
        plain = min(max(min(0.4 * (30.0 - speed), follow), driver.lowest), driver.highest)
        assert proposed == pytest.approx(plain, abs=1e-12)


def test_in_the_compiled_world_it_drives_as_in_python():
    class Plain:
        propose = staticmethod(BOUNDED.propose)

    leader = Leader(IDM(1.2, 25.0, 1.0, 1.0, 2.5), brake_decel=5.0, brake_time=15.0)
    scenario = Scenario(leader, initial_gap=20.0, duration=30.0)
    compiled = KinematicWorld().run(scenario, BOUNDED)
    assert np.array_equal(compiled.record, KinematicWorld().run(scenario, Plain()).record)


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"desired_speed": 0.0}, "desired_speed"),
        ({"desired_speed": math.inf}, "desired_speed"),
        ({"gap_gain": -0.2}, "gap_gain"),
        ({"cruise_gain": math.nan}, "cruise_gain"),
        ({"approach_gain": -1.0}, "approach_gain"),
        ({"min_gap": -1.0}, "min_gap"),
        ({"time_headway": math.nan}, "time_headway"),
        ({"lowest": 3.0, "highest": 2.5}, "bounds"),
    ],
)
def test_impossible_parameters_are_refused_by_name(change, word):
    values = {"desired_speed": 25.0, "min_gap": 2.0, "time_headway": 1.0}
    with pytest.raises(ValueError, match=word):
        AdaptiveCruise(**{**values, **change})
