"""A trial learns on training episodes, is frozen, and counts what it does held out."""

from typing import NamedTuple

import numpy as np
import pytest
from studies.judges.amounts import PARTS
from studies.judges.plan import Plan
from studies.judges.study import run_judges
from studies.systems import make_system
from studies.systems.cartpole import CartPole
from studies.systems.system import Start
from studies.systems.trial import make_judge, run, trial, try_judge

import evofsm.guard


class Decided(NamedTuple):
    executed: object


class Timid:
    """Always the lowest action once it has seen a failure; it writes down what it is told."""

    def __init__(self, **told):
        self.told = told
        self.frozen = self.afraid = False
        self.ended = []
        self.decisions = 0

    def begin(self):
        self.decisions = 0

    def decide(self, observation, proposal):
        self.decisions += 1
        return Decided(self.told.get("low", 0) if self.afraid else proposal)

    def end(self, failed=False, observation=None):
        self.ended.append((failed, self.decisions, tuple(observation), self.frozen))
        self.afraid = self.afraid or (failed and not self.frozen)

    def freeze(self):
        self.frozen = True


@pytest.fixture
def made(monkeypatch):
    """The timid one in place of the learnt guard."""
    every = []

    def learnt_guard(**told):
        every.append(Timid(**told))
        return every[-1]

    monkeypatch.setattr(evofsm.guard, "learnt_guard", learnt_guard)
    return every


def test_failures_are_counted_while_learning_and_held_out(made):
    row = trial("acc", train=4, test=6, without=("margin", "lags"), seed=3)
    assert (row.failed_while_learning, row.failed, row.unrevised_failed) == (1, 0, 6)
    assert (row.trained, row.episodes, row.failed_late) == (4, 6, 0)
    assert (row.kept, row.mean_change) == (0.0, 2.0)
    assert (row.system, row.controller, row.judge) == ("acc", "full throttle", "learnt")
    assert row.without == "margin+lags"
    assert row.failed_low == 0.0
    assert 0.4 < row.failed_high < 0.5
    (guard,) = made
    assert guard.told == {
        "low": -2.0,
        "high": 2.0,
        "interval": 0.02,
        "seed": 3,
        "without": ("margin", "lags"),
    }
    assert [frozen for _, _, _, frozen in guard.ended] == [False] * 4 + [True] * 6
    failed, decisions, last, _ = guard.ended[0]
    assert failed
    assert decisions < 100
    assert last[0] >= 0.0


def test_failures_after_episode_30_are_late():
    row = trial("acc", train=33, test=1, judge="unrevised")
    assert (row.failed_while_learning, row.failed_late) == (33, 3)


def test_a_system_may_tell_its_horizon(made, monkeypatch):
    monkeypatch.setattr("studies.systems.acc.Acc.horizon", 1.2)
    trial("acc", train=0, test=1)
    assert made[0].told["horizon"] == 1.2


def test_actions_of_any_kind_are_told_and_kept(made):
    rows = [trial(name, train=1, test=1) for name in ("tanks", "reactor", "cartpole")]
    assert made[0].told["low"].tolist() == [0.0, 0.0]
    assert made[0].told["high"].tolist() == [1.0, 1.0]
    assert made[1].told["n_actions"] == 3
    assert rows[0].unrevised_failed == 1


def test_proposals_that_are_kept_change_nothing():
    for name in ("tanks", "reactor", "pendulum"):
        row = trial(name, judge="unrevised", train=0, test=2)
        assert (row.kept, row.mean_change) == (1.0, 0.0)


def test_the_score_of_cars_is_mobility():
    document = trial("emergency", judge="unrevised", train=0, test=3).as_dict()
    assert document["mobility"] == pytest.approx(1.0)
    assert document["return"] is None
    document = trial("acc", judge="unrevised", train=0, test=3).as_dict()
    assert document["mobility"] is None
    assert document["return"] < -2000.0


def test_the_kinematic_judge_drives_as_it_does_elsewhere():
    from evofsm.driving import drive, guard_for_family

    system = make_system("emergency")
    start = Start.training(0, 0, 4)
    guard, other = guard_for_family(system.family), guard_for_family(system.family)
    ended = run(system, guard, start)
    driven = drive(other, system.family.draw(start.seed, start.episode, split="train"))
    assert ended.kept == len(driven.decisions) - int(driven.changed.sum())
    np.testing.assert_array_equal(system._road.episode().record, driven.record)


