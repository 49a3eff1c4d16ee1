"""What is estimated from noisy observations, and what is learnt in spite of noise."""

import copy
import math

import numpy as np
import pytest

from evofsm.driving.risk.brakes import Latest, OwnBrakes, Sample
from evofsm.driving.risk.latent import LatentRisk
from evofsm.driving.risk.manoeuvres import BrakeWatch
from evofsm.driving.risk.perception import Perception
from evofsm.guard.protocols import Situation

DT = 0.25
NOISE = np.array([0.5, 0.3, 0.3])
ACTIONS = np.linspace(-2.5, 2.5, 11)


def traffic(decisions, seed=0):
    """Truth of a follower behind a leader in waves: observations, and what was done after each."""
    rng = np.random.default_rng(seed)
    rows, done = [], []
    gap, speed, leader = 40.0, 15.0, 15.0
    leads = 0.0
    for k in range(decisions):
        if k % 16 == 0:
            leads = rng.uniform(-3.0, 1.5) if leader > 12.0 else rng.uniform(0.5, 2.0)
        does = float(np.clip(0.1 * (gap - 2.0 * speed) + 0.8 * (leader - speed), -2.5, 2.0))
        rows.append((gap, speed, leader))
        done.append(does)
        reached, led = max(speed + does * DT, 0.0), max(leader + leads * DT, 0.0)
        gap += 0.5 * DT * (leader + led - speed - reached)
        speed, leader = reached, led
    return np.array(rows), done


def noisy(rows, seed=1):
    seen = rows + np.random.default_rng(seed).normal(scale=NOISE, size=rows.shape)
    seen[:, 1:] = np.maximum(seen[:, 1:], 0.0)
    return seen


def estimates(perception, seen, done):
    before = [0.0, *done[:-1]]
    return [perception.see(row, did) for row, did in zip(seen, before, strict=True)]


def taught(decisions=600):
    """A risk that has followed noisy traffic."""
    risk = LatentRisk(lowest=-2.5)
    risk.brakes.trust(2.5)
    rows, done = traffic(decisions)
    for row, did in zip(noisy(rows), done, strict=True):
        risk.learn(row, did)
    return risk, rows[-1]


def situation(row):
    return Situation(np.asarray(row), np.ones(1), 0, np.nan, 0.0)


def test_without_noise_the_estimate_is_the_observation():
    rows, done = traffic(600)
    perception = Perception(DT)
    for row, estimate in zip(rows, estimates(perception, rows, done), strict=True):
        assert estimate.mean == tuple(row)
        assert not np.any(estimate.covariance)
    assert perception.noise == (0.0, 0.0, 0.0)


@pytest.mark.parametrize("seed", range(5))
def test_noise_is_learnt_as_it_is(seed):
    rows, done = traffic(500, seed)
    perception = Perception(DT)
    estimates(perception, noisy(rows, seed + 100), done)
    assert np.array(perception.noise) == pytest.approx(NOISE, rel=0.2)


def test_estimates_are_better_than_observations_and_know_how_good_they_are():
    rows, done = traffic(2000)
    seen = noisy(rows)
    found = estimates(Perception(DT), seen, done)[500:]
    off = np.array([estimate.mean for estimate in found]) - rows[500:]
    raw = seen[500:] - rows[500:]
    assert np.all(off.std(axis=0) < [0.6, 0.6, 1.0] * raw.std(axis=0))
    claimed = np.array([[one.deviation(axis) for axis in np.eye(3)] for one in found])
    assert np.all(np.abs(off).mean(axis=0) < claimed.mean(axis=0))
    assert (off[:, 0] > 3.0 * claimed[:, 0]).mean() < 0.01


def test_a_cut_in_is_believed_at_once():
    rows, done = traffic(500)
    perception = Perception(DT)
    seen = noisy(rows)
    estimates(perception, seen, done)
    cut_in = seen[-1] - [20.0, 0.0, 5.0]
    assert perception.see(cut_in, done[-1]).mean == tuple(cut_in)


def test_an_episode_begins_afresh_but_knows_its_sensors():
    risk, _ = taught()
    noise = risk.perception.noise
    assert min(noise) > 0.0
    risk.start_episode()
    assert risk.perception.noise == noise
    elsewhere = np.array([3.0, 5.0, 5.0])
    assert risk.perception.estimate(elsewhere, 0.0).mean == tuple(elsewhere)


def test_following_without_learning_leaves_the_noise_as_it_is():
    risk, _ = taught()
    noise = risk.perception.noise
    rows, done = traffic(100, seed=9)
    for row, did in zip(rows, done, strict=True):
        risk.follow(row, did)
    assert risk.perception.noise == noise


