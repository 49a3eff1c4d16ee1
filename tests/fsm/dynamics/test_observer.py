"""Where sensors are noisy, where one is follows from what was expected as well."""

import numpy as np
import pytest

from evofsm.fsm import Dynamics, Here
from evofsm.fsm.dynamics.merging import merge_dynamics
from evofsm.fsm.dynamics.observer import best_gains, untried

NOISE = 1.0


@pytest.fixture
def walk(follow):
    """Walk a step forth or back at a time; what is seen of it may be noisy."""

    def make(noise, episodes=20, seed=0, **settings):
        draw, dynamics = np.random.default_rng(seed), Dynamics(n_actions=2, **settings)
        for _ in range(episodes):
            U = draw.integers(2, size=60)
            x = np.append(0.0, np.cumsum(2.0 * U - 1.0))[:, None]
            follow(dynamics, x + noise * draw.normal(size=x.shape), U)
        return dynamics

    return make


def off(dynamics, seed=9, steps=400):
    """Mean squares of how far from where one is what is seen, and what is made of it, are."""
    draw, x = np.random.default_rng(seed), 0.0
    here, action = Here(np.zeros(1), np.zeros(1), dynamics.encode(0)), dynamics.encode(0)
    squares = []
    for _ in range(steps):
        x += 2.0 * float(action[1]) - 1.0
        seen = np.array([x + NOISE * draw.normal()])
        z = dynamics.corrected(here, action, seen)
        squares.append((float(seen[0] - x) ** 2, float(z[0] - x) ** 2))
        here, action = Here(z, z - here.z, action), dynamics.encode(int(draw.integers(2)))
    return np.mean(squares, axis=0)


def test_what_is_seen_exactly_is_taken_as_it_is(walk):
    exact, seen = walk(0.0), np.array([3.0])
    assert not exact.is_noisy
    here = Here(np.zeros(1), np.zeros(1), exact.encode(0))
    assert exact.corrected(here, exact.encode(1), seen) is seen


def test_noise_is_found_and_mostly_taken_away(walk):
    noisy = walk(NOISE)
    assert noisy.is_noisy
    before, after = off(noisy)
    assert after < 0.5 * before


def test_disturbances_are_no_noise(follow):
    draw, dynamics = np.random.default_rng(0), Dynamics(n_actions=2)
    for _ in range(20):
        U = draw.integers(2, size=60)
        moved = 2.0 * U - 1.0 + draw.normal(size=60)
        follow(dynamics, np.append(0.0, np.cumsum(moved))[:, None], U)
    assert not dynamics.is_noisy


def test_without_an_observer_noise_is_not_looked_for(walk):
    assert not walk(NOISE, without=["observer"]).is_noisy


def test_noise_that_ends_is_forgotten(walk, follow):
    dynamics, draw = walk(NOISE), np.random.default_rng(1)
    for _ in range(40):
        U = draw.integers(2, size=60)
        follow(dynamics, np.append(0.0, np.cumsum(2.0 * U - 1.0))[:, None], U)
    assert not dynamics.is_noisy


def test_what_jumps_is_taken_as_it_is_seen(walk):
    noisy = walk(NOISE)
    here = Here(np.zeros(1), np.zeros(1), noisy.encode(0))
    far = np.array([1000.0])
    np.testing.assert_array_equal(noisy.corrected(here, noisy.encode(1), far), far)


def test_a_noisy_sensor_at_an_end_is_taken_to_be_there(follow, drive):
    """A car that brakes at a standstill: what its sensor says is no force that holds it back."""
    draw = np.random.default_rng(0)
    dynamics = Dynamics(-2.5, 2.5)
    for episode in range(20):
        Z, U = drive(draw, braking=60 if episode % 2 else None)
        U[90:] = -2.5
        for t in range(90, 120):
            Z[t + 1, 1] = max(0.0, Z[t, 1] - 0.25 * 2.5)
        seen = Z + np.array([0.5, 0.3, 0.3]) * draw.normal(size=Z.shape)
        seen[:, 1:] = np.maximum(seen[:, 1:], 0.0)
        follow(dynamics, seen, U)
    at_rest = Z[2:, 1] == 0.0
    left = dynamics.latest.residuals[:, 1]
    assert dynamics.consequents.gains[1] < 1.0
    assert at_rest.sum() > 10
    assert np.abs(left[at_rest]).mean() < 0.3 * np.abs(left[~at_rest]).mean()


def test_gains_of_parts_are_those_that_missed_least_in_all(walk):
    noisy, other = walk(NOISE), walk(NOISE, seed=1)
    merged = merge_dynamics([noisy, other])
    np.testing.assert_allclose(merged.missed, 0.5 * (noisy.missed + other.missed))
    assert merged.is_noisy


def test_of_gains_that_miss_hardly_more_the_largest_is_taken():
    missed = untried(2)
    missed[1] = 0.4, 0.31, 0.3, 0.299, 0.3, 0.4
    assert best_gains(missed).tolist() == [1.0, 0.5]
