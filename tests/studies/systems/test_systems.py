"""Systems start by seed, fail under their controllers, and can be kept from it."""

import copy
from itertools import pairwise

import numpy as np
import pytest
from studies.systems import SYSTEMS, make_system
from studies.systems.system import Box, Discrete, Start

EVERY = [(name, controller) for name in SYSTEMS for controller in make_system(name).controllers]
STARTS = [Start.held_out(11, episode) for episode in range(20)]


def play(system, start, policy=None):
    """Observations, actions and rewards of an episode, and whether it failed."""
    observation = system.reset(start)
    seen, done, paid = [observation], [], []
    while True:
        action = system.propose(observation) if policy is None else policy(observation)
        observation, reward, failed, over = system.step(action)
        seen.append(observation)
        done.append(action)
        paid.append(reward)
        if over:
            return np.array(seen), np.array(done), np.array(paid), failed


@pytest.mark.parametrize("name", SYSTEMS)
def test_an_episode_is_drawn_by_its_start_alone(name):
    system, other = make_system(name), make_system(name)
    start = Start.training(0, 3, 1)
    first = play(system, start)
    play(system, Start.training(0, 3, 2))
    again, of_other = play(system, start), play(other, start)
    for one in (again, of_other):
        assert all(np.array_equal(a, b) for a, b in zip(first, one, strict=True))
    held_out = play(system, Start.held_out(0, 1))
    assert not np.array_equal(first[0][0], held_out[0][0])


@pytest.mark.parametrize("name", SYSTEMS)
def test_what_is_said_of_a_system_is_so(name):
    system = make_system(name)
    seen, done, paid, failed = play(system, STARTS[0])
    assert seen.shape[1] == len(system.variables)
    assert len(done) == len(paid) <= system.steps
    assert failed or len(done) == system.steps
    assert isinstance(system.score, float)
    if isinstance(system.actions, Box):
        assert (np.array(done) >= system.actions.low).all()
        assert (np.array(done) <= system.actions.high).all()
    else:
        assert set(done) <= set(range(system.actions.n_actions))


@pytest.mark.parametrize(("name", "controller"), EVERY)
def test_a_controller_alone_fails_nearly_always(name, controller):
    system = make_system(name, controller)
    failed = sum(play(system, start)[3] for start in STARTS)
    assert failed <= 6 if name == "cut_in" else failed >= 15


def test_training_and_held_out_episodes_are_others():
    starts = {Start.training(0, seed, one) for seed in range(3) for one in range(5)}
    starts |= {Start.held_out(0, one) for one in range(5)}
    draws = {start.rng(0).random() for start in starts}
    assert len(draws) == len(starts) == 20
    assert STARTS[0].rng(0).random() != STARTS[0].rng(1).random()


def test_an_unknown_system_or_controller_is_refused():
    with pytest.raises(ValueError, match="no system 'boat'; there are acc"):
        make_system("boat")
    with pytest.raises(ValueError, match="tanks has no controller 'shy'; it has full"):
        make_system("tanks", "shy")


def test_a_change_is_told_in_halves_of_the_range():
    assert Box((-2.0,), (2.0,)).change(1.0, 2.0) == 0.5
    assert Box((0.0, 0.0), (1.0, 4.0)).change(np.array([0.5, 4.0]), np.array([1.0, 4.0])) == 0.5
    assert [Discrete(3).change(*pair) for pair in ((1, 1), (1, 2))] == [0.0, 1.0]


# -- ACC ------------------------------------------------------------------------------------------


def test_acc_is_the_published_one():
    acc = make_system("acc")
    seen, done, paid, failed = play(acc, STARTS[1])
    assert failed
    np.testing.assert_allclose(np.diff(seen[:, 0]), 0.02 * seen[:-1, 1], atol=1e-12)
    noise = np.diff(seen[:, 1]) / 0.02 - done
    assert abs(noise.mean()) < 0.3
    assert 0.35 < noise.std() < 0.65
    np.testing.assert_allclose(paid[:-1], 2.0 + seen[1:-1, 0])
    assert seen[-1, 0] >= 0.0
    assert paid[-1] == -10.0 * (300 - len(done) + 1)


def test_acc_can_be_kept_by_stopping_in_time():
    acc = make_system("acc")

    def stop_in_time(z):
        free = -z[0] - 0.1
        return 2.0 if max(z[1] + 0.04, 0.0) ** 2 / (2.0 * 1.5) < free else -2.0

    scores = []
    for start in STARTS:
        assert not play(acc, start, stop_in_time)[3]
        scores.append(acc.score)
    assert np.mean(scores) > 500.0


