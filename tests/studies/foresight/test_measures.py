"""What is judged, by whom it is foreseen, and how that is measured."""

import math

import numpy as np
import pytest

pytest.importorskip("scipy")
pytest.importorskip("gymnasium")

from studies.foresight.data import Cases, Run, cases, gather
from studies.foresight.measures import leads, measured, scored
from studies.foresight.rivals import Logistic, Neighbours, Taylor
from studies.systems import Start


def run(steps, *, failed):
    """A point that moves by 1 in each step."""
    z = np.arange(float(steps + 1))[:, None]
    actions = np.zeros((steps, 1))
    return Run(z, actions, tuple(actions[:, 0]), failed)


def test_steps_are_counted_back_from_the_end():
    some = cases([run(12, failed=True), run(9, failed=False)], every=5)
    np.testing.assert_array_equal(some.z[:, 0], [6.0, 11.0, 3.0, 8.0])
    np.testing.assert_array_equal(some.left, [6.0, 1.0, math.inf, math.inf])
    np.testing.assert_array_equal(some.truth(5), [False, True, False, False])
    np.testing.assert_array_equal(some.judged(5), [True, True, True, False])
    np.testing.assert_array_equal(some.episode, [0, 0, 1, 1])
    np.testing.assert_array_equal(some.change, 1.0)


def test_the_same_start_gives_the_same_episode_and_controllers_are_mixed():
    starts = [Start.held_out(0, k) for k in range(12)]
    one, other = gather("acc", starts), gather("acc", starts)
    for a, b in zip(one, other, strict=True):
        np.testing.assert_array_equal(a.observations, b.observations)
        np.testing.assert_array_equal(a.actions, b.actions)
        assert np.abs(a.actions).max() <= 1.0
        assert len(a.observations) == len(a.actions) + 1 == len(a.executed) + 1
    assert {run.failed for run in one} == {True, False}


def random_cases(seed=0, n=400, truth=lambda z: z[:, 0] > 0.0):
    """Steps of a system that fails in the next step, where ``truth`` says so."""
    rng = np.random.default_rng(seed)
    z = rng.normal(size=(n, 2))
    zeros = np.zeros((n, 2))
    left = np.where(truth(z), 1.0, math.inf)
    action = rng.uniform(-1.0, 1.0, (n, 1))
    episode = np.arange(n) // 4
    return Cases(z, zeros, zeros, action, action, left, np.full(n, 99.0), episode, n // 4)


def test_logistic_regression_and_neighbours_learn_a_curved_boundary():
    def circle(z):
        return (z**2).sum(axis=1) < 1.0

    train, others, test = (random_cases(seed, 800, circle) for seed in range(3))
    truth = test.truth(5)
    regression = Logistic(train, train.truth(5))
    near = Neighbours(train, train.truth(5), others, others.truth(5))
    for said in (regression, near):
        probability = said(test)
        assert (probability.min() >= 0.0) & (probability.max() <= 1.0)
        assert ((probability > 0.5) == truth).mean() > 0.9


def test_extrapolation_is_exact_where_motion_is_uniform_or_its_pace_grows():
    z = np.array([[0.0], [0.0]])
    change, earlier = np.array([[1.0], [2.0]]), np.array([[1.0], [1.0]])
    zeros, left = np.zeros((2, 1)), np.full(2, math.inf)
    some = Cases(z, change, earlier, zeros, zeros, left, left, np.zeros(2, np.intp), 1)
    sides = np.array([[0.0, 1.0, 9.5, 1.0]])
    np.testing.assert_array_equal(Taylor(sides, 1).steps(some), [10.0, 5.0])
    np.testing.assert_array_equal(Taylor(sides, 2).steps(some), [10.0, 3.0])  # 3, 7, 12
    assert np.isinf(Taylor(-sides, 1).steps(some)).all()
    assert np.isinf(Taylor(np.empty((0, 4)), 1).steps(some)).all()


def test_a_perfect_score_is_measured_as_one_and_a_blind_one_is_not():
    test, others = random_cases(1), random_cases(2)

    def of(score):
        made = scored(score(test), test, score(others), others, 5)
        return measured([made, made], test.episodes, 30, 0)

    perfect = of(lambda some: some.truth(5).astype(float))
    assert perfect["brier"].value == perfect["ece"].value == perfect["false_95"].value == 0.0
    assert perfect["f1"] == (1.0, 1.0, 1.0)
    blind = of(lambda some: np.zeros(len(some.z)))
    assert blind["brier"].value == pytest.approx(0.25, abs=0.01)
    assert blind["false_95"].value == 1.0
    assert blind["brier"].low < blind["brier"].value < blind["brier"].high


def test_lead_time_is_from_the_first_alarm_that_stays_on():
    some = cases([run(12, failed=True), run(12, failed=True), run(12, failed=False)], every=1)
    score = np.where(np.isfinite(some.left) & (some.left <= 4.0), 1.0, 0.0)
    score[(some.episode == 0) & (some.left == 8.0)] = 1.0  # goes off again
    score[(some.episode == 1) & (some.left == 1.0)] = 0.0  # is not on at the end
    others = cases([run(12, failed=False), run(12, failed=True)], every=1)
    made = scored(score, some, np.where(others.left <= 4.0, 1.0, 0.0), others, 4)
    found, episodes = leads(made)
    np.testing.assert_array_equal(found, [4.0, 0.0])
    np.testing.assert_array_equal(episodes, [0, 1])
