"""What was learnt apart of two systems of one kind is learnt together."""

import numpy as np
import pytest

from evofsm.guard import LearntRisk, Mode, merge_judges


def test_what_two_learnt_apart_is_what_one_would_have_of_both(points, content):
    """Counted from another origin: what was seen, and where it fails."""
    point, whole = points["box"], points["box"].guard(mode=Mode.OFF)
    guards = [point.guard(mode=Mode.OFF), point.guard(mode=Mode.OFF)]
    for episode in range(8):
        point.play(guards[episode % 2], episode)
        point.play(whole, episode)
    before = [content(guard) for guard in guards]
    merged = merge_judges([guard.judge for guard in guards])
    assert [content(guard) for guard in guards] == before
    one, other = merged.state, whole.judge.state
    for name in ("n_episodes", "n_failed", "n_seen", "least", "most", "lowest", "highest", "used"):
        np.testing.assert_allclose(getattr(one, name), getattr(other, name), 1e-9, err_msg=name)
    assert (
        merged.told_by_experience.partition(";")[0]
        == whole.judge.told_by_experience.partition(";")[0]
    )


def test_a_merged_judge_knows_what_both_have_learnt_and_goes_on(points):
    point = points["box"]
    guards = [point.taught(6, seed=seed) for seed in (0, 1)]
    merged = merge_judges([guard.judge for guard in guards])
    assert len(merged.state.failures) == sum(len(g.judge.state.failures) for g in guards)
    seconds = sum(guard.judge.remembered.seconds for guard in guards)
    assert merged.remembered.seconds == pytest.approx(seconds)
    guard = point.guard(judge=merged)
    assert not any(point.play(guard, 50 + episode)[1] for episode in range(4))
    assert guard.judge.state.n_episodes == 16


def test_judges_of_other_systems_are_refused_and_of_one_a_copy_is_made(points, content):
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
    assert content(alone) == content(box)


def test_what_failed_says_is_known_to_a_merged_judge_before_any_failure(points):
    point = points["box"]
    guards = [point.guard(failed=lambda z: z[0] >= 0.8, seed=seed) for seed in (0, 1)]
    assert not any(point.play(guard, k, steps=12)[1] for guard in guards for k in range(3))
    merged = merge_judges([guard.judge for guard in guards])
    assert merged.told_by_experience.startswith("fails where variable 1 is above 0.8")


@pytest.mark.parametrize(("count", "steps"), [(2, 2), (40, 20)])
def test_judges_of_little_and_many_judges_are_merged_within_what_they_may_keep(
    points, count, steps
):
    point = points["box"]
    guard = point.guard(failed=lambda z: z[0] >= 0.4)
    for episode in range(8):
        point.play(guard, episode, steps)
    merged = merge_judges([guard.judge] * count)
    assert len(merged.state.situations) <= merged.settings.n_situations
    point.play(point.guard(judge=merged), 9)


def test_doubts_and_what_is_left_out_outlast_merging(points):
    judges = [points["box"].taught(4, seed=seed).judge for seed in (0, 1)]
    for judge, held in zip(judges, (-30, -25), strict=True):
        judge.without = frozenset({"backups"})
        judge.state = judge.state._replace(misled=5.0, held=held)
    merged = merge_judges(judges).state
    assert (merged.misled, merged.held) == (5.0, -25)
    np.testing.assert_array_equal(merged.policies, judges[0].state.policies)
