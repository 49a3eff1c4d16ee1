"""The latent risk, as its user relies on it: what it counts on, and what it never does."""

import copy
import math

import numba
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from studies.counts import OutcomeCounts

from evofsm.driving.measures import is_dead_end
from evofsm.driving.risk.brakes import OwnBrakes
from evofsm.driving.risk.by_state import RiskByState, assess_states
from evofsm.driving.risk.latent import LatentRisk
from evofsm.driving.risk.manoeuvres import BrakeWatch, Manoeuvres
from evofsm.driving.risk.ranges import hardest_seen
from evofsm.driving.risk.rehearsal import HARDEST, Body, critical_decelerations
from evofsm.fsm.machine import EvolvingFSM
from evofsm.fsm.states.novelty import Novelty
from evofsm.guard.protocols import Situation

DT = 0.25
MARGIN = 0.5
# Where both brake, positions at the ends of intervals miss at most |a| dt²/8 of the smallest gap;
# a command that comes late rules for a part of an interval, or by its share of all of it.
GAP_TOLERANCE = 0.2
DECEL_TOLERANCE = 0.05

GAPS = st.floats(0.05, 120.0)
SPEEDS = st.one_of(st.just(0.0), st.floats(0.0, 40.0))
ACTIONS = st.floats(-5.0, 3.0)
DECELS = st.floats(1.0, 9.0)
LAGS = st.one_of(st.just(0.0), st.floats(0.0, 1.0))
ONSETS = st.integers(0, 12)


def critical(gap, speed, leader_speed, action, *, before=0.0, decel=4.0, lag=0.0, onset=0):
    answer = np.empty(1)
    observation = np.array([gap, speed, leader_speed])
    body = Body(decel, lag, MARGIN)
    critical_decelerations(observation, np.array([action]), before, body, onset, DT, answer)
    return float(answer[0])


@numba.njit
def smallest_gap(gap, speed, leader_speed, action, before, decel, lag, onset, leader_decel):
    """Driven out in steps of 1 ms: the old command, the new one, and full braking."""
    step = 1e-3
    smallest, tick = gap, 0
    while True:
        time = tick * step
        if time < lag * DT:
            command = before
        elif time < (1.0 + lag) * DT:
            command = action
        else:
            command = -decel
            if speed <= 0.0:
                return smallest
        braking = -leader_decel if time >= onset * DT - 1e-9 else 0.0
        reached = max(0.0, speed + max(command, -decel) * step)
        leader_reached = max(0.0, leader_speed + braking * step)
        gap += 0.5 * (leader_speed + leader_reached - speed - reached) * step
        speed, leader_speed = reached, leader_reached
        smallest = min(smallest, gap)
        tick += 1


# -- Rehearsal ----------------------------------------------------------------------------------


@pytest.mark.slow
@settings(max_examples=400)
@given(GAPS, SPEEDS, SPEEDS, ACTIONS, ACTIONS, DECELS, LAGS, ONSETS)
def test_the_critical_deceleration_agrees_with_driving_it_out(
    gap, speed, leader_speed, action, before, decel, lag, onset
):
    hardest = critical(
        gap, speed, leader_speed, action, before=before, decel=decel, lag=lag, onset=onset
    )
    stays = speed == 0.0 and max(action, before) <= 0.0
    kept = 0.0 if stays else MARGIN

    def left(leader_decel):
        return smallest_gap(
            gap, speed, leader_speed, action, before, decel, lag, onset, leader_decel
        )

    assert 0.0 <= hardest <= HARDEST
    if hardest > DECEL_TOLERANCE:
        assert left(hardest - DECEL_TOLERANCE) > kept - GAP_TOLERANCE
    if hardest < HARDEST:
        assert left(hardest + DECEL_TOLERANCE) < kept + GAP_TOLERANCE


@pytest.mark.slow
@given(GAPS, SPEEDS, SPEEDS, ACTIONS, ACTIONS, DECELS, LAGS, ONSETS, st.floats(0.0, 20.0))
def test_the_critical_deceleration_is_monotonic(
    gap, speed, leader_speed, action, before, decel, lag, onset, more
):
    def at(gap=gap, action=action, decel=decel):
        return critical(
            gap, speed, leader_speed, action, before=before, decel=decel, lag=lag, onset=onset
        )

    rounding = HARDEST / 2**9
    assert at(gap=gap + more) >= at() - rounding
    assert at(decel=decel + more) >= at() - rounding
    assert at(action=action + more) <= at() + rounding


