"""What decides between learning a system and learning nonsense, each by itself."""

import copy
import pickle

import numpy as np
import pytest

from evofsm.fsm.dynamics.consequents import Disturbances, Here, residuals
from evofsm.fsm.dynamics.dynamics import Dynamics
from evofsm.fsm.dynamics.questions import look_ahead
from evofsm.guard.learnt.search import harm


def sums_of(dynamics):
    return {name: array.copy() for name, array in dynamics.sums._asdict().items()}


@pytest.mark.parametrize(
    ("given", "why"),
    [
        ({}, "either"),
        ({"low": 0.0}, "either"),
        ({"low": 0.0, "high": 1.0, "n_actions": 2}, "either"),
        ({"low": 1.0, "high": 0.0}, "below high"),
        ({"low": [0.0, 0.0], "high": [1.0]}, "below high"),
        ({"low": np.nan, "high": 1.0}, "low"),
        ({"n_actions": 0}, "n_actions"),
        ({"n_actions": 2, "horizon": 0}, "horizon"),
        ({"n_actions": 2, "stretches": 1.5}, "stretches"),
        ({"n_actions": 2, "without": ["wheels"]}, "wheels"),
    ],
)
def test_settings_that_cannot_be_are_refused(given, why):
    with pytest.raises(ValueError, match=why):
        Dynamics(**given)


def test_it_learns_what_a_car_does(taught, drive):
    dynamics = taught(8)
    Z, U = drive(np.random.default_rng(9), steps=30, noise=0.0)
    for z, u in zip(Z[:-1], U, strict=True):
        dynamics.observe(z)
        dynamics.act(dynamics.encode(u))
    np.testing.assert_allclose(look_ahead(dynamics, U[-1], 1).mean[0], Z[-1], atol=0.05)


def test_the_failing_transition_is_neither_fitted_nor_remembered(taught, follow, drive):
    one, other = taught(), taught()
    Z, U = drive(np.random.default_rng(5))
    follow(one, Z, U)
    crash = Z[-1] + [-60.0, -14.0, 20.0]
    follow(other, np.vstack([Z, crash]), np.append(U, 0.0), failed=True)
    before, after = sums_of(one), sums_of(other)
    # The last one before the crash waits for one after it, which an end without failure does not.
    for name in ("least", "most", "unit"):
        np.testing.assert_allclose(after[name], before[name], rtol=0.01, err_msg=name)
    np.testing.assert_allclose(other.weights, one.weights, atol=0.02)
    assert len(other.stretches) == len(one.stretches)
    assert not any((stretch.observations == crash).any() for stretch in other.stretches)
    assert (other.highest == one.highest).all()
    assert (other.lowest == one.lowest).all()


def test_one_jump_of_130_m_changes_model_and_units_by_less_than_1_percent(taught, follow, drive):
    one, other = taught(6), taught(6)
    Z, U = drive(np.random.default_rng(5))
    follow(one, Z, U)
    jumped = Z.copy()
    jumped[50:, 0] += 130.0
    follow(other, jumped, U)
    np.testing.assert_allclose(other.sums.unit, one.sums.unit, rtol=0.01)
    np.testing.assert_allclose(other.consequents.reach, one.consequents.reach, rtol=0.01)
    ahead = [look_ahead_from(each, [40.0, 15.0, 14.0], 1.0) for each in (one, other)]
    np.testing.assert_allclose(ahead[1], ahead[0], rtol=0.01, atol=0.01 * one.sums.unit.max())


@pytest.mark.parametrize("at", [2, 5, 8, 20])
def test_a_jump_among_the_first_steps_there_are_is_one(follow, drive, at):
    """It would stand in the sums, and in the limits of what is ordinary, for ever."""
    dynamics = Dynamics(-2.5, 2.5)
    Z, U = drive(np.random.default_rng(5), noise=0.001)
    Z[at:, 0] -= 130.0
    follow(dynamics, Z, U)
    assert len(dynamics.jumps[0]) == 1
    assert dynamics.consequents.least[0] > -10.0
    ahead = look_ahead_from(dynamics, [40.0, 15.0, 14.5], 0.0)
    assert np.diff(ahead[:, 0]) == pytest.approx(-0.125, abs=0.03)


