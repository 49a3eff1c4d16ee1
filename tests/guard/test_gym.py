import importlib
import math
from pathlib import Path

import numpy as np
import pytest

gymnasium = pytest.importorskip("gymnasium")

from gymnasium.spaces import Box, Dict, Discrete, MultiBinary, MultiDiscrete  # noqa: E402
from gymnasium.utils.env_checker import check_env  # noqa: E402

from evofsm.driving.cars import guard_for_cars  # noqa: E402
from evofsm.driving.families.family import load_family  # noqa: E402
from evofsm.driving.framework import Framework  # noqa: E402
from evofsm.driving.revisers import Unrevised  # noqa: E402
from evofsm.driving.risk.latent import LatentRisk  # noqa: E402
from evofsm.driving.worlds.gym import CarFollowing  # noqa: E402
from evofsm.driving.worlds.kinematic import KinematicWorld  # noqa: E402
from evofsm.fsm.actions import IntervalActions  # noqa: E402
from evofsm.fsm.machine import EvolvingFSM  # noqa: E402
from evofsm.fsm.naming import Labels  # noqa: E402
from evofsm.guard.auditing.log import AuditLog  # noqa: E402
from evofsm.guard.guard import Guard  # noqa: E402
from evofsm.guard.gym import RevisedActions, RevisedVectorActions  # noqa: E402
from evofsm.guard.protocols import Fallback, Judgement, Proposal, Search  # noqa: E402
from evofsm.guard.reviser import ActionReviser, Mode  # noqa: E402

FAMILY = load_family("emergency")
ACTIONS = FAMILY.actions
EXAMPLES = Path(__file__).parents[2] / "examples"
KEYS = {
    *("reviser/proposed_action", "reviser/executed_action", "reviser/reason"),
    *("reviser/risk", "reviser/risk_proposed", "reviser/penalty"),
}
FAR, NEAR, HIT = [90.0, 10.0, 10.0], [4.0, 20.0, 10.0], [-0.1, 18.0, 8.0]


class Script(gymnasium.Env):
    """Shows one observation after another, whatever is done, and remembers what was."""

    observation_space = Box(-100.0, 1000.0, (3,), np.float64)

    def __init__(self, *seen, action_space=None, terminates=True, failed=False):
        self.action_space = action_space or Box(-2.5, 2.5, (1,), np.float64)
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
        return self.seen[self.row], 1.5, last and self.terminates, False, info


def make_reviser():
    return ActionReviser(LatentRisk(ACTIONS.low, FAMILY.interval), ACTIONS)


def revise(env, reviser=None, *, machine=None, learn=True, **options):
    guard = Guard.of(
        reviser or make_reviser(), machine=machine, learn=learn, interval=FAMILY.interval
    )
    return RevisedActions(env, guard, failed=lambda info: info["failed"], **options)


def own_driver(env):
    car = env.unwrapped
    return lambda observation, info: np.array(
        [car.draw.controller.propose(observation, info["time"]).action]
    )


def drive(env, policy, **reset):
    observation, info = env.reset(**reset)
    infos, over = [], False
    while not over:
        observation, _, terminated, truncated, info = env.step(policy(observation, info))
        infos.append(info)
        over = terminated or truncated
    return infos


def full_throttle(observation, info):
    return np.array([2.5])


# -- It decides as the framework does ----------------------------------------------------------


@pytest.mark.parametrize("learn", [True, False])
def test_it_decides_and_learns_bit_for_bit_as_the_framework(learn, snapshot):
    wrapped_machine, machine = (EvolvingFSM(ACTIONS.n_actions, radius=3.0) for _ in range(2))
    reviser = make_reviser()
    env = revise(CarFollowing(FAMILY), machine=wrapped_machine)
    guard = Guard.of(reviser, machine=machine, interval=FAMILY.interval)
    framework = Framework(None, guard)
    for index in range(4):
        env.guard.learn = guard.learn = learn or index < 2
        infos = drive(env, own_driver(env), options={"index": index})
        scenario, framework.controller, _ = FAMILY.draw(0, index)
        driven = framework.drive(KinematicWorld(), scenario)
        executed = [info["reviser/executed_action"][0] for info in infos]
        assert executed == driven.executed.tolist()
        assert [info["reviser/proposed_action"][0] for info in infos] == driven.proposed.tolist()
        assert [i["reviser/reason"] for i in infos] == [d.revision.reason for d in driven.decisions]
        assert infos[-1]["failed"] == driven.episode.collided
    assert snapshot(wrapped_machine) == snapshot(machine)
    assert env.guard.judge.manoeuvres.decels == reviser.risk.manoeuvres.decels


