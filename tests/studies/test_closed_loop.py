"""The closed loop in its short form: the claims of the issue, on fewer draws."""

import json
from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("scipy")

from studies.closed_loop.amounts import ShiftPlan
from studies.closed_loop.beside import (
    run_cases,
    run_separation,
    run_shift,
    run_two_worlds,
)
from studies.closed_loop.calibration import reliability, run_calibration
from studies.closed_loop.machine import MACHINE, run_machine, run_machine_shift
from studies.closed_loop.plan import Plan
from studies.closed_loop.study import run_closed_loop
from studies.policies import fixed_policies
from studies.scores import auroc

from evofsm.driving.cars import guard_for_family, load_learnt, save_learnt
from evofsm.driving.episodes import drive, outcome_of, reference_of, teach, unrevised_guard
from evofsm.driving.families import load_family

pytestmark = pytest.mark.slow

EMERGENCY = load_family("emergency")
TINY = Plan(
    train=10,
    test=20,
    seeds=2,
    rule_seeds=1,
    rule_test=3,
    side_train=10,
    side_test=10,
    world_test=2,
    machine_checks=4,
)


@pytest.fixture(scope="module")
def study():
    return run_closed_loop(EMERGENCY, TINY, workers=2)


def rows_of(study, policy):
    return [row for row in study.rows if row.policy == policy]


@pytest.mark.slow
def test_the_unrevised_driver_collides_and_ours_does_not(study):
    [unrevised] = rows_of(study, "unrevised")
    assert unrevised.collision_rate > 0.8
    ours = rows_of(study, "evofsm")
    assert [row.learning_seed for row in ours] == [0, 1]
    assert all(row.collisions == 0 and row.mobility > 0.6 for row in ours)
    assert all(row.train_collisions == 0 for row in ours)


@pytest.mark.slow
def test_the_machine_learns_from_the_same_draws_and_is_tried_on_the_same_ones(study):
    machine = rows_of(study, MACHINE)
    assert [row.learning_seed for row in machine] == [0, 1]
    told = rows_of(study, "evofsm")
    assert {row.episodes for row in machine} == {row.episodes for row in told} == {20}
    assert {row.train_episodes for row in machine} == {10}
    # It knows of no collision before the first, and the driver alone has hardly an episode without.
    assert all(1 <= row.train_collisions <= 7 for row in machine)
    assert all(row.collisions <= 2 and row.mobility > 0.5 for row in machine)
    curve = [point for point in study.curve if point.policy == MACHINE]
    assert {point.episodes for point in curve} == {0, 2, 5, 10}
    assert all(point.collisions >= 3 for point in curve if point.episodes == 0)
    documents = [row for row in study.as_dict()["rows"] if row["policy"] == MACHINE]
    assert {row["told"] for row in documents} == {"nothing but failures"}


@pytest.mark.slow
def test_the_machine_goes_on_learning_after_a_shift():
    plan = Plan(shift=ShiftPlan(before=8, after=11, held_out=6))
    found = run_machine_shift(load_family("shift_leader"), plan, seed=0)
    (stream,) = found["streams"]
    assert (stream.policy, len(stream.collided)) == (MACHINE, 19)
    assert [check.episodes_after for check in found["checks"]] == [-1, 0, 10]
    assert {check.held_out for check in found["checks"]} == {6}


def test_without_training_there_is_no_row_of_the_machine():
    none = replace(TINY, seeds=1, rule_seeds=0, test=3, train=1, machine_train=0, side_test=4)
    assert not rows_of(run_closed_loop(EMERGENCY, none, workers=2), MACHINE)


def test_every_baseline_stands_in_the_table_once(study):
    expected = {policy.name for policy in fixed_policies(EMERGENCY)}
    assert {"unrevised", "aeb-ttc", "rss-r157", "rss-matched", "oracle"} <= expected
    for name in expected:
        assert len(rows_of(study, name)) == 1, name


def test_a_row_has_the_fields_that_others_rely_on(study):
    assert {
        *("family", "policy", "learning_seed", "train_episodes", "episodes", "collisions"),
        *("collision_rate", "mobility", "intervention_rate", "mean_change", "jerk"),
        "episodes_until_safe",
    } <= set(study.rows[0].as_dict())
    json.dumps(study.as_dict(), allow_nan=False)


def test_the_unrevised_driver_is_the_measure_of_mobility(study):
    [unrevised] = rows_of(study, "unrevised")
    assert unrevised.mobility == 1.0
    assert unrevised.intervention_rate == 0.0
    [always] = rows_of(study, "always-brake")
    assert always.mobility == 0.0
    assert always.collisions == 0


