"""Any environment of Gymnasium or PettingZoo runs under a guard, alone or many at once."""

import copy
import importlib
import math
import os
import pickle
import re
import warnings
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from itertools import product
from pathlib import Path
from threading import Thread

import gymnasium
import numpy as np
import pettingzoo
import pytest
from gymnasium import wrappers
from gymnasium.spaces import Box, Dict, Discrete, MultiBinary, MultiDiscrete, Tuple
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv, VectorWrapper
from pettingzoo.utils import aec_to_parallel, parallel_to_aec

from evofsm import Guard, Labels
from evofsm.driving import CarFollowing, guard_for_cars
from evofsm.guard import AuditLog, Fallback, Judgement, LearningJudge, Mode, Search, run_episode
from evofsm.guard.gym import RevisedActions, RevisedVectorActions
from evofsm.guard.pettingzoo import RevisedAgents

pytestmark = pytest.mark.filterwarnings("ignore:nobody says which", "ignore:the guard's actions")
EXAMPLES = Path(__file__).parents[2] / "examples"
KEYS = {
    *("reviser/proposed_action", "reviser/executed_action", "reviser/reason"),
    *("reviser/risk", "reviser/risk_proposed", "reviser/penalty"),
}
FAR, NEAR, HIT = [90.0, 10.0, 10.0], [4.0, 20.0, 10.0], [-0.1, 18.0, 8.0]
MODES = NEXT_STEP, SAME_STEP, DISABLED = list(AutoresetMode)
ONE = Box(-2.5, 2.5, (1,), np.float64)


class Script(gymnasium.Env):
    """Shows one observation after another, whatever is done, and remembers what was."""

    observation_space = Box(-100.0, 1000.0, (3,), np.float64)
    reward = 1.5

    def __init__(self, *seen, action_space=ONE, terminates=True, failed=False):
        self.action_space = action_space
        self.seen = seen
        self.terminates = terminates
        self.failed = failed
        self.executed = []
        self.resets = []

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.resets.append((seed, options))
        self.row = 0
        return self.seen[0], {"of": "reset"}

    def step(self, action):
        self.executed.append(action)
        self.row += 1
        last = self.row + 1 == len(self.seen)
        info = {"of": "step", "failed": last and self.failed}
        return self.seen[self.row], self.reward, last and self.terminates, False, info


class Spy(LearningJudge):
    """A judge of any system: some actions are dangerous, and what it is told it remembers."""

    labels, fallback, dt = Labels(), Fallback(0.0, "nothing"), 0.1

    def __init__(self, dangerous=lambda action: False):
        self.dangerous = dangerous
        self.rows, self.episodes = [], []

    def judge(self, situation, actions):
        risk = np.array([float(self.dangerous(action)) for action in actions])
        return Judgement(risk, risk, risk, risk, 1.0)

    def why(self, judged):
        return "dangerous"

    def learn(self, observation, action, *, watched):
        action = np.atleast_1d(np.float32(action))  # as an environment takes it
        self.rows.append((tuple(observation), tuple(action)))

    def start_episode(self):
        self.rows = []

    def end(self, observation, *, failed, terminated):
        last = None if observation is None else tuple(observation)
        self.episodes.append((self.rows, last, failed))
        self.rows = []


def guard_for(space, judge=None, **others):
    judge = judge or Spy()
    if not isinstance(space, Box):
        n_actions = space.n if isinstance(space, Discrete) else np.prod(getattr(space, "nvec", 4))
        return Guard(n_actions=int(n_actions), interval=0.1, judge=judge, **others)
    low, high = space.low.ravel(), space.high.ravel()
    return Guard(low=low, high=high, interval=0.1, judge=judge, **others)


def of_cars(env):
    return RevisedActions(env, guard_for_cars(-2.5, 2.5), failed=lambda step: step.info["failed"])


def drive(env, policy, **reset):
    observation, info = env.reset(**reset)
    steps, over = [], False
    while not over:
        steps.append(env.step(policy(observation, info)))
        observation, _, terminated, truncated, info = steps[-1]
        over = terminated or truncated
    return steps


def above_half(action):
    return bool(np.max(action) > 0.5)


# -- One environment ---------------------------------------------------------------------------


def test_it_decides_and_learns_bit_for_bit_as_a_loop_does(snapshot):
    env, guard = of_cars(CarFollowing()), guard_for_cars(-2.5, 2.5)
    for index in range(3):
        how = {"options": {"index": index}}
        revised = drive(env, lambda *_: np.array([2.5]), **how)
        loop = run_episode(CarFollowing(), guard, lambda seen: 2.5, **how)
        executed = [one.revision.executed for one in loop]
        assert [step[-1]["reviser/executed_action"][0] for step in revised] == executed
    assert snapshot(env.guard.machine) == snapshot(guard.machine)


def test_a_proposal_that_is_kept_is_passed_on_untouched():
    env = RevisedActions(Script(FAR, FAR), guard_for(ONE))
    env.reset()
    proposed = np.array([1.0], dtype=np.float32)
    info = env.step(proposed)[-1]
    assert env.env.executed[0] is proposed
    proposed[0] = 9.0  # what was said is not changed later
    assert info["reviser/proposed_action"] == info["reviser/executed_action"] == [1.0]


@pytest.mark.filterwarnings("ignore:.*symmetric and normalized space:UserWarning")
@pytest.mark.filterwarnings("ignore:.*different from the unwrapped version:UserWarning")
@pytest.mark.filterwarnings("ignore:.*value is -?infinity:UserWarning")
@pytest.mark.parametrize("name", ["cars", "CartPole-v1", "Blackjack-v1"])
def test_gymnasium_finds_nothing_to_complain_of(name):
    env = of_cars(CarFollowing())
    if name != "cars":  # one that it can make again, under a guard that has judged nothing yet
        env = gymnasium.make(name, disable_env_checker=True)
        env = RevisedActions(env, Guard(n_actions=2, interval=0.02))
    env.guard.learn = name == "CartPole-v1"  # in Blackjack a first step may end, and teach
    check_env(env, skip_render_check=True)


