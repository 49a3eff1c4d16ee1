"""The latent risk, as its user relies on it: what it counts on, and what it never does."""

import copy
import math

import numba
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from evofsm import driving
from evofsm.driving import IDM, Leader, Scenario, guard_for_cars
from evofsm.driving.judge import LatentRisk, dead_ends_of
from evofsm.driving.rehearsal import HARDEST, critical_decelerations
from evofsm.driving.rehearsal import Body as Follower
from evofsm.fsm.machine import EvolvingFSM
from evofsm.fsm.rules import Novelty
from evofsm.guard.api import Situation

DT = 0.25
MARGIN = 0.5
# Where both brake, positions at the ends of intervals miss at most |a| dt²/8 of the smallest gap;
# a command that comes late rules for a part of an interval, or by its share of all of it.
GAP_TOLERANCE = 0.2
DECEL_TOLERANCE = 0.05

GAPS = st.floats(0.05, 120.0)
SPEEDS = st.one_of(st.just(0.0), st.floats(0.0, 40.0))
ACTIONS = st.floats(-5.0, 3.0)
STEADY = IDM(1.2, 20.0, 1.0, 1.0, 2.5)
HASTY = IDM(2.25, 28.0, 0.8, 0.3, 2.0, lowest=-4.0, highest=2.5)
DECELS = st.floats(1.0, 9.0)
LAGS = st.one_of(st.just(0.0), st.floats(0.0, 1.0))


def critical(gap, speed, leader_speed, action, *, before=0.0, decel=4.0, lag=0.0, dt=DT):
    answer = np.empty(1)
    observation = np.array([gap, speed, leader_speed])
    body = Follower(decel, lag, MARGIN, before, dt)
    critical_decelerations(observation, np.array([action]), body, answer)
    return float(answer[0])


@numba.njit
def smallest_gap(gap, speed, leader_speed, action, before, decel, lag, leader_decel, dt=DT):
    """Driven out in steps of 1 ms: the old command, the new one, and full braking."""
    step = 1e-3
    smallest, tick = gap, 0
    while True:
        time = tick * step
        if time < lag * dt:
            command = before
        elif time < (1.0 + lag) * dt:
            command = action
        else:
            command = -decel
            if speed <= 0.0:
                return smallest
        reached = max(0.0, speed + max(command, -decel) * step)
        leader_reached = max(0.0, leader_speed - leader_decel * step)
        gap += 0.5 * (leader_speed + leader_reached - speed - reached) * step
        speed, leader_speed = reached, leader_reached
        smallest = min(smallest, gap)
        tick += 1


# -- Rehearsal ------------------------------------------------------------------------------


@settings(max_examples=400)
@given(GAPS, SPEEDS, SPEEDS, ACTIONS, ACTIONS, DECELS, LAGS, st.sampled_from([DT, 2.0]))
@example(5.0, 20.0, 25.0, -2.0, -2.0, 2.0, 0.0, DT)  # a faster leader who brakes harder
@example(3.0, 20.0, 15.0, -4.0, 0.0, 9.0, 0.0, 2.0)  # nearest within an interval
@example(2.0, 0.0, 10.0, 0.0, 0.0, 4.0, 0.0, DT)  # who stands is never hit
@example(0.3, 0.0, 0.0, -2.0, 0.0, 4.0, 0.0, DT)
@example(100.0, 2.0, 30.0, 0.0, 0.0, 4.0, 0.0, DT)  # nor who is left behind
@example(5.0, 30.0, 0.0, -4.0, 0.0, 4.0, 0.0, DT)  # this collision needs no braking leader
@example(-0.1, 0.0, 0.0, -4.0, 0.0, 4.0, 0.0, DT)
def test_the_critical_deceleration_agrees_with_driving_it_out(
    gap, speed, leader_speed, action, before, decel, lag, dt
):
    lag = lag if dt == DT else 0.0
    told = {"before": before, "decel": decel, "lag": lag}
    hardest = critical(gap, speed, leader_speed, action, **told, dt=dt)
    stays = speed == 0.0 and action <= 0.0 and (before <= 0.0 or lag == 0.0)
    kept = 0.0 if stays else MARGIN

    def left(leader_decel):
        return smallest_gap(gap, speed, leader_speed, action, before, decel, lag, leader_decel, dt)

    assert 0.0 <= hardest <= HARDEST
    if hardest > DECEL_TOLERANCE:
        assert left(hardest - DECEL_TOLERANCE) > kept - GAP_TOLERANCE
    if hardest < HARDEST:
        assert left(hardest + DECEL_TOLERANCE) < kept + GAP_TOLERANCE
    if left(0.0) < kept - GAP_TOLERANCE:
        assert hardest == 0.0