@given(st.floats(1.0, 120.0), SPEEDS, SPEEDS, DECELS, st.floats(0.5, 14.0))
def test_braking_at_once_agrees_with_the_oracle_of_dead_ends(
    gap, speed, leader_speed, decel, leader_decel
):
    hardest = critical(gap, speed, leader_speed, -decel, before=-decel, decel=decel)
    assume(abs(hardest - leader_decel) > DECEL_TOLERANCE)
    if hardest > leader_decel:
        assert not is_dead_end(np.array([gap, speed, leader_speed]), decel, leader_decel)
    else:
        assert is_dead_end(np.array([gap - MARGIN, speed, leader_speed]), decel, leader_decel)


def test_who_stands_or_is_left_behind_is_never_hit():
    assert critical(2.0, 0.0, 10.0, 0.0) == HARDEST
    assert critical(0.3, 0.0, 0.0, -2.0) == HARDEST
    assert critical(100.0, 2.0, 30.0, 0.0) == HARDEST


def test_a_collision_that_needs_no_braking_leader_is_certain():
    assert critical(5.0, 30.0, 0.0, -4.0) == 0.0
    assert critical(-0.1, 0.0, 0.0, -4.0) == 0.0


@given(GAPS, SPEEDS, ACTIONS, st.floats(-0.3, -1e-9))
def test_a_sensor_that_shows_a_standing_car_as_rolling_back_changes_nothing(
    gap, speed, action, rolling
):
    assert critical(gap, speed, rolling, action) == critical(gap, speed, 0.0, action)
    assert critical(gap, rolling, speed, action) == critical(gap, 0.0, speed, action)


# -- One's own brakes ---------------------------------------------------------------------------


def drive(brakes, true_decel, *, rounds=1, speed=25.0, noise=0.0, seed=0, late=0):
    """Speed up and brake in full, in turn; answers what was counted on after each decision."""
    rng = np.random.default_rng(seed)
    counted_on, given = [], [0.0] * (late + 1)
    for _ in range(rounds):
        brakes.clear()
        v = speed
        for k in range(40):
            command = 1.0 if k < 10 else brakes.lowest
            given.append(command)
            brakes.see(max(0.0, v + rng.normal(0.0, noise)), command)
            counted_on.append(brakes.decel)
            v = max(0.0, v + DT * max(given[-1 - late], -true_decel))
    return np.array(counted_on)


def test_full_braking_is_learnt_as_it_is_and_not_as_commanded():
    brakes = OwnBrakes(lowest=-4.5, assumed=0.6, dt=DT)
    assert brakes.decel == pytest.approx(2.7)
    assert not brakes.known
    drive(brakes, 2.5)
    assert brakes.known
    assert brakes.decel == pytest.approx(2.5)


def test_brakes_that_weaken_show_within_seconds_of_braking():
    brakes = OwnBrakes(lowest=-4.5, assumed=0.6, dt=DT)
    drive(brakes, 4.5, rounds=3)
    assert brakes.decel == pytest.approx(4.5)
    brakes.clear()
    speed = 30.0
    for _ in range(round(3.0 / DT)):
        brakes.see(speed, -4.5)
        speed -= DT * 2.5
    assert brakes.decel <= 2.5 + 1e-9


def test_weaker_brakes_show_in_ordinary_braking_too():
    brakes = OwnBrakes(lowest=-4.5, assumed=0.6, dt=DT)
    drive(brakes, 4.5, rounds=3)
    brakes.clear()
    speed = 30.0
    for _ in range(20):
        brakes.see(speed, -3.0)
        speed -= DT * 2.0
    assert brakes.decel <= 2.0 + 1e-9


@given(st.lists(st.floats(0.0, 8.0), min_size=10, max_size=80))
def test_it_never_counts_on_more_than_was_shown(realised):
    brakes = OwnBrakes(lowest=-8.0, assumed=0.6, dt=DT)
    speed = 300.0
    for did in realised:
        brakes.see(speed, -8.0)
        speed -= DT * did
    brakes.see(speed, -8.0)
    least = 0.2 * 8.0  # what calls itself a brake
    assert brakes.decel <= max(*realised[-40:], least) + 1e-9


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("noise", [0.05, 0.3])
def test_noise_on_the_speed_never_makes_brakes_look_good(seed, noise):
    brakes = OwnBrakes(lowest=-4.5, assumed=0.5, dt=DT)
    counted_on = drive(brakes, 2.5, rounds=30, noise=noise, seed=seed)
    assert counted_on.max() <= 1.15 * 2.5
    if noise < 0.1:
        assert counted_on[-1] > 0.7 * 2.5


