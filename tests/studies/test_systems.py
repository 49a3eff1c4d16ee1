"""Systems start by seed, fail under their controllers, and can be kept from it; rivals do that."""

import numpy as np
import pytest
from studies.judges import make_judge, run, trial
from studies.rivals import BackupShield, Counted, obstacle_shield, rivals_of
from studies.shapes import PEERS, SHAPES
from studies.systems import HIGHWAY, SYSTEMS, Box, Discrete, Start, System, lacking, make_system

NAMES = [name for name in (*SYSTEMS, *SHAPES, *PEERS) if not lacking(name)]
EVERY = [(name, controller) for name in NAMES for controller in make_system(name).controllers]
STARTS = [Start.held_out(11, episode) for episode in range(20)]


def play(system, start, policy=None):
    """Observations, actions and rewards of an episode, and whether it failed."""
    observation, _ = system.reset(options={"start": start})
    seen, done, paid, over = [observation], [], [], False
    while not over:
        action = system.propose(observation) if policy is None else policy(observation)
        observation, reward, ended, truncated, info = system.step(action)
        failed, over = info["failed"], ended or truncated
        assert ended == (failed or system.arrived)
        assert system.has_failed is None or system.has_failed(observation) == failed
        seen.append(observation)
        done.append(action)
        paid.append(reward)
    return np.array(seen), np.array(done), np.array(paid), failed


@pytest.mark.parametrize("name", NAMES)
def test_an_episode_is_drawn_by_its_start_alone_and_is_what_is_said_of_it(name):
    system, other = make_system(name), make_system(name)
    start = Start.training(0, 3, 1)
    first = play(system, start)
    play(system, Start.training(0, 3, 2))
    for again in (play(system, start), play(other, start)):
        assert all(np.array_equal(a, b) for a, b in zip(first, again, strict=True))
    assert not np.array_equal(first[0][0], play(system, Start.held_out(0, 1))[0][0])
    seen, done, _, failed = first
    assert seen.shape[1] == len(system.variables)
    assert len(done) == system.steps or ((failed or other.arrived) and len(done) < system.steps)
    if isinstance(system.actions, Box):
        assert (done >= system.actions.low).all()
        assert (done <= system.actions.high).all()
    else:
        assert set(done) <= set(range(system.actions.n_actions))


@pytest.mark.parametrize(("name", "controller"), EVERY)
def test_a_controller_alone_fails_nearly_always_or_often(name, controller):
    system = make_system(name, controller)
    failed = sum(play(system, start)[3] for start in STARTS)
    least = 15 if name in SYSTEMS else 8
    assert failed <= 6 if name == "cut_in" else failed >= least


def test_what_is_missing_is_named_with_the_command_that_installs_it(monkeypatch):
    monkeypatch.setattr("studies.systems.find_spec", lambda package: None)
    assert lacking("hopper") == "it needs mujoco (pip install 'gymnasium[mujoco]')"
    assert lacking("disc") == ""


def test_acc_is_the_published_one():
    seen, done, paid, failed = play(make_system("acc"), STARTS[1])
    assert failed
    np.testing.assert_allclose(np.diff(seen[:, 0]), 0.02 * seen[:-1, 1], atol=1e-12)
    noise = np.diff(seen[:, 1]) / 0.02 - done
    assert abs(noise.mean()) < 0.3
    assert 0.35 < noise.std() < 0.65
    np.testing.assert_allclose(paid[:-1], 2.0 + seen[1:-1, 0])
    assert seen[-1, 0] >= 0.0
    assert paid[-1] == -10.0 * (300 - len(done) + 1)
    held = make_system("acc-5")
    assert len(play(held, STARTS[0], lambda z: -2.0)[1]) == held.steps == 60
    assert held.interval == pytest.approx(0.1)