def test_who_would_collide_does_not():
    unrevised = CarFollowing(FAMILY)
    assert drive(unrevised, full_throttle, seed=1)[-1]["failed"]
    assert not drive(revise(unrevised), full_throttle, seed=1)[-1]["failed"]


# -- What it changes, and what it forwards -----------------------------------------------------


def test_a_dangerous_proposal_is_replaced_and_info_says_so():
    env = revise(Script(NEAR, NEAR))
    env.reset()
    proposed = np.array([1.0])
    observation, reward, terminated, truncated, info = env.step(proposed)
    assert env.env.executed == [info["reviser/executed_action"]] == [np.array([-2.5])]
    assert info["reviser/proposed_action"] == proposed
    assert info["reviser/risk_proposed"] == 1.0
    assert "own brakes not known yet" in info["reviser/reason"]
    assert info.keys() == KEYS | {"of", "failed"}
    assert (observation, reward, terminated, truncated) == (NEAR, 1.5, True, False)
    assert env.revision.executed == -2.5


def test_a_proposal_that_is_kept_is_passed_on_as_it_is():
    env = revise(Script(FAR, FAR), Unrevised(ACTIONS))
    env.reset()
    proposed = np.array([1.0], dtype=np.float32)
    info = env.step(proposed)[-1]
    assert env.env.executed[0] is proposed
    assert info["reviser/proposed_action"] == info["reviser/executed_action"] == proposed
    proposed[0] = 9.0  # what was told is not changed later
    assert info["reviser/proposed_action"] == [1.0]
    assert math.isnan(info["reviser/risk"])


def test_in_the_shadow_it_only_looks_on():
    reviser = ActionReviser(LatentRisk(-2.5), ACTIONS, mode=Mode.SHADOW)
    env = revise(Script(NEAR, NEAR), reviser)
    env.reset()
    info = env.step(np.array([1.0]))[-1]
    assert info["reviser/executed_action"] == [1.0]
    assert env.revision.advised == -2.5


def test_all_else_is_forwarded():
    inner = gymnasium.make("evofsm.driving.worlds.gym:evofsm/CarFollowing-v0", render_mode="ansi")
    env = revise(inner)
    assert env.spec.id == inner.spec.id
    assert env.unwrapped is inner.unwrapped
    assert env.action_space is inner.action_space
    assert env.observation_space is inner.observation_space
    assert env.metadata == inner.metadata
    assert env.render_mode == "ansi"
    observation, info = env.reset(seed=3, options={"index": 4, "split": "test"})
    assert (info["index"], info["split"]) == (4, "test")
    assert np.array_equal(observation, inner.reset(options={"index": 4, "split": "test"})[0])
    assert env.np_random is inner.np_random
    assert env.render() == inner.render()
    env.close()


@pytest.mark.filterwarnings("ignore:.*symmetric and normalized space:UserWarning")
@pytest.mark.filterwarnings("ignore:.*different from the unwrapped version:UserWarning")
def test_gymnasium_finds_nothing_to_complain_of():
    check_env(revise(CarFollowing(FAMILY), learn=False), skip_render_check=True)


def test_it_drives_in_a_vector_of_environments():
    cars = gymnasium.vector.SyncVectorEnv([lambda: revise(CarFollowing(FAMILY))] * 2)
    cars.reset(seed=1)
    *_, info = cars.step(np.full((2, 1), 2.5))
    assert info["reviser/executed_action"].shape == (2, 1)
    cars.close()


@pytest.mark.parametrize(("action", "executed"), [(np.nan, -1.0), (np.inf, -1.0), (99.0, 2.5)])
def test_an_action_that_cannot_be_executed_is_made_one_that_can(action, executed):
    env = revise(Script(FAR, FAR), Unrevised(ACTIONS))
    env.reset()
    info = env.step(np.array([action]))[-1]
    assert info["reviser/executed_action"] == [executed]