def test_nothing_is_learnt_from_noise_at_a_standstill():
    rng = np.random.default_rng(0)
    brakes = OwnBrakes(lowest=-2.5, assumed=0.6, dt=DT)
    drive(brakes, 2.5, rounds=3)
    for speed in np.maximum(rng.normal(0.0, 0.3, 2000), 0.0):
        brakes.see(speed, -2.5)
    assert brakes.decel > 2.3


@pytest.mark.parametrize(("late", "lag"), [(0, 0.0), (1, 1.0)])
def test_it_learns_how_late_commands_take_effect(late, lag):
    brakes = OwnBrakes(lowest=-2.5, assumed=0.6, dt=DT)
    drive(brakes, 2.5, rounds=6, late=late)
    assert brakes.lag == pytest.approx(lag, abs=0.05)
    assert brakes.decel == pytest.approx(2.5)


def test_what_is_assumed_of_brakes_is_never_nothing():
    assert OwnBrakes(lowest=-4.0, assumed=1e-9, dt=DT).decel > 0.5


# -- How hard others brake ----------------------------------------------------------------------


@given(st.lists(st.floats(2.5, 30.0), max_size=60), st.floats(1.0, 20.0))
def test_harder_manoeuvres_are_less_likely(decels, assumed):
    manoeuvres = Manoeuvres(assumed)
    manoeuvres.remember(*decels)
    chance = manoeuvres.harder(np.linspace(0.0, HARDEST, 400))
    assert ((chance >= 0.0) & (chance <= 1.0)).all()
    assert (np.diff(chance) <= 1e-12).all()
    assert manoeuvres.harder(HARDEST) == 0.0  # beyond physics
    if decels:
        beyond = max(decels) + 4.0 * np.std(decels) + 0.2
        if beyond < min(assumed, HARDEST) - 0.1:
            assert manoeuvres.harder(beyond) == pytest.approx(1.0 / (len(decels) + 1))


def test_gentle_braking_does_not_water_down_what_hard_braking_may_be():
    manoeuvres = Manoeuvres(assumed=10.0)
    manoeuvres.remember(*[1.5] * 400)
    assert manoeuvres.harder(9.0) == 1.0  # nothing is known of hard braking yet
    manoeuvres.remember(*[7.5] * 30)
    assert manoeuvres.harder(6.0) == pytest.approx(1.0)
    assert manoeuvres.any_harder(6.0) == pytest.approx(31.0 / 431.0)
    assert manoeuvres.any_harder(2.0) == 1.0


def test_old_manoeuvres_are_forgotten():
    manoeuvres = Manoeuvres(assumed=10.0, memory=20)
    manoeuvres.remember(*[8.0] * 20)
    manoeuvres.remember(*[3.0] * 20)
    assert len(manoeuvres) == 20
    assert manoeuvres.harder(5.0) == pytest.approx(1.0 / 21.0)


@pytest.mark.parametrize("decel", [math.nan, math.inf, -1.0])
def test_what_is_no_manoeuvre_is_refused(decel):
    manoeuvres = Manoeuvres(assumed=10.0)
    with pytest.raises(ValueError, match="decel"):
        manoeuvres.remember(3.0, decel)
    assert len(manoeuvres) == 0


def watch_it(watch, speeds, gap=60.0, own=10.0):
    """Manoeuvres of a leader with these speeds; the gap follows from them."""
    told, last = [], speeds[0]
    for speed in speeds:
        gap += 0.5 * watch.dt * (last + speed - 2.0 * own)
        told.append(watch.see(gap, own, speed))
        last = speed
    return [decel for decel in told if decel is not None]


