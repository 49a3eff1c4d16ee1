"""The judge of scenes: told which episodes failed, it keeps from meeting what is around."""

from io import BytesIO

import numpy as np
import pytest

from evofsm.guard import Guard, Layout, Mode, SceneRisk, same_action
from evofsm.guard.scene.contact import closest, learn
from evofsm.guard.scene.memory import Foreseen, Memory

LEFT, STAY = 0, 1


def failures(world, guard, seeds):
    return sum(world.play(guard, seed)[1] for seed in seeds)


@pytest.mark.slow
@pytest.mark.parametrize("kind", [{"shuffled": True}, {"relative": False}, {"scale": (0.01, 30.0)}])
def test_after_some_failures_it_keeps_a_random_policy_from_failing(rain, kind):
    world = rain(**kind)
    alone = failures(world, world.guard(mode=Mode.OFF), range(500, 515))
    guard = world.guard()
    failures(world, guard, range(20))
    guard.freeze()
    assert alone >= 10
    assert failures(world, guard, range(500, 515)) <= 1


def test_before_the_first_failure_all_is_kept_and_it_says_why(rain):
    world = rain(steps=3)
    guard = world.guard()
    said, failed = world.play(guard, 0)
    assert not failed
    assert all(same_action(one.executed, one.proposed) for one in said)
    assert all("no failure is known yet" in one.reason for one in said)


def test_what_is_harmless_is_kept_and_what_is_changed_is_changed_for_a_reason(rain, taught):
    said, _ = rain().play(taught, 700)
    kept = [same_action(one.executed, one.proposed) for one in said]
    assert 0.3 < np.mean(kept) < 1.0
    for one, is_kept in zip(said, kept, strict=True):
        assert is_kept == (one.risk_proposed <= taught.reviser.tolerance) or is_kept
        assert 0.0 <= one.interval[0] <= one.risk_executed <= one.interval[1] <= 1.0
        assert one.risk_executed <= one.risk_proposed
        if not is_kept:
            assert "an object is met within 5 s" in one.reason


def test_what_oneself_never_did_at_first_is_learnt_too(rain):
    world = rain(moves=0.0, lanes=3)
    judge = world.judge()
    guard = Guard(n_actions=3, interval=1.0, judge=judge, mode=Mode.OFF)
    failures(world, guard, range(8))
    world.moves = 0.3
    failures(world, guard, range(8, 20))
    abreast_soon = np.array([1.0, 0.0, 1.0, 0.0, 1.0, 5.0, -1.0, -6.0] + [0.0] * 8)
    risks = judge.memory.foresee(judge.layout.read(abreast_soon)).risks
    assert risks.min(1)[LEFT] > 0.5 > 0.2 > risks.min(1)[STAY]


def test_an_object_that_was_taken_for_another_one_is_no_forecast(taught):
    memory = taught.judge.memory
    episode = memory.episodes[0]
    now, then = episode.links[:2], episode.away[episode.links[:2], 0]
    assert (now >= 0).all()
    assert abs(then[0] - then[1]) > 10.0
    links = episode.links.copy()
    links[:2] = now[::-1]
    again = Memory(memory.n_actions, memory.steps)
    episodes = [episode._replace(links=links), *memory.episodes[1:]]
    again.restore(episodes, memory.failures, memory.fitted)
    assert len(again._paths) == len(memory._paths) - 2
    assert np.abs(again._paths[:, 0, 0]).max() < 8.5


def test_what_fails_only_in_one_and_the_same_place_is_learnt(rain):
    """As in a world of cells: how close is too close is then 0."""
    guard, random = rain().guard(), np.random.default_rng(0)

    def row(lane, place):
        return [1.0, 0, lane, 0.0, 1.0, place[0], place[1] - lane, -1.0] + [0.0] * 8

    for _ in range(12):
        lane, place = 1, [float(random.integers(4, 8)), float(random.integers(3))]
        while place[0] >= 0.0:
            wanted = int(random.integers(3))
            did = guard.decide(row(lane, place), wanted).executed
            lane, place[0] = int(np.clip(lane + did - 1, 0, 2)), place[0] - 1.0
            if place == [0.0, lane]:
                break
        guard.end(place == [0.0, lane], row(lane, place))
    guard.freeze()
    assert guard.judge.memory.contact.met == 0.0
    assert guard.decide(row(1, [1.0, 1.0]), STAY).executed != STAY


