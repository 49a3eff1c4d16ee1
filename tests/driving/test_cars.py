"""Guards for cars: two judges, of which one is told how cars follow each other."""

import numpy as np
import pytest

pytest.importorskip("scipy")

from evofsm.driving.cars import (
    TOLD,
    guard_for_family,
    learners_of,
    learnt_by,
    load_learnt,
    name_judge,
    save_learnt,
)
from evofsm.driving.episodes import teach, try_out
from evofsm.driving.families import load_family
from evofsm.driving.family import held_out, training
from evofsm.driving.judge import LatentRisk
from evofsm.guard.guard import Guard
from evofsm.guard.learnt.judge import LearntRisk

pytestmark = pytest.mark.usefixtures("compiled")

EMERGENCY = load_family("emergency")


def taught(episodes, **settings):
    guard = guard_for_family(EMERGENCY, judge="learnt", **settings)
    drives = teach(guard, training(EMERGENCY, 0, 0, episodes))
    return guard, sum(one.collided for one in drives)


def decided(guard):
    """All that a frozen copy executes in a few held-out draws."""
    frozen = guard.copy()
    frozen.freeze()
    drives = teach(frozen, held_out(EMERGENCY, 0, 2))
    return np.concatenate([one.executed for one in drives]).tolist()


def test_a_judge_is_made_by_its_name():
    kinds = {"kinematic": LatentRisk, "learnt": LearntRisk}
    assert set(kinds) == set(TOLD)
    for name, kind in kinds.items():
        _, judge = learners_of(guard_for_family(EMERGENCY, judge=name))
        assert isinstance(judge, kind)
        assert name_judge(judge) == name
    with pytest.raises(ValueError, match="no judge 'wise'; there are kinematic, learnt"):
        guard_for_family(EMERGENCY, judge="wise")
    with pytest.raises(TypeError, match="no LatentRisk"):
        learnt_by(guard_for_family(EMERGENCY, judge="learnt"))


@pytest.mark.slow
def test_told_nothing_but_failures_it_learns_to_prevent_them():
    guard, collisions = taught(15)
    assert 1 <= collisions <= 6  # it can know of none before the first
    outcomes = try_out(guard, EMERGENCY, held_out(EMERGENCY, 0, 10))
    assert not any(one.collided for one in outcomes)
    assert np.mean([one.mobility for one in outcomes]) > 0.6


@pytest.mark.slow
def test_neither_states_nor_names_decide():
    """A machine with other states, and a judge that was not told what variables are called."""
    guard, _ = taught(6)
    other, _ = taught(6, rule=None)
    any_system = Guard(EMERGENCY.actions.low, EMERGENCY.actions.high, interval=EMERGENCY.interval)
    teach(any_system, training(EMERGENCY, 0, 0, 6))
    assert guard.machine.n_states > other.machine.n_states
    assert decided(guard) == decided(other) == decided(any_system)


def test_what_was_learnt_is_kept_with_the_machine_that_is_asked(tmp_path):
    guard, _ = taught(4)
    save_learnt(guard, tmp_path)
    machine, judge = load_learnt(tmp_path)
    assert isinstance(judge, LearntRisk)
    assert judge.dynamics.n_episodes == 4
    assert machine.n_states == guard.machine.n_states
    assert decided(guard_for_family(EMERGENCY, judge=judge)) == decided(guard)