@pytest.mark.parametrize("dt", [0.1, 0.25, 0.5])
@given(decel=st.floats(1.2, 12.0), speed=st.floats(8.0, 40.0))
def test_constant_brakes_are_measured_as_they_are(dt, decel, speed):
    steps = int(speed / (decel * dt))
    assume(steps * dt >= 1.0 + 2 * dt)
    braking = speed - decel * dt * np.arange(steps + 1)
    watch = BrakeWatch(dt)
    told = watch_it(watch, np.concatenate([[speed] * 12, braking, [0.0] * 8]))
    assert told == [pytest.approx(decel)]
    assert not watch.braking


def test_a_manoeuvre_under_way_counts_when_the_episode_ends():
    risk = LatentRisk(lowest=-2.5)
    for k in range(14):
        risk.learn([40.0, 20.0, 20.0 - max(0, k - 5) * DT * 5.0], 0.0)
    assert len(risk.manoeuvres) == 0
    risk.start_episode()
    assert list(risk.manoeuvres.decels) == [pytest.approx(5.0)]


@pytest.mark.parametrize("dt", [0.1, 0.25])
@pytest.mark.parametrize("speed", [0.0, 20.0])
def test_noise_is_no_manoeuvre(dt, speed):
    rng = np.random.default_rng(0)
    watch, told = BrakeWatch(dt), 0
    for noise, own in rng.normal(0.0, 0.2, (round(3600 / dt), 2)):
        seen = watch.see(30.0, max(0.0, speed + own), max(0.0, speed + noise))
        told += seen is not None
    assert told <= 1  # in an hour


@pytest.mark.parametrize("cut_in", [(12.0, 12.0), (30.0, 8.0), (12.0, 20.0), (29.0, 5.0)])
def test_a_car_that_cuts_in_has_not_braked(cut_in):
    watch = BrakeWatch(DT)
    gap, speed = cut_in
    for _ in range(8):
        assert watch.see(30.0, 20.0, 20.0) is None
    for _ in range(8):
        assert watch.see(gap, 20.0, speed) is None
        gap += DT * (speed - 20.0)
    assert watch.end() is None


# -- Latent risk --------------------------------------------------------------------------------


def situation(gap, speed, leader_speed, belief=(1.0,)):
    return Situation(np.array([gap, speed, leader_speed]), np.array(belief), 0, math.nan, 0.0)


@pytest.fixture
def taught():
    """Some learning, in mid-episode."""
    rng = np.random.default_rng(3)
    risk = LatentRisk(lowest=-4.0)
    for _ in range(6):
        speed = leader_speed = 20.0
        gap, decel = 40.0, rng.uniform(3.0, 6.0)
        for k in range(60):
            command = 0.5 if k < 20 else -4.0
            risk.learn([gap, speed, leader_speed], command, rng.dirichlet([1.0, 1.0, 1.0]))
            braking = decel if k > 15 else 0.0
            reached = max(0.0, leader_speed - DT * braking)
            then = max(0.0, speed + DT * max(command, -3.0))
            gap += 0.5 * DT * (leader_speed + reached - speed - then)
            speed, leader_speed = then, reached
        risk.start_episode()
    assert len(risk.manoeuvres) == 6
    assert risk.brakes.known
    return risk


@given(GAPS, SPEEDS, SPEEDS)
def test_risk_lies_in_its_interval_and_grows_with_the_acceleration(gap, speed, leader_speed):
    risk = LatentRisk(lowest=-2.5)
    risk.manoeuvres.remember(2.5, 3.0, 3.5, 4.5)
    judged = risk.judge(situation(gap, speed, leader_speed), np.linspace(-2.5, 2.5, 11))
    assert (np.diff(judged.risk) >= -1e-12).all()
    assert ((judged.low >= 0.0) & (judged.low <= judged.risk + 1e-12)).all()
    assert ((judged.high <= 1.0) & (judged.high >= judged.risk - 1e-12)).all()
    assert judged.evidence == 4


def test_dangerous_and_never_seen_are_told_apart(taught):
    unseen = LatentRisk(lowest=-4.0)
    here = situation(15.0, 25.0, 20.0)
    assert unseen.judge(here, [1.0]).evidence == 0.0
    assert taught.judge(here, [1.0]).evidence == 6.0
    unknown, known = unseen.judge(here, [1.0]), taught.judge(here, [1.0])
    assert unknown.high - unknown.low > known.high - known.low
    assert taught.seconds_seen([1.0, 0.0, 0.0]) > 10.0
    assert taught.seconds_seen([0.0, 0.0, 0.0, 1.0]) == 0.0


