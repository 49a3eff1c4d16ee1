"""What is learnt of brakes, of leaders and of the noise of sensors."""

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from evofsm.driving.brakes import OwnBrakes
from evofsm.driving.leaders import BrakeWatch, Manoeuvres
from evofsm.driving.perception import Perception
from evofsm.driving.rehearsal import HARDEST

DT = 0.25
NOISE = np.array([0.5, 0.3, 0.3])
# -- One's own brakes -------------------------------------------------------------------------


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


@pytest.mark.parametrize(("command", "brings", "decisions"), [(-4.5, 2.5, 12), (-3.0, 2.0, 20)])
def test_brakes_that_weaken_show_within_seconds_of_full_or_of_ordinary_braking(
    command, brings, decisions
):
    brakes = OwnBrakes(lowest=-4.5, assumed=0.6, dt=DT)
    drive(brakes, 4.5, rounds=3)
    assert brakes.decel == pytest.approx(4.5)
    brakes.clear()
    for k in range(decisions):
        brakes.see(30.0 - k * DT * brings, command)
    assert brakes.decel <= brings + 1e-9


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


@pytest.mark.parametrize(("late", "lag"), [(0, 0.0), (1, 1.0)])
def test_it_learns_how_late_commands_take_effect(late, lag):
    brakes = OwnBrakes(lowest=-2.5, assumed=0.6, dt=DT)
    drive(brakes, 2.5, rounds=6, late=late)
    assert brakes.lag == pytest.approx(lag, abs=0.05)
    assert brakes.decel == pytest.approx(2.5)


# -- How hard leaders brake -------------------------------------------------------------------


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
    assert manoeuvres.gentle == 400


@pytest.mark.parametrize("dt", [0.1, 0.25, 0.5, 1.0])
@given(decel=st.floats(1.2, 12.0), speed=st.floats(8.0, 40.0))
def test_constant_brakes_are_measured_as_they_are(dt, decel, speed):
    steps = int(speed / (decel * dt))
    assume(steps * dt >= 1.0 + 2 * dt)
    braking = speed - decel * dt * np.arange(steps + 1)
    watch, gap, told, last = BrakeWatch(dt), 60.0, [], speed
    for now in np.concatenate([[speed] * 12, braking, [0.0] * 8]):
        gap, last = gap + 0.5 * dt * (last + now - 20.0), now  # behind it at 10 m/s
        told.append(watch.see(gap, 10.0, now))
    assert [one for one in told if one is not None] == [pytest.approx(decel)]


def test_with_a_row_every_second_short_emergency_brakes_are_seen():
    for decel, speed in ((9.0, 17.5), (6.0, 12.5), (8.0, 15.0)):
        watch = BrakeWatch(1.0)
        speeds = np.maximum(speed - np.maximum(decel * (np.arange(9.0) - 3.0), 0.0), 0.0)
        told = [watch.see(30.0, now, now) for now in speeds]
        assert [one for one in told if one is not None] == [pytest.approx(decel)]


@pytest.mark.parametrize("dt", [0.1, 0.25, 1.0])
@pytest.mark.parametrize("speed", [0.0, 20.0])
@pytest.mark.parametrize(("deviation", "known"), [(0.2, 0.0), (0.5, 0.7)])
def test_noise_is_no_manoeuvre(dt, speed, deviation, known):
    rng = np.random.default_rng(0)
    watch, told = BrakeWatch(dt), 0
    for noise, own in rng.normal(0.0, deviation, (round(3600 / dt), 2)):
        seen = watch.see(30.0, max(0.0, speed + own), max(0.0, speed + noise), known)
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


@pytest.mark.parametrize("decel", [3.0, 4.5])
def test_a_leaders_braking_is_measured_well_in_spite_of_noise(decel):
    rng = np.random.default_rng(0)
    found = []
    for _ in range(50):
        watch = BrakeWatch(DT)
        for k in range(60):
            speed = max(0.0, 20.0 - max(0.0, decel * DT * (k - 20)))
            seen = max(0.0, speed + rng.normal(0.0, NOISE[2]))
            found.append(watch.see(50.0, speed, seen, np.sqrt(2.0) * NOISE[2]))
        found.append(watch.end())
    told = np.array([one for one in found if one is not None])
    assert 50 <= len(told) <= 55
    assert np.median(told) == pytest.approx(decel, rel=0.1)
    assert np.quantile(told, 0.95) < 1.15 * decel


# -- Where one is -----------------------------------------------------------------------------


def test_estimates_are_better_than_observations_and_know_how_good_they_are():
    """Of a follower behind a leader in waves, whose truth is driven first."""
    rng, rows, done = np.random.default_rng(0), [], []
    gap, speed, leader, leads = 40.0, 15.0, 15.0, 0.0
    for k in range(2000):
        if k % 16 == 0:
            leads = rng.uniform(-3.0, 1.5) if leader > 12.0 else rng.uniform(0.5, 2.0)
        does = float(np.clip(0.1 * (gap - 2.0 * speed) + 0.8 * (leader - speed), -2.5, 2.0))
        rows.append((gap, speed, leader))
        done.append(does)
        reached, led = max(speed + does * DT, 0.0), max(leader + leads * DT, 0.0)
        gap += 0.5 * DT * (leader + led - speed - reached)
        speed, leader = reached, led
    rows = np.array(rows)
    seen = rows + np.random.default_rng(1).normal(scale=NOISE, size=rows.shape)
    seen[:, 1:] = np.maximum(seen[:, 1:], 0.0)
    perception, before = Perception(DT), [0.0, *done[:-1]]
    found = [perception.see(tuple(z), did) for z, did in zip(seen, before, strict=True)][500:]
    off = np.array([estimate.mean for estimate in found]) - rows[500:]
    raw = seen[500:] - rows[500:]
    assert np.all(off.std(axis=0) < [0.6, 0.6, 1.0] * raw.std(axis=0))
    claimed = np.array([[one.deviation(axis) for axis in np.eye(3)] for one in found])
    assert np.all(np.abs(off).mean(axis=0) < claimed.mean(axis=0))
    assert (off[:, 0] > 3.0 * claimed[:, 0]).mean() < 0.01