@given(asked=st.tuples(*[st.floats(-1e100, 1e100)] * 4), decel=st.floats(5e-324, 1e100))
@example(asked=(1e30, 1e18, 0.0, 0.0), decel=4.0)
@example(asked=(1e100, 1e100, 1e-300, 1.0), decel=5e-324)
def test_a_rehearsal_of_any_numbers_ends(asked, decel, ends_in_time):
    with ends_in_time():
        assert 0.0 <= critical(*asked, decel=decel) <= HARDEST


@given(GAPS, SPEEDS, ACTIONS, st.floats(-0.3, -1e-9))
def test_a_sensor_that_shows_a_standing_car_as_rolling_back_changes_nothing(
    gap, speed, action, rolling
):
    assert critical(gap, speed, rolling, action) == critical(gap, speed, 0.0, action)
    assert critical(gap, rolling, speed, action) == critical(gap, 0.0, speed, action)


# -- Latent risk ------------------------------------------------------------------------------


def situation(gap, speed, leader_speed, belief=(1.0,)):
    return Situation(np.array([gap, speed, leader_speed]), np.array(belief), 0, math.nan, 0.0)


def test_who_stands_may_stay_however_long_the_leader_is_not_seen():
    risk, away = LatentRisk(lowest=-6.0, dt=0.1), (math.nan, 0.0, math.nan)
    for seen in [(3.0, 0.0, 0.0)] * 3 + [away] * 80:
        risk.learn(seen, 0.0)
    assert risk.judge(situation(*away), [0.0, 1.0]).risk.tolist() == [0.0, 1.0]


@given(GAPS, SPEEDS, SPEEDS)
def test_risk_lies_in_its_interval_and_grows_with_the_acceleration(gap, speed, leader_speed):
    risk = LatentRisk(lowest=-2.5)
    risk.manoeuvres.remember(2.5, 3.0, 3.5, 4.5)
    judged = risk.judge(situation(gap, speed, leader_speed), np.linspace(-2.5, 2.5, 11))
    assert (np.diff(judged.risk) >= -1e-12).all()
    assert ((judged.low >= 0.0) & (judged.low <= judged.risk + 1e-12)).all()
    assert ((judged.high <= 1.0) & (judged.high >= judged.risk - 1e-12)).all()
    assert judged.evidence == 4
    said = "leaders: 4 given or seen, the hardest by 4.5 m/s², and one assumed, by 10.0 "
    assert f"manoeuvres of {said}" in risk.told_by_experience


@pytest.mark.parametrize(
    ("observation", "acceleration", "named"),
    [
        ([-math.inf, 20.0, 20.0], 0.0, "observation"),
        ([30.0, math.inf, -math.inf], 0.0, "observation"),
        ([30.0, 20.0], 0.0, "observation"),
        ([[30.0, 20.0, 20.0]], 0.0, "observation"),
        ([30.0, 20.0, 20.0], math.nan, "acceleration"),
        ([30.0, 20.0, 20.0], None, "acceleration"),
        (np.array([30.0, math.inf, 20.0]), 0.0, "observation"),
        (np.array([30.0, 20.0, 20.0]), math.inf, "acceleration"),
    ],
)
def test_bad_input_is_named_and_changes_nothing(snapshot, observation, acceleration, named):
    risk = LatentRisk(lowest=-4.0)
    risk.manoeuvres.remember(2.5, 6.0)
    for k in range(8):
        risk.learn([30.0, 20.0, 20.0 * 0.9**k], -4.0)
    before, twin = snapshot(risk), copy.deepcopy(risk)
    for call in (
        *(risk.learn, risk.follow, lambda seen, did: risk.critical(seen, [did])),
        lambda seen, did: risk.judge(situation(9, 9, 9)._replace(observation=seen), [did]),
    ):
        with pytest.raises((TypeError, ValueError), match=named):
            call(observation, acceleration)
    assert snapshot(risk) == before
    for one in (risk, twin):  # nor is it confused about what is under way
        for k in range(8, 20):
            one.learn([30.0, 20.0, 20.0 * 0.9**k], -4.0)
        one.end(None, failed=False)
    assert snapshot(risk) == snapshot(twin) != before