def test_frozen_it_still_knows_what_was_commanded_last():
    risk = LatentRisk.told(-4.0, 4.0, 8.0)
    risk.brakes.set_lagged(0.8, 1.0)
    here, chances = situation(30.0, 20.0, 20.0), []
    for command in (-4.0, 2.0):
        risk.follow([30.0, 20.0, 20.0], command)
        chances.append(risk.judge(here, [0.0]).critical[0])
    assert chances[1] < chances[0]


def test_following_learns_nothing(taught, snapshot):
    before = snapshot(taught)
    for k in range(60):
        taught.follow([60.0, 20.0, max(0.0, 20.0 - k)], -4.0)
    taught.start_episode(learn=False)
    assert snapshot(taught) == before


def test_a_question_changes_nothing(taught, snapshot):
    before = snapshot(taught)
    taught.judge(situation(20.0, 20.0, 10.0), [1.0, 0.0])
    taught.probability([20.0, 20.0, 20.0], 1.0, 8.0)
    taught.score(np.array([[20.0, 20.0, 20.0]]), DT)
    assert snapshot(taught) == before


def test_a_copy_goes_its_own_way(taught, snapshot):
    before, other = snapshot(taught), copy.deepcopy(taught)
    for k in range(30):
        other.learn([60.0, 20.0, max(0.0, 20.0 - k)], -4.0, [0.0, 1.0])
    other.start_episode()
    other.brakes.trust(1.0)
    assert snapshot(taught) == before


def test_saved_and_loaded_it_judges_identically(taught, tmp_path, snapshot):
    taught.save(tmp_path / "risk")
    loaded = LatentRisk.load(tmp_path / "risk")
    assert snapshot(loaded) == snapshot(taught)
    rng = np.random.default_rng(0)
    for gap, speed, leader_speed in rng.uniform(0.0, 40.0, (50, 3)):
        judged = [
            risk.judge(situation(gap, speed, leader_speed), [-4.0, 0.0, 2.0])
            for risk in (taught, loaded)
        ]
        for one, other in zip(*judged, strict=True):
            np.testing.assert_array_equal(one, other)
        chances = [
            risk.probability([gap, speed, leader_speed], 1.0, 5.0, [0.2, 0.3, 0.5])
            for risk in (taught, loaded)
        ]
        assert chances[0] == chances[1]


def test_damaged_files_are_refused(taught, tmp_path):
    path = tmp_path / "risk"
    taught.save(path)
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(ValueError, match="risk"):
        LatentRisk.load(path)
    EvolvingFSM(n_actions=2).save(path)
    with pytest.raises(ValueError, match="holds a machine, not a risk"):
        LatentRisk.load(path)
    with pytest.raises(FileNotFoundError):
        LatentRisk.load(tmp_path / "none")


@pytest.mark.parametrize(
    ("observation", "acceleration", "belief", "named"),
    [
        ([-math.inf, 20.0, 20.0], 0.0, [1.0], "observation"),
        ([30.0, math.inf, -math.inf], 0.0, [1.0], "observation"),
        ([30.0, 20.0], 0.0, [1.0], "observation"),
        ([[30.0, 20.0, 20.0]], 0.0, [1.0], "observation"),
        (["near", 20.0, 20.0], 0.0, [1.0], "observation"),
        ([30.0, 20.0, 20.0], math.nan, [1.0], "acceleration"),
        ([30.0, 20.0, 20.0], None, [1.0], "acceleration"),
        ([30.0, 20.0, 20.0], 0.0, [[1.0]], "belief"),
        ([30.0, 20.0, 20.0], 0.0, [math.nan, 1.0], "belief"),
        ([30.0, 20.0, 20.0], 0.0, [0.5, 0.1], "belief"),
        (np.array([30.0, math.inf, 20.0]), 0.0, np.ones(1), "observation"),
        (np.array([30.0, 20.0, 20.0]), math.inf, np.ones(1), "acceleration"),
        (np.array([30.0, 20.0, 20.0]), 0.0, np.full(9, 0.2), "belief"),
    ],
)
def test_bad_input_is_named_and_changes_nothing(
    taught, snapshot, observation, acceleration, belief, named
):
    taught.learn([30.0, 20.0, 20.0], -1.0)
    before, after = snapshot(taught), copy.deepcopy(taught)
    with pytest.raises((TypeError, ValueError), match=named):
        taught.learn(observation, acceleration, belief)
    if named != "belief":
        with pytest.raises((TypeError, ValueError), match=named):
            taught.follow(observation, acceleration)
        with pytest.raises((TypeError, ValueError), match=named):
            taught.critical(observation, [acceleration])
        with pytest.raises((TypeError, ValueError), match=named):
            taught.judge(
                situation(20.0, 20.0, 20.0)._replace(observation=observation), [acceleration]
            )
    assert snapshot(taught) == before
    for risk in (taught, after):  # nor is it confused about what is under way
        for k in range(12):
            risk.learn([30.0, 20.0, 20.0 - k], -4.0)
        risk.start_episode()
    assert snapshot(taught) == snapshot(after)


