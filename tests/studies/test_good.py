"""Good controllers are good, and the study says what a guard does to them."""

import polars
import pytest
from studies.good import ALONE, FRESH, FROZEN, GOOD, LEARNING, Driver, Good, driven
from studies.rivals import Unrevised
from studies.shapes import NEEDS
from studies.systems import Start, make_system

from evofsm.guard import run_episode


@pytest.mark.parametrize(("name", "careless"), GOOD)
def test_a_good_controller_does_not_fail_alone(name, careless):
    if name in NEEDS:
        pytest.importorskip(NEEDS[name][0])
    system = make_system(name, careless)
    driver = Driver(system, GOOD[name, careless])
    for k in range(4):
        options = {"start": Start.training(1, 0, k)}
        *_, last = run_episode(system, Unrevised(), driver, options=options)
        assert not last.failed


@pytest.mark.slow
def test_a_guard_that_learnt_of_a_careless_controller_leaves_a_good_one_alone():
    rows = driven("pendulum", "random", seed=0, train=12, episodes=3)
    assert [row["way"] for row in rows] == [ALONE, FRESH, FROZEN, LEARNING]
    assert all(row["failed"] == 0 and row["kept"] > 0.95 for row in rows)
    worse = [row | {"failed": 2 * (row["way"] == FROZEN)} for row in rows]
    page = Good().page({"rows": polars.DataFrame(worse)})
    assert page.lost[0].frame["way"].to_list() == [FROZEN]