def test_a_policy_that_answers_nan_does_not_stop_the_car():
    env = revise(CarFollowing(FAMILY), machine=EvolvingFSM(ACTIONS.n_actions))
    infos = drive(env, lambda *_: np.array([np.nan]), seed=1)
    assert not infos[-1]["failed"]
    assert "braking gently" in infos[0]["reviser/reason"]


# -- Learning ----------------------------------------------------------------------------------


def test_frozen_it_learns_nothing(snapshot):
    env = revise(CarFollowing(FAMILY), machine=EvolvingFSM(ACTIONS.n_actions, radius=3.0))
    for index in range(2):
        drive(env, own_driver(env), options={"index": index})
    env.guard.learn = False
    machine, risk = snapshot(env.guard.machine), repr(env.guard.judge._learnt())
    drive(env, own_driver(env), options={"index": 2})
    assert (snapshot(env.guard.machine), repr(env.guard.judge._learnt())) == (machine, risk)
    env.guard.learn = True
    drive(env, own_driver(env), options={"index": 2})
    assert snapshot(env.guard.machine) != machine
    assert repr(env.guard.judge._learnt()) != risk


def test_a_failure_is_reported_to_the_machine_and_the_end_of_time_is_none():
    for failed in (True, False):
        env = revise(
            Script(FAR, NEAR, HIT, failed=failed), Unrevised(ACTIONS), machine=EvolvingFSM(17)
        )
        drive(env, full_throttle)
        assert env.guard.machine.endings.sum() == failed
        assert env.guard.machine.failures.sum(axis=1).argmax() == failed * (ACTIONS.n_actions - 1)
        assert env.guard.machine.model().uses.sum() == 2  # the last transition is learnt as well


def test_a_failure_that_is_not_seen_is_reported_as_well():
    env = revise(Script(FAR, NEAR, None, failed=True), machine=EvolvingFSM(17))
    drive(env, full_throttle)
    assert env.guard.machine.endings.sum() == 1


def test_a_failure_ends_the_episode_where_the_environment_goes_on():
    env = revise(Script(FAR, HIT, failed=True, terminates=False), machine=EvolvingFSM(17))
    env.reset()
    env.step(np.array([0.0]))
    assert env.guard.machine.endings.sum() == 1
    assert env.guard.machine.state is None  # the next observation is no consequence


def test_a_reset_in_mid_episode_ends_it_without_failure():
    env = revise(Script(FAR, NEAR, NEAR), Unrevised(ACTIONS), machine=EvolvingFSM(17))
    env.reset(seed=1)
    env.step(np.array([0.0]))
    env.reset(seed=2, options={"a": "b"})
    env.step(np.array([0.0]))
    assert env.env.resets == [(1, None), (2, {"a": "b"})]
    assert env.guard.machine.model().uses.sum() == 1  # FAR to NEAR, and not NEAR to FAR
    assert env.guard.machine.endings.sum() == 0


def test_where_nothing_is_ahead_the_proposal_is_kept_and_nothing_is_learnt():
    env = revise(Script(None, None, FAR, None, FAR, FAR), machine=EvolvingFSM(17))
    infos = drive(env, full_throttle)
    kept = [info["reviser/reason"].startswith("nothing is ahead") for info in infos]
    assert kept == [True, True, False, True, False]
    assert env.env.executed[0] == [2.5]
    assert env.guard.machine.model().uses.sum() == 1  # FAR to FAR: the unseen is not


def test_nan_is_not_executed_where_nothing_is_ahead_either():
    env = revise(Script(None, None))
    env.reset()
    assert env.step(np.array([np.nan]))[-1]["reviser/executed_action"] == [-1.0]


# -- Other environments' actions ---------------------------------------------------------------


def test_actions_in_other_units_are_converted():
    env = revise(
        Script(NEAR, NEAR, action_space=Box(-1.0, 1.0, (1,), np.float32)),
        to_acceleration=lambda action: 5.0 * float(action[0]),
        to_action=lambda acceleration: np.array([acceleration / 5.0], dtype=np.float32),
    )
    env.reset()
    info = env.step(np.array([0.1], dtype=np.float32))[-1]
    assert env.revision.proposed == pytest.approx(0.5)
    assert info["reviser/executed_action"] == [-0.5]
    assert info["reviser/executed_action"] in env.action_space