def test_where_nothing_is_ahead_a_usable_proposal_is_kept_and_nothing_is_learnt():
    env = of_cars(Script(None, None, FAR, None, FAR, FAR))
    steps = drive(env, lambda seen, info: np.array([2.5 if seen is None else 9.0]))
    kept = [step[-1]["reviser/reason"].startswith("nothing to judge") for step in steps]
    assert kept == [True, True, False, True, False]
    assert env.env.executed[0] == [2.5]
    assert env.guard.machine.model().uses.sum() == 1  # FAR to FAR: what is not seen is not
    env = of_cars(Script(None, None))
    env.reset()
    assert env.step(np.array([np.nan]))[-1]["reviser/executed_action"] == [-1.0]


def test_a_sensor_that_is_silent_is_named():
    env = RevisedActions(Script(*[[90.0, np.nan, 10.0]] * 150), guard_for(ONE))
    with pytest.warns(UserWarning, match=r"none of 100 observations .* is variable 2. .*sensor"):
        drive(env, lambda seen, info: np.array([0.0]))


def test_a_guard_of_other_actions_or_whose_go_beyond_the_environments_is_refused():
    (two, three), others = (Box(-1.0, 1.0, (n,)) for n in (2, 3)), [(ONE, Discrete(2))]
    others += [(two, three), (MultiDiscrete([2, 2]), Discrete(2)), (MultiBinary(3), Discrete(3))]
    for space, guarded in others:
        with pytest.raises(ValueError, match=r"the environment's .*, but the guard's are"):
            RevisedActions(Script(FAR, action_space=space), guard_for(guarded))
    for space in (Box(-1.0, 2.0, (1,), np.float32), Box(-2.0, 1.0, (1,)), Box(-1.0, 1.0, ())):
        with pytest.raises(ValueError, match=r"from -2\.0 to 2\.0, beyond those of the env"):
            RevisedActions(Script(FAR, action_space=space), Guard(-2.0, 2.0, interval=0.1))
    wide = Box(-0.1, np.inf, (2,), np.float32)  # -0.1 is another number in 32 bits
    RevisedActions(Script(FAR, action_space=wide), Guard([-0.1] * 2, [0.1] * 2, interval=0.1))
    with pytest.raises(ValueError, match="beyond"):
        RevisedActions(Script(FAR, action_space=wide), Guard([-0.1, -0.2], [1.0] * 2, interval=0.1))
    clipped = wrappers.ClipAction(Script(FAR))  # a wrapper's limits count, too
    many = SyncVectorEnv([lambda: clipped])
    for wrap, env in ((RevisedActions, clipped), (RevisedVectorActions, many)):
        wrap(env, Guard(low=-2.5, high=2.5, interval=0.1))
        with pytest.raises(ValueError, match="beyond"):
            wrap(env, Guard(low=-2.5, high=3.0, interval=0.1))


@pytest.mark.parametrize(
    ("space", "proposed", "executed", "size"),
    [
        (Discrete(3, start=-1), 1, 0, 1.0),
        (MultiDiscrete([2, 3]), [0, 2], [0, 1], 1.0),
        (MultiDiscrete([2, 3], start=[1, -1]), [1, 1], [1, 0], 1.0),
        (MultiDiscrete([2, 3]), [0, 3], [0, 0], 1.0),  # no action: the fallback
        (MultiBinary(2), [1, 0], [0, 1], 1.0),
        (Box(-2.0, 2.0, (2, 1), np.float32), [[1.0], [2.0]], [[0.5], [0.5]], 10.0**0.5 / 4.0),
        (Box(-2.0, 2.0, (1,), np.float32), [9.0], [0.5], 0.75),
        (Box(-2.0, 2.0, (1,), np.float32), [math.nan], [0.0], 1.0),
        (Box(-4.0, 4.0, (1,), np.float32), [9.0], [0.5], 1.75),  # beyond the guard's 2, too
        (Box(-2.0, 2.0, (), np.float32), 1.0, 0.5, 0.25),
    ],
)
@pytest.mark.parametrize(
    ("penalty", "paid"), [(0.0, 1.5), (3.0, 1.5), (3.0, np.array([1.5])), (3.0, np.ones(2))]
)
def test_a_change_is_executed_and_can_cost_reward(space, proposed, executed, size, penalty, paid):
    def dangerous(action):
        return (np.asarray(action) > 0.5).any() if isinstance(space, Box) else action == 2

    class Half(Spy):  # finds what is nearest itself
        def search(self, situation, wanted, *, tolerance, mask):
            options = np.array([wanted, 1.0 if np.ndim(wanted) == 0 else np.minimum(wanted, 0.5)])
            best = int(bool(dangerous(wanted)))
            return Search(options, self.judge(situation, options), best, "nearest")

    script = Script(FAR, FAR, FAR, action_space=space)
    script.reward = paid
    within = Box(-2.0, 2.0, space.shape) if isinstance(space, Box) else space
    env = RevisedActions(script, guard_for(within, Half(dangerous)), penalty=penalty)
    env.reset()
    seen, reward, terminated, truncated, info = env.step(np.array(proposed, space.dtype)[()])
    assert (seen, terminated, truncated) == (FAR, False, False)
    assert info.keys() == KEYS | {"of", "failed"}
    said = env.revision.risk_proposed, env.revision.reason
    np.testing.assert_equal((info["reviser/risk_proposed"], info["reviser/reason"]), said)
    assert np.array_equal(info["reviser/proposed_action"], np.array(proposed), equal_nan=True)
    assert info["reviser/executed_action"] in space
    assert np.array_equal(info["reviser/executed_action"], executed)
    assert np.array_equal(script.executed, [executed])
    assert info["reviser/penalty"] == pytest.approx(size)
    assert np.shape(reward) == np.shape(paid)
    assert reward == pytest.approx(paid - penalty * size)


