"""Scenes: which objects one may meet, as pairs, and the judge of the worst of them."""

import numpy as np
import pytest

from evofsm.driving import LatentRisk, Object, Scene, TrafficRisk, guard_for_cars, guard_for_traffic
from evofsm.driving.traffic import Role, pairs_of
from evofsm.guard import Mode, Situation

LOW, HIGH, DECEL, INTERVAL = -9.0, 2.5, 4.5, 0.1
ME = Object("me", x=100.0, y=0.0, vx=20.0)
SLOWER = Object("me", x=0.0, y=0.0, vx=15.0)
ACTIONS = np.array([2.5, 0.0, -4.5, -9.0])


# -- Pairs -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("other", "pair"),
    [
        (Object("a", 130.0, 0.3, 15.0, length=12.0), (Role.AHEAD, 1, 21.5, 20.0, 15.0)),
        (Object("b", 90.0, 0.0, 25.0), (Role.BEHIND, 1, 5.0, 25.0, 20.0)),
        (Object("c", 105.0, 3.5, 20.0), None),  # keeps to the next lane
        (Object("d", 115.0, 3.5, 20.0, vy=-1.0), (Role.CUTTING_IN, 1, 10.0, 20.0, 20.0)),
        (Object("e", 115.0, -3.5, 20.0, vy=1.0), (Role.CUTTING_IN, 1, 10.0, 20.0, 20.0)),
        (Object("f", 115.0, 3.5, 20.0, vy=1.0), None),  # moves away
        (Object("i", 130.0, 0.0, -25.0), (Role.ONCOMING, 1, 25.0, 20.0, -25.0)),
        # Who crosses is as long along the road as it is wide.
        (
            Object("g", 120.0, -6.0, 0.0, vy=4.0, length=2.0, width=0.6),
            (Role.CROSSING, 1, 17.2, 20.0, 0.0),
        ),
        (Object("h", 80.0, -6.0, 0.0, vy=4.0), None),  # crosses behind
        # Who stands lies along the road, whatever a sensor says of its speed.
        (Object("l", 130.0, 0.0, 0.0, vy=0.5, length=12.0), (Role.AHEAD, 1, 21.5, 20.0, 0.0)),
        (Object("m", 125.0, 4.5, 0.0, vy=-0.9, length=12.0), (Role.CROSSING, 1, 21.6, 20.0, 0.0)),
        (Object("m", 115.0, 4.0, 0.0, vy=-0.01, length=12.0, width=2.5), None),
        (Object("j", 99.5, 3.5, 20.0, vy=-1.0), None),  # is beside, and comes closer
        (Object("k", 90.0, 3.5, 25.0, vy=-1.0), None),  # will be behind
    ],
)
def test_whom_one_may_meet_is_a_pair(other, pair):
    found = pairs_of(Scene(ME, [other]).rows(most=1))
    assert [one[:5] for one in found] == ([] if pair is None else [pair])


def test_rows_hold_the_closest_and_zeros_where_there_is_none():
    far, near = Object("far", 180.0, 0.0, 20.0), Object("near", 120.0, 0.0, 20.0)
    assert [pair.gap for pair in pairs_of(Scene(ME, [far, near]).rows(most=2))] == [15.0, 75.0]
    rows = Scene(ME, [far, near]).rows(most=1).reshape(2, 8)
    assert rows[1].tolist() == [1.0, 120.0, 0.0, 20.0, 0.0, 5.0, 1.8, 0.0]
    assert not Scene(ME).rows(most=3)[8:].any()
    aside = [Object("aside", 100.0 + k, 6.0, 0.0) for k in range(9)]
    assert [pair.gap for pair in pairs_of(Scene(ME, [*aside, far, near]).rows(most=2))] == [15, 75]


# -- The judge ---------------------------------------------------------------------------------


def judge():
    return TrafficRisk(LatentRisk(-DECEL, INTERVAL, decel=DECEL, leader_decel=9.0))


def scene(*others):
    return Scene(SLOWER, others).rows(most=2)


