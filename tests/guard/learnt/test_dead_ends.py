"""Where an episode failed that had been certified not to, one may be in a dead end."""

from io import BytesIO

import numpy as np
import pytest

from evofsm import Guard
from evofsm.guard import LearntRisk, merge_judges
from evofsm.guard.learnt.dead_ends import DeadEnds
from evofsm.guard.learnt.replay import NOTHING_PASSES, replay, search

ONE, WALL, TRAP = np.ones(2), 1.0, 0.6
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


def taught(on_ice=2, see=lambda z: z, without=("regions",)):
    """A guard that knows the wall, and met the trap so often."""
    judge = LearntRisk(0.1, -1.0, 1.0, without=without)
    guard = Guard(low=-1.0, high=1.0, interval=0.1, judge=judge, explaining=True)
    for episode in range(4):
        play(guard, episode % 2, episode, see)
    for episode in range(10, 10 + on_ice):
        play(guard, ICE, episode, see)
    return guard


@pytest.fixture(scope="module")
def wary():
    return taught()


def file_of(one):
    one.save(file := BytesIO())
    return BytesIO(file.getvalue())


def test_where_a_certificate_was_refuted_is_a_dead_end_that_is_named_and_kept_away_from(wary):
    ends, told = wary.judge.dynamics.dead_ends, str(wary)
    assert (ends.centres[:, 2] == ICE).all()
    assert (np.abs(ends.centres[:, 0] - TRAP) < 0.1).all()
    assert f"; {len(ends.counts)} dead-end state" in told
    assert "that had been certified failed from there" in told
    guard = Guard.load(file_of(wary))
    said = [one for episode in range(30, 33) for one in play(guard, ICE, episode)[0]]
    reasons = [one.reason for one in said if "would come near dead end" in one.reason]
    assert reasons
    assert "from where 1 episode that had been certified failed; the closest" in reasons[0]
    explained = [one.explanation for one in said if "from dead end" in one.explanation]
    assert "that had been certified failed. Its centre is in #" in explained[-1]


def test_without_them_nothing_is_learnt_from_it():
    guard = taught(without=["regions", "dead-ends"])
    assert "dead-end" not in str(guard)
    assert play(guard, ICE, 30)[1]


def after(ends, observations, *, failed=False, certified=True, horizon=10):
    """What becomes of them, where an ordinary change is a fiftieth of a spread."""
    z = np.array(observations, np.float64)
    held = [certified, *[False] * (len(z) - 1)]
    return ends.after(z, held if failed else [], horizon, ONE, 0.02 * ONE)


def test_it_grows_by_repetition_shrinks_by_what_is_survived_and_is_forgotten():
    ends, path = DeadEnds.none(2), [[0.0, 0.0], [1.0, 1.0], [1.0, 1.05]]
    assert not len(after(ends, path, failed=True, certified=False).counts)
    for count, radius in ((1, 0.15), (2, 0.3), (3, 0.6), (4, 0.6)):
        ends = after(ends, path, failed=True)
        assert ends.counts.tolist() == [count]
        assert ends.radii.tolist() == [radius]
        assert ends.centres.tolist() == [[1.0, 1.0]]
    ends = after(ends, [[1.0, 1.9], [2.0, 2.0], [1.5, 1.0], *[[9.0, 9.0]] * 10])
    assert ends.radii.tolist() == [0.45]
    ends = after(ends, [[5.0, 5.0], [1.0, 1.95]], failed=True)
    assert (ends.counts.tolist(), ends.numbers.tolist()) == ([4, 1], [1, 2])
    ends = after(ends, [[1.0, 1.95], *[[9.0, 9.0]] * 10])
    assert ends.numbers.tolist() == [1]
    far = [[5.0, 5.0], *[[float(k), 50.0] for k in range(90)]]
    ends = after(ends, far, failed=True, horizon=99)  # no number is given again
    assert ends.numbers.tolist() == [1, *range(3, 42)]


def test_in_a_file_they_are_the_same_and_merged_they_are_all_there_are(wary):
    ends = wary.judge.dynamics.dead_ends
    again = LearntRisk.load(file_of(wary.judge)).dynamics.dead_ends
    for one, other in zip(again, ends, strict=True):
        np.testing.assert_array_equal(one, other)
    other = taught(1).judge
    merged = merge_judges([wary.judge, other]).dynamics.dead_ends
    assert merged.counts.sum() == ends.counts.sum() + other.dynamics.dead_ends.counts.sum()


def test_however_variables_are_written_it_decides_the_same(wary):
    def see(z):
        return (z * [-4.0, 1e-3, 60.0] + [3.0, 0.1, -7.0])[[2, 0, 1]]

    other = taught(see=see)
    assert len(other.judge.dynamics.dead_ends.counts) == len(wary.judge.dynamics.dead_ends.counts)
    pair = [Guard.load(file_of(guard)) for guard in (wary, other)]
    for episode in range(30, 32):
        rows = [play(pair[0], ICE, episode)[0], play(pair[1], ICE, episode, see)[0]]
        executed = [[one.executed for one in row] for row in rows]
        np.testing.assert_allclose(*executed, atol=1e-5)
        assert any("dead end" in one.reason for one in rows[1])


def test_nothing_is_certified_in_one_but_how_soon_who_is_in_one_leaves_does_not_count(wary):
    judge = wary.judge
    model, disturbances = judge.dynamics.model, judge.disturbances
    here = np.append(judge.dynamics.dead_ends.centres[0], np.zeros(4))
    free = model._replace(dead_ends=model.dead_ends[:0])
    ranked = judge.backups.policies, judge.backups.ranks, disturbances, 1.0, np.ones(1), 1.0, 0
    assert search(model, here, *ranked)[0] == NOTHING_PASSES
    assert search(free, here, *ranked)[0] != NOTHING_PASSES
    asked = here[None], np.empty((0, 1)), judge.backups.policies[0], disturbances
    np.testing.assert_array_equal(replay(model, *asked).worth, replay(free, *asked).worth)