def test_what_does_not_fit_is_named():
    env = RevisedActions(Script(FAR), guard_for(ONE))
    with pytest.raises(ValueError, match=r"the action is array\(\[0.5, 0.2\]\), but .* Box"):
        env.step(np.array([0.5, 0.2]))
    with pytest.raises(AttributeError, match="guard"):  # no second one is taken without a word
        env.guard = guard_for(ONE)
    with pytest.raises(TypeError, match=r"guard is 'a\.evofsm'; it must be a Guard"):
        RevisedActions(Script(FAR), "a.evofsm")
    env.env.observation_space = Dict({"speed": ONE, "gap": ONE})
    with pytest.raises(ValueError, match=r"names are .* taken in order: \('gap', 'speed'\)"):
        RevisedActions(env.env, Guard(-2.5, 2.5, interval=0.1, names=("speed", "gap")))
    env.env.observation_space = Discrete(500)
    with pytest.raises(ValueError, match=r"each of 500 values .* at most 64"):
        RevisedActions(env.env, guard_for(ONE))
    RevisedActions(env.env, guard_for(ONE), lambda place: divmod(place, 20))
    for penalty in (-1.0, math.nan, math.inf):
        with pytest.raises(ValueError, match="penalty"):
            RevisedActions(Script(FAR), guard_for(ONE), penalty=penalty)
    env.env.step = lambda action: (FAR, 0.0, 0.0, False, False, {})  # as Safety-Gymnasium
    with pytest.raises(ValueError, match=r"step returned 6 values, .* a cost belongs in info"):
        env.step(np.array([0.5]))
    for first, what in ((np.zeros(2), "one ndarray"), ((1, 2, True), "3 values")):  # as of old Gym
        env.env.reset = lambda *, first=first, **how: first
        with pytest.raises(ValueError, match=rf"reset returned {what}, not 2 .* old Gym in a"):
            env.reset()
    for name, given in product(("failed", "observe"), ("failed", {"failed": True})):
        with pytest.raises(TypeError, match=f"{name} is .* it must be a function, such as"):
            RevisedActions(Script(FAR), guard_for(ONE), **{name: given})


@pytest.mark.parametrize(
    ("space", "observation", "observe", "seen"),
    [
        (Box(0.0, 9.0, (2, 2)), np.array([[1.0, 2.0], [3.0, 4.0]]), None, (1.0, 2.0, 3.0, 4.0)),
        (Box(0.0, 9.0, ()), np.array(2.0), None, (2.0,)),
        (Discrete(3), 2, None, (0.0, 0.0, 1.0)),
        (Discrete(3, start=5), 5, None, (1.0, 0.0, 0.0)),
        (
            Dict({"a": Box(0.0, 9.0, ()), "b": Tuple([Discrete(2), MultiBinary(2)])}),
            {"a": 3.0, "b": (1, np.array([1, 0])), "action_mask": None},
            None,
            (3.0, 0.0, 1.0, 1.0, 0.0),
        ),
        (Dict({"a": MultiDiscrete([9])}), {"a": [3]}, lambda given: given.pop("a"), (3.0,)),
    ],
)
def test_observations_become_a_vector(space, observation, observe, seen):
    script = Script(observation, observation)
    script.observation_space = space
    guard = guard_for(ONE)
    drive(RevisedActions(script, guard, observe), lambda *_: np.array([0.0]))
    assert guard.judge.episodes == [([(seen, (0.0,))], seen, True)]
    if observe is not None:
        with pytest.raises(ValueError, match="give observe"):
            RevisedActions(script, guard)


@pytest.mark.parametrize(
    ("settings", "own", "terminates", "failed"),
    [
        ({}, None, True, True),  # nobody says otherwise
        ({}, None, False, False),
        ({"failed": "terminated"}, None, True, True),
        ({"failed": "terminated"}, None, False, False),
        ({"failed": "terminated"}, lambda z: z[0] < 0.0, True, True),
        ({}, lambda z: z[0] < 0.0, True, False),  # the guard knows
        ({"failed": lambda step: False}, None, True, False),
        ({"failed": lambda step: step.info["of"] == "step"}, None, False, True),
        ({"failed": lambda step: step.reward == 1.5}, None, False, True),  # without the penalty
        ({"failed": lambda step: step.observation[0] > 0 and step.terminated}, None, True, True),
        ({"failed": lambda step: bool(step.observation.clear())}, lambda z: z[0] < 0, True, False),
        ({"failed": lambda step: np.array([step.truncated])}, None, True, False),
    ],
)
def test_what_is_terminated_has_failed_unless_somebody_says_otherwise(
    settings, own, terminates, failed
):
    guard = guard_for(ONE, failed=own)
    env = RevisedActions(Script(FAR, FAR, terminates=terminates), guard, **settings)
    env.reset()
    env.step(np.array([0.0]))
    env.reset()
    assert [ended[-1] for ended in guard.judge.episodes] == [failed]
    assert guard.machine.endings.sum() == failed


def test_a_failure_that_lasts_is_one_and_what_comes_after_it_another_episode():
    script = Script(*[[height] * 3 for height in (9.0, 1.0, -1.0, -2.0, 1.0, 1.0, -1.0)])
    judge = Spy(above_half)
    env = RevisedActions(script, guard_for(ONE, judge), failed=lambda step: step.observation[0] < 0)
    infos = [step[-1] for step in drive(env, lambda *_: np.array([1.0]))]
    passes = [info["reviser/executed_action"][0] > 0.5 for info in infos]
    assert passes == [info["reviser/reason"].startswith("it failed") for info in infos]
    assert passes == [False, False, True, True, False, False]
    rows = [[row[0] for row, _ in rows] for rows, _, bad in judge.episodes if bad]
    assert rows == [[9.0, 1.0], [1.0, 1.0]]


def test_who_does_not_say_which_episodes_failed_is_told_both_ways_to():
    def warned(guard, **settings):
        with warnings.catch_warnings(record=True, action="always") as caught:
            RevisedActions(Script(FAR), guard, **settings)
        return [str(one.message) for one in caught]

    (said,) = warned(guard_for(ONE))
    assert "failed='terminated'" in said
    assert "failed=lambda step:" in said
    assert not warned(guard_for(ONE), failed="terminated")
    assert not warned(guard_for(ONE, failed=lambda z: z[0] < 0.0))
    frozen = guard_for(ONE)
    frozen.freeze()
    assert not warned(frozen)


