"""Where an episode failed that had been certified not to, one may be in a dead end."""

import numpy as np
import pytest

from evofsm import Guard
from evofsm.guard import LearntRisk, Mode, run_episode
from evofsm.guard.learnt.failure import SAYS, are_sides, distances
from evofsm.guard.learnt.rollout import CRASHES, ENDS, FAILS

WALL, TRAP = 1.0, 0.6
ICE = 0.5  #: of the kinds of road that are seen, the one on which it fails at the trap


def play(guard, road, episode, see=lambda z: z):
    """Revisions on a road, and whether it failed: at a wall, on ice sooner than anybody is told."""
    rng, place, speed, said = np.random.default_rng(episode), 0.0, 0.0, []
    fails = TRAP if road == ICE else WALL
    while len(said) < 50 and place < fails:
        z, proposal = np.array([place, speed, road]), rng.uniform(-0.2, 1.0)
        said.append(guard.decide(see(z), proposal))
        speed = 0.9 * speed + 0.02 * said[-1].executed + 0.001 * rng.normal()
        place += speed
    guard.end(place >= fails, see(np.array([place, speed, road])))
    return said, place >= fails


def taught(see=lambda z: z, times=2):
    """A guard that knows the wall, and met the trap some times."""
    guard = Guard(-1.0, 1.0, interval=0.1, judge=LearntRisk(0.1, -1.0, 1.0), explaining=True)
    for episode in range(4):
        play(guard, episode % 2, episode, see)
    for episode in range(10, 10 + times):
        play(guard, ICE, episode, see)
    return guard


@pytest.fixture(scope="module")
def wary():
    return taught()


def test_where_a_certificate_was_refuted_is_a_dead_end_that_is_named_and_kept_away_from(
    wary, reloaded
):
    ends, told = wary.judge.state.centres, str(wary)
    assert (ends[:, 2] == ICE).all()
    assert (np.abs(ends[:, 0] - TRAP) < 0.1).all()
    assert f"; {len(ends)} dead end" in told
    assert "that had been certified failed from there" in told
    guard = reloaded(wary)
    said = [one for episode in range(30, 33) for one in play(guard, ICE, episode)[0]]
    explained = [one.explanation for one in said if "from a dead end" in one.explanation]
    assert "that had been certified failed. Its centre is in #" in explained[-1]


@pytest.mark.parametrize(("n_doubted", "learns"), [(0, True), (-1, False)])
def test_a_failure_while_a_rival_is_tried_refutes_that_and_no_certificate(n_doubted, learns):
    guard = taught(times=0)
    guard.judge.state = guard.judge.state._replace(n_doubted=n_doubted)
    guard.judge.remake()
    assert play(guard, ICE, 10)[1]
    assert bool(len(guard.judge.state.centres)) == learns


def test_what_is_survived_there_takes_it_back(wary):
    few = wary.judge.state
    guard = wary.copy()
    speed = few.centres[0, 1]
    for _ in range(3):  # someone else goes there as fast, and comes back
        for place in [*np.linspace(0.0, TRAP + 0.2, 20), *np.linspace(TRAP + 0.2, 0.0, 20)]:
            guard.judge.observe(np.array([place, speed, ICE]))
            guard.judge.act(0.0)
        guard.judge.end(None, failed=False)
    assert guard.judge.state.radii.sum() < few.radii.sum()


def test_however_variables_are_written_it_decides_the_same(wary, reloaded):
    def see(z):
        return (z * [-4.0, 1e-3, 60.0] + [3.0, 0.1, -7.0])[[2, 0, 1]]

    other = taught(see=see)
    assert len(other.judge.state.counts) == len(wary.judge.state.counts)
    pair, told = [reloaded(guard) for guard in (wary, other)], []
    for episode in range(30, 33):
        rows = [play(pair[0], ICE, episode)[0], play(pair[1], ICE, episode, see)[0]]
        executed = [[one.executed for one in row] for row in rows]
        np.testing.assert_allclose(*executed, atol=1e-5)
        told += [one.explanation for one in rows[1]]
    assert any("dead end" in explanation for explanation in told)


def test_the_end_of_a_rail_is_no_disturbance_that_may_begin_anywhere(reloaded):
    """Whoever touches it shakes ever more: nothing survives that, and it begins nowhere else."""
    guard, failed = Guard(low=-1.0, high=1.0, interval=0.1), []
    for episode in range(14):
        rng, place, shaken, shake = np.random.default_rng([0, episode]), 0.0, 0.0, 0.0
        for _ in range(80):
            wanted = float(np.clip(0.6 + 0.4 * rng.normal(), -1.0, 1.0))
            executed = float(guard.decide([place, shaken, shake], wanted).executed)
            place, shaken = place + 0.05 * executed + 0.002 * rng.normal(), shaken + shake
            if place > WALL:
                place, shake = WALL + 0.001 * abs(rng.normal()), 0.2
            if shaken >= 1.0:
                break
        failed.append(shaken >= 1.0)
        guard.end(failed=failed[-1], observation=[place, shaken, shake])
    assert failed[0]
    assert sum(failed) <= 4
    assert not any(failed[-6:])
    assert reloaded(guard).judge.told_by_experience == guard.judge.told_by_experience


# -- Endings that are no failure end a replay: who may land, lands ---------------------------------


class Descent:
    """Thrust brings it down, and it lands; faster than 1 that is a failure."""

    def reset(self, *, seed=None, options=None):
        self.random, self.steps = np.random.default_rng(seed), 0
        self.at = self.random.uniform((2.0, -0.5), (4.0, 0.0))
        self.sinks = self.random.uniform(0.4, 1.6)
        return self.at, {}

    def propose(self, seen, time):
        return min(max(1.0 - self.sinks - seen[1], 0.0), 2.0)

    def step(self, action):
        push = 0.1 * (action - 1.0) + 0.005 * self.random.normal()
        self.at, self.steps = self.at + np.array([0.1 * self.at[1], push]), self.steps + 1
        down = bool(self.at[0] <= 0.0)
        return self.at, 0.0, down, self.steps >= 80, {"failed": down and self.at[1] < -1.0}


def flown(guard, seeds):
    """How many failed, and how many landed; the controller sinks at a pace of its own."""
    env, outcomes = Descent(), np.zeros(2, int)
    for seed in seeds:
        *_, last = run_episode(env, guard, env, seed=seed)
        outcomes += last.failed, env.at[0] <= 0.0 and not last.failed
    return outcomes.tolist()


def test_who_lands_is_let_land_and_what_lands_too_fast_is_not():
    lander = Guard(low=0.0, high=2.0, interval=0.1, names=("height", "speed"))
    off = Guard(low=0.0, high=2.0, interval=0.1, mode=Mode.OFF)
    assert flown(lander, range(200, 220))[1] >= 10
    assert "if it ends where speed is below -0.9" in str(lander)
    assert "; ends by itself where height is below 0.0" in str(lander)
    lander.freeze()
    (failed, landed), alone = flown(lander, range(900, 920)), flown(off, range(900, 920))
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
