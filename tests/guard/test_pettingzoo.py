"""Guards beside the agents of a parallel environment of PettingZoo."""

import warnings

import numpy as np
import pytest

pytest.importorskip("pettingzoo")

from evofsm.driving import CarFollowing, Platoon, guard_for_family
from evofsm.guard import RevisedActions, RevisedAgents

with warnings.catch_warnings():  # its tests import what it has deprecated itself
    warnings.simplefilter("ignore", DeprecationWarning)
    from pettingzoo.test import parallel_api_test


def test_under_guards_that_share_what_they_learn_nobody_collides(drive_agents, throttle):
    platoon = Platoon(n_cars=3)
    unrevised = [drive_agents(platoon, throttle, index=k)[-1][4] for k in range(3)]
    assert any(info["failed"] for infos in unrevised for info in infos.values())
    guard = guard_for_family(platoon.family)
    env = RevisedAgents(platoon, guard, failed=lambda info: info["failed"])
    revised = [drive_agents(env, throttle, index=k)[-1][4] for k in range(3)]
    assert not any(info["failed"] for infos in revised for info in infos.values())
    assert guard.machine.n_states > 0
    assert set(env.revisions) == {"car_1", "car_2", "car_3"}


def test_info_says_what_was_executed_and_the_penalty_is_taken_off(drive_agents, throttle):
    def steps(penalty):
        platoon = Platoon(n_cars=2)
        guard = guard_for_family(platoon.family)
        env = RevisedAgents(platoon, guard, failed=lambda info: info["failed"], penalty=penalty)
        return drive_agents(env, throttle, index=0)

    changed = 0
    for free, paid in zip(steps(0.0), steps(2.0), strict=True):
        for agent, info in paid[4].items():
            size = info["reviser/penalty"]
            assert paid[1][agent] == pytest.approx(free[1][agent] - 2.0 * size)
            assert info["reviser/proposed_action"] == [2.5]
            changed += size > 0.0
    assert changed > 0


def test_with_one_agent_it_comes_to_the_same_as_with_gymnasium(drive_agents, throttle):
    platoon, single = Platoon(n_cars=1), CarFollowing()
    one, other = guard_for_family(platoon.family), guard_for_family(platoon.family)
    agents = RevisedAgents(platoon, one, failed=lambda info: info["failed"])
    env = RevisedActions(single, other, failed=lambda info: info["failed"])
    for index in range(2):
        steps = drive_agents(agents, throttle, index=index)
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
