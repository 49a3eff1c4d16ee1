"""Rollouts, and which action passes by them."""

import numpy as np
import pytest

from evofsm.guard.learnt.backups import regulator
from evofsm.guard.learnt.rollout import (
    CHANGED,
    CRASHES,
    ENDS,
    FAILS,
    GROWN,
    KEPT,
    NOTHING_PASSES,
    SHRUNK,
    Model,
    features,
    n_features,
    rollout,
    search,
)

STEPS, WALL = 20, 100.0
ACTION = 3  # index of the first one among the features: after 1, the variable, its latest change


def side(variable, sign, threshold, unit=1.0):
    """It fails beyond a threshold."""
    form = [FAILS, variable, variable, threshold, threshold, 1.0 / unit, 1.0, 0.0, sign]
    return np.array([[*form, 0.0, 0.0, 0.0, 0.0]])


def mover(choices=0, **others):
    """One variable, moved by the action, or by the last of two choices; fails at a wall."""
    a = max(1, choices)
    weights = np.zeros((n_features(1, a, box=not choices), 1))
    weights[ACTION + a - 1] = 1.0
    one, none = np.ones(1), np.zeros(1)
    model = Model(
        weights=weights,
        origin=none,
        reach=one,
        lowest=-np.inf * one,
        highest=np.inf * one,
        least=-9.0 * one,
        most=9.0 * one,
        forms=side(0, 1.0, WALL),
        dead_ends=np.empty((0, 3)),
        mean=none,
        inverse=one,
        choices=choices,
    )
    return model._replace(**others)


def random_model(draw, m, a, choices):
    """Something that moves, saturates, ends, and fails there or elsewhere."""
    one = np.ones(m)
    return Model(
        weights=0.05 * draw.normal(size=(n_features(m, a, box=not choices), m)),
        origin=draw.normal(size=m),
        reach=0.5 * one,
        lowest=np.append(-0.8, np.full(m - 1, -np.inf)),
        highest=np.append(np.full(m - 1, np.inf), 0.9),
        least=-0.2 * one,
        most=0.3 * one,
        forms=np.vstack(
            [
                [ENDS, 0.0, 2.0, -0.2, 0.3, 2.0, 0.5, 0.6, -0.9, 0.3, 0.1, 0.0, 0.0],
                [CRASHES, 1.0, 1.0, 0.9, 0.0, 3.0, 1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0],
                [ENDS, 0.0, 0.0, -0.7, 0.0, 2.0, 1.0, 0.0, -1.0, 0.0, 0.0, 0.0, 0.0],
                [ENDS, 1.0, 1.0, 1.4, 0.0, 2.0, 1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0],
                [CRASHES, 0.0, 0.0, 0.1, 0.0, 3.0, 1.0, 0.0, -1.0, 0.0, 0.0, 0.0, 0.0],
                [FAILS, 1.0, m - 1.0, 1.5, -0.2, 2.0, 0.5, 1.0, 0.3, 0.1, -0.9, 0.4, -1.2],
                side(0, 1.0, 0.7, 0.5),
                side(m - 1, -1.0, -1.5, 2.0),
            ]
        ),
        dead_ends=np.column_stack([draw.normal(size=(2, m)), [0.4, 1.1], [9.0, 9.0]]),
        mean=draw.normal(size=m),
        inverse=1.0 + draw.random(m),
        choices=a if choices else 0,
    )


def acts(model, policy, z):
    """What a policy does at an observation."""
    action = policy[:, 0] + policy[:, 1:] @ ((z - model.mean) * model.inverse)
    return np.eye(len(action))[action.argmax()] if model.choices else np.clip(action, -1.0, 1.0)


def nearest(form, z):
    """How far an observation is from a form, to first order, and what that says."""
    says, i, j, *at, one, other, c, b, d, p, q, r = form
    x, y = (z[int(i)] - at[0]) * one, (z[int(j)] - at[1]) * other
    slope = np.array([b + 2.0 * p * x + q * y, d + q * x + 2.0 * r * y])
    far = -(c + b * x + d * y + p * x * x + q * x * y + r * y * y) / np.sqrt(slope @ slope)
    return says, far - GROWN * (says == FAILS and any([p, q, r]))


def crashes(said):
    """How far it is to crash, each in the ends that stand before it."""
    last, before = np.inf, None
    for says, far in said:
        if says == ENDS:
            last = min(far, last) if before == ENDS else far
        if says == CRASHES:
            yield max(last - GROWN, far)
        before = says


def from_dead_end(model, row, z):
    """How far an observation is from a dead end."""
    *centre, radius, worth = row
    return (np.linalg.norm((z - centre) * model.inverse) - radius) * worth


def plainly(model, situation, plan, policy, residuals, k, scale):
    """One rollout, step by step in NumPy: steps survived, and the least distance."""
    m, near = len(model.origin), np.inf
    z, change, before = situation[:m], situation[m : 2 * m], situation[2 * m :]
    dead_ends = [row for row in model.dead_ends if from_dead_end(model, row, z) >= 0.0]
    for t, rest in enumerate(residuals[:, :, k]):
        u = plan[t] if t < len(plan) else acts(model, policy, z)
        reach = model._replace(reach=scale * model.reach)
        move = (features(reach, z[None], change[None], before[None], u[None]) @ model.weights)[0]
        move = np.clip(move + scale * rest, scale * model.least, scale * model.most)
        after = np.clip(z + move, model.lowest, model.highest)
        z, change, before = after, after - z, u
        said = [nearest(form, z) for form in model.forms]
        end = min((far for says, far in said if says == ENDS), default=np.inf)
        near = min([near, *(far for says, far in said if says == FAILS)])
        near = min([near, *crashes(said)])
        near = min([near, *(from_dead_end(model, row, z) for row in dead_ends)])
        if near < 0.0:
            return t, near
        if end <= -SHRUNK:  # it ends by itself
            return len(residuals) + 1, near
    return len(residuals), near


