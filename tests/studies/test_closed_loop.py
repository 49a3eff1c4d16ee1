"""The closed loop on fewer draws."""

from dataclasses import replace

import pytest
from studies import closed_loop
from studies.closed_loop import MACHINE, OURS, ClosedLoop

from evofsm.paper import write_page

# After ten drives a guard was seldom shown to help.
pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore:this guard was not shown")]
TINY = ClosedLoop(train=10, test=10, seeds=2, rule_seeds=1, rule_train=4, rule_test=3)
TINY = replace(TINY, world_train=10, world_test=2, machine_train=10, machine_check=4, check_test=10)


@pytest.fixture(scope="module")
def found():
    return TINY.run(workers=1)


def rows_of(found, policy):
    return found["rows"].filter(policy=policy).to_dicts()


def test_the_unrevised_driver_collides_and_ours_does_not(found):
    (unrevised,) = rows_of(found, "unrevised")
    assert unrevised["collision_rate"] > 0.8
    assert (unrevised["mobility"], unrevised["intervention_rate"]) == (1.0, 0.0)
    (always,) = rows_of(found, "always-brake")
    assert (always["mobility"], always["collisions"]) == (0.0, 0)
    ours = rows_of(found, OURS)
    assert [row["learning_seed"] for row in ours] == [0, 1]
    assert all(row["collisions"] == row["train_collisions"] == 0 for row in ours)
    assert all(row["mobility"] > 0.6 for row in ours)


def test_the_machine_is_told_nothing_but_failures_and_learns_from_the_same_draws(found):
    machine = rows_of(found, MACHINE)
    assert {row["told"] for row in machine} == {"nothing but failures"}
    assert {(row["train_episodes"], row["episodes"]) for row in machine} == {(10, 10)}
    # It knows of no collision before the first, and the driver alone has hardly an episode without.
    assert all(1 <= row["train_collisions"] <= 7 for row in machine)
    assert all(row["collisions"] <= 2 and row["mobility"] > 0.5 for row in machine)
    curve = found["curve"].filter(policy=MACHINE)
    assert set(curve["episodes"]) == {0, 2, 5, 10}
    assert curve.filter(episodes=0)["collisions"].min() >= 3


def test_the_page_names_every_policy_and_where_ours_loses(found, tmp_path, read_page):
    page = TINY.page(found)
    read = read_page(write_page(tmp_path / "index.html", [page]))
    read.is_sound()
    assert all(name in read.text for name in found["rows"]["policy"])
    lost = page.losses[0].frame
    assert "rss-matched" in set(lost["policy"])  # it changes fewer decisions
    assert not {"oracle", "evofsm-told"} & set(lost["policy"])  # which are our own reviser


def test_the_papers_cases_are_driven_without_a_collision_and_left_alone_where_safe():
    found = closed_loop._revise_cases(ClosedLoop(family="paper"))["cases"]
    case = {row["run"]: row for row in found}
    assert case["case 1"]["unrevised_collided"]
    assert case["case 4"]["unrevised_collided"]
    assert not any(row["collided"] for row in found)
    assert all(row["end"] > 59.9 for row in found)
    assert {"brake at 11 s", "brake at 15 s"} <= set(case)
    assert max(case["case 2"]["changed"], case["case 3"]["changed_late"]) <= 0.05