@pytest.mark.parametrize(
    ("failed", "error", "said"),
    [
        (lambda info: info["failed"], TypeError, "failed=lambda step: step.info['failed']"),
        (lambda info: info.get("hit"), AttributeError, "failed=lambda step: step.info['failed']"),
        (lambda step: step.info["crashed"], KeyError, "failed=lambda step: step.info['failed']"),
        (lambda step: None, TypeError, "failed returned"),
        (lambda step: "no", TypeError, "failed returned"),
        (lambda step: [True, False], TypeError, "failed returned"),
    ],
)
def test_a_function_that_says_neither_yes_nor_no_of_a_step_is_told_so(failed, error, said):
    env = RevisedActions(Script(FAR, FAR), guard_for(ONE), failed=failed)
    with pytest.raises(error) as found:
        drive(env, lambda *_: np.array([0.0]))
    assert said in "".join([str(found.value), *getattr(found.value, "__notes__", ())])


# -- Whoever wraps, resets, takes turns or forbids ----------------------------------------------


def cart(steps=None):
    return gymnasium.make("CartPole-v1", max_episode_steps=steps)


@pytest.mark.parametrize(
    ("name", "given", "told"),
    [
        ("NormalizeObservation", (), "statistics that change, so that no threshold stays"),
        ("NormalizeReward", (), "rescales the reward, which failed looks at"),
        ("StickyAction", (0.2,), "executes other actions than the guard"),
        ("DelayObservation", (2,), "shows the guard where the system was"),
        ("RepeatAction", (2,), ""),
        ("TimeAwareObservation", (), ""),
        ("FrameStackObservation", (2,), ""),
        ("RecordEpisodeStatistics", (), ""),
    ],
)
@pytest.mark.parametrize("many", [False, True])
def test_a_wrapper_under_which_nothing_can_be_learnt_is_named(name, given, told, many):
    def below():
        return wrappers.TimeLimit(getattr(wrappers, name)(cart(), *given), 9)

    with warnings.catch_warnings(record=True, action="always") as heard:
        guard, how = guard_for(Discrete(2)), {"failed": lambda step: step.reward < 0.0}
        if many:
            RevisedVectorActions(SyncVectorEnv([below] * 2), guard, **how)
        else:
            RevisedActions(below(), guard, **how)
    said = "".join(str(one.message) for one in heard)
    assert said.startswith(f"{name} below the guard") and told in said if told else said == ""
    getattr(wrappers, name)(RevisedActions(cart(), guard, **how), *given)  # as it was advised


def test_a_list_of_infos_is_made_above_the_guard_and_statistics_that_change_no_more_are_none():
    listed = wrappers.vector.DictInfoToList
    many, guard = SyncVectorEnv([cart]), guard_for(Discrete(2))
    with pytest.warns(UserWarning, match=r"DictInfoToList below the guard .*in DictInfoToList"):
        RevisedVectorActions(listed(many), guard)
    listed(RevisedVectorActions(many, guard)).reset()  # as it was advised
    frozen = wrappers.NormalizeObservation(cart())
    frozen.update_running_mean = False
    RevisedActions(frozen, guard_for(Discrete(2)))
    RevisedActions(wrappers.NormalizeReward(cart()), guard_for(Discrete(2)))  # nobody looks at it


def test_an_environment_is_not_put_under_one_guard_twice():
    guard, other = guard_for(Discrete(2)), guard_for(ONE)
    one = wrappers.TimeLimit(RevisedActions(cart(), guard), 9)
    agents, many = RevisedAgents(Crowd(2), other), SyncVectorEnv([lambda: one])
    wraps = (RevisedActions, one, guard), (RevisedVectorActions, many, guard)
    for wrap, env, same in (*wraps, (RevisedAgents, agents, other)):
        with pytest.raises(ValueError, match=r"under this guard already.*make it anew"):
            wrap(env, same)


def test_a_guard_that_is_narrower_than_the_environment_is_told_of_and_in_shadow_changes_nothing():
    env, guard = Script(FAR, FAR), Guard(low=-1.0, high=1.0, interval=0.1, mode=Mode.SHADOW)
    with pytest.warns(UserWarning, match=r"go from -1\.0 to 1\.0, .* put at its edge") as told:
        drive(RevisedActions(env, guard), lambda *_: np.array([-2.0]))
    assert told[0].filename == __file__
    assert env.executed == [[-2.0]]


class Again(gymnasium.Wrapper):
    """Begins the next episode by itself, in the step after one ends, or with a name in that."""

    name = over = None

    def step(self, action):
        if self.over and not self.name:
            self.over = False
            return self.env.reset()[0], 0.0, False, False, {}
        seen, reward, terminated, truncated, info = self.env.step(action)
        self.over = terminated or truncated
        if self.over and self.name:
            info, seen = {self.name: seen, "final_info": info}, self.env.reset()[0]
        return seen, reward, terminated, truncated, info


NAMES = ("final_obs", "final_observation", "terminal_observation")


@pytest.mark.parametrize(
    ("wrap", "name"), [(wrappers.Autoreset, None), *((Again, name) for name in (None, *NAMES))]
)
def test_episodes_that_an_environment_begins_by_itself_are_learnt(monkeypatch, wrap, name):
    monkeypatch.setattr(Again, "name", name)
    monkeypatch.setattr(Recorder, "ended", [])
    env = wrappers.TimeLimit(wrap(Recorder(cart(steps=20))), 999)
    env = RevisedActions(env, guard_for(Discrete(2)))
    env.reset(seed=0)
    env.action_space.seed(0)
    with warnings.catch_warnings(record=True, action="always") as heard:
        for _ in range(90):
            env.step(env.action_space.sample())
    assert len(Recorder.ended) > 3
    assert env.guard.judge.episodes == Recorder.ended
    assert ["reset()" in str(one.message) for one in heard] == [True] * (wrap is Again and not name)


@pytest.mark.parametrize(("name", "fails"), [*product(NAMES, [True]), ("final_obs", False)])
def test_what_is_put_back_at_once_ended_where_it_was_and_begins_an_episode(name, fails):
    class Back(Script):
        def step(self, action):
            seen, *said, info = super().step(action)
            info |= {name: seen} if seen is HIT or not fails else {}
            return FAR if seen is HIT else seen, *said, info

    env = Back(NEAR, HIT, NEAR)
    env = RevisedActions(env, guard_for(ONE), failed=lambda step: fails and step.observation[0] < 0)
    drive(env, lambda *_: np.array([0.0]))
    rows = [([(tuple(seen), (0.0,))], tuple(last)) for seen, last in ((NEAR, HIT), (FAR, NEAR))]
    assert env.guard.judge.episodes == [(*rows[0], fails), (*rows[1], False)]


