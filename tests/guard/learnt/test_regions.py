"""Where a system fails that is no threshold."""

from io import BytesIO

import numpy as np
import pytest

from evofsm import Guard
from evofsm.guard.learnt.regions import distances, explain, inside

SHAPES = {
    "disc": lambda z: np.hypot(z[..., 0], z[..., 2]) < 0.8,
    "oblique": lambda z: 0.8 * z[..., 1] + 0.6 * z[..., 2] > 1.2,
    "ring": lambda z: np.hypot(z[..., 0], z[..., 1]) > 1.7,
    "hyperbola": lambda z: z[..., 0] * z[..., 1] > 0.8,
    "two discs": lambda z: np.hypot(np.abs(z[..., 1]) - 1.0, z[..., 2]) < 0.4,
    "corner": lambda z: (z[..., 0] > 0.5) & (z[..., 1] > 0.5),
}
UNIT = np.full(3, 0.1)


def seen(shape, seed=0):
    """Failures and what was survived, in three variables."""
    z = np.random.default_rng(seed).uniform(-2.0, 2.0, (2000, 3))
    fails = SHAPES[shape](z)
    return z[fails][:40], z[~fails]


@pytest.mark.parametrize("shape", SHAPES)
def test_regions_explain_failures_and_nothing_that_was_survived_is_inside(shape):
    failures, survived = seen(shape)
    thresholds, regions = explain([], failures, survived, UNIT, survived.std(0))
    assert thresholds == []
    assert len(regions) <= 3
    assert inside(regions, failures).any(0).mean() >= 0.95
    assert (distances(regions, survived) > 0.0).all()
    elsewhere = np.random.default_rng(1).uniform(-2.0, 2.0, (2000, 3))
    said = (distances(regions, elsewhere) < 0.0).any(0)
    assert (said != SHAPES[shape](elsewhere)).mean() < 0.06


@pytest.mark.parametrize("shape", SHAPES)
def test_order_unit_direction_and_origin_of_variables_make_no_difference(shape):
    failures, survived = seen(shape)
    order, times, off = [2, 0, 1], np.array([-3.7, 0.25, 100.0]), np.array([5.0, -2.0, 30.0])

    def written(z):
        return (z * times + off)[:, order]

    _, found = explain([], failures, survived, UNIT, survived.std(0))
    spread, unit = ((np.abs(times) * one)[order] for one in (survived.std(0), UNIT))
    _, other = explain([], written(failures), written(survived), unit, spread)
    far, otherwise = distances(found, survived), distances(other, written(survived))
    assert len(far) == len(otherwise)
    np.testing.assert_allclose(far.min(0), otherwise.min(0), rtol=1e-4, atol=1e-4)


def test_what_thresholds_explain_has_no_region_and_few_of_them_may_be_challenged():
    failures, survived = seen("oblique")
    behind = [(1, 1.0, 0.0), (2, 1.0, 0.0)]
    assert explain(behind, failures[:1], survived, UNIT, UNIT)[0] == behind
    survived = survived[~SHAPES["oblique"](survived)]
    weak = [(2, 1.0, float(np.sort(failures[:, 2])[-2]))]
    stay, regions = explain(weak, failures, survived, UNIT, survived.std(0))
    assert stay == []
    assert len(regions) == 1


# -- As guards learn them -----------------------------------------------------------------------


def play(guard, episode, wanted=None):
    """Walk in the plane towards random places, amid a disc; whether it failed."""
    rng = np.random.default_rng(episode)
    place, speed, said = rng.uniform([-2.0, -1.5], [-1.4, 1.5]), np.zeros(2), []
    to = rng.uniform([1.4, -1.5], [2.0, 1.5])
    for _ in range(60):
        proposal = np.clip(0.7 * (to - place) - speed + 0.2 * rng.normal(size=2), -1.0, 1.0)
        said.append(guard.decide([*place, *speed], proposal))
        speed = speed + 0.1 * said[-1].executed + 0.004 * rng.normal(size=2)
        place = place + 0.1 * speed
        if np.hypot(*place) < 0.6:
            break
    failed = bool(np.hypot(*place) < 0.6)
    guard.end(failed, [*place, *speed])
    return said, failed


@pytest.fixture(scope="module")
def taught():
    """A guard that learnt where the disc is."""
    guard = Guard(-np.ones(2), np.ones(2), interval=0.1, horizon=2.0)
    for episode in range(12):
        play(guard, episode)
    return guard


def test_a_disc_is_learnt_said_and_no_threshold(taught):
    dynamics = taught.judge.dynamics
    assert len(dynamics.regions) >= 1
    survived = np.concatenate([dynamics.survived, dynamics.brinks])
    assert (distances(dynamics.regions, survived) > 0.0).all()
    assert "ellipse of variable 1 and variable 2 around (" in taught.judge.told_by_experience
    assert taught.told_here([0.0, 0.0, 0.0, 0.0]).startswith("This is where it fails: inside")
    assert "ordinary changes from where it fails" in taught.told_here([-0.9, 0.0, 0.0, 0.0])
    assert taught.told_here([-2.0, 1.5, 0.0, 0.0]) == ""
    again = Guard.load(BytesIO(saved(taught)))
    assert saved(again) == saved(taught)
    held = [play(again, 100 + episode) for episode in range(5)]
    assert sum(failed for _, failed in held) <= 1


def test_thresholds_that_one_failure_tells_are_doubted_where_nearly_all_is_refused_for_long():
    guard = Guard(-np.ones(1), np.ones(1), interval=0.1, horizon=2.0)
    rng, dynamics = np.random.default_rng(0), guard.judge.dynamics

    def play(to, failed):
        z = np.zeros(2)
        while z[0] < to:
            guard.decide(z, np.ones(1))
            z = z + 0.02 + 0.002 * rng.normal(size=2)
        guard.end(failed, z)

    for k in range(4):
        play(1.0 if k == 3 else 0.5, k == 3)
    assert len(dynamics.thresholds) == 2  # of one failure it may be either
    play(0.5, failed=False)
    for _ in range(8):
        assert len(dynamics.daring.thresholds) == 2
        dynamics.challenge(60)
    assert not len(dynamics.daring.thresholds)
    assert len(dynamics.model.thresholds) == 2
    assert "so it is doubted" in guard.decide(np.zeros(2), np.ones(1)).reason
    guard.freeze()
    guard.decide(np.zeros(2), np.ones(1))
    assert "is doubted" not in guard.decide(np.zeros(2), np.ones(1)).reason
    guard.learn = True
    play(1.0, failed=True)
    assert len(dynamics.daring.thresholds) >= 1


def saved(guard):
    guard.save(file := BytesIO())
    return file.getvalue()
