"""What is known need not be learnt: a model, where it fails, a backup."""

import numpy as np
import pytest

from evofsm import Guard
from evofsm.guard.learnt.rollout import action_of

WALL = 60.0


def move(z, u):
    """Brakes are weaker than actions say."""
    speed = max(0.0, z[1] + 0.1 * max(-0.8, float(u)))
    return np.array([z[0] - 0.1 * speed, speed])


def drive(guard, seed, start=WALL):
    """Towards a wall, by a driver who does not see it; whether it was hit."""
    rng = np.random.default_rng(seed)
    z = np.array([start, rng.uniform(4.0, 8.0)])
    for _ in range(150):
        z = move(z, np.squeeze(guard.decide(z, rng.uniform(-1.0, 2.0)).executed))
        if z[0] <= 0.0:
            break
    guard.end(bool(z[0] <= 0.0), z)
    return z[0] <= 0.0


@pytest.mark.slow
def test_a_given_model_knows_of_brakes_that_were_never_tried():
    hit = []
    for given in ({}, {"model": move}):
        guard = Guard(-4.0, 2.0, interval=0.1, failed=lambda z: z[0] <= 0.0, seed=1, **given)
        for k in range(6):  # far away from the wall, and no hard braking
            drive(guard, k, start=WALL + 400.0)
        guard.shadow = False  # nobody drives alone near the wall
        hit.append(sum(drive(guard, 100 + k) for k in range(8)))
    assert hit[1] <= 2 < 5 <= hit[0]  # it is fitted, not copied


def test_what_is_wrong_with_a_given_function_is_said_and_nothing_is_learnt(tmp_path):
    guard = Guard(-1.0, 1.0, interval=0.1, model=lambda z, u: [0.0])
    for k in range(5):
        guard.decide([1.0 + 0.1 * k, 2.0], 0.5)
    before = str(guard)
    with pytest.raises(ValueError, match=r"model gave \[0\.\] after .*2 finite numbers"):
        guard.end(False)
    assert str(guard) == before
    with pytest.raises(TypeError, match="backup is 3; it must be a function, such as"):
        Guard(-1.0, 1.0, interval=0.1, backup=3)
    with pytest.raises(ValueError, match="LearntRisk asks no model, no backup"):
        Guard(-1.0, 1.0, interval=0.1, judge=guard.judge, model=move)
    guard.save(tmp_path / "guard")
    again = Guard.load(tmp_path / "guard", model=lambda z, u: 1 / 0)  # as given anew
    for k in range(5):
        again.decide([1.0 + 0.1 * k, 2.0], 0.5)
    with pytest.raises(ZeroDivisionError) as raised:
        again.end(False)
    assert "model was asked of [1.1 2. ], " in raised.value.__notes__[0]


class Asked(dict):
    """A function that remembers what it was asked: empty, and so false, at first."""

    def __call__(self, z, u=0.0):
        self[tuple(z)] = u
        return move(z, u) if u else -1.0


@pytest.mark.parametrize("name", ["model", "backup"])
def test_a_function_that_is_false_as_an_object_is_asked_too(name):
    guard = Guard(-1.0, 1.0, interval=0.1, **{name: Asked()})
    for k in range(9):
        guard.decide([1.0 + 0.1 * k, 2.0], 0.5)
    guard.end(True, [2.0, 2.0])
    assert getattr(guard.judge, name)


@pytest.mark.parametrize("name", ["choices", "plane"])
def test_a_given_backup_is_fitted_for_choices_and_for_many_numbers(points, name):
    def backup(z):
        return int(1.0 - np.sign(z[0])) if name == "choices" else np.clip(-4.0 * z[:2], -1.0, 1.0)

    guard = points[name].taught(3, backup=backup)
    state, model = guard.judge.state, guard.judge.parts.model
    given = state.policies[state.linear == 2.0]
    assert len(given) == 1
    for place in (0.5, -0.5):
        z = np.append(place, np.zeros(guard.judge.n_variables - 1))
        push = guard.judge.decode(action_of(model, given[0], z))[0] - (name == "choices")
        assert np.sign(push) == -np.sign(place)


def test_a_function_that_covers_not_all_failures_is_said_to():
    guard = Guard(low=-1.0, high=1.0, interval=0.1, failed=lambda z: z[0] > 318.0)  # [K], for [°C]
    for last in (47.0, 319.0, 46.0):
        for temperature in (42.0, 43.0, 44.0):
            guard.decide([temperature], 0.5)
        guard.end(failed=True, observation=[last])
    says = "failed= was False at the last row of 2 of 3 failures"
    assert f"; {says}" in str(guard)
    with pytest.warns(UserWarning, match=says):
        guard.freeze()


def test_a_guard_says_variables_by_their_names():
    guard = Guard(low=-1.0, high=1.0, interval=0.1, names=iter(["angle", "speed"]))
    for k in range(4):
        guard.decide([0.1 * k, 1.0], 0.5)
    guard.end(failed=True, observation=[0.4, 1.0])
    assert "fails where angle is above 0.3" in str(guard)
    there = "where it fails: angle is above 0.3 (1 failure)."
    assert guard.told_here([0.5, 1.0]) == f"This is {there}"
    assert guard.told_here([0.25, 1.0]).endswith(f"typical steps from {there}")
    with pytest.raises(ValueError, match=r"has 1 variables; it must have 2 \(angle, speed\)"):
        guard.decide([0.0], 0.5)