def at(rows):
    return Situation(np.asarray(rows), np.ones(1), None, np.nan, 0.0)


def decide(rows, proposal=1.0):
    return guard_for_traffic(LOW, HIGH, DECEL, INTERVAL).decide(rows, proposal)


def ahead(gap, speed):
    return Object("ahead", gap + 5.0, 0.0, speed)


def behind(gap, speed):
    return Object("behind", -gap - 5.0, 0.0, speed)


def test_one_leader_is_judged_as_by_the_kinematic_judge():
    alone = LatentRisk(-DECEL, INTERVAL, decel=DECEL, leader_decel=9.0)
    expected = alone.judge(at([22.0, 15.0, 12.0]), ACTIONS)
    found = judge().judge(at(scene(ahead(22, 12))), ACTIONS)
    np.testing.assert_array_equal(found.risk, expected.risk)
    np.testing.assert_array_equal(found.critical, expected.critical)


def test_an_empty_road_has_no_risk_but_of_what_is_not_seen_it_is_not_known():
    assert not judge().judge(at(scene()), ACTIONS).risk.any()
    near, far = ahead(3.0, 0.0), ahead(300.0, 15.0)
    for column, risks in (("vx", (np.nan, 1.0)), ("ax", (1.0, 1.0)), ("width", (1.0, 1.0))):
        unseen = near._replace(**{column: np.nan})
        for others, risk in zip(((unseen, far), (unseen, near)), risks, strict=True):
            revision = decide(scene(*others))
            np.testing.assert_equal(revision.risk_proposed, risk)
            assert f"not seen: object 1 {column}; " in revision.reason
    assert decide(scene(near._replace(x=np.nan))).reason.endswith("its risk is not known yet")
    unseen = decide(Scene(SLOWER._replace(vx=np.nan), [behind(60.0, 15.0)]).rows(2))
    assert unseen.reason == "not seen: own vx; its risk is not known yet"


def test_the_risk_is_that_of_the_worst_and_names_it():
    one = judge()
    cutting_in = Object("in", 13.0, 3.5, 5.0, vy=-2.0)
    several = one.judge(at(scene(ahead(60, 15), cutting_in)), ACTIONS)
    assert one.worst.role is Role.CUTTING_IN
    assert several.risk[0] == 1.0
    assert "object 1, cutting in" in one.why(several)


def test_whoever_crosses_is_braked_for_and_who_comes_towards_one_in_full():
    walker = Object("walker", 28.3, -3.0, 0.0, vy=1.5, length=0.5, width=0.5)
    revision = decide(scene(walker))
    assert revision.executed <= -4.0
    assert "crossing" in revision.reason
    assert decide(scene(walker._replace(y=3.0))).executed == 1.0
    assert decide(scene(ahead(400.0, -25.0))).executed == 1.0
    revision = decide(scene(ahead(80.0, -25.0)))
    assert (revision.risk_proposed, revision.executed) == (1.0, LOW)
    assert "object 1, oncoming" in revision.reason
    assert "nothing can" in revision.reason


def test_a_proposal_is_kept_or_changed_as_little_as_it_can_be():
    assert decide(scene(ahead(100, 15))).executed == 1.0
    rows = scene(ahead(15.0, 15))  # who keeps the speed there survives
    revision = decide(rows, 2.5)
    assert LOW < revision.executed < 2.5
    assert revision.risk_executed <= 0.02
    assert judge().judge(at(rows), [revision.executed + 0.3]).risk[0] > 0.018


def test_braking_that_would_be_hit_from_behind_is_as_risky():
    risk = judge().judge(at(scene(behind(6.0, 15.0))), ACTIONS).risk
    assert risk.tolist() == [0.0, 0.0, 1.0, 1.0]
    assert not judge().judge(at(scene(behind(60.0, 15.0))), ACTIONS).risk.any()


