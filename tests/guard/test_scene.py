"""The judge of scenes: told which episodes failed, it keeps from meeting what is around."""

import numpy as np
import pytest

from evofsm.guard import Guard, Mode, Proposal, SceneRisk
from evofsm.guard.actions import same_action
from evofsm.guard.audit_log import digests_of

LEFT, STAY, RIGHT = range(3)
THINGS = 3
HALF = np.array([2.0, 0.6])  # of the box around each other that fails


class Rain:
    """Rows of presence, place (2) and speed; things come from ahead and never change lanes."""

    def __init__(self, *, relative=True, shuffled=False, scale=(1.0, 1.0), steps=25):
        self.relative, self.shuffled, self.scale = relative, shuffled, np.array(scale)
        self.steps, self.moves, self.lanes = steps, 1.0, 5

    def guard(self, **settings):
        judge = SceneRisk(1.0, 3, columns=4, relative=self.relative)
        return Guard(n_actions=3, interval=1.0, judge=judge, **settings)

    def play(self, guard, seed):
        """Revisions of an episode under a policy that moves now and then, and whether it failed."""
        random, whim = np.random.default_rng(seed), np.random.default_rng([seed, 1])
        lane, said = self.lanes // 2, []
        place = np.column_stack(
            [random.uniform(20, 60, THINGS), random.integers(self.lanes, size=THINGS)]
        )
        speed = random.uniform(4.0, 8.0, THINGS)
        failed = False
        for _ in range(self.steps):
            row = self.seen(lane, place, speed, random)
            wanted = int(random.integers(3)) if whim.random() < self.moves else STAY
            said.append(guard.decide(row, wanted))
            then = int(np.clip(lane + said[-1].executed - 1, 0, self.lanes - 1))
            start, end = place - [0.0, lane], place - [0.0, then]
            end[:, 0] -= speed
            place[:, 0] -= speed
            lane = then
            way = np.linspace(0.0, 1.0, 50)[:, None, None]
            failed = bool((np.abs(start + way * (end - start)) < HALF).all(-1).any())
            if failed:
                break
            gone = place[:, 0] < -10.0
            place[gone] = np.column_stack(
                [random.uniform(40, 70, gone.sum()), random.integers(self.lanes, size=gone.sum())]
            )
            speed[gone] = random.uniform(4.0, 8.0, gone.sum())
        guard.end(failed, self.seen(lane, place, speed, random))
        return said, failed

    def seen(self, lane, place, speed, random):
        """The observation, flattened."""
        own = np.array([1.0, 0.0, lane, 0.0])
        rows = np.column_stack([np.ones(THINGS), place, -speed])
        if self.relative:
            rows[:, 1:] -= own[1:]
        if self.shuffled:
            random.shuffle(rows)
        seen = np.vstack([own, rows])
        seen[:, 1:3] *= self.scale
        return seen.ravel()


def failures(world, guard, seeds):
    return sum(world.play(guard, seed)[1] for seed in seeds)


@pytest.fixture(scope="module")
def taught():
    """A guard that has learnt from some episodes, and is frozen."""
    world = Rain()
    guard = world.guard()
    failures(world, guard, range(12))
    guard.freeze()
    return guard


@pytest.mark.slow
@pytest.mark.parametrize("kind", [{"shuffled": True, "scale": (0.01, 30.0)}, {"relative": False}])
def test_after_some_failures_it_keeps_a_random_policy_from_failing(kind):
    world = Rain(**kind)
    alone = failures(world, world.guard(mode=Mode.OFF), range(500, 515))
    guard = world.guard()
    failures(world, guard, range(20))
    guard.freeze()
    assert alone >= 10
    assert failures(world, guard, range(500, 515)) <= 1


def test_before_the_first_failure_all_is_kept_and_it_says_why():
    world = Rain(steps=3)
    said, failed = world.play(world.guard(), 0)
    assert not failed
    assert all(same_action(one.executed, one.proposed) for one in said)
    assert all("no failure with an object in sight is known yet" in one.reason for one in said)


def test_what_is_harmless_is_kept_and_what_is_changed_is_changed_for_a_reason(taught):
    said, _ = Rain().play(taught, 700)
    kept = [same_action(one.executed, one.proposed) for one in said]
    assert 0.3 < np.mean(kept) < 1.0
    for one, is_kept in zip(said, kept, strict=True):
        assert is_kept or one.risk_proposed > taught.reviser.tolerance
        assert 0.0 <= one.interval[0] <= one.risk_executed <= one.interval[1] <= 1.0
        assert one.risk_executed <= one.risk_proposed
        if not is_kept:
            assert "an object is met within 5 s" in one.reason


