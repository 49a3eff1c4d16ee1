"""What decides between learning a system and learning nonsense, each by itself."""

import numpy as np
import pytest

from evofsm.guard.learnt.dynamics import Dynamics
from evofsm.guard.learnt.library import Violations
from evofsm.guard.learnt.regression import are_misleading
from evofsm.guard.learnt.replay import features, lags, limited, residuals


def follow(dynamics, Z, U, *, failed=False):
    """An episode: T + 1 observations and T actions, of which nobody knows what they mean."""
    for t, z in enumerate(Z):
        dynamics.observe(np.asarray(z, np.float64))
        if t < len(U):
            dynamics.act(dynamics.encode(U[t]))
    dynamics.end(failed=failed)


def drive(draw, steps=120, *, braking=None, start=(40.0, 15.0, 15.0), noise=0.01, weakest=-2.5):
    """A gap [m] and two speeds [m/s] at 4 Hz; the leader brakes from a step on, and stands at 0."""
    gap, own, leader = start
    Z, U = [[gap, own, leader]], []
    for t in range(steps):
        a = float(np.clip(draw.normal(0.05 * (leader - own), 0.8), -2.5, 2.5))
        push = -3.0 if braking is not None and braking <= t < braking + 16 else 0.0
        own_next = max(0.0, own + 0.25 * max(a, weakest))
        leader_next = max(0.0, leader + 0.25 * push + noise * draw.normal())
        gap += 0.25 * (leader - own)
        own, leader = own_next, leader_next
        Z.append([gap, own, leader])
        U.append(a)
    return np.array(Z), np.array(U)


def taught(episodes=4, seed=0, **settings):
    """Dynamics of a car behind another one, after some episodes without a failure."""
    draw = np.random.default_rng(seed)
    dynamics = Dynamics(-2.5, 2.5, **settings)
    for episode in range(episodes):
        follow(dynamics, *drive(draw, braking=60 if episode % 2 else None))
    return dynamics


def ahead(dynamics, z, action, steps=4):
    """(steps, m) what is observed under an action, from rest, if nothing disturbs it."""
    z, change, model = np.array([z], np.float64), np.zeros((1, len(z))), dynamics.model
    u, path = dynamics.encode(action)[None], []
    for before in [np.zeros_like(u), *[u] * (steps - 1)]:
        move = limited(model, features(model, z, change, before, u) @ model.weights)
        after = np.clip(z + move, model.lowest, model.highest)
        z, change = after, after - z
        path.append(z[0])
    return np.array(path)


def content(dynamics):
    """All that it goes on with, to be compared."""
    arrays = {name: array.tobytes() for name, array in dynamics.arrays().items()}
    return dynamics.numbers(), arrays


def test_it_learns_what_a_car_does_but_nothing_of_the_failing_transition():
    one, other = taught(), taught()
    assert ahead(one, [40.0, 15.0, 14.0], 1.0, 1)[0] == pytest.approx(
        [39.75, 15.25, 14.0], abs=0.05
    )
    Z, U = drive(np.random.default_rng(5))
    follow(one, Z, U)
    crash = Z[-1] + [-60.0, -14.0, 20.0]
    follow(other, np.vstack([Z, crash]), np.append(U, 0.0), failed=True)
    for name in ("least", "most", "unit"):  # but for the last one before, which is learnt by now
        before, after = getattr(one.sums, name), getattr(other.sums, name)
        np.testing.assert_allclose(after, before, rtol=0.01, err_msg=name)
    np.testing.assert_allclose(other.weights, one.weights, atol=0.02)
    assert len(other.sequences) == len(one.sequences)
    assert not any((sequence.observations == crash).any() for sequence in other.sequences)
    assert (other.highest == one.highest).all()
    assert (other.lowest == one.lowest).all()


def test_a_long_rest_at_an_end_teaches_nothing_of_what_an_action_does():
    dynamics = taught()
    effect = dynamics.weights[[7, 8], 1].copy()  # of this action and the one before on own speed
    U = np.full(120, -2.0)
    own = np.maximum(0.0, 2.0 + 0.25 * np.cumsum(np.append(0.0, U)))
    Z = np.column_stack([30.0 - 0.25 * np.append(0.0, np.cumsum(own[:-1])), own, np.zeros(121)])
    for _ in range(2):
        follow(dynamics, Z, U)
        np.testing.assert_allclose(dynamics.weights[[7, 8], 1], effect, atol=0.01)
    assert dynamics.model.lowest[1] == 0.0


