"""A platoon for PettingZoo, and guards beside its cars."""

import warnings
from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("pettingzoo")
pytest.importorskip("gymnasium")

from evofsm.driving import CarFollowing, KinematicWorld, Platoon, guard_for_family, load_family
from evofsm.driving.worlds.scenario import Behind
from evofsm.guard import RevisedAgents

with warnings.catch_warnings():  # its tests import what it has deprecated itself
    warnings.simplefilter("ignore", DeprecationWarning)
    from pettingzoo.test import parallel_api_test


def drive(env, policy, **options):
    """The steps of an episode: what each returned."""
    observations, _ = env.reset(options=options or None)
    steps = []
    while env.agents:
        actions = {agent: [policy(agent, observations[agent])] for agent in env.agents}
        steps.append(env.step(actions))
        observations = steps[-1][0]
    return steps


def throttle(agent, observation):
    return 2.5


def test_pettingzoo_finds_nothing_to_complain_of():
    parallel_api_test(Platoon(n_cars=3), num_cycles=200)


def test_a_platoon_of_one_is_car_following():
    platoon, single = Platoon(n_cars=1), CarFollowing()
    steps = drive(platoon, throttle, index=3)
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


def test_a_collision_ends_the_run_and_is_of_whoever_ran_into_the_one_ahead():
    def policy(agent, observation):
        return 2.5 if agent == "car_2" else 0.0

    steps = drive(Platoon(n_cars=3), policy, index=0)
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


def test_after_the_end_and_before_the_beginning_there_are_no_agents():
    platoon = Platoon(n_cars=1)
    assert platoon.step({}) == ({}, {}, {}, {}, {})
    drive(platoon, throttle, index=0)
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


# -- Guards beside the cars -----------------------------------------------------------------------


def test_under_guards_that_share_what_they_learn_nobody_collides():
    platoon = Platoon(n_cars=3)
    unrevised = [drive(platoon, throttle, index=k)[-1][4] for k in range(3)]
    assert any(info["failed"] for infos in unrevised for info in infos.values())
    guard = guard_for_family(platoon.family)
    env = RevisedAgents(platoon, guard, failed=lambda info: info["failed"])
    revised = [drive(env, throttle, index=k)[-1][4] for k in range(3)]
    assert not any(info["failed"] for infos in revised for info in infos.values())
    assert guard.machine.n_states > 0
    assert set(env.revisions) == {"car_1", "car_2", "car_3"}


def test_info_says_what_was_executed_and_the_penalty_is_taken_off():
    def steps(penalty):
        platoon = Platoon(n_cars=2)
        guard = guard_for_family(platoon.family)
        env = RevisedAgents(platoon, guard, failed=lambda info: info["failed"], penalty=penalty)
        return drive(env, throttle, index=0)

    changed = 0
    for free, paid in zip(steps(0.0), steps(2.0), strict=True):
        for agent, info in paid[4].items():
            size = info["reviser/penalty"]
            assert paid[1][agent] == pytest.approx(free[1][agent] - 2.0 * size)
            assert info["reviser/proposed_action"] == [2.5]
            changed += size > 0.0
    assert changed > 0


def test_with_one_agent_it_comes_to_the_same_as_with_gymnasium():
    pytest.importorskip("gymnasium")
    from evofsm.guard import RevisedActions

    platoon, single = Platoon(n_cars=1), CarFollowing()
    one, other = guard_for_family(platoon.family), guard_for_family(platoon.family)
    agents = RevisedAgents(platoon, one, failed=lambda info: info["failed"])
    env = RevisedActions(single, other, failed=lambda info: info["failed"])
    for index in range(2):
        steps = drive(agents, throttle, index=index)
        env.reset(options={"index": index})
        for observations, *_ in steps:
            observation, *_ = env.step(np.array([2.5]))
            assert observations["car_1"].tolist() == observation.tolist()
    assert one.machine.n_states == other.machine.n_states


def test_an_audit_log_follows_one_episode_at_a_time():
    platoon = Platoon(n_cars=2)
    guard = guard_for_family(platoon.family)
    guard.audit = object()
    with pytest.raises(ValueError, match="one episode at a time"):
        RevisedAgents(platoon, guard)


def test_pettingzoo_finds_nothing_to_complain_of_under_guards():
    platoon = Platoon(n_cars=2)
    env = RevisedAgents(platoon, guard_for_family(platoon.family))
    parallel_api_test(env, num_cycles=60)