@pytest.mark.slow
def test_the_result_does_not_depend_on_the_number_of_workers(study):
    small = replace(TINY, seeds=1, rule_seeds=0, test=5, train=2)
    alone = run_closed_loop(EMERGENCY, small, workers=1)
    together = run_closed_loop(EMERGENCY, small, workers=2)
    assert [row.as_dict() for row in alone.rows] == [row.as_dict() for row in together.rows]


def test_the_papers_cases_are_driven_without_a_collision_and_left_alone_where_safe():
    by_name = {case.name: case for case in run_cases(load_family("paper"), Plan())["cases"]}
    assert by_name["case 1"].unrevised_collided
    assert by_name["case 4"].unrevised_collided
    assert not any(case.collided for case in by_name.values())
    assert all(case.end > 59.9 for case in by_name.values())
    assert {"brake at 11 s", "brake at 15 s"} <= set(by_name)
    assert by_name["case 2"].changed <= 0.05
    assert by_name["case 3"].changed_late <= 0.05


@pytest.mark.slow
def test_the_machine_learns_the_papers_cases_from_nothing_but_failures():
    found = run_machine(load_family("paper"), Plan(train=12, test=4, machine_checks=4), 0)
    by_name = {case.name: case for case in found["machine_cases"]}
    assert set(by_name) == {f"case {n}" for n in (1, 2, 3, 4)} | {"brake at 11 s", "brake at 15 s"}
    assert 1 <= found["rows"][0].train_collisions <= 4  # what failure is has to happen
    assert not any(by_name[f"case {n}"].collided for n in (1, 2, 3, 4))


@pytest.mark.slow
def test_brakes_that_weaken_are_noticed_while_unchanged_constants_collide():
    plan = Plan(shift=ShiftPlan(before=12, after=6, held_out=25))
    found = run_shift(load_family("shift"), plan, learning_seed=0)
    checks = {(check.policy, check.episodes_after): check for check in found["checks"]}
    assert checks["evofsm", 5].collisions == 0
    assert checks["rss-unchanged", -1].collisions == 0
    assert checks["rss-unchanged", 6].collisions > 15


def test_the_same_model_revises_alike_in_both_worlds():
    pytest.importorskip("libsumo")
    sumo, kinematic = run_two_worlds(EMERGENCY, Plan(side_train=8, world_test=4))["worlds"]
    assert sumo.collisions == kinematic.collisions == 0
    assert sumo.mean_speed == pytest.approx(kinematic.mean_speed, rel=1e-6)
    assert sumo.intervention_rate == pytest.approx(kinematic.intervention_rate)


@pytest.mark.slow
@pytest.mark.parametrize("family", ["rare", "weak_brakes"])
def test_dead_ends_are_told_apart(family):
    found = run_separation(load_family(family), Plan(side_train=30, side_test=40))["separations"]
    areas = {one.measure: one.auroc for one in found}
    assert areas["evofsm"] > 0.98
    assert areas["evofsm"] > areas["aeb-ttc"]


def test_probabilities_are_better_than_the_base_rate():
    counted, rehearsed = run_calibration(EMERGENCY, Plan(side_train=40, side_test=60))[
        "reliabilities"
    ]
    for one in (counted, rehearsed):
        assert one.brier < 0.6 * one.base_brier
        assert sum(part.cases for part in one.bins) == one.cases


def test_a_reliability_counts_what_it_is_told():
    one = reliability("", [0.05, 0.05, 0.95, 0.95], [False, True, True, True])
    assert [(part.observed, part.cases) for part in one.bins] == [(0.5, 2), (1.0, 2)]
    assert one.failures == 3


def test_the_area_under_the_curve():
    truth = np.array([False, True, False, True])
    assert auroc(np.array([0.0, 1.0, 0.0, 1.0]), truth) == 1.0
    assert auroc(np.zeros(4), truth) == 0.5
    assert np.isnan(auroc(np.zeros(4), np.zeros(4, bool)))


def test_a_driver_who_proposes_nothing_usable_is_replaced_and_counted():
    class Broken:
        def propose(self, observation, time=0.0):
            raise RuntimeError("no")

    draw = EMERGENCY.draw(0, 0, split="test")
    none = unrevised_guard(EMERGENCY)
    base = reference_of(EMERGENCY, draw)
    found = outcome_of(drive(none, draw, controller=Broken()), base, EMERGENCY.interval)
    assert found.changed == found.decisions
    assert found.change == 0.0


def test_what_was_learnt_is_kept(tmp_path):
    guard = guard_for_family(EMERGENCY, tolerance=0.01)
    teach(guard, (EMERGENCY.draw(0, index) for index in range(3)))
    save_learnt(guard, tmp_path)
    machine, risk = load_learnt(tmp_path)
    assert machine.n_states == guard.machine.n_states
    situation = np.array([20.0, 15.0, 15.0])
    actions = [-1.0, 0.0, 1.0]
    assert np.array_equal(
        risk.critical(situation, actions), guard.judge.critical(situation, actions)
    )