@pytest.mark.parametrize("gap", [5.0, 0.4, -0.1])
def test_proposed_braking_is_not_softened_for_who_is_behind(gap):
    revision = decide(scene(behind(gap, 15.0)), -4.0)
    assert (revision.executed, revision.risk_proposed) == (-4.0, 1.0)
    assert "object 1, behind, survives no braking harder than" in revision.reason
    assert "the proposed braking is kept" in revision.reason
    one = Object("ahead", 14.0, 0.0, 15.0, ax=-4.0)
    assert decide(scene(one, behind(gap, 15.0)), -2.0).executed <= -2.0
    standing = Scene(SLOWER._replace(vx=0.0), [behind(gap + 5.0, 8.0)]).rows(most=1)
    revision = decide(standing, -3.0)
    assert (revision.executed, revision.risk_proposed) == (-3.0, 0.0)


def test_a_gap_that_is_not_safe_is_regained_in_proportion():
    cut_in = [decide(scene(ahead(5.0, v)), 0.0).executed for v in (22.0, 15.0, 10.0, 7.0)]
    assert cut_in[0] == 0.0  # it opens the gap again by itself
    assert -3.0 < cut_in[1] < 0.0  # safe again in 2 s
    assert cut_in[2] == pytest.approx(-3.0)  # not so soon: as hard as is comfortable
    assert cut_in[3] < -3.0  # what avoids a collision that is foreseen
    braking = [(14.0, 0.0), (14.0, 4.0), (14.0, 9.0), (4.0, 9.0)]
    seen = [Object("ahead", gap, 0.0, 15.0, ax=-a) for gap, a in braking]
    gentle, comfortable, hard, hardest = (decide(scene(one), 0.0).executed for one in seen)
    assert gentle > comfortable > hard > hardest == LOW  # no harder than avoids it, held on


def test_one_brakes_no_harder_than_who_is_behind_survives():
    one = Object("ahead", 14.0, 0.0, 15.0, ax=-4.0)
    alone, followed = (decide(scene(one, *others)) for others in ([], [behind(5.0, 15)]))
    assert alone.executed < followed.executed < 0.0
    assert "who is behind survives" in followed.reason
    one = one._replace(ax=-8.0)  # whom one would hit, as it goes on like that
    alone, followed = (decide(scene(one, *others)) for others in ([], [behind(5.0, 15)]))
    assert followed.executed == alone.executed < -4.5


def test_who_is_behind_and_cannot_be_spared_is_braked_for_softly_and_who_stands_stays():
    assert decide(scene(ahead(10.0, 0.0), behind(3.0, 15))).executed == LOW
    revision = decide(scene(ahead(27.0, 0.0), behind(0.5, 15)))
    assert -DECEL <= revision.executed < 0.0
    assert "the softest for ahead" in revision.reason
    me, others = Object("me", 0.0, 0.0, 0.0), [ahead(0.3, 0.0), behind(1.0, 5.0)]
    assert -0.1 < decide(Scene(me, others).rows(most=2)).executed <= 0.0  # who stands stays
    creeping = Scene(me._replace(vx=0.18), [ahead(0.03, 0.0), behind(0.1, 0.3)])
    assert decide(creeping.rows(most=2)).executed < -0.5 * 0.18**2 / 0.03  # and who creeps stops

    guard = guard_for_traffic(LOW, HIGH, DECEL, INTERVAL, mode=Mode.SHADOW)
    rows = Scene(Object("me", 0.0, 0.0, 0.0), [ahead(0.2, 0.0)]).rows(most=2)
    assert guard.decide(rows, 0.0).advised == 0.0


def test_what_it_cannot_work_with_is_refused():
    with pytest.raises(ValueError, match="counts on braking"):
        guard_for_traffic(-4.0, HIGH, DECEL, INTERVAL, judge=judge())
    with pytest.raises(ValueError, match="no rows of 8"):
        decide([1.0, 2.0])
    with pytest.raises(ValueError, match="own vx is -20; x counts along"):
        decide(Scene(ME._replace(vx=-20.0)).rows(1))
    with pytest.raises(ValueError, match=r"v_follower is -20; .*direction"):
        guard_for_cars(LOW, HIGH).decide([8.0, -20.0, -5.0], 1.0)
