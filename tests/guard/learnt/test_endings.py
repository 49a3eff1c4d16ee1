"""Endings that are no failure end a replay: who may land, lands."""

import gymnasium
import numpy as np
import pytest

from evofsm import Guard
from evofsm.guard import LearntRisk, RevisedActions
from evofsm.guard.learnt.failure import SAYS, are_sides, distances
from evofsm.guard.learnt.rollout import CRASHES, ENDS, FAILS


class Descent(gymnasium.Env):
    """Thrust brings it down, and it lands; faster than 1 that is a failure."""

    observation_space = gymnasium.spaces.Box(-100.0, 100.0, (2,), np.float64)
    action_space = gymnasium.spaces.Box(0.0, 2.0, (1,), np.float64)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.at = self.np_random.uniform((2.0, -0.5), (4.0, 0.0))
        self.sinks, self.steps = self.np_random.uniform(0.4, 1.6), 0
        return self.at, {}

    def step(self, action):
        push = 0.1 * (float(action[0]) - 1.0) + 0.005 * self.np_random.normal()
        self.at, self.steps = self.at + np.array([0.1 * self.at[1], push]), self.steps + 1
        down = bool(self.at[0] <= 0.0)
        return self.at, 0.0, down, self.steps >= 80, {"failed": down and self.at[1] < -1.0}


def flown(guard, seeds):
    """How many failed, and how many landed; the controller sinks at a pace of its own."""
    env, outcomes = Descent(), np.zeros(2, int)
    if guard is not None:
        env = RevisedActions(env, guard, failed=lambda step: step.info["failed"])
    for seed in seeds:
        (seen, _), over = env.reset(seed=seed), False
        while not over:
            wanted = np.clip([1.0 - env.unwrapped.sinks - seen[1]], 0.0, 2.0)
            seen, _, landed, late, info = env.step(wanted)
            over = landed or late
        outcomes += info["failed"], landed and not info["failed"]
    return outcomes.tolist()


@pytest.fixture(scope="module")
def lander():
    judge = LearntRisk(0.1, 0.0, 2.0, names=("height", "speed"))
    guard = Guard(low=0.0, high=2.0, interval=0.1, judge=judge)
    assert flown(guard, range(200, 220))[1] >= 10
    return guard


def test_who_lands_is_let_land_and_what_lands_too_fast_is_not(lander):
    assert "if it ends where speed is below -0.9" in str(lander)
    assert "; ends by itself where height is below 0.0" in str(lander)
    twin = lander.copy()
    twin.freeze()
    (failed, landed), alone = flown(twin, range(900, 920)), flown(None, range(900, 920))
    assert failed == 0 < 4 < alone[0] < 16 <= landed


def walk(judge, place, **how):
    for part in np.linspace(0.0, 1.0, 1 + round(np.abs(place).max() / 0.1)):
        judge.observe(part * np.array(place))
        judge.act(0.0)
    judge.end(None, **{"failed": False} | how)


def said(judge, what):
    """Forms that say so."""
    return judge.state.forms[judge.state.forms[:, SAYS] == what]


def test_where_something_went_on_or_failed_there_is_none():
    judge, ends = LearntRisk(0.1, -1.0, 1.0), np.array([[1.05, -0.4], [1.05, 0.0], [1.05, 0.3]])
    for y in np.linspace(-1.0, 1.0, 9):
        walk(judge, [0.9, y])
    for before, z in enumerate(ends):
        assert (len(said(judge, ENDS)) == 0) == (before < 2)  # two are needed
        walk(judge, z, terminated=True)
    assert (distances(said(judge, ENDS), ends) < 0.0).all()
    walk(judge, [1.05, 0.9], failed=True)  # it fails if it ends so far out
    crashes = distances(said(judge, CRASHES), np.array([*ends, [1.05, 0.9]])).min(0) < 0.0
    assert crashes.tolist() == [False, False, False, True]
    assert not are_sides(said(judge, FAILS)).any()
    walk(judge, [3.0, 0.0])
    assert (distances(said(judge, ENDS), np.array([[1.2, 0.0], [3.0, 0.0]])) > 0.0).all()