@pytest.mark.parametrize("shape", [(), (1,)])
def test_one_number_is_taken_for_an_acceleration_and_stays_in_the_space(shape):
    env = revise(Script(NEAR, NEAR, action_space=Box(-2.0, 2.0, shape, np.float32)))
    env.reset()
    info = env.step(np.full(shape, 1.0, np.float32))[-1]
    assert info["reviser/executed_action"] in env.action_space
    assert info["reviser/executed_action"] == -2.0


@pytest.mark.parametrize("space", [Box(-1.0, 1.0, (2,)), MultiBinary(2)])
def test_actions_that_are_not_one_number_need_a_conversion(space):
    with pytest.raises(ValueError, match="give to_acceleration and to_action"):
        revise(Script(FAR, action_space=space))


def test_one_conversion_is_not_enough():
    with pytest.raises(ValueError, match="both"):
        revise(Script(FAR), to_acceleration=float)


def test_a_machine_for_other_actions_is_refused():
    with pytest.raises(ValueError, match="5 actions"):
        revise(Script(FAR), machine=EvolvingFSM(5))


@pytest.mark.parametrize("seen", [[1.0, 2.0], [np.inf, 2.0, 3.0], [[1.0, 2.0, 3.0]]])
def test_an_observation_that_is_not_ours_is_refused(seen):
    with pytest.raises(ValueError, match="v_leader"):
        revise(Script(seen)).reset()


def test_the_set_of_actions_may_be_coarser_than_the_environments():
    actions = IntervalActions(-2.0, 2.0, 1.0, outside="clip")
    env = revise(Script(NEAR, NEAR), ActionReviser(LatentRisk(-2.0), actions))
    env.reset()
    assert env.step(np.array([2.5]))[-1]["reviser/executed_action"] == [-2.0]


# -- Any other environment ---------------------------------------------------------------------


class Spy:
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

    def trial(self):
        return None

    def effective(self, situation, actions):
        return actions

    def refuse_unfit(self, low, high):
        pass

    def learn(self, observation, action, belief):
        action = np.atleast_1d(np.float32(action))  # as an environment takes it
        self.rows.append((tuple(observation), tuple(action)))

    watch = learn

    def follow(self, observation, action):
        pass

    def start_episode(self, *, learn=True):
        self.rows = []

    def end(self, observation, *, failed):
        self.episodes.append(
            (self.rows, None if observation is None else tuple(observation), failed)
        )
        self.rows = []

    def sums(self, n_states):
        return {}

    def save(self, path, provenance=None):
        pass

    @classmethod
    def load(cls, path):
        return cls()


def guard_for(space, judge, **others):
    if isinstance(space, Discrete):
        return Guard(n_actions=int(space.n), interval=0.1, judge=judge, **others)
    return Guard(
        low=space.low.ravel(), high=space.high.ravel(), interval=0.1, judge=judge, **others
    )


@pytest.mark.parametrize(
    "space",
    [
        Box(-2.0, 2.0, (1,), np.float32),
        Box(np.array([-1.0, 0.0]), np.array([1.0, 4.0]), dtype=np.float64),
        Box(-1.0, 1.0, (2, 3), np.float32),
        Discrete(3),
        Discrete(3, start=-1),
    ],
)
def test_actions_of_a_box_and_discrete_ones_need_nothing(space):
    env = RevisedActions(Script(FAR, FAR, FAR, action_space=space), guard_for(space, Spy()))
    env.reset()
    space.seed(1)
    for _ in range(2):
        action = space.sample()
        *_, info = env.step(action)
        assert info["reviser/executed_action"] is not None
        assert np.array_equal(env.env.executed[-1], action)
        assert info["reviser/penalty"] == 0.0
    assert len(env.guard.judge.episodes[0][0]) == 2


