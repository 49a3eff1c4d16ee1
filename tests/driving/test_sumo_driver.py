from dataclasses import replace

import numpy as np
import pytest

from evofsm.driving.drivers import IDM
from evofsm.driving.episodes import drive
from evofsm.driving.judge import LatentRisk
from evofsm.driving.revisers import Unrevised
from evofsm.driving.scenarios import CutIn, Leader, Scenario, Sensors
from evofsm.driving.sumo import MODELS, SumoDriver, SumoWorld
from evofsm.driving.world import KinematicWorld
from evofsm.fsm.actions import IntervalActions
from evofsm.guard.api import Proposal
from evofsm.guard.guard import Guard
from evofsm.guard.reviser import ActionReviser

libsumo = pytest.importorskip("libsumo")

LEADER = Leader(
    IDM(1.2, 25.0, 1.0, 1.0, 2.5),
    brake_decel=6.0,
    brake_time=25.0,
    initial_speed=10.0,
    waves=((8.0, -3.0), (11.0, 0.5), (20.0, 1.0)),
)
SCENARIO = Scenario(LEADER, initial_gap=20.0, duration=32.0, initial_speed=10.0)
CAR = {"accel": 1.5, "decel": 2.0, "tau": 1.2, "minGap": 2.0, "maxSpeed": 28.0}
SAME_IDM = IDM(1.5, 28.0, 2.0, 1.2, 2.0, lowest=-9.0)


@pytest.fixture
def world():
    with SumoWorld() as world:
        yield world


@pytest.mark.parametrize("dt", [0.01, 0.25])
def test_the_wish_of_sumos_idm_is_the_closed_form(world, dt):
    driver = SumoDriver(world, "IDM", **CAR, emergencyDecel=9.0)
    draw = np.random.default_rng(2)
    compared = 0
    with world.open(replace(SCENARIO, dt=dt)):
        for seen in draw.uniform([1.0, 0.0, 0.0], [150.0, 28.0, 30.0], size=(500, 3)):
            expected = SAME_IDM.propose(seen).action
            if -9.0 < expected and seen[1] + expected * dt > 0.0:  # no bound bites
                assert driver.propose(seen).action == pytest.approx(expected, abs=1e-9)
                compared += 1
    assert compared > 250


def test_bounds_are_the_cars_own_and_standstill(world):
    driver = SumoDriver(world, "IDM", **CAR, emergencyDecel=7.0)
    krauss = SumoDriver(world, "Krauss", **CAR)
    with world.open(SCENARIO):
        for gap in (1.0, 0.0, -3.0):
            assert driver.propose(np.array([gap, 20.0, 0.0])).action == pytest.approx(-7.0)
        # SUMO wishes no speed below 0.
        assert driver.propose(np.array([1.0, 0.02, 0.0])).action == pytest.approx(-2.0)
        assert driver.propose(np.array([1.0, 0.0, 0.0])).action == 0.0
        assert krauss.propose(np.array([1e4, 10.0, 10.0])).action == pytest.approx(1.5)


def driven_by_sumo_alone(world, driver, scenario, leader_speeds):
    """The same run with the follower left to SUMO: nobody sets its speed."""
    vehicle, rows = libsumo.vehicle, []
    with world.open(scenario) as road:
        driver.propose(road.observation)  # makes the follower a car of the driver's kind
        follower = next(car for car in vehicle.getIDList() if car.startswith("follower"))
        leader = follower.replace("follower", "leader")
        vehicle.setApparentDecel(leader, driver.leader_decel)
        vehicle.setSpeedMode(follower, 31)
        vehicle.setSpeed(follower, -1)
        for k in range(len(leader_speeds)):
            gap = vehicle.getLanePosition(leader) - 5.0 - vehicle.getLanePosition(follower)
            rows.append((gap, vehicle.getSpeed(follower), vehicle.getSpeed(leader)))
            vehicle.setSpeed(leader, leader_speeds[min(k + 1, len(leader_speeds) - 1)])
            libsumo.simulationStep()
    return np.array(rows)


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("dt", [0.01, 0.1])
def test_unrevised_it_drives_as_sumo_does_alone(world, model, dt):
    scenario = replace(SCENARIO, dt=dt)
    driver = SumoDriver(world, model, **CAR)
    proposed = world.run(scenario, driver).observations
    alone = driven_by_sumo_alone(world, driver, scenario, proposed[:, 2].tolist())
    assert np.ptp(proposed[:, 1]) > 5.0
    assert np.abs(proposed - alone).max() < 1e-9