@pytest.mark.parametrize(
    "settings_",
    [
        {"lowest": 0.0},
        {"lowest": math.nan},
        {"lowest": -2.5, "dt": 0.0},
        {"lowest": -2.5, "own_brakes": -1.0},
        {"lowest": -2.5, "leader_decel": math.nan},
        {"lowest": -2.5, "margin": math.inf},
    ],
)
def test_settings_that_cannot_be_right_are_refused(settings_):
    with pytest.raises(ValueError, match="must be"):
        LatentRisk(**settings_)


def test_limits_that_cannot_be_right_are_refused():
    for decel in (-2.5, math.nan):
        with pytest.raises(ValueError, match="decel"):
            LatentRisk.told(-2.5, decel, 4.5)


@given(GAPS, SPEEDS, SPEEDS, ACTIONS, st.booleans())
def test_the_probability_grows_with_the_horizon(gap, speed, leader_speed, action, braking):
    risk = LatentRisk(lowest=-4.0)
    risk.manoeuvres.remember(2.5, 3.0, 4.5)
    for k in range(8):
        risk.follow([60.0, 20.0, 20.0 - k * braking], 0.0)
    chances = [
        risk.probability([gap, speed, leader_speed], action, horizon)
        for horizon in (0.25, 1.0, 4.0, 16.0)
    ]
    assert all(0.0 <= chance <= 1.0 for chance in chances)
    assert (np.diff(chances) >= -1e-12).all()


def test_what_no_one_can_avoid_is_certain_even_if_the_leader_does_not_brake():
    risk = LatentRisk(lowest=-4.0)
    assert risk.probability([5.0, 30.0, 0.0], -4.0, 5.0) == 1.0
    assert risk.probability([50.0, 0.0, 0.0], -4.0, 5.0) == 0.0


@pytest.mark.parametrize("horizon", [0.0, -1.0, math.nan, math.inf])
def test_a_horizon_that_cannot_be_right_is_refused(horizon):
    with pytest.raises(ValueError, match="horizon"):
        LatentRisk(lowest=-4.0).probability([5.0, 3.0, 3.0], 0.0, horizon)


def test_leaders_brake_more_often_where_they_were_seen_to():
    risk = LatentRisk(lowest=-4.0)
    for k in range(400):
        at = k % 20
        belief = [0.0, 1.0] if 10 <= at < 16 else [1.0, 0.0]
        risk.learn([60.0, 20.0, 20.0 - max(0, at - 12)], 0.0, belief)
    assert risk.onset_rate([0.0, 1.0]) > risk.onset_rate() > risk.onset_rate([1.0, 0.0])


# -- By state -----------------------------------------------------------------------------------


def test_states_are_judged_at_their_centres_weighed_by_the_belief():
    machine = EvolvingFSM(n_actions=1, rule=Novelty(radius=1.0, scales=(4.0, 2.0, 2.0)))
    machine.learn_many([[80.0, 5.0, 5.0], [3.0, 25.0, 25.0]], [0, 0])
    assert machine.n_states == 2
    risk = LatentRisk.told(-4.0, 4.0, 8.0)
    by_state = RiskByState(risk, machine, caution=0.0)
    judged = [
        by_state.judge(situation(20.0, 10.0, 10.0, belief), [-4.0]).risk[0]
        for belief in ([1.0, 0.0], [0.5, 0.5], [0.0, 1.0])
    ]
    assert judged == pytest.approx([0.0, 0.5, 1.0])
    cautious = RiskByState(risk, machine, caution=1.0)
    assert cautious.judge(situation(20.0, 10.0, 10.0, [0.5, 0.5]), [-4.0]).risk[0] == 1.0
    assert [state.is_dead_end for state in assess_states(machine.model(), risk)] == [False, True]


