"""Replays, and which action passes by them."""

import numpy as np
import pytest

from evofsm.guard.learnt.library import Backups, at_once, harm
from evofsm.guard.learnt.replay import (
    CHANGED,
    CUT_SHORT,
    GROWN,
    KEPT,
    NOTHING_PASSES,
    SHRUNK,
    Disturbances,
    Model,
    features,
    limited,
    n_features,
    replay,
    search,
)

STEPS, WALL = 20, 100.0
ACTION = 3  # index of the first one among the features: after 1, the variable, its latest change


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
        thresholds=np.array([[0.0, 1.0, WALL, 1.0]]),
        **dict.fromkeys(("regions", "endings", "crashes"), np.empty((0, 12))),
        dead_ends=np.empty((0, 3)),
        drifted=none,
        mean=none,
        inverse=one,
        choices=choices,
    )
    return model._replace(**others)


def random_model(draw, m, a, choices):
    """Something that moves, saturates, drifted in part, ends, and fails there or elsewhere."""
    one = np.ones(m)
    return Model(
        weights=0.05 * draw.normal(size=(n_features(m, a, box=not choices), m)),
        origin=draw.normal(size=m),
        reach=0.5 * one,
        lowest=np.append(-0.8, np.full(m - 1, -np.inf)),
        highest=np.append(np.full(m - 1, np.inf), 0.9),
        least=-0.2 * one,
        most=0.3 * one,
        thresholds=np.array([[0.0, 1.0, 0.7, 2.0], [m - 1.0, -1.0, -1.5, 0.5]]),
        regions=np.array([[1.0, m - 1.0, 1.5, -0.2, 2.0, 0.5, 1.0, 0.3, 0.1, -0.9, 0.4, -1.2]]),
        endings=np.array([[0.0, 2.0, -0.2, 0.3, 2.0, 0.5, 0.0, -0.9, 0.3, 0.1, 0.0, 0.0]]),
        crashes=np.array([[1.0, 1.0, 0.9, 0.0, 3.0, 1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0]]),
        dead_ends=np.column_stack([draw.normal(size=(2, m)), [0.4, 1.1], [9.0, 9.0]]),
        drifted=np.resize([1.0, -1.0, 0.0], m),
        mean=draw.normal(size=m),
        inverse=1.0 + draw.random(m),
        choices=a if choices else 0,
    )


def acts(model, policy, z):
    """What a policy does at an observation."""
    action = policy[:, 0] + policy[:, 1:] @ ((z - model.mean) * model.inverse)
    return np.eye(len(action))[action.argmax()] if model.choices else np.clip(action, -1.0, 1.0)


def nearest(region, z):
    """How far an observation is from a region, to first order."""
    i, j, *at, one, other, c, b, d, p, q, r = region
    x, y = (z[int(i)] - at[0]) * one, (z[int(j)] - at[1]) * other
    slope = np.array([b + 2.0 * p * x + q * y, d + q * x + 2.0 * r * y])
    return -(c + b * x + d * y + p * x * x + q * x * y + r * y * y) / np.sqrt(slope @ slope)


def from_dead_end(model, row, z):
    """How far an observation is from a dead end."""
    *centre, radius, worth = row
    return (np.linalg.norm((z - centre) * model.inverse) - radius) * worth


def plainly(model, situation, plan, policy, disturbances, k, scale, enough):
    """One replay, step by step in NumPy: steps survived, least distance, and that at its end."""
    m = len(model.origin)
    z, change, before = situation[:m], situation[m : 2 * m], situation[2 * m :]
    (steps, _, _), near, clock = disturbances.residuals.shape, np.inf, 0
    i, sign, threshold, begins, over = disturbances.place[k]
    dead_ends = [row for row in model.dead_ends if from_dead_end(model, row, z) >= 0.0]
    for t in range(steps):
        u = plan[t] if t < len(plan) else acts(model, policy, z)
        if t >= len(plan) and not model.choices:
            u = np.clip(policy[:, 0] + policy[:, 1:] @ ((z - model.mean) * model.inverse), -1, 1)
            u = np.clip(u, -1.0 + 0.01 * enough, 1.0 - 0.01 * enough)
        reach = model._replace(reach=scale * model.reach)
        move = (features(reach, z[None], change[None], before[None], u[None]) @ model.weights)[0]
        move = np.where(model.drifted > 0.0, np.clip(move, model.least, model.most), move)
        far = model.drifted < 0.0
        low = np.minimum(scale * model.least, np.maximum(move, 3.0 * model.least))
        high = np.maximum(scale * model.most, np.minimum(move, 3.0 * model.most))
        low, high = np.where(far, low, scale * model.least), np.where(far, high, scale * model.most)
        there = i < 0.0 or sign * ((z + move)[int(i)] - threshold) >= 0.0
        if i >= 0.0 and there and clock >= over:  # it begins again
            clock = int(begins)
        plays = i < 0.0 or (clock < over and (there or clock != begins))
        rest = scale * disturbances.residuals[clock, :, k] if plays else 0.0
        after = z + np.clip(move + rest, low, high)
        for j in np.flatnonzero((disturbances.jump_at[k] == clock) & plays):
            seen = np.clip(z, *disturbances.jump_from[k, j].T)
            to = disturbances.jump_to[k, j] + disturbances.jump_slope[k, j] @ seen
            after[j] = np.clip(to, *disturbances.landing[k, j])
        clock += plays
        after = np.clip(after, model.lowest, model.highest)
        z, change, before = after, after - z, u
        left = [s * (at - z[int(j)]) * worth for j, s, at, worth in model.thresholds]
        near = min([near, *left, *(nearest(row, z) - GROWN for row in model.regions)])
        end = min((nearest(row, z) for row in model.endings), default=np.inf)
        near = min([near, *(max(end - GROWN, nearest(row, z)) for row in model.crashes)])
        near = min([near, *(from_dead_end(model, row, z) for row in dead_ends)])
        if near < enough:
            return t, near
        if end <= -SHRUNK:  # it ends by itself
            return steps + 1, near
    return steps, near


