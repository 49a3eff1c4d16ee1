import importlib
from dataclasses import replace
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from tests.guard.test_gym import drive

from evofsm.driving import CarFollowing, load_family
from evofsm.driving.env import ID
from evofsm.driving.scenarios import Behind

NAME = f"evofsm.driving.env:{ID}"
INFO = {"time", "gap", "distance", "failed", "rear_ended", "split", "index"}


# Accelerations are in m/s² here; gymnasium.wrappers.RescaleAction gives the range that is advised.
@pytest.mark.filterwarnings("ignore:.*symmetric and normalized space:UserWarning")
@pytest.mark.parametrize("family", ["emergency", "cut_in"])
def test_gymnasium_finds_nothing_to_complain_of(family):
    env = gymnasium.make(NAME, family=family, collision_cost=5.0)
    assert env.spec.id == ID
    assert env.unwrapped.collision_cost == 5.0
    check_env(env.unwrapped)


def test_an_episode_is_chosen_exactly():
    env = CarFollowing(seed=5)
    env.reset(seed=1, options={"index": 7, "split": "test"})
    assert env.draw == load_family("emergency").draw(5, 7, "test")
    assert env.reset(options={"index": 7})[1]["split"] == "train"


@pytest.mark.parametrize(
    ("arguments", "options", "message"),
    [
        ({}, {"idx": 3}, "no option idx"),
        ({}, {"index": -1}, "-1"),
        ({"world": "mars"}, {}, "mars"),
        ({"collision_cost": np.nan}, {}, "collision_cost"),
    ],
)
def test_what_makes_no_sense_is_refused(arguments, options, message):
    with pytest.raises(ValueError, match=message):
        CarFollowing(**arguments).reset(options=options)


def test_a_step_is_an_interval_and_pays_the_distance():
    env = CarFollowing()
    env.reset(options={"index": 0})
    for k in range(1, 5):
        observation, reward, terminated, truncated, info = env.step([2.0])
        assert info.keys() == INFO | {"realised"}
        assert (terminated, truncated) == (False, False)
        assert info["time"] == pytest.approx(0.25 * k)
        assert observation[1] == pytest.approx(0.5 * k)
        assert reward == info["distance"] == pytest.approx(0.5 * 2.0 * 0.25**2 * (2 * k - 1))


def test_a_collision_terminates_costs_and_is_a_failure_and_the_end_of_time_truncates():
    env = CarFollowing(collision_cost=100.0)
    *before, (observation, reward, terminated, truncated, info) = drive(
        env, lambda *_: [2.5], options={"index": 0}
    )
    assert (terminated, truncated) == (True, False)
    assert (info["failed"], info["rear_ended"]) == (True, False)
    assert reward == info["distance"] - 100.0
    assert observation[0] == info["gap"] <= 0.0
    assert not any(answer[-1]["failed"] for answer in before)
    answers = drive(env, lambda *_: [0.0], options={"index": 0})
    _, reward, terminated, truncated, info = answers[-1]
    assert (terminated, truncated, info["failed"], reward) == (False, True, False, 0.0)
    assert info["time"] == pytest.approx(35.0, abs=0.02)


def test_being_rear_ended_terminates_and_costs_but_is_no_failure():
    family = load_family("emergency")

    def followed_closely(numbers):
        scenario, hasty = family.make(numbers)
        return replace(scenario, behind=Behind(hasty, 5.0)), hasty

    env = CarFollowing(replace(family, make=followed_closely))

    def stops_dead(observation, info):
        return [2.5 if info["time"] < 3.0 else -2.5]

    ends = [drive(env, stops_dead, options={"index": index})[-1] for index in range(8)]
    rear_ended = [end for end in ends if end[-1]["rear_ended"]]
    assert rear_ended
    for _, reward, terminated, truncated, info in rear_ended:
        assert (terminated, truncated, info["failed"]) == (True, False, False)
        assert reward == info["distance"] - env.collision_cost


def test_there_is_no_step_without_an_episode_or_an_action_that_is_a_number():
    env = CarFollowing()
    with pytest.raises(RuntimeError, match="reset"):
        env.step([0.0])
    env.reset()
    for action in ([np.nan], [np.inf], [1.0, 2.0]):
        with pytest.raises(ValueError):  # noqa: PT011
            env.step(action)
    drive(env, lambda *_: [2.5], options={"index": 0})
    with pytest.raises(RuntimeError, match="reset"):
        env.step([0.0])


def test_in_a_platoon_the_example_prevents_collisions(monkeypatch):
    monkeypatch.syspath_prepend(Path(__file__).parents[2] / "examples")
    unguarded, guarded = importlib.import_module("platoon").main(["--episodes", "1"])
    assert (unguarded, guarded) == (1, 0)