def test_one_jump_of_130_m_changes_model_and_units_by_less_than_1_percent():
    one, other = taught(6), taught(6)
    Z, U = drive(np.random.default_rng(5))
    follow(one, Z, U)
    jumped = Z.copy()
    jumped[50:, 0] += 130.0
    follow(other, jumped, U)
    np.testing.assert_allclose(other.sums.unit, one.sums.unit, rtol=0.01)
    np.testing.assert_allclose(other.model.reach, one.model.reach, rtol=0.01)
    paths = [ahead(each, [40.0, 15.0, 14.0], 1.0) for each in (one, other)]
    np.testing.assert_allclose(paths[1], paths[0], rtol=0.01, atol=0.01 * one.sums.unit.max())


@pytest.mark.parametrize("at", [2, 5, 8, 20])
def test_a_jump_among_the_first_steps_there_are_is_one(at):
    """It would stand in the sums, and in the limits of what is ordinary, for ever."""
    dynamics = Dynamics(-2.5, 2.5)
    Z, U = drive(np.random.default_rng(5), noise=0.001)
    Z[at:, 0] -= 130.0
    follow(dynamics, Z, U)
    assert len(dynamics.jumps[0]) == 1
    assert dynamics.model.least[0] > -10.0
    gap = ahead(dynamics, [40.0, 15.0, 14.5], 0.0)[:, 0]
    assert np.diff(gap) == pytest.approx(-0.125, abs=0.03)


def test_a_jump_is_replayed_to_where_such_jumps_led():
    dynamics = taught(2, horizon=20)
    for seed in range(4):
        Z, U = drive(np.random.default_rng(seed), start=(160.0, 15.0, 15.0))
        Z[40:, 0] -= 120.0
        follow(dynamics, Z, U)
    found = dynamics.disturbances(20)
    k, j = np.argwhere(found.jump_at >= 0.0)[0]
    assert j == 0
    low, high = found.landing[k, 0]
    assert 20.0 < low <= high < 60.0
    seen_from = dynamics.jumps[0][:, 0]
    assert found.jump_from[k, 0, 0].tolist() == [seen_from.min(), seen_from.max()]


def test_a_side_on_which_episodes_fail_is_never_a_saturation():
    dynamics, draw = taught(0), np.random.default_rng(3)
    for k in range(6):
        Z, U = drive(draw, steps=60)
        Z[:, 0] = np.maximum(Z[:, 0] - Z[-1, 0], 0.0)  # each ends where the gap is 0
        follow(dynamics, np.vstack([Z, Z[-1] - [0.5 + 0.1 * k, 0.0, 0.0]]), [*U, 0.0], failed=True)
    assert dynamics.reached[0, 0] >= 2
    assert (0, -1.0) in [(j, sign) for j, sign, _ in dynamics.thresholds]
    assert dynamics.model.lowest[0] == -np.inf


@pytest.mark.parametrize("arrives", [False, True])
def test_who_stays_at_an_end_learns_that_it_is_one(arrives):
    dynamics, leader = taught(), 8.0 + np.sin(np.arange(81))
    own = np.maximum(0.0, (4.0 if arrives else 0.0) - 0.5 * np.arange(81))
    gap = 90.0 + np.cumsum(np.append(0.0, 0.25 * (leader - own)[:-1]))
    assert dynamics.model.lowest[1] == -np.inf
    follow(dynamics, np.column_stack([gap, own, leader]), np.full(80, -2.0))
    assert dynamics.model.lowest[1] == 0.0


def test_a_brake_remembered_from_a_low_speed_lasts_from_a_high_one():
    dynamics = taught(6)
    for _ in range(3):  # it comes to stand in more than one episode: speeds stop at 0
        follow(dynamics, *drive(np.random.default_rng(7), start=(90.0, 10.0, 8.0), braking=20))
    assert dynamics.model.lowest[2] == 0.0
    leader = np.maximum(0.0, 4.0 - 0.75 * np.arange(22))
    Z = np.column_stack([np.full(22, 50.0), np.full(22, 10.0), leader])
    seen = dynamics.model, dynamics.close, Z, np.zeros((21, 1))
    stood = int(np.flatnonzero(leader[1:] == 0.0)[0])
    found = residuals(*seen, carried=True)
    assert (found[stood + 1 : stood + 6, 2] <= 0.8 * found[: stood - 1, 2].max()).all()
    assert (found[stood + 1 : stood + 6, 2] < 0.0).all()
    assert np.abs(residuals(*seen)[stood + 3 : stood + 8, 2]).max() < 0.2  # censored


