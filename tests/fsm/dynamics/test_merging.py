"""Two halves of a stream come to what all of it comes to."""

import numpy as np
import pytest

from evofsm.fsm.dynamics import dynamics as module
from evofsm.fsm.dynamics.consequents import Futures, fill_features, n_features
from evofsm.fsm.dynamics.dynamics import Dynamics
from evofsm.fsm.dynamics.keeping import to_bytes
from evofsm.fsm.dynamics.merging import merge_dynamics, moved
from evofsm.fsm.dynamics.questions import look_ahead


def halves(drive, rows=60, seed=0):
    draw = np.random.default_rng(seed)
    return [drive(draw, steps=rows), drive(draw, steps=rows, start=(90.0, 25.0, 22.0))]


def test_features_from_another_origin_are_a_linear_map_of_them():
    draw = np.random.default_rng(0)
    for box in (False, True):
        z, change, action, before = draw.normal(size=(4, 3))
        origin, other = draw.normal(size=(2, 3))
        p = n_features(3, 3, box=box)
        reach, found = np.full(3, np.inf), np.empty((2, p))
        none, count = np.empty((3, 1)), np.zeros(1, int)
        columns = [one[:, None] for one in (z, change, before, action)]
        for row, where in zip(found, (origin, other), strict=True):
            unused = count, none[None], count > 0
            ends = count, none[0], count, none[0]
            room = Futures(*unused, *columns, none, none, row[:, None], *ends)
            getattr(fill_features, "py_func", fill_features)(room, where, reach, box)
        np.testing.assert_allclose(moved(origin - other, 3, p) @ found[0], found[1], atol=1e-12)


def test_two_halves_merge_to_the_whole_up_to_rounding_and_forgetting(drive, follow, monkeypatch):
    monkeypatch.setattr(module, "_KEPT", 1.0)
    # In the light of what one half calls ordinary some residuals weigh less: not here.
    monkeypatch.setattr(Dynamics, "_rescale", lambda self, found, safe: None)
    both, *parts = (Dynamics(-2.5, 2.5, without=["stretches"]) for _ in range(3))
    for part, (Z, U) in zip(parts, halves(drive), strict=True):
        follow(part, Z, U)
        follow(both, Z, U)
    merged = merge_dynamics(parts)
    for name in ("counts", "squares", "products", "scatter", "variance", "least", "most"):
        one, other = (getattr(each.sums, name) for each in (merged, both))
        if name in ("squares", "products"):  # counted from the first observation of either
            T = moved(merged.origin - both.origin, 1, len(both.sums.squares))
            one = T @ one @ T.T if name == "squares" else T @ one
        scale = np.abs(other).max()
        np.testing.assert_allclose(one, other, rtol=1e-7, atol=1e-9 * scale, err_msg=name)
    np.testing.assert_allclose(
        merged.origin + merged.sums.mean, both.origin + both.sums.mean, rtol=1e-9
    )
    np.testing.assert_array_equal(merged.lowest, both.lowest)
    np.testing.assert_array_equal(merged.highest, both.highest)
    np.testing.assert_array_equal(merged.used, both.used)
    assert merged.n_episodes == both.n_episodes == 2


def test_what_merged_dynamics_expect_is_what_the_whole_expects(drive, follow):
    draw = np.random.default_rng(1)
    both, parts = Dynamics(-2.5, 2.5), [Dynamics(-2.5, 2.5) for _ in range(2)]
    for episode in range(12):
        Z, U = drive(draw, braking=50 if episode % 4 < 2 else None)
        follow(parts[episode % 2], Z, U)
        follow(both, Z, U)
    merged = merge_dynamics(parts)
    z = np.array([30.0, 14.0, 12.0])
    ahead = [look_ahead(each, -1.0, 8, z).mean for each in (merged, both)]
    np.testing.assert_allclose(ahead[0], ahead[1], atol=0.6)
    follow(merged, *drive(draw))  # it goes on


def test_the_order_of_parts_means_nothing(taught):
    parts = [taught(seed=seed) for seed in range(3)]
    one, other = merge_dynamics(parts), merge_dynamics(parts[::-1])
    assert (to_bytes(one) == to_bytes(other)).all()
    again = merge_dynamics(parts)
    assert (to_bytes(one) == to_bytes(again)).all()  # the parts stayed as they were


def test_the_newest_of_all_parts_are_remembered_evenly(taught):
    parts = [taught(30, seed=seed, stretches=2) for seed in range(3)]
    assert all(len(part.stretches) == 8 for part in parts)
    merged = merge_dynamics(parts)
    assert len(merged.stretches) == 8
    episodes = [one.episode for one in merged.stretches]
    assert episodes == sorted(episodes)
    assert max(episodes) < merged.n_episodes == 90
    for part in parts:
        assert any(
            np.array_equal(part.stretches[-1].observations, one.observations)
            for one in merged.stretches
        )


def test_failures_of_all_parts_are_explained_together(drive, follow):
    parts = []
    for side in (-1.0, 1.0):
        part = Dynamics(-2.5, 2.5)
        for _ in range(2):
            Z, U = drive(np.random.default_rng(3), steps=40)
            follow(part, np.vstack([Z, Z[-1] + [side * 500.0, 0.0, 0.0]]), [*U, 0.0], failed=True)
        parts.append(part)
    merged = merge_dynamics(parts)
    assert sorted((j, sign) for j, sign, _ in merged.sides) == [(0, -1.0), (0, 1.0)]
    assert len(merged.failures) == 4


def test_saturations_are_those_of_the_farthest_extreme(taught):
    one, other = taught(), taught()
    one.lowest[2], one.reached[2, 0] = 0.0, 5.0
    other.lowest[2], other.reached[2, 0] = 0.0, 2.0
    assert merge_dynamics([one, other]).reached[2, 0] == 7.0
    other.lowest[2] = -1.0
    assert merge_dynamics([one, other]).reached[2, 0] == 2.0


def test_parts_that_saw_nothing_add_nothing(taught):
    part = taught()
    merged = merge_dynamics([Dynamics(-2.5, 2.5), part, Dynamics(-2.5, 2.5)])
    assert (merged.sums.squares == part.sums.squares).all()
    assert merge_dynamics([Dynamics(-2.5, 2.5)] * 2).n_variables == 0


def test_parts_that_saw_no_transition_merge():
    parts = [Dynamics(n_actions=2) for _ in range(2)]
    for part, z in zip(parts, (1.0, 2.0), strict=True):
        part.observe(np.array([z]))
    merged = merge_dynamics(parts)
    assert merged.sums.counts.tolist() == [2.0, 0.0]
    assert not merged.is_noisy


def test_what_was_told_stays_told(taught):
    def failed(z):
        return bool(z[0] < 0.0)

    one, other = taught(), taught(seed=1)
    other.told, other.sides = failed, [(0, -1.0, 0.0)]
    for parts in ([one, other], [other, one]):
        merged = merge_dynamics(parts)
        assert merged.told is failed
        assert merged.sides == [(0, -1.0, 0.0)]


@pytest.mark.parametrize(
    "other", [Dynamics(n_actions=2), Dynamics(-2.5, 2.6), Dynamics(-2.5, 2.5, horizon=9)]
)
def test_other_actions_or_settings_are_refused(taught, other):
    with pytest.raises(ValueError, match="same settings"):
        merge_dynamics([taught(), other])


def test_other_numbers_of_variables_are_refused(taught):
    other = Dynamics(-2.5, 2.5)
    other.observe(np.zeros(2))
    with pytest.raises(ValueError, match="numbers of variables"):
        merge_dynamics([taught(), other])
