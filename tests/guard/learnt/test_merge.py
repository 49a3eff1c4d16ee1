"""What was learnt apart of two systems of one kind is learnt together."""

import numpy as np
import pytest
from tests.guard.learnt.test_dynamics import Dynamics, ahead, content, drive, follow, taught

from evofsm.guard import LearntRisk, merge_judges
from evofsm.guard.learnt.merge import _merged, _moved
from evofsm.guard.learnt.replay import features


def test_features_from_another_origin_are_those_of_before_moved():
    dynamics, draw = taught(2), np.random.default_rng(0)
    z, u = draw.normal(size=(5, 3)), draw.uniform(-1.0, 1.0, (5, 1))
    model, d = dynamics.model._replace(reach=np.full(3, 9.0)), draw.normal(size=3)
    given = z, 0.1 * z, u, -u
    moved = features(model._replace(origin=model.origin - d), *given)
    T = _moved(d, 1, moved.shape[1])
    np.testing.assert_allclose(moved, features(model, *given) @ T.T, atol=1e-12)


def test_of_two_halves_comes_what_comes_of_all():
    draw, whole = np.random.default_rng(0), Dynamics(-2.5, 2.5)
    halves = [Dynamics(-2.5, 2.5), Dynamics(-2.5, 2.5)]
    for episode in range(8):
        Z, U = drive(draw, braking=60 if episode % 2 else None, start=(40.0 + episode, 15.0, 15.0))
        follow(whole, Z, U)
        follow(halves[episode % 2], Z, U)
    before = [content(half) for half in halves]
    merged = _merged(halves)
    assert [content(half) for half in halves] == before
    assert max(one.episode for one in merged.sequences) < merged.n_episodes == 8
    np.testing.assert_array_equal(merged.sums.counts, whole.sums.counts)
    for name in ("mean", "scatter", "low", "high", "least", "most"):
        one, other = (getattr(each.sums, name) for each in (merged, whole))
        np.testing.assert_allclose(one, other, rtol=1e-9, err_msg=name)
    paths = [ahead(one, [40.0, 15.0, 13.0], 1.0)[:, 1] for one in (merged, whole)]
    np.testing.assert_allclose(paths[0], paths[1], rtol=1e-4)  # what an action does


def test_a_merged_judge_knows_what_both_have_learnt_and_goes_on(points):
    point = points["box"]
    guards = [point.taught(6, seed=seed) for seed in (0, 1)]
    merged = merge_judges([guard.judge for guard in guards])
    assert len(merged.dynamics.failures) == sum(len(g.judge.dynamics.failures) for g in guards)
    seconds = sum(guard.judge.remembered.seconds for guard in guards)
    assert merged.remembered.seconds == pytest.approx(seconds)
    guard = point.guard(judge=merged)
    assert not any(point.play(guard, 50 + episode)[1] for episode in range(4))
    assert guard.judge.dynamics.n_episodes == 16


def test_judges_of_other_systems_are_refused_and_of_one_a_copy_is_made(points):
    box, plane = (points[name].taught(2).judge for name in ("box", "plane"))
    for judges, why in (
        ([box, plane], "made for actions from"),
        ([box, LearntRisk(0.2, -1.0, 1.0)], "same actions and interval"),
        ([], "at least one"),
    ):
        with pytest.raises(ValueError, match=why):
            merge_judges(judges)
    alone = merge_judges([LearntRisk(0.1, -1.0, 1.0), box])
    assert alone is not box
    assert content(alone.dynamics) == content(box.dynamics)
