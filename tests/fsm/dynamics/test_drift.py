"""A system that changes is noticed and followed; what was unforeseen before stays what it was."""

import numpy as np
import pytest

from evofsm.fsm.dynamics.dynamics import Dynamics
from evofsm.fsm.dynamics.keeping import from_bytes, to_bytes
from evofsm.fsm.dynamics.merging import merge_dynamics
from evofsm.fsm.dynamics.questions import look_ahead

BEFORE, WEAK = 30, -1.0


def braked(Z, U, weakest):
    """The same drive by a car that brakes no harder than this [m/s²]."""
    Z = Z.copy()
    for t, a in enumerate(U):
        Z[t + 1, 1] = max(0.0, Z[t, 1] + 0.25 * max(a, weakest))
        Z[t + 1, 0] = Z[t, 0] + 0.25 * (Z[t, 2] - Z[t, 1])
    return Z, U


@pytest.fixture
def changed(drive, follow):
    """Dynamics of a car that follows another; after some episodes its brakes weaken."""

    def make(after=10, weakest=WEAK, **settings):
        draw, dynamics = np.random.default_rng(3), Dynamics(-2.5, 2.5, **settings)
        for episode in range(BEFORE + after):
            Z, U = drive(draw, braking=60 if episode % 2 else None)
            follow(dynamics, *braked(Z, U, weakest if episode >= BEFORE else -2.5))
        return dynamics

    return make


def slows_by(dynamics, action=-2.5):
    """What a second of braking is expected to take from one's own speed [m/s]."""
    return 15.0 - look_ahead(dynamics, action, 4, np.array([40.0, 15.0, 15.0])).mean[-1, 1]


def test_weaker_brakes_are_noticed_and_followed(changed):
    dynamics = changed()
    assert {one.variable for one in dynamics.drifts} == {1}
    assert BEFORE <= dynamics.drifts[0].since <= dynamics.drifts[0].noticed < BEFORE + 8
    assert slows_by(dynamics) == pytest.approx(1.0, abs=0.15)
    assert slows_by(dynamics, 2.0) == pytest.approx(-2.0, abs=0.15)


def test_otherwise_the_old_brakes_are_believed_in(changed):
    dynamics = changed(without=["drift"])
    assert dynamics.drifts == []
    assert slows_by(dynamics) > 1.5


def test_a_leader_who_brakes_is_no_change(changed):
    dynamics = changed(weakest=-2.5)
    assert dynamics.drifts == []
    assert slows_by(dynamics) == pytest.approx(2.5, abs=0.1)


def test_what_was_remembered_is_replayed_with_the_new_brakes(changed):
    dynamics = changed()
    old = [k for k, one in enumerate(dynamics.stretches, 1) if one.episode < BEFORE]
    assert old
    residuals = dynamics.disturbances().residuals[old]
    assert residuals[:, :, 2].min() < -0.5  # the leader still brakes
    assert np.abs(residuals[:, :, 1]).max() < 0.2  # oneself as expected, now


def test_nothing_is_a_change_as_long_as_all_is_being_learnt(drive, follow):
    draw, dynamics = np.random.default_rng(3), Dynamics(-2.5, 2.5)
    for episode in range(16):
        follow(dynamics, *braked(*drive(draw), WEAK if episode >= 6 else -2.5))
    assert dynamics.drifts == []


def test_what_was_doubted_while_all_was_being_learnt_is_no_doubt_later(drive, follow):
    draw, dynamics = np.random.default_rng(3), Dynamics(-2.5, 2.5)
    for episode in range(20):
        follow(dynamics, *braked(*drive(draw), WEAK if episode >= 16 else -2.5))
        assert not dynamics.recent.doubt.any()


def test_cars_that_cut_in_are_jumps_after_a_change_too(drive, follow):
    draw, dynamics = np.random.default_rng(3), Dynamics(-2.5, 2.5)
    for episode in range(BEFORE + 12):
        Z, U = drive(draw, start=(160.0, 15.0, 15.0), braking=60 if episode % 2 else None)
        Z, U = braked(Z, U, WEAK if episode >= BEFORE else -2.5)
        Z[40:, 0] -= 120.0
        follow(dynamics, Z, U)
    assert {one.variable for one in dynamics.drifts} == {1}
    assert dynamics.sums.least[0] > -10.0
    assert dynamics.sums.scale[0] < 1.0


def test_it_is_kept_in_files_and_merges(changed, drive, follow):
    dynamics = changed(after=1)  # in doubt
    again = from_bytes(to_bytes(dynamics))
    draw = np.random.default_rng(9)
    for _ in range(5):
        drives = braked(*drive(draw, braking=40), WEAK)
        for each in (dynamics, again):
            follow(each, *drives)
    assert dynamics.drifts == again.drifts != []
    assert (to_bytes(dynamics) == to_bytes(again)).all()
    other = changed(after=0)
    merged = merge_dynamics([dynamics, other])
    last = merged.n_episodes - dynamics.n_episodes
    assert [one.noticed - last for one in merged.drifts] == [one.noticed for one in dynamics.drifts]
    assert not merged.recent.doubt.any()


def test_no_larger_change_is_foreseen_than_was_seen_since(changed):
    """Where the effect of the action bends is known only nearly."""
    dynamics = changed()
    assert dynamics.consequents.anew.tolist() == [-1.0, 1.0, -1.0]
    assert dynamics.sums.least[1] == pytest.approx(0.25 * WEAK)
    assert max(slows_by(dynamics, action) for action in np.linspace(-2.5, 0.0, 11)) <= 1.0 + 1e-9
