"""Rivals do what they are told they can: they save, and leave alone what needs no saving."""

import numpy as np
import pytest
from studies.systems import lacking, make_system
from studies.systems.rivals.counted import Counted
from studies.systems.rivals.masa import obstacle_shield, road_shield
from studies.systems.rivals.rival import BackupShield, tried
from studies.systems.system import Box, Discrete, System
from studies.systems.trial import trial


@pytest.mark.parametrize("hold", ["acc", "acc-5"])
@pytest.mark.parametrize("judge", ["stopping-distance", "barrier"])
def test_judges_of_acc_stay_short_of_the_leader_and_come_close(hold, judge):
    row = trial(hold, judge=judge, train=0, test=20)
    assert row.failed == 0
    assert row.score > 545.0


@pytest.mark.slow
def test_the_barrier_of_cbfpy_saves():
    pytest.importorskip("cbfpy")
    row = trial("acc", judge="cbfpy", train=0, test=3)
    assert row.failed == 0
    assert row.score > 500.0


@pytest.mark.parametrize(
    ("task", "controller"),
    [("cartpole", "random"), ("pendulum", "random"), ("pendulum-cos", "badpd")],
)
def test_the_regulators_ellipsoid_is_not_left(task, controller):
    row = trial(task, controller, judge="lqr-shield", train=0, test=3)
    assert row.failed == 0
    system = make_system(task)
    shield = system.rivals["lqr-shield"]()
    upright = np.zeros(len(system.variables))
    if task == "pendulum-cos":
        upright[0] = 1.0
    proposal = 1 if task == "cartpole" else 0.5
    assert shield.decide(upright, proposal).executed == proposal


def test_a_backup_shield_takes_the_closest_action_that_can_still_be_saved():
    """A point that moves by its speed; braking takes 1 off it, the wall is at 10."""
    box = Box((-1.0,), (1.0,))
    shield = BackupShield(
        box,
        "all",
        move=lambda states, taken: np.column_stack(
            [states[:, 0] + states[:, 1], states[:, 1] + taken.reshape(-1)]
        ),
        fails=lambda states: states[:, 0] >= 10.0,
        backup=lambda states: np.where(states[:, 1] > 0.0, -1.0, 0.0),
        steps=20,
    )
    assert shield.action(np.array([0.0, 0.0]), 1.0) == 1.0
    assert shield.action(np.array([5.0, 2.5]), 1.0) == pytest.approx(-0.75, abs=0.3)
    assert shield.action(np.array([9.0, 5.0]), 1.0) == 1.0  # lost, whatever is done


def test_roads_keep_their_limit_and_the_obstacle_is_not_entered():
    one, plane = Box((-2.0,), (2.0,)), Box((-2.0, -2.0), (2.0, 2.0))
    road = road_shield(one)
    assert road.action(np.array([0.0, 0.005]), 2.0) == 2.0
    assert road.action(np.array([0.0, 0.0095]), 2.0) < 0.41
    both = road_shield(plane).action(np.array([0.0, 0.0, 0.0099, 0.0]), np.array([2.0, 2.0]))
    assert both[0] <= 0.0
    assert both[1] == 2.0
    shield = obstacle_shield(plane)
    far, near = np.array([0.5, 0.5, 0.0, 0.05]), np.array([0.5, 1.85, 0.0, 0.05])
    assert np.array_equal(shield.action(far, np.ones(2)), np.ones(2))
    assert not np.array_equal(shield.action(near, np.ones(2)), np.ones(2))


def test_actions_that_are_tried_cover_the_set():
    assert tried(Discrete(3)).tolist() == [0.0, 1.0, 2.0]
    assert {tried(Box((-2.0,), (1.0,)))[i] for i in (0, -1)} == {-2.0, 1.0}
    corners = tried(Box((0.0, 0.0), (1.0, 2.0)))
    assert [1.0, 2.0] in corners.tolist()


class Ladder(System):
    """Up or down a ladder of ten rungs, from the middle; the top one breaks."""

    name, variables = "ladder", ("rung",)
    actions, interval, steps = Discrete(2), 1.0, 30

    @property
    def controllers(self):
        return {"random": lambda z: int(self.whim.integers(2))}

    def _begin(self, start):
        self._rung = 5

    def _observation(self):
        return np.array([float(self._rung)])

    def _advance(self, action):
        self._rung = max(self._rung + (1 if action else -1), 0)
        return 1.0, self._rung >= 9


@pytest.mark.slow
def test_a_shield_by_counts_learns_which_rung_breaks():
    from studies.systems.system import Start
    from studies.systems.trial import run

    ladder, judge = Ladder(), Counted(Ladder())
    learnt = [run(ladder, judge, Start.training(0, 0, k)).failed for k in range(40)]
    assert any(learnt)
    judge.freeze()
    tested = [run(ladder, judge, Start.held_out(0, k)) for k in range(30)]
    assert sum(one.failed for one in tested) <= 2
    assert judge.decide(np.array([8.0]), 1).executed == 0
    assert judge.decide(np.array([5.0]), 0).executed == 0
    assert sum(one.kept for one in tested) > 0.4 * sum(len(one.times) for one in tested)


@pytest.mark.parametrize("size", [1, 2, 3])
def test_actions_that_are_counted_reach_every_end_of_a_box(size):
    """Both ends of each number, whatever the others are."""
    ladder = Ladder()
    ladder.actions = Box((-1.0,) * size, (1.0,) * size)
    judge, seen = Counted(ladder), np.array([8.0])
    for sign in np.ndindex(*(2,) * size):
        corner = 2.0 * np.array(sign) - 1.0
        judge.decide(seen, corner if size > 1 else float(corner[0]))
        assert np.array_equal(judge._actions[judge._done[-1]], corner)


MASA = ["cont_cartpole", "disc_cartpole", "road_1d", "road_2d", "obstacle"]


@pytest.mark.parametrize("task", MASA)
@pytest.mark.skipif(bool(lacking("masa-road_1d")), reason=lacking("masa-road_1d"))
def test_labelled_tasks_fail_alone_and_not_under_judges_that_are_told(task):
    name = f"masa-{task}"
    system = make_system(name)
    (rival,) = system.rivals
    assert trial(name, judge="unrevised", train=0, test=4).failed == 4
    assert trial(name, judge=rival, train=0, test=4).failed == 0