def test_a_decision_is_held_for_five_steps():
    held = make_system("acc-5")
    _, done, _, _ = play(held, STARTS[0], lambda z: -2.0)
    assert len(done) == held.steps == 60
    assert held.interval == pytest.approx(0.1)


# -- CartPole and Pendulum ------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["cartpole", "cartpole-gusts"])
def test_the_pole_can_be_kept_up(name):
    system = make_system(name)
    gains = np.array([0.5, 1.0, 15.0, 3.0])
    assert not any(play(system, start, lambda z: int(z @ gains > 0.0))[3] for start in STARTS)
    assert system.score == 500.0


def test_gusts_push_for_a_while():
    calm, windy = make_system("cartpole"), make_system("cartpole-gusts")
    windy.reset(STARTS[2])
    pushes = np.array([windy._pushed() for _ in range(2000)])
    pushed = pushes != 0.0
    assert 0.03 < pushed.mean() < 0.2
    assert ((np.abs(pushes[pushed]) >= 2.0) & (np.abs(pushes[pushed]) <= 5.0)).all()
    changes = np.flatnonzero(np.diff(pushes, prepend=0.0, append=0.0))
    lasted = [b - a for a, b in pairwise(changes) if pushed[a]]
    assert 5 <= min(lasted) <= max(lasted) <= 15
    first, other = play(calm, STARTS[2])[0], play(windy, STARTS[2])[0]
    np.testing.assert_array_equal(first[0], other[0])


@pytest.mark.parametrize("name", ["pendulum", "pendulum-cos"])
def test_the_pendulum_can_be_held(name):
    system = make_system(name)

    def hold(z):
        angle = z[0] if name == "pendulum" else np.arctan2(z[1], z[0])
        return float(np.clip(-10.0 * angle - 2.0 * z[-1], -2.0, 2.0))

    assert not any(play(system, start, hold)[3] for start in STARTS)


def test_the_angle_is_seen_in_two_ways():
    plain, circular = make_system("pendulum"), make_system("pendulum-cos")
    (one, _, _, _), (other, _, _, _) = play(plain, STARTS[3]), play(circular, STARTS[3])
    np.testing.assert_allclose(np.cos(one[:, 0]), other[:, 0])
    np.testing.assert_allclose(one[:, 1], other[:, 2])


# -- Tanks and reactor ----------------------------------------------------------------------------


def careful_pumps(z):
    """Steer the flows towards what keeps both levels at 1 m, ahead of the pumps' lag."""
    levels, flows = z[:2], z[2:]
    wanted = 0.03 * np.sqrt(levels) + 0.03 * (1.0 - levels)
    return np.clip((flows + 3.0 * (wanted - flows)) / 0.15, 0.0, 1.0)


def careful_feed(z):
    """Feed only what the reactor could take if nothing cooled it any more."""
    temperature, unreacted = z
    for action, fed in ((2, 0.04), (1, 0.015)):
        if temperature + 80.0 * (unreacted + fed) < 97.0:
            return action
    return 0


@pytest.mark.slow
@pytest.mark.parametrize(("name", "careful"), [("tanks", careful_pumps), ("reactor", careful_feed)])
def test_who_is_careful_keeps_it(name, careful):
    system = make_system(name)
    starts = [Start.held_out(12, episode) for episode in range(60)]
    assert not any(play(system, start, careful)[3] for start in starts)


@pytest.mark.parametrize(
    ("name", "controller", "ways"),
    [
        ("tanks", "full", [np.zeros(2), np.ones(2), np.array([0.0, 1.0]), np.array([1.0, 0.0])]),
        ("reactor", "hurried", [0]),
        ("reactor", "thermostat", [0]),
    ],
)
def test_a_failure_is_decided_many_steps_before(name, controller, ways):
    """Neither of the ways out saves it any more, though nobody can see that it has failed."""
    system, steps = make_system(name, controller), []
    for start in STARTS[:8]:
        observation, lost = system.reset(start), []
        over = False
        while not over:
            lost.append(not any(_saves(system, way) for way in ways))
            observation, _, _, over = system.step(system.propose(observation))
        steps.append(len(lost) - 1 - max(np.flatnonzero(~np.array(lost))))
    assert np.median(steps) >= 5


def _saves(system, action):
    tried = copy.deepcopy(system)
    for _ in range(25):
        _, _, failed, over = tried.step(action)
        if over:
            return not failed
    return True


def test_failed_cooling_is_not_observed_at_once():
    """The step after it failed looks like others; twenty steps later it is far hotter."""
    system, other = make_system("reactor"), make_system("reactor")
    for one in (system, other):
        one.reset(STARTS[0])
    other._fails_for = 40
    apart = [other.step(2)[0][0] - system.step(2)[0][0] for _ in range(20)]
    assert abs(apart[0]) < 3.0
    assert max(apart) > 10.0
