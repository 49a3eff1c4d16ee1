import importlib
import math
from pathlib import Path

import numpy as np
import pytest

gymnasium = pytest.importorskip("gymnasium")

from gymnasium.spaces import Box, MultiBinary  # noqa: E402
from gymnasium.utils.env_checker import check_env  # noqa: E402

from evofsm.core.actions import IntervalActions  # noqa: E402
from evofsm.core.machine import EvolvingFSM  # noqa: E402
from evofsm.driving.families.family import load_family  # noqa: E402
from evofsm.driving.framework import Framework  # noqa: E402
from evofsm.driving.revisers import Unrevised  # noqa: E402
from evofsm.driving.risk.latent import LatentRisk  # noqa: E402
from evofsm.driving.worlds.gym import CarFollowing  # noqa: E402
from evofsm.driving.worlds.kinematic import KinematicWorld  # noqa: E402
from evofsm.guard.guard import Guard  # noqa: E402
from evofsm.guard.gym import RevisedActions  # noqa: E402
from evofsm.guard.reviser import ActionReviser, Mode  # noqa: E402

FAMILY = load_family("emergency")
ACTIONS = FAMILY.actions
EXAMPLES = Path(__file__).parents[2] / "examples"
KEYS = {
    *("reviser/proposed_action", "reviser/executed_action", "reviser/reason"),
    *("reviser/risk", "reviser/risk_proposed"),
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