def test_a_leader_who_brakes_is_remembered_number_0_is_none_and_nothing_disturbs_who_rests():
    dynamics = taught(6)
    found = dynamics.disturbances(30)
    assert found.residuals.shape == (30, 3, 1 + len(dynamics.sequences))
    assert not found.residuals[:, :, 0].any()
    assert found.residuals[:, 2].min() == pytest.approx(-0.75, abs=0.2)  # 3 m/s² for 0.25 s
    follow(dynamics, np.tile([300.0, 0.0, 0.0], (60, 1)), np.full(59, -1.0))
    assert (dynamics.latest.residuals == 0.0).all()
    assert len(taught(20, remembered=2).sequences) <= 8  # bounded also where nobody chooses


def test_something_unexpected_begins_once_and_then_not_for_a_while():
    dynamics = taught(6)
    Z, U = drive(np.random.default_rng(1), braking=50)
    begun = []
    for t, z in enumerate(Z[:-1]):
        if dynamics.observe(z):
            begun.append(t)
        dynamics.act(dynamics.encode(U[t]))
    assert begun == [51]


# -- Changes ------------------------------------------------------------------------------------

BEFORE, WEAK = 30, -1.0


def changed(weakest=WEAK, before=BEFORE, **settings):
    """Dynamics of a car that follows another; after some episodes its brakes weaken."""
    draw, dynamics = np.random.default_rng(3), Dynamics(-2.5, 2.5, **settings)
    for episode in range(before + 10):
        weak = weakest if episode >= before else -2.5
        follow(dynamics, *drive(draw, braking=60 if episode % 2 else None, weakest=weak))
    return dynamics


def slows_by(dynamics, action=-2.5):
    """What a second of braking is expected to take from one's own speed [m/s]."""
    return 15.0 - ahead(dynamics, [40.0, 15.0, 15.0], action)[-1, 1]


def test_weaker_brakes_are_noticed_and_followed():
    dynamics = changed()
    assert {one.variable for one in dynamics.drifts} == {1}
    assert BEFORE <= dynamics.drifts[0].since <= dynamics.drifts[0].noticed < BEFORE + 8
    assert slows_by(dynamics) == pytest.approx(1.0, abs=0.15)
    assert slows_by(dynamics, 2.0) == pytest.approx(-2.0, abs=0.15)
    assert dynamics.model.drifted.tolist() == [-1.0, 1.0, -1.0]
    # Where the effect of an action bends is known only nearly: no more is foreseen than was seen.
    assert max(slows_by(dynamics, one) for one in np.linspace(-2.5, 0.0, 11)) <= 1.0 + 1e-9
    # What was remembered is replayed with the new brakes.
    old = [k for k, one in enumerate(dynamics.sequences, 1) if one.episode < BEFORE]
    found = dynamics.disturbances(48).residuals[:, :, old]
    assert found[:, 2].min() < -0.5  # the leader still brakes
    assert np.abs(found[:, 1]).max() < 0.2  # oneself as expected, now


def test_without_a_change_the_old_brakes_are_believed_in():
    dynamics = changed(weakest=-2.5)
    assert dynamics.drifts == []
    assert slows_by(dynamics) > 1.5


def test_nothing_is_a_change_as_long_as_all_is_being_learnt():
    dynamics = changed(before=6)
    assert dynamics.drifts == []
    assert not dynamics.recent.doubt.any()


def coasting():
    """Learnt of what goes on for a while when it is pushed."""
    draw, dynamics = np.random.default_rng(0), Dynamics(-1.0, 1.0, horizon=10)
    for _ in range(4):
        push, speeds = draw.uniform(-1.0, 1.0, 60), [0.0]
        for one in push:
            speeds.append(0.9 * speeds[-1] + 0.1 * one)
        follow(dynamics, np.cumsum(speeds)[:, None], push)
    return dynamics