@pytest.mark.parametrize("choices", [False, True])
@pytest.mark.parametrize("planned", [0, 1, 3])
def test_the_kernel_replays_as_a_plain_loop_does(choices, planned):
    draw, m, a, K = np.random.default_rng(planned), 3, 2, 5
    model, disturbances = random_model(draw, m, a, choices), Disturbances.none(K, STEPS, m)
    disturbances.residuals[:, :, 1:] = 0.1 * draw.normal(size=(STEPS, m, K - 1))
    disturbances.jump_at[2, 1], disturbances.jump_to[2, 1] = 4.0, 0.3
    disturbances.jump_slope[2, 1] = draw.normal(size=m)
    disturbances.jump_from[2, 1] = np.sort(draw.normal(size=(m, 2)))
    disturbances.landing[2, 1] = -0.2, 0.4
    disturbances.place[2:4] = [[0.0, 1.0, 0.1, 2.0, 9.0], [1.0, -1.0, 0.2, 0.0, 3.0]]
    situations = 0.3 * draw.normal(size=(4, 2 * m + a))
    situations[2:, :m] = [[-0.7, 0.1, 0.3], [-0.6, -0.2, 0.5]]
    plan, policy = draw.uniform(-1.0, 1.0, (planned, a)), draw.normal(size=(a, 1 + m))
    fails, happened = ("thresholds", "regions", "crashes", "dead_ends"), []
    harmless = model._replace(**{name: getattr(model, name)[:0] for name in fails})
    for one in (model, harmless):
        ends = replay(one, situations, plan, policy, disturbances, 1.3, 0.2)
        pairs = ((situation, k) for situation in situations for k in range(K))
        found = [plainly(one, z, plan, policy, disturbances, k, 1.3, 0.2) for z, k in pairs]
        survived, least = np.array(found).T
        value = np.where(survived < STEPS, survived - STEPS - 1.0, least)
        np.testing.assert_allclose(ends.value, value)
        happened += survived.tolist()
    assert min(happened) < STEPS < max(happened)  # some fail, and some end
    move = np.array([[5.0, 5.0, 5.0], [-5.0, -5.0, -5.0], [0.1, 0.1, 0.1]])
    expected = [[0.3, 0.9, 0.3], [-0.2, -0.6, -0.2], [0.1, 0.1, 0.1]]
    np.testing.assert_allclose(limited(model, move), expected)


# -- Which action passes ------------------------------------------------------------------------


def search_for(
    model, proposal, policies, margin=0.0, place=0.0, disturbances=None, allowed=0, most=np.inf
):
    """What is found there, if nothing disturbs: how, the action, the backup, and what is left."""
    disturbances = Disturbances.none(1, STEPS, 1) if disturbances is None else disturbances
    here, policies = np.array([place, 0.0, *[0.0] * len(proposal)]), np.array(policies)
    asked = here, policies, np.arange(len(policies)), disturbances, 1.0, np.array(proposal)
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


@pytest.mark.parametrize(("most", "how"), [(0, CUT_SHORT), (2, CUT_SHORT), (3, CHANGED)])
def test_a_search_is_cut_short_after_so_many_steps_with_the_backup_that_passed_last(most, how):
    back, still = [[-1.0, 0.0]], [[-0.5, 0.0]]
    found = search_for(mover(), [1.0], [back, still], place=WALL - 0.2, most=most)
    assert found[0] == how
    assert how == CHANGED or (found[1].tolist(), found[2]) == ([-1.0], 0)


def test_so_many_disturbances_need_not_be_survived_but_that_none_begins():
    pushed, doomed = Disturbances.none(3, STEPS, 1), mover()
    pushed.residuals[0, 0, 1:] = 5.0, 8.0
    doomed.weights[0] = 1.0
    asked = {"place": WALL - 3.0, "disturbances": pushed}
    for model, allowed, how in (
        (mover(), 1, NOTHING_PASSES),
        (mover(), 2, KEPT),
        (doomed, 2, NOTHING_PASSES),
    ):
        found = search_for(model, [0.0], [[[0.0, 0.0]]], allowed=allowed, **asked)
        assert found[0] == how
        assert how != KEPT or found[-1] == pytest.approx(3.0)  # of those that are survived


# -- Backups ------------------------------------------------------------------------------------


def test_feedback_evolves_where_no_constant_action_survives():
    """Between two walls: each constant one runs into one of them."""
    walls = np.array([[0.0, 1.0, 3.0, 1.0], [0.0, -1.0, -3.0, 1.0]])
    random = np.random.default_rng(1)
    seen, done = random.normal(size=(30, 1)).cumsum(0), random.uniform(-1.0, 1.0, (29, 1))
    model, found = mover(thresholds=walls), Backups.of(seen, done, choices=False)
    pushed = Disturbances.none(3, STEPS, 1)
    pushed.residuals[:, 0, 1], pushed.residuals[:, 0, 2] = 0.5, -0.5
    situations = np.array([[-2.0, 0.0, 0.0], [2.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    for _ in range(10):
        found = at_once(found.evolved(model, situations, pushed, 1.0, random))
    ends = harm(model, situations, found.policies[found.ranks[:1]], pushed)
    assert found.ranks[0] >= found.n_constant
    assert found.policies[found.ranks[0], 0, 1] < 0.0  # back to the middle
    assert (ends >= 0.0).all()
    assert (np.diff(found.scores[found.ranks]) <= 0.0).all()
