"""What is learnt of how a system moves, of a car that follows another one."""

import numpy as np
import pytest

from evofsm.guard import LearntRisk
from evofsm.guard.learnt.rollout import expected


def follow(judge, Z, U, *, failed=False):
    """An episode: T + 1 observations and T actions, of which nobody knows what they mean."""
    for t, z in enumerate(Z):
        judge.observe(np.asarray(z, np.float64))
        if t < len(U):
            judge.act(U[t])
    judge.end(None, failed=failed)


def drive(draw, steps=120, *, braking=None):
    """A gap [m] and two speeds [m/s] at 4 Hz; the leader brakes from a step on, and stands at 0."""
    gap, own, leader = 40.0, 15.0, 15.0
    Z, U = [[gap, own, leader]], []
    for t in range(steps):
        a = float(np.clip(draw.normal(0.05 * (leader - own), 0.8), -2.5, 2.5))
        push = -3.0 if braking is not None and braking <= t < braking + 16 else 0.0
        own_next = max(0.0, own + 0.25 * a)
        leader_next = max(0.0, leader + 0.25 * push + 0.01 * draw.normal())
        gap += 0.25 * (leader - own)
        own, leader = own_next, leader_next
        Z.append([gap, own, leader])
        U.append(a)
    return np.array(Z), np.array(U)


def taught(episodes=4, seed=0):
    """A judge after some episodes without a failure."""
    draw, judge = np.random.default_rng(seed), LearntRisk(0.25, -2.5, 2.5)
    for episode in range(episodes):
        follow(judge, *drive(draw, braking=60 if episode % 2 else None))
    return judge


def ahead(judge, z, action, steps=4):
    """(steps, m) what is observed under an action, from rest, if nothing disturbs it."""
    change, u, path = np.zeros(len(z)), judge.encode(action), []
    for before in [np.zeros_like(u), *[u] * (steps - 1)]:
        after = expected(judge.parts.model, np.concatenate([z, change, before]), u)
        z, change = after, after - z
        path.append(z)
    return np.array(path)


def test_it_learns_what_a_car_does_but_nothing_of_the_failing_transition():
    one, other = taught(8), taught(8)
    after = ahead(one, [40.0, 15.0, 14.0], 1.0, 1)[0] - [39.75, 15.25, 14.0]
    assert (np.abs(after) < [0.05, 0.05, 0.1]).all()
    Z, U = drive(np.random.default_rng(5))
    follow(one, Z, U)
    crash = Z[-1] + [-60.0, -14.0, 20.0]
    follow(other, np.vstack([Z, crash]), np.append(U, 0.0), failed=True)
    for name in ("least", "most", "unit", "lowest", "highest"):
        before, after = getattr(one.state, name), getattr(other.state, name)
        np.testing.assert_allclose(after, before, rtol=0.01, err_msg=name)
    before, after = one.parts.model.weights, other.parts.model.weights
    np.testing.assert_allclose(after, before, atol=0.02)
    assert not (other.state.windows[:, :, :3] == crash).all(2).any()


@pytest.mark.parametrize("back", [1, 120])
def test_a_jump_changes_model_and_units_by_less_than_1_percent(back):
    one, other = taught(6), taught(6)
    Z, U = drive(np.random.default_rng(5))
    follow(one, Z, U)
    jumped = Z.copy()
    jumped[50 : 50 + back, 0] += 130.0
    follow(other, jumped, U)
    np.testing.assert_allclose(other.state.unit, one.state.unit, rtol=0.01)
    np.testing.assert_allclose(other.parts.model.reach, one.parts.model.reach, rtol=0.01)
    paths = [ahead(each, [40.0, 15.0, 14.0], 1.0) for each in (one, other)]
    np.testing.assert_allclose(paths[1], paths[0], rtol=0.01, atol=0.01 * one.state.unit.max())


def test_a_side_on_which_episodes_fail_is_never_a_saturation():
    judge, draw = taught(0), np.random.default_rng(3)
    for k in range(6):
        Z, U = drive(draw, steps=60)
        Z[:, 0] = np.maximum(Z[:, 0] - Z[-1, 0], 0.0)  # each ends where the gap is 0
        follow(judge, np.vstack([Z, Z[-1] - [0.5 + 0.1 * k, 0.0, 0.0]]), [*U, 0.0], failed=True)
    assert judge.state.reached[0, 0] >= 2
    assert judge.told_by_experience.startswith("fails where variable 1 is below 0")
    assert judge.parts.model.lowest[0] == -np.inf


@pytest.mark.parametrize(
    ("flag", "least"),
    [(lambda t: np.random.default_rng(3).random(len(t)) < 0.5, 0.9), (lambda t: t % 7 == 0, 0.8)],
)
def test_a_flag_that_comes_and_goes_leaves_what_is_learnt_of_others(flag, least):
    draw = np.random.default_rng(3)
    plain, flagged = LearntRisk(0.25, -2.5, 2.5), LearntRisk(0.25, -2.5, 2.5)
    for braking in (None, 60, None, 60):
        Z, U = drive(draw, braking=braking)
        follow(plain, Z, U)
        follow(flagged, np.column_stack([Z, flag(np.arange(len(Z)))]), U)
    rows, of_flagged = plain.state.squares[0, 0], flagged.state.squares[0, 0]
    assert of_flagged > least * rows