def test_asking_changes_nothing():
    risk, row = taught()
    asked = copy.deepcopy(risk)
    for k in range(20):
        asked.judge(situation(row + k), ACTIONS)
        asked.critical(row - k, ACTIONS)
        asked.score(np.array([row, row + 1.0]))
    for one in (risk, asked):
        one.learn(row + 0.1, 0.0)
    np.testing.assert_array_equal(
        risk.judge(situation(row), ACTIONS).critical, asked.judge(situation(row), ACTIONS).critical
    )


def test_rows_that_are_scored_are_taken_as_they_are():
    risk, row = taught()
    scores = risk.score(np.array([row, row - [5.0, 0.0, 0.0]]))
    risk.start_episode()
    risk.learn(row, 0.0)
    assert risk.score(np.array([row]))[0] == pytest.approx(scores[0], abs=0.5)
    assert scores[1] > scores[0]


def test_a_situation_that_is_not_sure_is_judged_with_more_distance():
    risk, _ = taught()
    risk.start_episode()
    row = np.array([30.0, 15.0, 15.0])
    assert np.all(risk.judge(situation(row), ACTIONS).critical < risk.critical(row, ACTIONS))
    sharp = LatentRisk(lowest=-2.5)
    np.testing.assert_array_equal(
        sharp.judge(situation(row), ACTIONS).critical, sharp.critical(row, ACTIONS)
    )


def test_what_was_learnt_of_noise_is_kept_in_the_file(tmp_path):
    risk, _ = taught()
    risk.save(tmp_path / "risk.evofsm")
    again = LatentRisk.load(tmp_path / "risk.evofsm")
    assert again.perception.noise == risk.perception.noise
    assert list(again.brakes.samples) == list(risk.brakes.samples)


@pytest.mark.parametrize("seed", range(8))
def test_noise_makes_brakes_seem_neither_better_nor_much_weaker(seed):
    rng = np.random.default_rng(seed)
    brakes = OwnBrakes(lowest=-4.0, assumed=0.6, dt=DT)
    for _ in range(40):
        brakes.clear()
        speed = 25.0
        for k in range(30):
            command = -4.0 if k > 8 else 0.0
            brakes.see(speed + rng.normal(0.0, NOISE[1]), command)
            assert brakes.decel <= 1.1 * 3.0
            speed = max(speed + DT * max(command, -3.0), 0.0)
    assert brakes.known
    assert brakes.decel >= 0.85 * 3.0


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


@pytest.mark.parametrize("decimals", [1, 9])
def test_noise_is_that_of_the_latest_residuals_and_of_no_others(decimals):
    rng = np.random.default_rng(2)
    speeds = np.round(20.0 + rng.normal(size=(1200, 2)), decimals)  # many sizes are equal
    perception = Perception(DT)
    for k, (own, leader) in enumerate(speeds):
        perception.see([50.0, own, leader], 0.0)
        residuals = np.abs(np.diff(speeds[: k + 1], n=2, axis=0))[-500:]
        if len(residuals) < 20:
            assert perception.noise[1:] == (0.0, 0.0)
            continue
        found = np.sort(residuals, axis=0)[len(residuals) // 2] / 0.6745 / np.sqrt(6.0)
        assert perception.noise[1:] == pytest.approx(tuple(found), rel=1e-12)
    kept = perception.learnt()["noise_speed"]
    np.testing.assert_array_equal(kept, residuals[:, 0])
    again = Perception(DT)
    again.restore(perception.learnt())
    assert again.noise == perception.noise


def test_asked_twice_it_answers_the_same_and_asked_otherwise_it_does_not():
    risk, row = taught()
    perception = risk.perception
    first = perception.estimate(row, 0.5)
    assert perception.estimate(row, 0.5) == first
    for other in (
        perception.estimate(row + 0.1, 0.5),
        perception.estimate(row, 0.0),
        perception.estimate(row, 0.5, sure=False),
    ):
        assert other != first
    perception.see(row, 0.5)
    assert perception.estimate(row, 0.5) != first


@pytest.mark.parametrize("seed", range(4))
def test_what_brakes_bring_is_what_all_samples_in_full_precision_say(seed):
    rng = np.random.default_rng(seed)
    latest, given = Latest(30), []
    for _ in range(70):
        given.append(Sample(round(rng.normal(3.0, 0.5), seed), bool(rng.random() < 0.2)))
        latest.add(given[-1])
        values = [sample.value for sample in given[-30:]]
        assert list(latest) == given[-30:]
        mean, bound = latest.mean_and_bound(2.0) if len(values) > 1 else (values[0], values[0])
        assert mean == math.fsum(values) / len(values)
        if len(values) > 1:
            stretches = max(1, sum(sample.begins for sample in given[-30:]))
            error = np.sqrt(np.var(values, ddof=1) * stretches) / len(values)
            few = 1.0 + 1.2 / (len(values) - 1)
            assert bound == pytest.approx(mean - few * 2.0 * error, abs=1e-9)