def test_where_nothing_can_it_takes_what_lasts_longest(taught, monkeypatch):
    row, after = [1.0, 0, 2.0, 0.0] + [0.0] * 12, np.eye(3)

    def executed(lasting):
        foreseen = Foreseen(np.ones((3, 3)), np.tile(lasting, (3, 1)).T, after)
        monkeypatch.setattr(taught.judge.memory, "foresee", lambda seen: foreseen)
        return taught.decide(row, STAY)

    assert executed([0.6, 0.2, 0.2]).executed == LEFT
    kept = executed([0.2, 0.19, 0.2])
    assert kept.executed == STAY
    assert "nothing can, nor does anything last longer" in kept.reason


def test_the_order_of_objects_makes_no_difference(taught):
    ego, near, far = [1.0, 0, 2.0, 0.0], [1.0, 6.0, 0.0, -6.0], [1.0, 30.0, 1.0, -5.0]
    first = taught.decide(ego + near + far + [0.0] * 4, 1)
    other = taught.decide(ego + [0.0] * 4 + far + near, 1)
    assert first.risk_proposed > 0.5
    assert first.risk_proposed == pytest.approx(other.risk_proposed, abs=1e-12)
    assert first.executed == other.executed != 1


def test_a_guard_in_a_file_decides_the_same(rain, taught):
    file = BytesIO()
    taught.save(file)
    again = Guard.load(BytesIO(file.getvalue()), judge=SceneRisk)
    said, as_before = (
        [(one.executed, one.risk_proposed) for one in rain().play(guard, 900)[0]]
        for guard in (again, taught)
    )
    assert said == as_before


def test_between_two_fits_it_is_kept_as_it_is(rain):
    world = rain()
    judge = world.judge()
    guard = Guard(n_actions=3, interval=1.0, judge=judge)
    failures(world, guard, range(12))
    world.steps = 4
    failures(world, guard, range(100, 101))
    file = BytesIO()
    judge.save(file)
    again = SceneRisk.load(BytesIO(file.getvalue()))
    assert again.sums(0) == judge.sums(0)
    assert again.memory.fitted == judge.memory.fitted
    world.steps = 40
    guard.freeze()
    other = Guard(n_actions=3, interval=1.0, judge=again)
    other.freeze()
    for one, two in zip(world.play(guard, 901)[0], world.play(other, 901)[0], strict=True):
        assert one.executed == two.executed
        assert one.risk_proposed == two.risk_proposed


def test_the_shape_of_what_is_too_close_is_learnt():
    random = np.random.default_rng(0)
    start = random.uniform(-10.0, 10.0, (4000, 2))
    end = start + random.normal(0.0, 0.3, (4000, 2))
    met = closest(start, end, np.array([4.0, 1.0])) < 1.0
    failed = [(start[[k]], end[[k]]) for k in np.flatnonzero(met)[:40]]
    contact = learn((start[~met], end[~met]), failed, np.array([5.0, 5.0]))
    assert contact.sides[0] / contact.sides[1] == pytest.approx(4.0, rel=0.4)
    at = np.array([[0.0, 0.0], [3.0, 0.0], [0.0, 0.7], [6.0, 0.0], [0.0, 1.6]])
    risk = contact.of(np.repeat(at[:, None], 3, axis=1))[:, -1]
    assert (risk[:3] > 0.3).all()
    assert (risk[3:] < 0.05).all()
    assert (np.diff(contact.risk) <= 0.0).all()
    coming = contact.of(np.array([[9.0, 0.0], [6.0, 0.0], [2.0, 0.0], [9.0, 0.0]]))
    assert coming[0] < 0.05 < 0.3 < coming[1] == coming[2]


def test_rows_that_are_not_in_use_or_not_seen_are_no_objects():
    layout = Layout(4)
    ego, car = [1.0, 10.0, 4.0, 20.0], [1.0, 15.0, 0.0, -2.0]
    assert len(layout.read(ego + car + [0.0] * 4).away) == 1
    assert len(layout.read(ego + car[:3] + [np.nan]).away) == 0
    assert Layout(4, relative=False).read(ego + car).away.tolist() == [[5.0, -4.0]]


@pytest.mark.parametrize(
    ("made", "why"),
    [
        (lambda: Layout(4, (0, 1)), "place"),
        (lambda: Layout(3, (1, 2)), "place"),
        (lambda: Layout(4).read(np.ones(7)), "7 numbers are no rows of 4"),
        (lambda: SceneRisk(0.0, 3), "dt"),
        (lambda: Guard(n_actions=4, interval=1.0, judge=SceneRisk(1.0, 3)), "3 choices"),
        (lambda: Guard(low=-1, high=1, interval=1.0, judge=SceneRisk(1.0, 3)), "3 choices"),
    ],
)
def test_what_it_cannot_be_made_of_is_refused(made, why):
    with pytest.raises(ValueError, match=why):
        made()