def test_only_what_a_mask_allows_is_executed(taught):
    ahead = [1.0, 0, 2.0, 0.0, 1.0, 6.0, 0.0, -6.0] + [0.0] * 8
    first = taught.decide(ahead, STAY).executed
    other = taught.decide(ahead, Proposal(STAY, np.arange(3) != first)).executed
    assert {first, other} == {LEFT, RIGHT}
    assert taught.decide(ahead, Proposal(first, np.arange(3) == STAY)).executed == STAY


def test_what_oneself_never_did_at_first_is_learnt_too():
    world = Rain()
    guard = world.guard(mode=Mode.OFF)
    world.moves, world.lanes = 0.0, 3
    failures(world, guard, range(8))
    world.moves = 0.3
    failures(world, guard, range(8, 20))
    guard.reviser.mode = Mode.SHADOW
    abreast_soon = [1.0, 0.0, 1.0, 0.0, 1.0, 5.0, -1.0, -6.0] + [0.0] * 8
    assert guard.decide(abreast_soon, LEFT).risk_proposed > 0.5
    assert guard.decide(abreast_soon, STAY).risk_proposed < 0.2


def test_what_fails_only_in_one_and_the_same_place_is_learnt():
    """As in a world of cells: how close is too close is then 0."""
    guard, random = Rain().guard(), np.random.default_rng(0)

    def row(lane, place):
        return [1.0, 0, lane, 0.0, 1.0, place[0], place[1] - lane, -1.0] + [0.0] * 8

    for _ in range(12):
        lane, place = 1, [float(random.integers(4, 8)), float(random.integers(3))]
        while place[0] >= 0.0:
            did = guard.decide(row(lane, place), int(random.integers(3))).executed
            lane, place[0] = int(np.clip(lane + did - 1, 0, 2)), place[0] - 1.0
            if place == [0.0, lane]:
                break
        guard.end(place == [0.0, lane], row(lane, place))
    guard.freeze()
    assert guard.judge.memory.contact.met == 0.0
    assert guard.decide(row(1, [1.0, 1.0]), STAY).executed != STAY


def test_neither_the_order_of_objects_nor_rows_that_are_not_seen_make_a_difference(taught):
    ego, near, far = [1.0, 0, 2.0, 0.0], [1.0, 6.0, 0.0, -6.0], [1.0, 30.0, 1.0, -5.0]
    first = taught.decide(ego + near + far + [0.0] * 4, STAY)
    other = taught.decide([*ego, 1.0, 2.0, 0.0, np.nan, *far, *near], STAY)
    assert first.risk_proposed > 0.5
    assert first.risk_proposed == pytest.approx(other.risk_proposed, abs=1e-12)
    assert first.executed == other.executed != STAY


# -- Files -------------------------------------------------------------------------------------


@pytest.mark.parametrize("more", [0, 1])
def test_in_a_file_it_is_kept_as_it_is_also_between_two_fits(more, reloaded):
    world = Rain()
    guard = world.guard()
    failures(world, guard, range(12))
    world.steps = 4
    failures(world, guard, range(100, 100 + more))
    again = reloaded(guard)
    assert digests_of(again) == digests_of(guard)
    world.steps = 40
    for seed in (901, 902):  # and it goes on learning
        one, two = (world.play(each, seed)[0] for each in (guard, again))
        assert [one.risk_proposed for one in one] == [two.risk_proposed for two in two]


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ({"links": lambda array: np.full_like(array, len(array))}, "not as many"),
        ({"links": np.zeros_like}, "another moment"),
        ({"links": lambda array: np.full_like(array, -1)}, "no object is seen twice"),
        ({"actions": 7.0}, "an action is none"),
        ({"lost": np.ones_like}, "end of an episode"),
        ({"own": lambda array: array[:, :2]}, "other columns"),
        ({"own": np.inf}, "own of inf"),
        ({"n_actions": 10**9}, "n_actions"),
    ],
)
def test_a_file_that_no_learning_could_have_left_is_refused(taught, forge, tmp_path, change, why):
    taught.judge.save(tmp_path / "judge")
    forge(tmp_path / "judge", change)
    with pytest.raises(ValueError, match=why):
        SceneRisk.load(tmp_path / "judge")


def test_what_it_cannot_work_with_is_refused():
    for make, why in (
        (lambda: SceneRisk(1.0, 3, columns=3), "columns is 3"),
        (lambda: SceneRisk(0.0, 3), "dt"),
        (lambda: Rain().guard().decide(np.ones(7), STAY), "7 numbers are no rows of 4"),
        (lambda: Guard(n_actions=4, interval=1.0, judge=SceneRisk(1.0, 3)), "3 choices"),
    ):
        with pytest.raises(ValueError, match=why):
            make()