@pytest.mark.parametrize("way", ["call reset", "observe returned None", "many: observe returned"])
def test_who_is_attached_and_never_decides_says_so(way):
    class Over(Script):
        def step(self, action):
            return FAR, 0.0, "reset" in way, False, {}

    given = guard_for(ONE), None if "reset" in way else lambda seen: None
    if way.startswith("many"):
        env = RevisedVectorActions(SyncVectorEnv([lambda: Over(FAR)] * 2), *given)
    else:
        env = RevisedActions(Over(FAR), *given)
    env.reset()
    why = way.removeprefix("many: ")
    with pytest.warns(UserWarning, match=f"nothing was decided in 200 steps on end: .*{why}"):
        _ = [env.step(env.action_space.sample()) for _ in range(220)]


@pytest.mark.parametrize("in_threads", [False, True])
def test_environments_may_share_a_guard_by_turns_and_in_threads(monkeypatch, in_threads):
    monkeypatch.setattr(Recorder, "ended", [])
    guard = guard_for(Discrete(2))
    envs = [RevisedActions(Recorder(cart(steps=15)), guard) for _ in range(3)]
    for k, env in enumerate(envs):
        env.reset(seed=k)
        env.action_space.seed(k)

    def go_on(env, steps=1):
        for _ in range(steps):
            *_, terminated, truncated, _ = env.step(env.action_space.sample())
            if terminated or truncated:
                env.reset()

    with ThreadPoolExecutor() as pool:
        list(pool.map(go_on, envs, [60] * 3) if in_threads else map(go_on, envs * 60))
    order = sorted if in_threads else list
    assert order(guard.judge.episodes) == order(Recorder.ended)
    assert len(Recorder.ended) > 9


def test_another_guard_waits_for_nobody():
    other = Thread(target=RevisedActions(Script(FAR), guard_for(ONE)).reset, daemon=True)
    env = RevisedActions(Script(FAR), guard_for(ONE), lambda _: other.start() or other.join(9))
    env.reset()
    assert not other.is_alive()


def test_of_an_episode_amid_which_another_environment_begins_the_rest_is_learnt():
    guard = guard_for(ONE)
    one, other = (RevisedActions(Script(*[FAR] * 8, end), guard) for end in (NEAR, HIT))
    one.reset()
    for _ in range(3):
        one.step(np.array([0.0]))
    drive(other, lambda seen, info: np.array([1.0]))
    for _ in range(5):
        one.step(np.array([0.0]))
    told = [(len(rows), rows[0][1], last) for rows, last, _ in guard.judge.episodes]
    assert told == [(8, (1.0,), tuple(HIT)), (5, (0.0,), tuple(NEAR))]


def test_what_a_loop_begins_amid_an_episode_is_not_mixed_with_it():
    env = RevisedActions(Script(*[FAR] * 5), guard_for(ONE))
    env.reset()
    env.step(np.array([0.0]))
    list(run_episode(Script(FAR, NEAR), env.guard, lambda seen: [1.0]))
    with pytest.raises(RuntimeError, match="another began with the same guard"):
        env.step(np.array([0.0]))
    env.reset()  # as it was advised
    env.step(np.array([0.0]))
    assert [len(rows) for rows, *_ in env.guard.judge.episodes] == [1]


def test_two_loops_that_feed_one_guard_by_turns_are_told():
    guard, script = guard_for(ONE), Script(*[FAR] * 8, HIT, failed=True)
    one, other = (run_episode(copy.copy(script), guard, lambda _: [0.0]) for _ in range(2))
    next(one)
    next(other)
    before = guard.situation
    with pytest.raises(RuntimeError, match=r"RevisedVectorActions.*guard of its own"):
        next(one)
    assert guard.situation is before
    assert len(list(other)) == 7
    assert (guard.n_episodes, guard.n_failed) == (1, 1)


def test_what_is_learnt_in_another_process_does_not_come_back():
    guard, here = guard_for(Discrete(2)), os.getpid()
    why = r"a copy \(by deepcopy .*other processes make.*guard.copy\(\).*SyncVectorEnv"

    def make():
        with nullcontext() if os.getpid() == here else pytest.warns(UserWarning, match=why):
            return RevisedActions(cart(), guard)

    AsyncVectorEnv([make]).close()


def test_what_the_copy_learns_that_gymnasium_makes_does_not_come_back(monkeypatch):
    guard, registry = guard_for(Discrete(2)), gymnasium.registry.copy()
    monkeypatch.setattr(gymnasium.envs.registration, "registry", registry)
    gymnasium.register("Kept-v0", lambda kept: RevisedActions(cart(), kept), kwargs={"kept": guard})
    spec = wrappers.TimeLimit(RevisedActions(cart(), guard), 9).spec
    for name in ("Kept-v0", spec):
        with pytest.warns(UserWarning, match=r"a copy \(.*gym.make.*wrap those that gym.make"):
            assert gymnasium.make(name).get_wrapper_attr("guard") is not guard
    with warnings.catch_warnings(action="error"):
        warnings.filterwarnings("ignore", message="nobody says which")
        assert gymnasium.make("Kept-v0", kept=guard).get_wrapper_attr("guard") is guard


class Allowing(Script):
    allowed = (1, 1, 1)

    def action_masks(self):
        return self.allowed


@pytest.mark.parametrize("how", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])
def test_a_copy_of_what_is_wrapped_goes_on_by_itself_and_asks_itself_what_is_allowed(how):
    env = Allowing(*[FAR] * 9, action_space=Discrete(3))
    env = RevisedActions(env, guard_for(env.action_space, Spy(np.isnan)))
    env.reset()
    twin = how(env)
    env.env.allowed = (1, 0, 0)
    for one, executed in ((env, 0), (twin, 2)):
        said = [one.step(2)[-1]["reviser/executed_action"] for _ in range(3)]
        assert said == [2, executed, executed]
    assert twin.guard is not env.guard


