"""The judge among many cars: the worst of the pairs."""

import numpy as np
import pytest

from evofsm.driving import LatentRisk, Object, Role, Scene, TrafficRisk, guard_for_traffic
from evofsm.guard import Situation

LOW, HIGH, DECEL, INTERVAL = -9.0, 2.5, 4.5, 0.1
ME = Object("me", x=0.0, y=0.0, vx=15.0)
ACTIONS = np.array([2.5, 0.0, -4.5, -9.0])


def judge():
    return TrafficRisk.told(LOW, HIGH, DECEL, INTERVAL)


def situation(*others, me=ME):
    return Situation(Scene(me, others).rows(most=4), np.ones(1), None, np.nan, 0.0)


def ahead(gap, speed, name="ahead"):
    return Object(name, gap + 5.0, 0.0, speed)


def behind(gap, speed):
    return Object("behind", -gap - 5.0, 0.0, speed)


def test_one_leader_is_judged_as_by_the_kinematic_judge():
    told = LatentRisk.told(-DECEL, DECEL, 9.0, INTERVAL)
    alone = Situation(np.array([22.0, 15.0, 12.0]), np.ones(1), None, np.nan, 0.0)
    expected, found = told.judge(alone, ACTIONS), judge().judge(situation(ahead(22, 12)), ACTIONS)
    np.testing.assert_array_equal(found.risk, expected.risk)
    np.testing.assert_array_equal(found.critical, expected.critical)


def test_an_empty_road_has_no_risk():
    assert not judge().judge(situation(), ACTIONS).risk.any()


def test_the_risk_is_that_of_the_worst_and_names_it():
    one = judge()
    several = one.judge(situation(ahead(60, 15), Object("in", 13.0, 3.5, 5.0, vy=-2.0)), ACTIONS)
    assert one.worst.role is Role.CUTTING_IN
    assert several.risk[0] == 1.0
    assert "object 1, cutting in" in one.why(several)


def test_whoever_crosses_is_braked_for():
    guard = guard_for_traffic(LOW, HIGH, DECEL, INTERVAL)
    walker = Object("walker", 28.3, -3.0, 0.0, vy=1.5, length=0.5, width=0.5)
    revision = guard.decide(Scene(ME, [walker]).rows(most=1), 1.0)
    assert revision.executed <= -4.0
    assert "crossing" in revision.reason
    gone = walker._replace(y=3.0)
    assert guard.decide(Scene(ME, [gone]).rows(most=1), 1.0).executed == 1.0


def test_a_proposal_is_kept_or_changed_as_little_as_it_can_be():
    guard = guard_for_traffic(LOW, HIGH, DECEL, INTERVAL)
    assert guard.decide(Scene(ME, [ahead(100, 15)]).rows(1), 1.0).executed == 1.0
    rows = Scene(ME, [ahead(14.0, 15)]).rows(1)
    revision = guard.decide(rows, 2.5)
    assert LOW < revision.executed < 2.5
    assert revision.risk_executed <= 0.02
    bolder = revision.executed + 0.3
    here = Situation(rows, np.ones(1), None, np.nan, 0.0)
    assert judge().judge(here, [bolder]).risk[0] > 0.018


def test_braking_that_would_be_hit_from_behind_is_as_risky():
    risk = judge().judge(situation(behind(6.0, 15.0)), ACTIONS).risk
    assert risk.tolist() == [0.0, 0.0, 1.0, 1.0]
    assert not judge().judge(situation(behind(60.0, 15.0)), ACTIONS).risk.any()


def test_one_brakes_no_harder_than_who_is_behind_survives():
    guard = guard_for_traffic(LOW, HIGH, DECEL, INTERVAL)
    alone = guard.decide(Scene(ME, [ahead(9.0, 15)]).rows(2), 1.0)
    followed = guard.decide(Scene(ME, [ahead(9.0, 15), behind(14.0, 15)]).rows(2), 1.0)
    assert alone.executed == LOW  # a leader who brakes in full could not be survived
    assert LOW < followed.executed < 0.0
    assert "who is behind survives" in followed.reason


def test_what_is_sure_ahead_weighs_more_than_who_is_behind():
    guard = guard_for_traffic(LOW, HIGH, DECEL, INTERVAL)
    rows = Scene(ME, [ahead(10.0, 0.0), behind(3.0, 15)]).rows(2)
    assert guard.decide(rows, 1.0).executed == LOW


def test_where_who_is_behind_cannot_be_spared_one_brakes_as_softly_as_one_can():
    guard = guard_for_traffic(LOW, HIGH, DECEL, INTERVAL)
    rows = Scene(ME, [ahead(27.0, 0.0), behind(0.5, 15)]).rows(2)
    revision = guard.decide(rows, 1.0)
    assert -DECEL <= revision.executed < 0.0
    assert "the softest for ahead" in revision.reason
    here = Situation(rows, np.ones(1), None, np.nan, 0.0)
    assert (
        judge()
        .ahead.judge(
            here._replace(observation=np.array([27.0, 15.0, 0.0])), [revision.executed + 0.25]
        )
        .risk[0]
        > 0.02
    )


def test_hard_braking_of_the_driver_is_softened_for_who_is_behind():
    guard = guard_for_traffic(LOW, HIGH, DECEL, INTERVAL)
    revision = guard.decide(Scene(ME, [behind(12.0, 15)]).rows(1), -9.0)
    assert -9.0 < revision.executed < 0.0
    assert "object 1, behind" in revision.reason


@pytest.mark.parametrize(
    ("other", "risk"),
    [
        (Object("beside", 1.0, 3.5, 15.0), 1.0),
        (Object("fast", -15.0, 3.5, 28.0), 1.0),
        (Object("slow", 9.0, 3.5, 5.0), 1.0),
        (Object("far", 90.0, 3.5, 15.0), 0.0),
        (Object("far behind", -90.0, 3.5, 15.0), 0.0),
    ],
)
def test_a_lane_change_is_judged_by_who_is_there(other, risk):
    here = situation(other)
    assert judge().judge_change(here, to=3.5).risk[0] == risk
    assert judge().judge_change(here, to=-3.5).risk[0] == 0.0


def test_what_was_taught_of_leaders_is_used():
    one = judge()
    near = situation(ahead(9.0, 15))
    assert one.judge(near, [0.0]).risk[0] == 1.0
    one.ahead.manoeuvres.remember(*[3.0] * 200)
    assert one.judge(near, [0.0]).risk[0] < 0.02


@pytest.mark.parametrize(("low", "high"), [(0.0, 1.0), (-1.0, -0.5), (-np.inf, 1.0)])
def test_limits_that_are_none_are_refused(low, high):
    with pytest.raises(ValueError, match="around 0"):
        TrafficRisk.told(low, high, DECEL, INTERVAL)


def test_a_set_of_actions_that_is_too_small_is_refused():
    with pytest.raises(ValueError, match="looks at accelerations"):
        guard_for_traffic(-5.0, HIGH, DECEL, INTERVAL, judge=judge())