@pytest.mark.parametrize(
    ("space", "proposed", "executed", "size"),
    [
        (Discrete(3, start=-1), 1, 0, 1.0),
        (Box(-2.0, 2.0, (1,), np.float32), [1.0], [0.5], 0.25),
        (Box(-2.0, 2.0, (2, 1), np.float32), [[1.0], [2.0]], [[0.5], [0.5]], 10.0**0.5 / 4.0),
        (Box(-2.0, 2.0, (1,), np.float32), [9.0], [0.5], 0.75),
        (Box(-2.0, 2.0, (1,), np.float32), [math.nan], [0.0], 1.0),
    ],
)
def test_a_change_is_executed_and_can_be_taken_off_the_reward(space, proposed, executed, size):
    def dangerous(action):
        return action == 2 if isinstance(space, Discrete) else (np.asarray(action) > 0.5).any()

    class Half(Spy):  # finds what is nearest itself
        def search(self, situation, wanted, *, tolerance, revising):
            options = np.array([wanted, 1.0 if np.ndim(wanted) == 0 else np.minimum(wanted, 0.5)])
            best = int(bool(dangerous(wanted)))
            return Search(options, self.judge(situation, options), best, "nearest")

    for penalty in (0.0, 3.0):
        env = RevisedActions(
            Script(FAR, FAR, FAR, action_space=space),
            guard_for(space, Half(dangerous)),
            penalty=penalty,
        )
        env.reset()
        action = np.int64(proposed) if isinstance(space, Discrete) else np.array(proposed, "f4")
        _, reward, _, _, info = env.step(action)
        assert info["reviser/executed_action"] in space
        assert np.array_equal(info["reviser/executed_action"], executed)
        assert info["reviser/penalty"] == pytest.approx(size)
        assert reward == pytest.approx(1.5 - penalty * size)


@pytest.mark.parametrize(
    ("space", "guarded"),
    [
        (MultiDiscrete([2, 2]), Discrete(4)),
        (Discrete(3), Discrete(2)),
        (Discrete(3), Box(0.0, 2.0, (1,))),
        (Box(-1.0, 1.0, (2,)), Box(-1.0, 1.0, (3,))),
        (Box(-1.0, 1.0, (1,)), Discrete(2)),
    ],
)
def test_actions_that_are_not_the_guards_need_a_conversion(space, guarded):
    env = Script(FAR, action_space=space)
    with pytest.raises(ValueError, match=r"the environment's actions are .*, but the guard's are"):
        RevisedActions(env, guard_for(guarded, Spy()))


@pytest.mark.parametrize("penalty", [-1.0, math.nan, math.inf])
def test_a_penalty_is_no_reward(penalty):
    with pytest.raises(ValueError, match="penalty"):
        revise(Script(FAR), penalty=penalty)


@pytest.mark.parametrize(
    ("space", "observation", "seen"),
    [
        (Box(0.0, 9.0, (2, 2)), np.array([[1.0, 2.0], [3.0, 4.0]]), (1.0, 2.0, 3.0, 4.0)),
        (Box(0.0, 9.0, ()), np.array(2.0), (2.0,)),
        (Box(0, 9, (2,), np.uint8), np.array([1, 2], np.uint8), (1.0, 2.0)),
        (Discrete(3), 2, (0.0, 0.0, 1.0)),
        (Discrete(3, start=5), 5, (1.0, 0.0, 0.0)),
    ],
)
def test_observations_become_a_vector(space, observation, seen):
    script = Script(observation, observation)
    script.observation_space = space
    env = RevisedActions(script, guard_for(script.action_space, Spy()))
    env.reset()
    env.step(np.array([0.0]))
    assert env.guard.judge.episodes == [([(seen, (0.0,))], seen, True)]


def test_observations_of_other_kinds_need_a_function():
    script = Script({"a": 3.0}, {"a": 4.0})
    script.observation_space = Dict({"a": Box(0.0, 9.0, ())})
    guard = guard_for(script.action_space, Spy())
    with pytest.raises(ValueError, match="give observe"):
        RevisedActions(script, guard)
    env = RevisedActions(script, guard, lambda observation: [observation["a"]])
    env.reset()
    env.step(np.array([0.0]))
    assert guard.judge.episodes == [([((3.0,), (0.0,))], (4.0,), True)]