def test_a_log_that_follows_one_episode_refuses_a_second_environment(tmp_path):
    with AuditLog(tmp_path / "log") as log:
        guard = Guard(n_actions=2, interval=0.1, audit=log)
        one, other = RevisedActions(cart(), guard), RevisedActions(cart(), guard)
        for env in (one, other):
            env.reset(seed=0)
        one.step(0)
        with pytest.raises(ValueError, match=r"one episode at a time.*reset that"):
            other.step(0)
        one.reset()  # as it was advised
        other.step(0)
        with pytest.raises(ValueError, match="one episode at a time"):
            RevisedVectorActions(SyncVectorEnv([cart]), guard)


class Barred(gymnasium.Env):
    """Drives towards a wall at 1; its brake is barred where it is slow, as it says in some way."""

    action_space = Discrete(3)

    def __init__(self, how="info"):
        self.how, self.observation_space = how, Box(-9.0, 9.0, (2,))
        if how == "observation":
            masks = Box(0, 1, (3,), np.int8)
            self.observation_space = Dict(observation=self.observation_space, action_mask=masks)
        if how == "method":
            self.action_masks = lambda: self.mask

    @property
    def mask(self):
        return np.array([1, 1, self.at[1] > 0.03], np.int8)

    def seen(self):
        seen, told = np.float32(self.at), {"action_mask": self.mask}
        if self.how == "observation":
            seen = {"observation": seen, **told}
        return seen, told if self.how == "info" else {}

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.at = np.zeros(2)
        return self.seen()

    def step(self, action):
        assert self.mask[action]
        pushed = 0.95 * self.at[1] + (0.02, 0.0, -0.03)[action] + self.np_random.normal(0.0, 0.001)
        self.at = self.at[0] + pushed, pushed
        seen, info = self.seen()
        return seen, 0.0, bool(self.at[0] >= 1.0), False, info


@pytest.mark.parametrize("how", ["info", "observation", "method"])
@pytest.mark.parametrize("host", ["one", "many", "loop"])
def test_only_what_the_environment_allows_is_executed(host, how):
    guard = guard_for(Discrete(3), Spy(lambda action: action < 2))  # it would rather brake
    env = wrappers.TimeLimit(Barred(how), 40)
    if host == "one":
        drive(RevisedActions(env, guard), lambda seen, info: 0, seed=0)
    elif host == "many":
        drive_all(RevisedVectorActions(SyncVectorEnv([lambda: env]), guard), 40, wish=0)
    elif how == "observation":
        return  # a loop takes vectors
    else:
        list(run_episode(env, guard, lambda seen: 0, seed=0))
    executed = [action for rows, *_ in guard.judge.episodes for _, (action,) in rows]
    assert {0.0, 2.0} <= set(executed)


def test_a_mask_of_each_component_is_one_of_their_combinations():
    def executed(mask, sizes=(3, 2)):
        env = Script(FAR, FAR, action_space=MultiDiscrete(sizes))
        env.action_masks = lambda: mask
        drive(RevisedActions(env, guard_for(env.action_space)), lambda *_: np.array([0, 0]))
        return env.executed[0].tolist()

    assert executed(np.array([0, 1, 0, 1, 0])) == [1, 0]
    assert executed(([0, 1, 1], [0, 1])) == executed(np.arange(6) == 3) == [1, 1]
    with pytest.raises(ValueError, match=r"MultiDiscrete.*tuple"):
        executed(np.arange(4) == 3, (2, 2))


# -- Many at once ------------------------------------------------------------------------------


class Recorder(gymnasium.Wrapper):
    """Writes down each episode as it ends, as the environment itself knows it."""

    ended = None  # of all recorders of a test

    def reset(self, **how):
        observation, info = self.env.reset(**how)
        self.last, self.rows = observation, []
        return observation, info

    def step(self, action):
        answer = self.env.step(action)
        observation, _, terminated, truncated, info = answer
        self.rows.append((tuple(map(float, self.last)), tuple(np.atleast_1d(action).tolist())))
        self.last = observation
        if terminated or truncated:
            self.ended.append((self.rows, tuple(map(float, observation)), terminated))
        info["length"] = len(self.rows)
        return answer


def recorded(name, count, mode, steps):
    """A vector of environments, and the list of the episodes that ended in it."""
    ended = []

    def make():
        recorder = Recorder(gymnasium.make(name, max_episode_steps=steps))
        recorder.ended = ended
        return recorder

    return SyncVectorEnv([make] * count, autoreset_mode=mode), ended


def drive_all(envs, steps, seed=0, wish=None):
    """Random actions, or one; where nothing resets by itself, what is over is reset."""
    envs.action_space.seed(seed)
    envs.reset(seed=seed)
    said = []
    for _ in range(steps):
        actions = envs.action_space.sample()
        if wish is not None:
            actions[:] = wish
        _, _, terminated, truncated, infos = envs.step(actions)
        over = terminated | truncated
        said.append((over, infos))
        if envs.metadata.get("autoreset_mode") is DISABLED and over.any():
            envs.reset(options={"reset_mask": over})
    return said


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize(("name", "steps"), [("CartPole-v1", 15), ("Pendulum-v1", 7)])
def test_what_each_meets_is_learnt_whole_and_nothing_across_a_reset(name, steps, mode):
    envs, ended = recorded(name, 3, mode, steps)
    guard = guard_for(envs.single_action_space, Spy(above_half))
    revised = RevisedVectorActions(envs, guard)
    drive_all(revised, 43)
    assert len(ended) > 6
    assert guard.judge.episodes == ended
    assert guard.machine.endings.sum() == sum(failed for *_, failed in ended)
    assert guard.machine.model().uses.sum() == sum(len(rows) for rows, *_ in ended)
    before = len(ended)
    revised.reset(seed=9)  # those under way end as they are
    assert len(guard.judge.episodes) == before + 3
    guard.freeze()
    drive_all(revised, 43)
    failures = sum(failed for *_, failed in ended[before:])
    assert f"({failures} of {len(ended) - before} episodes failed since)" in str(guard)
    assert len(guard.judge.episodes) == before + 3