# -- Rivals ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("task", "controller", "judge", "returns"),
    [
        *(("acc", None, judge, 545.0) for judge in ("stopping-distance", "barrier")),
        *(("acc-5", None, judge, 545.0) for judge in ("stopping-distance", "barrier")),
        ("cartpole", "random", "lqr-shield", 500.0),
        ("pendulum", "random", "lqr-shield", 200.0),
        ("pendulum-cos", "badpd", "lqr-shield", 200.0),
    ],
)
def test_judges_that_are_told_the_equations_save_and_come_close(task, controller, judge, returns):
    row = trial(task, controller, judge, train=0, test=5)
    assert row["failed"] == 0
    assert row["score"] >= returns
    assert row["kept"] > 0.1
    assert row["told"] in ("dynamics and noise", "linear model and limits")


def test_a_backup_shield_takes_the_closest_action_that_can_still_be_saved():
    """A point that moves by its speed; braking takes 1 off it, the wall is at 10."""
    shield = BackupShield(
        Box((-1.0,), (1.0,)),
        move=lambda states, taken: np.column_stack(
            [states[:, 0] + states[:, 1], states[:, 1] + taken.reshape(-1)]
        ),
        fails=lambda states: states[:, 0] >= 10.0,
        backup=lambda states: np.where(states[:, 1] > 0.0, -1.0, 0.0),
        steps=20,
    )
    assert shield.action(np.array([0.0, 0.0]), 1.0) == 1.0
    assert shield.action(np.array([5.0, 2.5]), 1.0) == pytest.approx(-0.75, abs=0.3)
    assert shield.action(np.array([9.0, 5.0]), 1.0) == 1.0  # lost, whatever is done
    obstacle = obstacle_shield(Box((-2.0, -2.0), (2.0, 2.0)))
    far, near = np.array([0.5, 0.5, 0.0, 0.05]), np.array([0.5, 1.85, 0.0, 0.05])
    assert np.array_equal(obstacle.action(far, np.ones(2)), np.ones(2))
    assert not np.array_equal(obstacle.action(near, np.ones(2)), np.ones(2))


class Ladder(System):
    """Up or down a ladder of ten rungs, from the middle; the top one breaks."""

    name, variables = "ladder", ("rung",)
    actions, interval, steps = Discrete(2), 1.0, 30

    @property
    def controllers(self):
        return {"random": lambda z: int(self.whim.integers(2))}

    def _begin(self, start):
        self._rung = 5

    def _observation(self):
        return np.array([float(self._rung)])

    def _advance(self, action):
        self._rung = max(self._rung + (1 if action else -1), 0)
        return 1.0, self._rung >= 9


@pytest.mark.slow
def test_a_shield_by_counts_learns_which_rung_breaks():
    ladder, judge = Ladder(), Counted(Ladder())
    assert any(run(ladder, judge, Start.training(0, 0, k)).failed for k in range(40))
    judge.freeze()
    tested = [run(ladder, judge, Start.held_out(0, k)) for k in range(30)]
    assert sum(one.failed for one in tested) <= 2
    assert judge.decide(np.array([8.0]), 1).executed == 0
    assert judge.decide(np.array([5.0]), 0).executed == 0
    assert sum(one.kept for one in tested) > 0.4 * sum(len(one.times) for one in tested)


# -- highway-env ----------------------------------------------------------------------------------


@pytest.mark.parametrize("task", HIGHWAY)
def test_a_task_of_highway_env_is_drawn_by_its_start_alone_and_seen_as_rows(task):
    pytest.importorskip("highway_env")
    system = make_system(task, "dqn")
    starts = [Start.held_out(3, k) for k in (1, 1, *range(2, 30))]
    seen = [system.reset(options={"start": start})[0] for start in starts]
    assert np.array_equal(seen[0], seen[1])
    assert not np.array_equal(seen[0], seen[2])
    assert len(seen[0]) == len(system.variables)
    assert len(seen[0]) % system.columns == 0
    assert len({system.propose(one) for one in seen}) > 1  # the network looks
    assert task not in SYSTEMS


@pytest.mark.slow
@pytest.mark.parametrize("task", HIGHWAY)
def test_it_drives_to_the_end_under_each_rival(task):
    pytest.importorskip("highway_env")
    system = make_system(task)
    for judge in ("unrevised", *rivals_of(system)):
        ended = run(system, make_judge(judge, system), Start.held_out(3, 1))
        assert 0 < len(ended.times) <= system.steps
        assert 0.0 <= ended.speed <= 40.0