@pytest.mark.parametrize(
    ("settings", "own", "terminates", "failed"),
    [
        ({}, None, True, True),  # nobody says otherwise
        ({}, None, False, False),
        ({}, lambda z: z[0] < 0.0, True, False),  # the guard knows
        ({}, lambda z: z[0] > 0.0, True, True),
        ({"failed": lambda info: False}, None, True, False),
        ({"failed": lambda info: info["of"] == "step"}, None, False, True),
    ],
)
def test_what_is_terminated_has_failed_unless_somebody_says_otherwise(
    settings, own, terminates, failed
):
    script = Script(FAR, FAR, terminates=terminates)
    guard = guard_for(script.action_space, Spy(), failed=own)
    env = RevisedActions(script, guard, **settings)
    env.reset()
    env.step(np.array([0.0]))
    env.reset()
    assert [ended[-1] for ended in guard.judge.episodes] == [failed]
    assert guard.machine.endings.sum() == failed


@pytest.mark.parametrize("name", ["CartPole-v1", "Pendulum-v1", "FrozenLake-v1"])
def test_environments_of_gymnasium_need_nothing_else(name):
    inner = gymnasium.make(name, max_episode_steps=30)
    guard = guard_for(inner.action_space, Spy())
    env = RevisedActions(inner, guard)
    env.action_space.seed(0)
    for seed in range(2):
        drive(env, lambda *_: env.action_space.sample(), seed=seed)
    assert len(guard.judge.episodes) == 2
    assert guard.machine.endings.sum() == (0 if name == "Pendulum-v1" else 2)


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


MODES = NEXT_STEP, SAME_STEP, DISABLED = list(gymnasium.vector.AutoresetMode)


def recorded(name, count, mode, steps):
    """A vector of environments, and the list of the episodes that ended in it."""
    ended = []

    def make():
        recorder = Recorder(gymnasium.make(name, max_episode_steps=steps))
        recorder.ended = ended
        return recorder

    return gymnasium.vector.SyncVectorEnv([make] * count, autoreset_mode=mode), ended


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
        if (
            envs.metadata["autoreset_mode"] is gymnasium.vector.AutoresetMode.DISABLED
            and over.any()
        ):
            envs.reset(options={"reset_mask": over})
    return said


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize(("name", "steps"), [("CartPole-v1", 15), ("Pendulum-v1", 7)])
def test_what_each_meets_is_learnt_whole_and_nothing_across_a_reset(name, steps, mode):
    envs, ended = recorded(name, 3, mode, steps)
    guard = guard_for(envs.single_action_space, Spy(lambda action: np.max(action) > 0.5))
    revised = RevisedVectorActions(envs, guard)
    drive_all(revised, 43)
    assert len(ended) > 6
    assert guard.judge.episodes == ended
    assert guard.machine.endings.sum() == sum(failed for *_, failed in ended)
    assert guard.machine.model().uses.sum() == sum(len(rows) for rows, *_ in ended)
    before = len(ended)
    revised.reset(seed=9)  # those under way end as they are
    assert len(guard.judge.episodes) == before + 3
    envs.close()


@pytest.mark.parametrize("mode", MODES)
def test_infos_are_arrays_with_masks(mode):
    envs, _ = recorded("Pendulum-v1", 2, mode, 5)
    guard = guard_for(envs.single_action_space, Spy(lambda action: np.max(action) > 0.5))
    revised = RevisedVectorActions(envs, guard)
    resets = 0
    for over, infos in drive_all(revised, 13):
        assert KEYS | {f"_{key}" for key in KEYS} <= infos.keys()
        resets += not infos["_reviser/reason"].any()
        assert all(len(set(infos[f"_{key}"].tolist())) == 1 for key in KEYS)
        for key in ("proposed", "executed"):
            assert infos[f"reviser/{key}_action"].shape == (2, 1)
            assert infos[f"reviser/{key}_action"].dtype == np.float32
        assert infos["reviser/risk"].shape == infos["reviser/penalty"].shape == (2,)
        assert infos["reviser/reason"].dtype == object
        assert over.shape == (2,)
    assert resets == (2 if mode is NEXT_STEP else 0)
    assert all(revision.executed[0] <= 0.5 for revision in revised.revisions)
    envs.close()