def test_a_step_that_only_resets_is_no_decision_and_costs_nothing():
    envs, _ = recorded("Pendulum-v1", 1, NEXT_STEP, 3)
    guard = guard_for(envs.single_action_space, Spy(above_half))
    revised = RevisedVectorActions(envs, guard, penalty=2.0)
    revised.reset(seed=0)
    for step in range(1, 9):
        _, rewards, _, _, infos = revised.step(np.array([[2.0]], np.float32))
        resets = step in (4, 8)
        assert infos["_reviser/executed_action"].tolist() == [not resets]
        executed = 2.0 if resets else 6.0 / 17.0  # the end of an interval of actions
        assert infos["reviser/executed_action"] == pytest.approx(executed)
        assert infos["reviser/penalty"] == pytest.approx((2.0 - executed) / 2.0)
        assert not resets or rewards == [0.0]


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize(
    "without",
    [
        ("masks", "final_info"),
        ("length", "_length", "final_info", "_final_info"),
        ("final_info", "_final_info", "final_obs", "_final_obs"),
        ("autoreset_mode", "_final_obs"),
    ],
)
def test_what_the_documents_call_optional_may_be_absent(mode, without):
    class Bare(VectorWrapper):
        def step(self, actions):
            *answer, infos = self.env.step(actions)
            kept = {name: value for name, value in infos.items() if name not in without}
            if "masks" in without:
                kept = {name: value for name, value in kept.items() if name[:1] != "_"}
            return *answer, kept | {"of": "all"}

    envs, ended = recorded("CartPole-v1", 3, mode, 12)
    guard, bare = guard_for(envs.single_action_space), Bare(envs)
    if "autoreset_mode" in without and mode is not DISABLED:
        bare.metadata = {}

    def failed(step):
        assert step.info.get("length", 1) >= 1
        return step.terminated and step.reward == 1.0

    drive_all(RevisedVectorActions(bare, guard, failed=failed), 60)
    if mode is SAME_STEP and "final_obs" in without:
        ended = [(rows, None, failed) for rows, _, failed in ended]
    assert guard.judge.episodes == ended


def test_an_episode_is_decided_by_what_was_learnt_before_it_began():
    class Once(Spy):
        def judge(self, situation, actions):
            self.dangerous = lambda action: bool(self.episodes) and action > 0.5
            return super().judge(situation, actions)

    envs, _ = recorded("Pendulum-v1", 2, SAME_STEP, 4)
    revised = RevisedVectorActions(envs, Guard(low=-2.0, high=2.0, interval=0.1, judge=Once()))
    revised.reset(seed=0)
    full = np.full((2, 1), 2.0, np.float32)
    executed = [revised.step(full)[-1]["reviser/executed_action"].ravel() for _ in range(8)]
    assert (np.array(executed[:4]) == 2.0).all()
    assert (np.array(executed[4:]) <= 0.5).all()


# -- PettingZoo --------------------------------------------------------------------------------


class Crowd(pettingzoo.ParallelEnv):
    """A parallel environment of scripts of different lengths, an agent each."""

    metadata = {"name": "crowd", "is_parallelizable": True}  # noqa: RUF012
    render_mode = None

    def __init__(self, *lengths):
        self.scripts = {
            f"a{k}": Script(*[FAR] * (length - 1), NEAR) for k, length in enumerate(lengths)
        }
        self.possible_agents = list(self.scripts)

    def observation_space(self, agent):
        return Script.observation_space

    def action_space(self, agent):
        return ONE

    def reset(self, seed=None, options=None):
        self.agents = list(self.scripts)
        each = {one: script.reset(seed=seed) for one, script in self.scripts.items()}
        return tuple({one: np.array(got[k]) for one, got in each.items()} for k in range(2))

    def step(self, actions):
        each = {one: self.scripts[one].step(action) for one, action in actions.items()}
        said = tuple({one: got[k] for one, got in each.items()} for k in range(5))
        self.agents = [one for one in self.agents if not said[2][one]]
        return ({one: np.array(seen) for one, seen in said[0].items()}, *said[1:])


def drive_agents(env, wanted):
    env.reset()
    steps = []
    while env.agents:
        steps.append(env.step({agent: np.array([wanted]) for agent in env.agents}))
    return steps


@pytest.mark.parametrize("named", [2, 1, 0])  # agents that the environment knows beforehand
def test_the_guard_learns_each_agents_episode_whole_and_info_says_what_was_done(named):
    guard, agents = guard_for(ONE, Spy(above_half)), Crowd(2, 4)
    del agents.possible_agents[named:]
    if not named:
        del agents.possible_agents
    env = RevisedAgents(agents, guard, penalty=2.0)
    first, *_, last = drive_agents(env, 2.5)
    size = first[4]["a0"]["reviser/penalty"]
    assert size > 0.5
    assert first[1] == {"a0": 1.5 - 2.0 * size, "a1": 1.5 - 2.0 * size}
    assert first[4]["a1"].keys() == KEYS | {"of", "failed"}
    assert first[4]["a0"]["reviser/executed_action"] == env.env.scripts["a0"].executed[0] <= [0.5]
    assert [len(rows) for rows, *_ in guard.judge.episodes] == [1, 3]
    assert [(end, failed) for _, end, failed in guard.judge.episodes] == [(tuple(NEAR), True)] * 2
    assert last[4].keys() == {"a1"}
    assert env.revisions.keys() == {"a0", "a1"}
    env.reset()
    env.step({agent: np.array([0.0]) for agent in env.agents})
    env.reset()  # what is under way ends without failure
    assert [failed for *_, failed in guard.judge.episodes] == [True, True, True, False]


@pytest.mark.parametrize("silent", ["infos", "rewards", "observations", "all"])
def test_what_an_agent_is_not_told_is_optional(silent):
    class Silent(Crowd):
        def step(self, actions):
            names = "observations", "rewards", "terminated", "truncated", "infos"
            said = dict(zip(names, super().step(actions), strict=True))
            said["truncated"] = {}
            for name, each in said.items():
                if silent in (name, "all"):
                    said[name] = {one: value for one, value in each.items() if one in self.agents}
            return tuple(said.values())

    guard = guard_for(ONE)
    steps = []
    env = RevisedAgents(Silent(2, 4), guard, failed=lambda step: steps.append(step) or False)
    drive_agents(env, 0.0)
    last = None if silent in ("observations", "all") else tuple(NEAR)
    assert [(len(rows), end) for rows, end, _ in guard.judge.episodes] == [(1, last), (3, last)]
    assert sum(step.terminated for step in steps) == (0 if silent == "all" else 2)
    assert sum(math.isnan(step.reward) for step in steps) == 2 * (silent in ("rewards", "all"))


