"""A platoon for PettingZoo, and guards beside its cars."""

import warnings
from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("pettingzoo")
pytest.importorskip("gymnasium")

from evofsm.driving import CarFollowing, KinematicWorld, Platoon, load_family
from evofsm.driving.worlds.scenario import Behind

with warnings.catch_warnings():  # its tests import what it has deprecated itself
    warnings.simplefilter("ignore", DeprecationWarning)
    from pettingzoo.test import parallel_api_test


def test_pettingzoo_finds_nothing_to_complain_of():
    parallel_api_test(Platoon(n_cars=3), num_cycles=200)


def test_a_platoon_of_one_is_car_following(drive_agents, throttle):
    platoon, single = Platoon(n_cars=1), CarFollowing()
    steps = drive_agents(platoon, throttle, index=3)
    single.reset(options={"index": 3})
    for observations, rewards, terminations, truncations, infos in steps:
        observation, reward, terminated, truncated, info = single.step([2.5])
        assert observations["car_1"].tolist() == observation.tolist()
        assert rewards["car_1"] == reward
        assert (terminations["car_1"], truncations["car_1"]) == (terminated, truncated)
        assert infos["car_1"] == info


@pytest.mark.parametrize("switches", [(), ("actuator", "jerk")])
def test_cars_behind_the_first_move_as_it_does(switches):
    """Where the car ahead keeps its speed, any car is in the place of the first."""
    family = load_family("emergency").with_switches(switches)
    platoon = Platoon(n_cars=2, family=family)
    platoon.reset(options={"index": 0})
    scenario = family.draw(0, 0, "train").scenario
    commands = [2.0, -1.0, 1.0, -3.0, -3.0, 2.5]
    # The second follows a first that does nothing; alone it is the first behind a free road.
    alone = KinematicWorld().open(replace(scenario, behind=None)).__enter__()
    for command in commands:
        observations, *_ = platoon.step({"car_1": [0.0], "car_2": [command]})
        low, high = family.actions.low, family.actions.high
        alone.advance(min(max(command, low), high), scenario.steps(family.interval))
        assert observations["car_2"][1] == pytest.approx(float(alone.observation[1]))


def test_gaps_are_what_lies_between_the_cars():
    platoon = Platoon(n_cars=3)
    observations, _ = platoon.reset(options={"index": 1})
    gaps = {agent: one[0] for agent, one in observations.items()}
    ways = dict.fromkeys(gaps, 0.0)
    for _ in range(8):
        actions = {"car_1": [1.0], "car_2": [0.5], "car_3": [2.0]}
        observations, _, _, _, infos = platoon.step(actions)
        for agent, info in infos.items():
            ways[agent] += info["distance"]
    for ahead, agent in (("car_1", "car_2"), ("car_2", "car_3")):
        expected = gaps[agent] + ways[ahead] - ways[agent]
        assert observations[agent][0] == pytest.approx(expected)
        assert observations[agent][2] == observations[ahead][1]


def test_a_collision_ends_the_run_and_is_of_whoever_ran_into_the_one_ahead(drive_agents):
    def policy(agent, observation):
        return 2.5 if agent == "car_2" else 0.0

    steps = drive_agents(Platoon(n_cars=3), policy, index=0)
    _, rewards, terminations, truncations, infos = steps[-1]
    assert terminations == {"car_1": False, "car_2": True, "car_3": False}
    assert truncations == {"car_1": True, "car_2": False, "car_3": True}
    assert infos["car_2"]["failed"]
    assert infos["car_1"]["rear_ended"]
    assert not infos["car_1"]["failed"]
    assert rewards["car_2"] < -900.0 < rewards["car_1"]


def test_the_same_seed_drives_the_same_scenarios():
    def indices(env):
        return [env.reset(seed=seed)[1]["car_1"]["index"] for seed in (5, None, None)]

    assert indices(Platoon()) == indices(Platoon())
    assert len(set(indices(Platoon()))) == 3


def test_after_the_end_and_before_the_beginning_there_are_no_agents(drive_agents, throttle):
    platoon = Platoon(n_cars=1)
    assert platoon.step({}) == ({}, {}, {}, {}, {})
    drive_agents(platoon, throttle, index=0)
    assert platoon.step({"car_1": [0.0]}) == ({}, {}, {}, {}, {})
    platoon.close()


def test_what_cannot_be_is_refused():
    with pytest.raises(ValueError, match="n_cars is 0"):
        Platoon(n_cars=0)
    with pytest.raises(ValueError, match="collision_cost"):
        Platoon(collision_cost=-1.0)
    platoon = Platoon(n_cars=2)
    platoon.reset()
    with pytest.raises(ValueError, match="no action of car_2"):
        platoon.step({"car_1": [0.0]})
    with pytest.raises(ValueError, match="action of car_1 is nan"):
        platoon.step({"car_1": [np.nan], "car_2": [0.0]})


def test_the_car_behind_of_a_family_gives_way():
    family = load_family("emergency").with_switches(("third_car",))
    assert isinstance(family.draw(0, 0, "train").scenario.behind, Behind)
    platoon = Platoon(n_cars=1, family=family)
    _, infos = platoon.reset()
    assert not infos["car_1"]["rear_ended"]