@pytest.mark.parametrize("choices", [False, True])
@pytest.mark.parametrize("planned", [0, 1, 3])
def test_the_kernel_rolls_out_as_a_plain_loop_does(choices, planned):
    draw, m, a, K = np.random.default_rng(planned), 3, 2, 5
    model, residuals = random_model(draw, m, a, choices), np.zeros((STEPS, m, K))
    residuals[:, :, 1:] = 0.1 * draw.normal(size=(STEPS, m, K - 1))
    situations = 0.3 * draw.normal(size=(4, 2 * m + a))
    situations[2:, :m] = [[-0.7, 0.1, 0.3], [-0.6, -0.2, 0.5]]
    plan, policy = draw.uniform(-1.0, 1.0, (planned, a)), draw.normal(size=(a, 1 + m))
    happened = []
    ending = model.forms[:, 0] == ENDS
    harmless = model._replace(forms=model.forms[ending], dead_ends=model.dead_ends[:0])
    for one in (model, harmless):
        ends = rollout(one, situations, policy, residuals, 1.3, plan)
        pairs = ((situation, k) for situation in situations for k in range(K))
        found = [plainly(one, z, plan, policy, residuals, k, 1.3) for z, k in pairs]
        survived, least = np.array(found).T
        value = np.where(survived < STEPS, survived - STEPS - 1.0, least)
        np.testing.assert_allclose(ends.value, value)
        happened += survived.tolist()
    assert min(happened) < STEPS < max(happened)  # some fail, and some end


# -- Which action passes ------------------------------------------------------------------------


def search_for(
    model, proposal, policies, margin=0.0, place=0.0, residuals=None, allowed=0, most=np.inf
):
    """What is found there, if nothing disturbs: how, the action, the backup, and what is left."""
    residuals = np.zeros((STEPS, 1, 1)) if residuals is None else residuals
    here, policies = np.array([place, 0.0, *[0.0] * len(proposal)]), np.array(policies)
    asked = here, policies, np.arange(len(policies)), residuals, 1.0, np.array(proposal)
    return search(model, *asked, margin, allowed, most)


def test_where_full_action_only_just_holds_nothing_passes():
    """No distance says that: it is as far from the wall as ever."""
    model = mover()
    model.weights[0] = 0.999  # what it withstands
    for margin, place, how in (
        (0.0, 80.0, KEPT),
        (0.25, 99.0, KEPT),
        (0.25, 99.74, NOTHING_PASSES),
    ):
        assert search_for(model, [-1.0], [[[-1.0, 0.0]]], margin, place)[0] == how


def test_what_is_refused_is_changed_by_no_more_than_it_takes():
    how, action, _, left = search_for(mover(), [1.0], [[[-1.0, 0.0]]], place=WALL - 0.2)
    assert how == CHANGED
    assert 0.0 < action[0] <= 0.2
    assert left == pytest.approx(0.2 - action[0])
    policies = [[[1.0, 0.0], [0.0, 0.0]]]
    how, action, _, _ = search_for(mover(choices=2), [0.0, 1.0], policies, place=WALL - 0.2)
    assert action.tolist() == [1.0, 0.0]


def test_where_nothing_passes_the_backup_that_lasts_longest_is_told_and_whether_all_are_alike():
    to, still, away = [[1.0, 0.0]], [[0.0, 0.0]], [[-0.1, 0.0]]
    model = mover()
    model.weights[0] = 0.5
    how, action, backup, apart = search_for(model, [1.0], [to, still, away], place=WALL - 2.0)
    assert (how, backup, action.tolist()) == (NOTHING_PASSES, 2, [-0.1])
    assert search_for(model, [1.0], [to, to], place=WALL - 2.0)[-1] < 0.02 < apart


def test_so_many_disturbances_need_not_be_survived_but_that_none_begins():
    pushed, doomed = np.zeros((STEPS, 1, 3)), mover()
    pushed[0, 0, 1:] = 5.0, 8.0
    doomed.weights[0] = 1.0
    asked = {"place": WALL - 3.0, "residuals": pushed}
    for model, allowed, how in (
        (mover(), 1, NOTHING_PASSES),
        (mover(), 2, KEPT),
        (doomed, 2, NOTHING_PASSES),
    ):
        found = search_for(model, [0.0], [[[0.0, 0.0]]], allowed=allowed, **asked)
        assert found[0] == how
        assert how != KEPT or found[-1] == pytest.approx(3.0)  # of those that are survived


def test_a_regulator_holds_two_unstable_axes_at_a_place_and_ends_where_costs_are_endless():
    A, B = np.eye(5), np.zeros((5, 2))
    A[[1, 3], [2, 4]], A[[2, 4], [1, 3]], B[[2, 4], [0, 1]] = 0.1, 0.2, 0.1
    away = np.eye(5)[1:]
    away[[0, 2], 0] = -1.0, 2.0  # at 1 and -2
    K = regulator(A, B, away.T @ away, 0.01, 200)
    x = np.array([1.0, 0.0, 0.0, 0.0, 0.0])
    for _ in range(400):
        x = A @ x + B @ K @ x
    assert np.allclose(x, [1.0, 1.0, 0.0, -2.0, 0.0], atol=0.3)
    assert np.isfinite(regulator(1e9 * A, B, away.T @ away, 0.01, 200)).all()