def test_an_environment_may_tell_no_reward_and_no_info(monkeypatch):
    def bare(call):
        return lambda self, *given, **how: (*call(self, *given, **how)[:-1], None)

    for name in ("reset", "step"):
        monkeypatch.setattr(Script, name, bare(getattr(Script, name)))
    monkeypatch.setattr(Script, "reward", None)
    guard, script, push = guard_for(ONE, Spy(above_half)), Script(FAR, FAR, NEAR), np.array([2.5])
    rewards = [one.reward for one in run_episode(script, guard, lambda seen: push)]
    env = RevisedActions(script, guard, penalty=1.0)
    rewards += [step[1] for step in drive(env, lambda seen, info: push)]
    env = RevisedAgents(Crowd(3), guard, penalty=1.0)
    rewards += [step[1]["a0"] for step in drive_agents(env, 2.5)]
    assert np.isnan(np.array(rewards, float)).tolist() == [True] * 6
    told = [(len(rows), end, failed) for rows, end, failed in guard.judge.episodes]
    assert told == [(2, tuple(NEAR), True)] * 3


def test_whom_anothers_failure_ends_did_not_end_by_itself():
    class Together(Crowd):
        def step(self, actions):
            seen, rewards, over, *others = super().step(actions)
            if any(over.values()):
                self.agents, over = [], dict.fromkeys(over, True)
            return seen, rewards, over, *others

    spy, ended = Spy(), []
    spy.end = lambda z, *, failed, terminated: ended.append((failed, terminated))
    near = {"failed": lambda step: step.observation[0] < 5.0}
    drive_agents(RevisedAgents(Together(2, 4), guard_for(ONE, spy), **near), 0.0)
    assert ended == [(True, False), (False, False)]


@pytest.mark.parametrize("name", ["black_death_par", "DelayObsModifier", "StickyActionsModifier"])
def test_what_hides_agents_from_the_guard_is_named(name):
    kind = type(name, (pettingzoo.utils.BaseParallelWrapper,), {})
    env = kind(Crowd(2))
    if name.endswith("Modifier"):  # as SuperSuit keeps them
        env = pettingzoo.utils.BaseParallelWrapper(Crowd(2))
        env.modifier_class = kind
    else:  # of one's own
        env.modifier_class, env.modifier = "fast", 0.5
    with pytest.warns(UserWarning, match=f"{name} below the guard .*that in {name}") as told:
        RevisedAgents(pettingzoo.utils.BaseParallelWrapper(env), guard_for(ONE), failed=bool)
    assert len(told) == 1


def test_what_an_agent_meets_after_a_step_without_an_action_is_no_consequence():
    class Turns(Crowd):
        def step(self, actions):
            return super().step({one: actions.get(one, [0.0]) for one in self.agents})

    guard = guard_for(ONE)
    env = RevisedAgents(Turns(6, 6), guard)
    env.reset()
    for acting in (["a0", "a1"], ["a0"], ["a0", "a1"], ["a0", "a1"], ["a0", "a1"]):
        env.step({agent: np.array([0.0]) for agent in acting})
    told = [(len(rows), failed) for rows, _, failed in guard.judge.episodes]
    assert told == [(1, False), (5, True), (3, True)]


def test_agents_that_observe_differently_or_take_turns_are_told_what_to_do():
    turns, sizes = parallel_to_aec(Crowd(4)), iter((1, 2))
    unlike = RevisedAgents(Crowd(2, 4), guard_for(ONE), observe=lambda z: z[: next(sizes)])
    with pytest.raises(ValueError, match=r"different numbers of variables, \{'a0': 1, 'a1': 2\}"):
        unlike.reset()
    for wrap in (RevisedAgents, RevisedActions):
        with pytest.raises(TypeError, match=r"PettingZoo, as parallel_env\(\).*aec_to_parallel"):
            wrap(turns, guard_for(ONE))
    guard = guard_for(ONE)  # as it was advised, and around again
    turns = parallel_to_aec(RevisedAgents(aec_to_parallel(turns), guard))
    turns.reset()
    for _ in turns.agent_iter(9):
        turns.step(None if turns.last()[2] else np.array([0.0]))
    assert [len(rows) for rows, *_ in guard.judge.episodes] == [3]


@pytest.mark.filterwarnings("ignore::DeprecationWarning:pettingzoo")  # of what it has itself
def test_pettingzoo_finds_nothing_to_complain_of():
    from pettingzoo.test import parallel_api_test

    parallel_api_test(RevisedAgents(Crowd(9, 30), guard_for(ONE)), num_cycles=60)


# -- Extras and examples -----------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_stable_baselines3_trains_in_several_environments_under_one_guard(capsys):
    pytest.importorskip("stable_baselines3")
    page = (EXAMPLES.parent / "docs" / "how-to" / "train-with-stable-baselines3.md").read_text()
    code = re.search(r"```python\n(.*?)```", page, re.DOTALL)[1]
    exec(code, {})
    failed, episodes = map(
        int, re.match(r"(\d+) of (\d+) episodes", capsys.readouterr().out).groups()
    )
    assert failed < 0.6 * episodes


@pytest.mark.slow
@pytest.mark.parametrize(
    "words", ["car_following --episodes 8 --train 4", "highway --episodes 3 --train 1"]
)
def test_in_the_examples_collisions_fall(monkeypatch, capsys, words):
    monkeypatch.syspath_prepend(EXAMPLES)
    example, *arguments = words.split()
    unrevised, revised = importlib.import_module(example).main(arguments)
    assert unrevised.collisions >= len(unrevised.speeds) - 1
    assert revised.collisions == 0
    assert 0.5 < revised.kept(unrevised) < 1.0
    assert f"0 of {len(revised.speeds)} episodes" in capsys.readouterr().out