def test_a_step_that_only_resets_is_no_decision():
    envs, _ = recorded("Pendulum-v1", 1, NEXT_STEP, 3)
    guard = guard_for(envs.single_action_space, Spy(lambda action: np.max(action) > 0.5))
    revised = RevisedVectorActions(envs, guard, penalty=2.0)
    revised.reset(seed=0)
    wanted = np.array([[2.0]], np.float32)
    for step in range(1, 9):
        _, rewards, _, _, infos = revised.step(wanted)
        resets = step in (4, 8)
        assert infos["_reviser/executed_action"].tolist() == [not resets]
        executed = 2.0 if resets else 6.0 / 17.0  # the end of an interval of actions
        assert infos["reviser/executed_action"] == pytest.approx(executed)
        assert infos["reviser/penalty"] == pytest.approx((2.0 - executed) / 2.0)
        assert not resets or rewards == [0.0]
    envs.close()


@pytest.mark.parametrize("mode", MODES)
def test_a_failure_is_told_by_its_own_info(mode):
    envs, ended = recorded("CartPole-v1", 3, mode, 12)
    guard = guard_for(envs.single_action_space, Spy())
    asked = []

    def failed(info):
        asked.append(info)
        return info["length"] == 12

    drive_all(RevisedVectorActions(envs, guard, failed=failed), 60)
    assert [failed for *_, failed in guard.judge.episodes] == [
        len(rows) == 12 for rows, *_ in ended
    ]
    assert {type(info["length"]) for info in asked} <= {int, np.int64}
    assert all("_length" not in info for info in asked)
    envs.close()


def test_an_episode_is_decided_by_what_was_learnt_before_it_began():
    class Once(Spy):
        def judge(self, situation, actions):
            self.dangerous = lambda action: bool(self.episodes) and action > 0.5
            return super().judge(situation, actions)

    envs, _ = recorded("Pendulum-v1", 2, SAME_STEP, 4)
    guard = Guard(low=-2.0, high=2.0, interval=0.1, judge=Once())
    revised = RevisedVectorActions(envs, guard)
    revised.reset(seed=0)
    full = np.full((2, 1), 2.0, np.float32)
    executed = [revised.step(full)[-1]["reviser/executed_action"].ravel() for _ in range(8)]
    assert (np.array(executed[:4]) == 2.0).all()
    assert (np.array(executed[4:]) <= 0.5).all()
    envs.close()


@pytest.mark.parametrize("mode", MODES)
def test_with_one_environment_it_comes_to_the_same_bit_for_bit(mode, snapshot):
    guards = [guard_for_cars(-2.5, 2.5, FAMILY.interval) for _ in range(2)]
    envs = gymnasium.vector.SyncVectorEnv([lambda: CarFollowing(FAMILY)], autoreset_mode=mode)
    many = RevisedVectorActions(envs, guards[0], failed=lambda info: bool(info["failed"]))
    one = RevisedActions(CarFollowing(FAMILY), guards[1], failed=lambda info: info["failed"])
    alone = drive(one, full_throttle, seed=1)
    alone += drive(one, full_throttle) + drive(one, full_throttle)
    said = drive_all(many, len(alone) + (2 if mode is NEXT_STEP else 0), seed=1, wish=2.5)
    told = [infos for _, infos in said if infos["_reviser/reason"][0]]
    assert len(told) == len(alone)
    for name in KEYS:
        many_said = [np.asarray(infos[name][0]).tolist() for infos in told]
        assert repr(many_said) == repr([np.asarray(info[name]).tolist() for info in alone]), name
    assert snapshot(guards[0].machine) == snapshot(guards[1].machine)
    assert repr(guards[0].judge._learnt()) == repr(guards[1].judge._learnt())
    envs.close()