def test_the_kinematic_judge_knows_cars_alone():
    with pytest.raises(ValueError, match="acc has no cars"):
        trial("acc", judge="kinematic")


def test_a_judge_of_ones_own_is_tried():
    def shy(system, without, seed):
        return Timid(low=-2.0)

    row = trial("acc", judge=shy, train=1, test=2)
    assert (row.judge, row.failed) == ("shy", 0)


# -- The study ------------------------------------------------------------------------------------


@pytest.mark.slow
def test_every_judge_part_and_seed_has_a_row(made):
    plan = Plan(systems="acc,emergency", without="margin,states", seeds=2, train=2, test=2)
    done = []
    found = run_judges(plan, lambda *at: done.append(at), workers=1)
    judges = [(row.system, row.judge, row.without, row.seed) for row in found.rows]
    assert judges[:4] == [
        ("acc", "unrevised", "", 0),
        ("acc", "learnt", "", 0),
        ("acc", "learnt", "margin", 0),
        ("acc", "learnt", "states", 0),
    ]
    assert judges.count(("emergency", "kinematic", "", 1)) == 1
    assert len(judges) == len(set(judges)) == 7 + 9
    assert done[-1] == (16, 16)
    assert found.systems == ["acc", "emergency"]
    assert found.parts == ["margin", "states"]
    assert len(found.of("acc", without="margin")) == 2


def test_the_short_form_is_a_look(made):
    plan = Plan(systems="cartpole,acc", test=3).shortened()
    assert plan.parts == ()
    found = run_judges(plan, workers=1)
    assert [(row.controller, row.judge) for row in found.rows] == [
        ("random", "unrevised"),
        ("random", "learnt"),
        ("full throttle", "unrevised"),
        ("full throttle", "learnt"),
    ]
    assert {row.trained for row in found.of()} == {30}


def test_parts_are_named_or_refused():
    assert Plan().parts == tuple(PARTS)
    assert Plan(without="none").parts == ()
    assert Plan(without="lags, jumps, lags").parts == ("lags", "jumps")
    with pytest.raises(ValueError, match="no part 'wheels'; there are stretches"):
        _ = Plan(without="wheels").parts


@pytest.mark.slow
def test_numbers_do_not_depend_on_the_number_of_processes():
    plan = Plan(systems="acc,reactor", without="margin", seeds=1, train=3, test=3)
    plan = plan.shortened()
    alone, shared = (run_judges(plan, workers=n).frame.as_dicts() for n in (1, 2))
    for one in (*alone, *shared):
        for took in ("p50_ms", "p99_ms"):
            assert one.pop(took) >= 0.0
    assert alone == shared


@pytest.mark.parametrize("seed", [0, *(pytest.param(k, marks=pytest.mark.slow) for k in (1, 2))])
def test_an_episode_of_ten_decisions_is_enough_to_learn_from(seed):
    """It fails once, as it must, and then no more."""
    row = trial("acc-5", train=6, test=4, base=7, seed=seed)
    assert (row.failed_while_learning, row.failed, row.unrevised_failed) == (1, 0, 4)


@pytest.mark.slow
def test_it_turns_back_before_full_torque_only_just_holds():
    """Leaning that far is no failure yet, but then the last digits of a model decide."""
    row = trial("pendulum-cos", "random", train=30, test=40, base=7, seed=2)
    assert row.unrevised_failed == 40
    assert row.failed <= 1


class Blurred(CartPole):
    """CartPole, seen with noise: of a hundredth of a radian, of 5 cm, and as much a second."""

    def reset(self, start):
        self.blur = start.rng(7)
        return self.blurred(super().reset(start))

    def step(self, action):
        step = super().step(action)
        return step._replace(observation=self.blurred(step.observation))

    def blurred(self, z):
        return z + self.blur.normal(0.0, [0.05, 0.05, 0.01, 0.05])


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 4])
def test_failures_that_noise_shows_amid_what_was_survived_are_understood(seed):
    system = Blurred()
    judge = make_judge("learnt", system, seed=seed)
    tried = try_judge(system, judge, seed=seed, train=30, test=20, base=7)
    assert sum(one.failed for one in tried.held_out) <= 1


@pytest.mark.slow
def test_lags_that_foresee_failure_that_never_comes_are_left_out():
    """Else nothing passes any more on the reactor, and what lasts longest is picked blindly."""
    told = {"train": 30, "test": 10, "base": 7, "seed": 0}
    assert trial("reactor", **told).failed == 0
    assert trial("reactor", without=("doubt",), **told).failed >= 3