# -- Counts -------------------------------------------------------------------------------------

EPISODES = st.lists(
    st.tuples(st.lists(st.tuples(st.integers(0, 2), st.integers(0, 1)), max_size=9), st.booleans()),
    max_size=8,
)


@pytest.mark.slow
@given(EPISODES, st.integers(1, 5))
def test_counts_agree_with_looking_ahead(episodes, steps):
    counts = OutcomeCounts(n_actions=2, horizon=steps * DT, dt=DT)
    cases, failures = np.zeros((3, 2)), np.zeros((3, 2))
    for decisions, failed in episodes:
        for i, (state, action) in enumerate(decisions):
            counts.learn(np.eye(3)[state], action)
            left = len(decisions) - i  # until the end, in decisions
            if failed or left > steps:
                cases[state, action] += 1
                failures[state, action] += failed and left <= steps
        counts.end_episode(failed=failed)
    for state in range(3):
        for action in range(2):
            outcome = counts.outcome(np.eye(3)[state], action)
            n = cases[state, action]
            assert outcome.evidence == n
            low, high = outcome.interval
            assert 0.0 <= low <= outcome.probability <= high <= 1.0
            if n:  # it leans on all the others by a few cases
                share = failures[state, action] / n
                assert abs(outcome.probability - share) <= 2.0 / (n + 2.0) + 1e-12


def test_counts_refuse_what_they_cannot_count():
    with pytest.raises(ValueError, match="horizon"):
        OutcomeCounts(n_actions=1, horizon=0.1, dt=0.25)
    counts = OutcomeCounts(n_actions=1)
    for belief in ([math.nan], [[1.0]], [0.2, 0.2]):
        with pytest.raises(ValueError, match="belief"):
            counts.learn(belief, 0)
    with pytest.raises(ValueError, match="action"):
        counts.learn([1.0], 1)
    counts.end_episode(failed=True)
    assert counts.outcome([1.0], 0).evidence == 0.0


def test_what_was_saved_doubts_the_brakes_as_before(tmp_path):
    risk = LatentRisk(lowest=-4.0)
    drive(risk.brakes, 4.0)
    for k in range(3):  # weaker than they were, but not yet for sure
        risk.learn([80.0, 20.0 - 0.5 * k, 20.0], -4.0)
    risk.save(tmp_path / "risk")
    again = LatentRisk.load(tmp_path / "risk")
    for name, latest in risk.brakes.doubts.items():
        assert list(again.brakes.doubts[name]) == list(latest)
    assert any(len(latest) for latest in risk.brakes.doubts.values())


# -- In files ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("gentle", -5.0, "gentle of -5"),
        ("gentle", 0.5, "gentle holds a fraction"),
        ("brakes", 100.0, "brakes of 100"),
        ("doubts_brought", 100.0, "doubts_brought of 100"),
        ("decels", np.nan, "decels of nan"),
        ("stretches", -1.0, "stretches of -1"),
        ("lowest", 1.0, "lowest of 1"),
        ("lowest", -1e308, r"lowest of -1e\+308"),
        ("dt", 0.0, "dt of 0"),
        ("dt", None, "lacks dt"),
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


def test_a_risk_that_saw_jumps_and_odd_numbers_is_kept_and_read_again(tmp_path):
    random = np.random.default_rng(0)
    odd = (0.0, 1e-9, 1.0, 30.0, 200.0, 1e9, 1e100, np.nan)
    for dt in (0.01, 0.25, 10.0):
        risk = LatentRisk(lowest=-2.5, dt=dt)
        for turn in range(300):
            risk.learn(random.choice(odd, 3), random.choice([-2.5, 1.0, -1e100, 1e100]))
            if turn % 100 == 0:
                risk.start_episode()
        risk.save(tmp_path / "risk")
        LatentRisk.load(tmp_path / "risk").save(tmp_path / "again")
        assert (tmp_path / "again").read_bytes() == (tmp_path / "risk").read_bytes()


def test_the_hardest_braking_is_the_same_for_leaders_and_in_files():
    assert hardest_seen(np.inf) == HARDEST