def look_ahead_from(dynamics, z, action, steps=4):
    return look_ahead(dynamics, action, steps, np.array(z)).mean


def test_long_steady_driving_and_then_fast_closing_is_learnt(follow, drive):
    dynamics = Dynamics(-2.5, 2.5)
    draw = np.random.default_rng(0)
    for _ in range(3):
        follow(dynamics, *drive(draw, steps=200, noise=0.001))
    before = dynamics.sums.counts[1]
    least = float(dynamics.sums.least[0])
    for _ in range(3):
        follow(dynamics, *drive(draw, steps=40, start=(200.0, 30.0, 3.0), noise=0.001))
    assert dynamics.sums.counts[1] > before
    assert dynamics.sums.least[0] < 3.0 * least  # it is a change like others, and no jump
    assert not dynamics.jumps[0]
    ahead = look_ahead_from(dynamics, [100.0, 30.0, 3.0], 0.0)[:, 0]
    np.testing.assert_allclose(np.diff(ahead), -0.25 * 27.0, rtol=0.1)


def stopping(speed, brake, steps=30):
    """A leader that brakes for good, and stands at 0."""
    leader = np.maximum(0.0, speed - brake * np.arange(steps))
    Z = np.column_stack([50.0 + np.zeros(steps), 10.0 + np.zeros(steps), leader])
    return Z, np.zeros(steps - 1)


def test_a_brake_remembered_from_a_low_speed_lasts_from_a_high_one(taught, follow, drive):
    dynamics = taught(6)
    for _ in range(3):  # it comes to stand in more than one episode: speeds stop at 0
        follow(dynamics, *drive(np.random.default_rng(7), start=(90.0, 10.0, 8.0), braking=20))
    assert dynamics.consequents.lowest[2] == 0.0
    Z, U = stopping(4.0, 0.75)
    inner = np.array([dynamics.encode(u) for u in U])
    found = np.zeros((20, 3))
    residuals(dynamics.consequents, Z, inner, 20, True, found)
    stood = int(np.flatnonzero(Z[1:, 2] == 0.0)[0])
    assert (found[stood + 1 : stood + 6, 2] <= 0.8 * found[: stood - 1, 2].max()).all()
    assert (found[stood + 1 : stood + 6, 2] < 0.0).all()
    censored = np.zeros((20, 3))
    residuals(dynamics.consequents, Z, inner, 20, False, censored)
    assert np.abs(censored[stood + 3 : stood + 8, 2]).max() < 0.2


def test_a_side_on_which_episodes_fail_is_never_a_saturation(taught, follow, drive):
    dynamics = taught(0)
    draw = np.random.default_rng(3)
    for k in range(6):
        Z, U = drive(draw, steps=60)
        Z[:, 0] = np.maximum(Z[:, 0] - Z[-1, 0], 0.0)  # each ends where the gap is 0
        follow(dynamics, np.vstack([Z, Z[-1] - [0.5 + 0.1 * k, 0.0, 0.0]]), [*U, 0.0], failed=True)
    assert dynamics.reached[0, 0] >= 2
    assert (0, -1.0) in [(j, sign) for j, sign, _ in dynamics.sides]
    assert dynamics.consequents.lowest[0] == -np.inf