@pytest.mark.slow
def test_under_a_reviser_what_is_executed_is_carried_out_exactly(world):
    actions = IntervalActions(low=-2.5, high=2.5, width=0.3, outside="clip")
    hasty = {"accel": 2.25, "decel": 2.0, "tau": 0.3, "minGap": 0.8, "maxSpeed": 28.0}
    driver = SumoDriver(world, "IDM", **hasty)
    risk = LatentRisk(lowest=-2.5)
    leader = replace(LEADER, brake_decel=4.0, brake_time=12.0, waves=())
    scenario = Scenario(leader, initial_gap=30.0, duration=25.0, initial_speed=10.0)
    alone = Guard.of(Unrevised(actions), interval=0.25)
    unrevised = drive(alone, scenario, world, driver)
    guard = Guard.of(ActionReviser(risk, actions), interval=0.25)
    revised = drive(guard, scenario, world, driver)
    assert unrevised.collided
    assert not revised.collided
    assert np.isfinite(revised.proposed).all()
    assert (np.abs(revised.executed - revised.proposed) > 0.1).any()
    speed, commanded = revised.observations[:, 1], revised.accelerations
    carried_out = np.maximum(0.0, speed[:-1] + commanded[:-1] * scenario.dt)
    assert np.abs(speed[1:] - carried_out).max() < 1e-12
    held = revised.accelerations[: 25 * len(revised.executed)]
    assert np.array_equal(held[::25], revised.executed)


def test_it_sees_what_the_sensors_show_and_the_car_that_cut_in(world):
    leader = replace(LEADER, cut_in=CutIn(5.0, gap=6.0, speed=8.0))
    sensors = Sensors(gap_noise=0.5, speed_noise=0.2, delay=0.2, seed=1)
    scenario = replace(SCENARIO, leader=leader, sensors=sensors, duration=8.0)
    driver, seen = SumoDriver(world, "IDM", **CAR, emergencyDecel=9.0), []

    class Looks:
        def propose(self, observation, time=0.0):
            seen.append(observation)
            return driver.propose(observation, time)

    actions = world.run(scenario, Looks()).accelerations
    expected = [SAME_IDM.propose(z).action for z in seen]
    assert actions == pytest.approx(expected, abs=1e-9)


def test_in_another_world_it_says_where_it_belongs(world):
    driver = SumoDriver(world, "IDM", **CAR)
    with pytest.raises(RuntimeError, match="only in the world that it was made with"):
        KinematicWorld().run(SCENARIO, driver)
    world.run(replace(SCENARIO, duration=1.0), driver)
    with pytest.raises(RuntimeError, match="no road open"):
        driver.propose(np.array([10.0, 5.0, 5.0]), 0.99)
    with world.open(SCENARIO) as road:
        road.advance(0.0, steps=100)
        with pytest.raises(RuntimeError, match="a road at 1 s open"):
            driver.propose(road.observation)
    with pytest.raises(TypeError, match="SumoWorld only"):
        SumoDriver(KinematicWorld(), "IDM")


def test_a_kind_made_too_late_for_the_open_road_is_named(world):
    with world.open(SCENARIO) as road:
        driver = SumoDriver(world, "IDM", **CAR)
        with pytest.raises(RuntimeError, match="then open the road"):
            driver.propose(road.observation)
    with world.open(SCENARIO) as road:
        assert isinstance(driver.propose(road.observation), Proposal)


@pytest.mark.parametrize(
    ("model", "change", "word"),
    [
        ("EIDM", {}, "no model 'EIDM'"),
        ("IDM", {"acel": 2.0}, "no attribute 'acel'"),
        ("Krauss", {"delta": 2.0}, "no attribute 'delta'"),
        ("IDM", {"accel": 0.0}, "accel"),
        ("IDM", {"minGap": -1.0}, "minGap"),
        ("IDM", {"tau": float("nan")}, "tau"),
        ("IDM", {"leader_decel": -4.0}, "leader_decel"),
    ],
)
def test_impossible_cars_are_refused_by_name(world, model, change, word):
    with pytest.raises(ValueError, match=word):
        SumoDriver(world, model, **change)
    assert world.run(replace(SCENARIO, duration=0.1), SAME_IDM)


def test_every_attribute_that_a_model_takes_is_one_that_sumo_takes(world):
    for model, names in MODELS.items():
        driver = SumoDriver(world, model, **dict.fromkeys(names, 1.0))
        with world.open(SCENARIO) as road:
            assert np.isfinite(driver.propose(road.observation).action)