def test_what_a_judge_learns_from_being_asked_is_learnt_as_well():
    class Asked(Spy):  # allows less the more often it was asked
        times = 0

        def search(self, situation, wanted, *, tolerance, revising):
            self.times += 1
            options = np.array([wanted, np.clip(wanted, -1.0 / self.times, 1.0 / self.times)])
            return Search(options, self.judge(situation, options), 1, "asked")

    judges = []
    for many in (False, True):
        inner = gymnasium.make("Pendulum-v1", max_episode_steps=6)
        guard = guard_for(inner.action_space, Asked())
        judges.append(guard.judge)
        if many:
            envs, _ = recorded("Pendulum-v1", 1, SAME_STEP, 6)
            drive_all(RevisedVectorActions(envs, guard), 18, wish=2.0)
        else:
            env = RevisedActions(inner, guard)
            for seed in (0, None, None):
                drive(env, lambda *_: np.full(1, 2.0, np.float32), seed=seed)
    assert judges[0].times == judges[1].times == 18
    assert judges[0].episodes == judges[1].episodes


def test_frozen_many_decide_as_one_does():
    guard = guard_for_cars(-2.5, 2.5)
    drive(RevisedActions(CarFollowing(FAMILY), guard), full_throttle, seed=5)
    guard.freeze()
    machine = guard.machine.model().uses.sum()
    envs = gymnasium.vector.SyncVectorEnv([lambda: CarFollowing(FAMILY)] * 2)
    revised = RevisedVectorActions(envs, guard)
    revised.reset(seed=3)
    told = [revised.step(np.full((2, 1), 2.5))[-1]["reviser/executed_action"] for _ in range(40)]
    for k in range(2):
        env = RevisedActions(CarFollowing(FAMILY), guard)
        alone = [i["reviser/executed_action"] for i in drive(env, full_throttle, seed=3 + k)]
        count = min(len(alone), 40)
        assert [one[k].tolist() for one in told][:count] == [one.tolist() for one in alone][:count]
    assert guard.machine.model().uses.sum() == machine
    envs.close()


def test_cars_are_kept_from_colliding_in_many_environments():
    envs = gymnasium.vector.SyncVectorEnv([lambda: CarFollowing(FAMILY)] * 3)
    guard = guard_for_cars(FAMILY.actions.low, FAMILY.actions.high, FAMILY.interval)
    revised = RevisedVectorActions(envs, guard, failed=lambda info: bool(info["failed"]))
    collisions = 0
    revised.reset(seed=1)
    for _ in range(400):
        *_, infos = revised.step(np.full((3, 1), 2.5))
        collisions += infos["failed"].sum()
    assert collisions == guard.machine.endings.sum() <= 1
    assert guard.judge.brakes.known
    envs.close()


def test_environments_that_are_a_vector_by_themselves_are_driven_too():
    envs = gymnasium.make_vec("CartPole-v1", num_envs=3, vectorization_mode="vector_entry_point")
    guard = guard_for(envs.single_action_space, Spy())
    ended = [over.copy() for over, _ in drive_all(RevisedVectorActions(envs, guard), 60)]
    assert len(guard.judge.episodes) == np.sum(ended)
    assert all(failed for *_, failed in guard.judge.episodes)
    assert all(abs(last[0]) > 2.4 or abs(last[2]) > 0.2 for _, last, _ in guard.judge.episodes)
    envs.close()


def test_a_guard_with_an_audit_log_is_not_shared(tmp_path):
    envs, _ = recorded("CartPole-v1", 2, NEXT_STEP, 12)
    with AuditLog(tmp_path / "log") as log:
        guard = guard_for(envs.single_action_space, Spy(), audit=log)
        with pytest.raises(ValueError, match="one episode at a time"):
            RevisedVectorActions(envs, guard)
        with pytest.raises(ValueError, match="call revise"):
            guard.take_in(guard.recognise([0.0], 0.0), Proposal(0), 0)


# -- The examples ------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(
    ("example", "arguments", "needs"),
    [
        ("car_following", ["--episodes", "8", "--train", "4"], "gymnasium"),
        ("highway", ["--episodes", "3", "--train", "1"], "highway_env"),
    ],
)
def test_in_the_examples_collisions_fall(monkeypatch, capsys, example, arguments, needs):
    pytest.importorskip(needs)
    monkeypatch.syspath_prepend(EXAMPLES)
    unrevised, revised = importlib.import_module(example).main(arguments)
    assert unrevised.collisions >= len(unrevised.speeds) - 1
    assert revised.collisions == 0
    assert 0.5 < revised.kept(unrevised) < 1.0
    assert f"0 of {len(revised.speeds)} episodes" in capsys.readouterr().out