def test_of_two_sides_that_explain_the_first_failures_alike_both_hold_until_told_apart():
    dynamics = Dynamics(n_actions=2)
    for _ in range(2):
        for t in range(40):
            dynamics.observe(np.array([np.sin(t), -np.sin(t)]))
            dynamics.act(dynamics.encode(t % 2))
        dynamics.observe(np.array([4.0, -4.0]))
        dynamics.end(failed=True)
        assert sorted((j, sign) for j, sign, _ in dynamics.sides) == [(0, 1.0), (1, -1.0)]
    for t in range(40):
        dynamics.observe(np.array([np.sin(t), -np.sin(t)]))
        dynamics.act(dynamics.encode(t % 2))
    dynamics.observe(np.array([4.0, 0.0]))
    dynamics.end(failed=True)
    assert [(j, sign) for j, sign, _ in dynamics.sides] == [(0, 1.0)]


@pytest.mark.parametrize("seed", range(3))
def test_order_unit_sign_and_origin_of_variables_and_actions_mean_nothing(seed, follow, drive):
    draw = np.random.default_rng(seed)
    order, scale = draw.permutation(3), draw.choice([-1.0, 1.0], 3) * 10.0 ** draw.uniform(-2, 2, 3)
    shift, turn = draw.normal(size=3) * 10.0 * np.abs(scale), -0.01
    plain = Dynamics(-2.5, 2.5)
    other = Dynamics(-0.025, 0.025)

    def seen(Z):
        return (Z * scale + shift)[..., order]

    for episode in range(4):
        Z, U = drive(draw, steps=80, braking=30 if episode % 2 else None)
        follow(plain, Z, U)
        follow(other, seen(Z), turn * U)
    z = np.array([30.0, 12.0, 10.0])
    one = look_ahead(plain, 1.5, 10, z)
    two = look_ahead(other, turn * 1.5, 10, seen(z))
    np.testing.assert_allclose(two.mean, seen(one.mean), rtol=1e-4, atol=1e-3 * np.abs(scale).min())
    np.testing.assert_allclose(two.spread, (one.spread * np.abs(scale))[:, order], rtol=1e-2)
    assert len(plain.stretches) == len(other.stretches) > 0


@pytest.mark.parametrize("twin", [Dynamics.copy, copy.deepcopy, copy.copy])
def test_a_copy_shares_nothing_and_goes_on_alike(taught, twin, follow, drive):
    dynamics = taught()
    dynamics.told = lambda z: bool(z[0] < 0.0)
    another = twin(dynamics)
    assert another.told is dynamics.told
    before = sums_of(dynamics)
    Z, U = drive(np.random.default_rng(8))
    follow(another, Z, U)
    for name, array in sums_of(dynamics).items():
        np.testing.assert_array_equal(array, before[name])
    follow(dynamics, Z, U)
    assert all((a == b).all() for a, b in zip(dynamics.sums, another.sums, strict=True))


def test_what_was_told_is_code_and_does_not_travel(taught, follow, drive):
    dynamics = taught()
    dynamics.told = lambda z: bool(z[0] < 0.0)
    again = pickle.loads(pickle.dumps(dynamics))
    assert again.told is None
    Z, U = drive(np.random.default_rng(8))
    dynamics.told = None
    for each in (again, dynamics):
        follow(each, Z, U)
    assert all((a == b).all() for a, b in zip(dynamics.sums, again.sums, strict=True))


def test_stretches_are_bounded_where_nobody_chooses(taught):
    assert len(taught(40, stretches=2).stretches) <= 8


def test_disturbances_replay_what_happened(taught):
    dynamics = taught(6)
    found = dynamics.disturbances()
    assert isinstance(found, Disturbances)
    assert isinstance(dynamics.frozen(), Dynamics)
    assert len(found.residuals) == 1 + len(dynamics.stretches)
    assert not found.residuals[0].any()
    dynamics.observe(np.array([40.0, 15.0, 15.0]))
    assert isinstance(dynamics.here, Here)