@pytest.mark.parametrize(
    ("name", "wrong"),
    [("lowest", math.nan), ("dt", 0.0), ("own_brakes", -1.0), ("margin", math.inf)],
)
def test_settings_that_cannot_be_right_are_refused(name, wrong):
    with pytest.raises(ValueError, match="must be"):
        LatentRisk(**{"lowest": -2.5, name: wrong})


# -- In proportion ----------------------------------------------------------------------------


def cars(worst):
    return guard_for_cars(low=-4.0, high=2.5, judge=LatentRisk(-4.0, decel=4.0, leader_decel=worst))


@pytest.mark.parametrize("ahead", [18.0, 20.0, 22.0])
@pytest.mark.parametrize("proposal", [0.0, 1.0])
def test_in_a_smaller_gap_one_never_brakes_less(proposal, ahead):
    gaps = np.arange(0.5, 45.0, 0.5)
    found = [cars(6.0).decide([gap, 20.0, ahead], proposal).executed for gap in gaps]
    assert (np.diff(found) >= 0.0).all()
    assert found[-1] == proposal
    assert -3.3 < found[4] < 0.0  # nothing is foreseen: as hard as is comfortable, to an option


@given(st.floats(0.5, 40.0), st.floats(5.0, 40.0), SPEEDS, st.floats(-4.0, 2.5))
@example(9.0, 20.0, 15.0, 0.5)
def test_a_reason_says_what_was_looked_at(gap, speed, ahead, proposal):
    guard = cars(9.0)
    chosen = guard.decide([gap, speed, ahead], proposal)
    options = np.array([chosen.executed, chosen.executed + 0.3])
    avoids, regains = guard.judge._foreseen((gap, speed, ahead), 0.0, options, 0.02)
    said = chosen.reason.rpartition("; ")[2]
    if "avoids" in said or "regains" in said:
        assert (regains if "regains" in said else avoids)[0]
    if "least" in said and "avoids" in said and options[1] <= proposal:
        assert not avoids[1]


@pytest.mark.parametrize("noise", [(0.0, 0.0, 0.0), (0.5, 0.3, 0.3)])
def test_who_comes_towards_one_is_no_car_that_stands(noise):
    guard = cars(9.0)
    guard.freeze()  # which learns no other noise
    guard.judge.perception.noise = noise
    gaps = np.arange(240.0, 180.0, -10.0)
    first, *_, last = (guard.decide([gap, 20.0, -20.0], 1.0) for gap in gaps)
    assert (first.risk_proposed, first.executed) == (0.0, 1.0)
    assert (last.risk_proposed, last.executed) == (1.0, -4.0)
    assert "avoids" not in last.reason


def test_who_is_pushed_does_not_creep_up_to_a_leader_that_stands():
    judge = LatentRisk(-6.0, 0.1, decel=6.0, leader_decel=9.0)
    guard, gap, speed = guard_for_cars(-6.0, 2.5, 0.1, judge=judge), 20.0, 8.0
    for _ in range(60):
        revision = guard.decide([gap, speed, 0.0], 0.5)
        # A gap that is too small is not regained by stopping in it.
        assert gap > judge.margin or "regains" not in revision.reason
        reached = max(speed + 0.1 * revision.executed, 0.0)
        gap, speed = gap - 0.05 * (speed + reached), reached
    assert (speed, gap > 0.1) == (0.0, True)