def test_lags_that_are_doubted_enough_are_left_out_until_they_foresee_again():
    dynamics, where = coasting(), lags(1, 1)
    dynamics.refute(np.arange(5, 40), 10)
    assert dynamics.doubt_of_lags == 0.0  # they foresee what came
    assert np.abs(dynamics.weights[where]).max() > 0.5
    dynamics.doubt_of_lags = 1.0
    dynamics.settle()
    assert are_misleading(dynamics.doubt_of_lags)
    assert np.abs(dynamics.weights[where]).max() < 1e-6
    dynamics.refute(np.arange(5, 40), 10)
    assert np.abs(dynamics.weights[where]).max() > 0.5


def test_lags_foresee_what_the_action_before_does_a_step_later():
    draw, dynamics = np.random.default_rng(0), Dynamics(-1.0, 1.0, horizon=10)
    for push in draw.uniform(-1.0, 1.0, (4, 60)):
        follow(dynamics, np.cumsum([0.0, 0.0, *push[:-1]])[:, None], push)
    dynamics.doubt_of_lags = 0.3
    dynamics.refute(np.arange(5, 40), 1)
    assert dynamics.doubt_of_lags == 0.0


def test_where_certificates_are_violated_ever_more_often_disturbances_are_worse():
    def since(violated, failed=False):
        found = Violations(share=0.05)
        for episode, one in enumerate(violated):
            found = found.after(episode, violated=one, failed=failed and one)
        return found.worse

    assert since([True] * 4) == since([True] * 2, failed=True) == 0
    assert since([False] * 9 + [True] * 4) == 9
    assert since([True] * 2) == since([True, False, False] * 9) == -1


def walk(noise, episodes=20, disturbed=0.0, dynamics=None, **settings):
    """A step forth or back at a time; what is seen of it may be noisy."""
    draw, dynamics = np.random.default_rng(0), dynamics or Dynamics(n_actions=2, **settings)
    for _ in range(episodes):
        U = draw.integers(2, size=60)
        moved = 2.0 * U - 1.0 + disturbed * draw.normal(size=60)
        x = np.append(0.0, np.cumsum(moved))[:, None]
        follow(dynamics, x + noise * draw.normal(size=x.shape), U)
    return dynamics


def off(dynamics, seed=9, steps=400):
    """Mean squares of how far from where one is what is seen, and what is made of it, are."""
    draw, x, squares = np.random.default_rng(seed), 0.0, []
    situation, action = np.zeros(4), dynamics.encode(0)
    for _ in range(steps):
        x += 2.0 * float(action[1]) - 1.0
        seen = np.array([x + draw.normal()])
        z = dynamics.corrected(situation, action, seen)
        squares.append((float(seen[0] - x) ** 2, float(z[0] - x) ** 2))
        situation = np.concatenate([z, z - situation[:1], action])
        action = dynamics.encode(int(draw.integers(2)))
    return np.mean(squares, axis=0)


def test_noise_is_found_and_mostly_taken_away_and_forgotten_where_it_ends():
    dynamics, far = walk(1.0), np.array([1000.0])
    assert dynamics.is_noisy
    before, after = off(dynamics)
    assert after < 0.5 * before
    jumped = dynamics.corrected(np.zeros(4), dynamics.encode(1), far)
    np.testing.assert_array_equal(jumped, far)
    walk(0.0, episodes=40, dynamics=dynamics)
    assert not dynamics.is_noisy
    seen = np.array([3.0])
    assert dynamics.corrected(np.zeros(4), dynamics.encode(1), seen) is seen
    assert not walk(0.0, disturbed=1.0).is_noisy  # disturbances are no noise


def test_a_noisy_sensor_at_an_end_is_taken_to_be_there():
    """A car that brakes at a standstill: what its sensor says is no force that holds it back."""
    draw, dynamics = np.random.default_rng(0), Dynamics(-2.5, 2.5)
    for episode in range(20):
        Z, U = drive(draw, braking=60 if episode % 2 else None)
        U[90:] = -2.5
        Z[90:, 1] = np.maximum(0.0, Z[90, 1] - 0.25 * 2.5 * np.arange(31))
        seen = Z + np.array([0.5, 0.3, 0.3]) * draw.normal(size=Z.shape)
        seen[:, 1:] = np.maximum(seen[:, 1:], 0.0)
        follow(dynamics, seen, U)
    at_rest, left = Z[2:, 1] == 0.0, dynamics.latest.residuals[:, 1]
    assert dynamics.gains[1] < 1.0
    assert at_rest.sum() > 10
    assert np.abs(left[at_rest]).mean() < 0.3 * np.abs(left[~at_rest]).mean()