def test_a_long_rest_at_an_end_teaches_nothing_of_what_an_action_does(taught, follow):
    dynamics = taught()
    effect = dynamics.weights[[7, 8], 1].copy()  # of this action and the one before on own speed
    U = np.full(120, -2.0)
    own = np.maximum(0.0, 2.0 + 0.25 * np.cumsum(np.append(0.0, U)))
    Z = np.column_stack([30.0 - 0.25 * np.append(0.0, np.cumsum(own[:-1])), own, np.zeros(121)])
    follow(dynamics, Z, U)
    np.testing.assert_allclose(dynamics.weights[[7, 8], 1], effect, atol=0.01)
    follow(dynamics, Z, U)
    assert dynamics.consequents.lowest[1] == 0.0
    np.testing.assert_allclose(dynamics.weights[[7, 8], 1], effect, atol=0.01)


def test_what_hardly_ever_changes_is_learnt_at_its_ends_too(follow):
    draw = np.random.default_rng(0)
    dynamics = Dynamics(-1.0, 1.0)
    for _ in range(4):
        flag = (np.arange(101) // 25 % 2).astype(float)
        place = np.cumsum(np.append(0.0, draw.uniform(-1.0, 1.0, 100)))
        follow(dynamics, np.column_stack([place, flag]), np.diff(place))
    assert dynamics.weights[5, 0] == pytest.approx(1.0, abs=0.01)


def test_whoever_never_leaves_an_end_learns_that_it_is_one(taught, follow):
    dynamics = taught()
    leader = 8.0 + np.sin(np.arange(81))
    gap = 20.0 + np.cumsum(np.append(0.0, 0.25 * leader[:-1]))
    assert dynamics.consequents.lowest[1] == -np.inf
    follow(dynamics, np.column_stack([gap, np.zeros(81), leader]), np.full(80, -2.0))
    assert dynamics.consequents.lowest[1] == 0.0


def test_whoever_comes_to_an_end_once_and_stays_learns_that_it_is_one(taught, follow, drive):
    dynamics = taught()
    Z, U = drive(np.random.default_rng(2), start=(90.0, 4.0, 9.0))
    own = np.maximum(0.0, 4.0 - 0.5 * np.arange(len(Z)))  # brakes for good, and stands
    follow(dynamics, np.column_stack([Z[:, 0], own, Z[:, 2]]), np.full(len(U), -2.0))
    assert dynamics.consequents.lowest[1] == 0.0


def test_a_disturbance_that_is_taken_to_be_harder_than_ever_still_has_a_sequel(follow):
    """What coasts goes on as it did; a push beyond all that there were would end at once."""
    draw, dynamics = np.random.default_rng(0), Dynamics(-1.0, 1.0)
    for _ in range(6):
        U = draw.uniform(-1.0, 1.0, 80)
        speed = np.zeros(81)
        for t, u in enumerate(U):
            speed[t + 1] = 0.95 * speed[t] + 0.1 * u
        follow(dynamics, np.cumsum(speed)[:, None], U)
    known, none = dynamics.consequents, np.zeros((1, 1))
    once = np.zeros((1, 4, 1))
    once[0, 0] = 0.9 * known.most
    nowhere = np.zeros((1, 1, 1)), np.zeros((1, 1, 1, 2)), np.zeros((1, 1, 2))
    pushed = Disturbances(once, none - 1.0, none, *nowhere)
    known = known._replace(sides=np.array([[0.0, 1.0, known.mean[0] + 1000.0, 1.0]]))
    where = known.mean[None], none, none, np.zeros((1, 1, 2))
    left = np.empty((1, 1))
    gone = []
    for harder in (1.0, 3.0):
        harm(known, *where, pushed, harder, left)
        gone.append(1000.0 - left[0, 0])
    assert gone[0] > 3.0 * once[0, 0, 0]  # it goes on for four steps
    assert gone[1] == pytest.approx(3.0 * gone[0], rel=0.1)


def test_where_nothing_moves_nothing_disturbs(taught, follow):
    dynamics = taught()
    follow(dynamics, np.tile([300.0, 0.0, 0.0], (60, 1)), np.full(59, -1.0))
    assert (dynamics.latest.residuals == 0.0).all()