@pytest.mark.parametrize(("comfort", "is_late"), [(3.0, True), (6.0, False)])
def test_guards_in_a_row_make_each_other_late_unless_they_brake_in_full_at_once(comfort, is_late):
    how = {"decel": 6.0, "leader_decel": 9.0, "comfort": comfort}
    judges = [LatentRisk(-6.0, 0.1, **how) for _ in range(3)]
    guards = [guard_for_cars(-6.0, 2.5, 0.1, judge=one) for one in judges]
    places, speeds, smallest = np.arange(150.0, -1.0, -50.0), np.full(4, 20.0), np.inf
    for k in range(160):
        rows = np.column_stack([-np.diff(places) - 5.0, speeds[1:], speeds[:-1]])
        smallest = min(smallest, rows[:, 0].min())
        deeds = [one.decide(row, 1.0).executed for one, row in zip(guards, rows, strict=True)]
        reached = np.maximum(speeds + 0.1 * np.array([-8.0 if k > 50 else 0.0, *deeds]), 0.0)
        places, speeds = places + 0.05 * (speeds + reached), reached
    assert (smallest <= 0.0) == is_late


def collides(gap, speed, ahead, brakes_at, worst, waves=()):
    """Behind a leader that goes on as it is, or in waves, and then brakes as hard as is assumed."""
    leader = Leader(STEADY, worst, brake_time=brakes_at, initial_speed=ahead, waves=waves)
    drive = Scenario(leader, initial_gap=gap, initial_speed=speed)
    return driving.drive(cars(worst), drive, controller=HASTY).collided


@pytest.mark.parametrize("gap", [3.0, 10.0, 18.0, 25.0, 32.0])
def test_after_some_seconds_a_gap_survives_what_is_assumed_of_leaders(gap):
    assert collides(gap, 20.0, 20.0, 0.0, 9.0)  # too small at first
    assert not collides(gap, 20.0, 20.0, 8.0, 9.0)


@given(SPEEDS, st.floats(5.0, 30.0), st.floats(0.0, 12.0), st.data())
@settings(max_examples=40)
def test_who_keeps_to_a_gap_that_is_safe_survives_whatever_the_leader_does(speed, ahead, at, data):
    more = [(float(k), data.draw(st.floats(-2.0, 2.0))) for k in range(12)]
    speed = min(speed, ahead + 3.0)
    gap = GAP_TOLERANCE + MARGIN
    while critical(gap, speed, ahead, 0.0) < 6.0:
        gap += 0.25
    assert not collides(gap, speed, ahead, at, 6.0, tuple(more))


# -- In files ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("gentle", -5.0, "gentle of -5"),
        ("full", 1e8, r"full of 1e\+08"),
        ("lowest", -1e308, r"lowest of -1e\+308"),
    ],
)
def test_a_risk_that_no_drive_could_have_left_is_refused(forge, tmp_path, name, value, words):
    risk = LatentRisk(lowest=-2.5)
    risk.manoeuvres.remember(4.0)
    for step in range(12):
        risk.learn([30.0, 30.0 - 0.625 * step, 20.0], -2.5)
    risk.save(tmp_path / "risk")
    forge(tmp_path / "risk", {name: value})
    with pytest.raises(ValueError, match=words):
        LatentRisk.load(tmp_path / "risk")


def test_a_risk_that_saw_jumps_and_odd_numbers_is_kept_and_read_again(snapshot, reloaded):
    random = np.random.default_rng(0)
    odd = (0.0, 1e-9, 1.0, 30.0, 200.0, 1e9, 1e100, np.nan)
    for dt in (0.01, 0.25, 10.0):
        risk = LatentRisk(lowest=-2.5, dt=dt)
        for turn in range(300):
            risk.learn(random.choice(odd, 3), random.choice([-2.5, 1.0, -1e100, 1e100]))
            if turn % 100 == 0:
                risk.end(None, failed=False)
        assert snapshot(reloaded(risk)) == snapshot(risk)


def test_states_are_judged_at_their_centres():
    machine = EvolvingFSM(n_actions=1, rule=Novelty(radius=1.0, scales=(4.0, 2.0, 2.0)))
    machine.learn_many([[80.0, 5.0, 5.0], [3.0, 25.0, 25.0]], [0, 0])
    risk = LatentRisk(-4.0, decel=4.0, leader_decel=8.0)
    assert dead_ends_of(machine.model(), risk) == [1]
    brink = EvolvingFSM(n_actions=1)
    brink.observe([7.0, 10.0, 10.0])  # full braking saves, keeping the speed does not
    assert dead_ends_of(brink, risk) == []
