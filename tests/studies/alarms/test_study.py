"""Windows, what alarms say of them, and rows of it."""

import math
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("scipy")

from studies.alarms.plan import Plan
from studies.alarms.study import run_alarms, said_by, threshold
from studies.alarms.windows import Windows, windows
from studies.detection.measures import Detector
from studies.policies import Group

from evofsm.guard import ConformalAlarm


def exposure(*episodes):
    """Episodes of so many decisions each, and whether they ended in a collision."""
    watched = [
        SimpleNamespace(commands=np.zeros(n), end=0.25 * n, collided=collided)
        for n, collided in episodes
    ]
    return SimpleNamespace(watched=watched, family=SimpleNamespace(interval=0.25))


def cut(*episodes):
    count = sum(n for n, _ in episodes)
    detector = Detector("made", Group.FIXED, lambda some: np.arange(float(count)))
    return windows(exposure(*episodes), detector)


def test_windows_before_a_collision_are_dangerous_and_open_ends_are_left_out():
    found = cut((50, True), (60, False))
    np.testing.assert_array_equal(found.episode, [0, 0, 0, 1, 1])
    np.testing.assert_array_equal(found.score, [19.0, 39.0, 49.0, 69.0, 89.0])
    # 20 decisions are 5 s: of the first 7.5 s are left, of the second 2.5 s
    np.testing.assert_array_equal(found.happened, [False, True, True, False, False])


def test_an_episode_that_ends_at_once_has_no_window():
    assert len(cut((10, False)).score) == 0


def test_a_fixed_threshold_holds_the_rate_of_what_it_was_chosen_on():
    rng = np.random.default_rng(0)
    score, happened = rng.normal(size=1000), rng.random(1000) < 0.5
    made = Windows(score, happened, np.arange(1000))
    above = score > threshold(made, 0.1, "false alarms")
    assert above[~happened].mean() == pytest.approx(0.1, abs=0.01)
    missed = score < threshold(made, 0.1, "misses")
    assert missed[happened].mean() == pytest.approx(0.1, abs=0.01)
    few = Windows(score[:5], np.zeros(5, np.bool_), np.arange(5))
    assert threshold(few, 0.1, "false alarms") == math.inf
    assert threshold(few, 0.1, "misses") == -math.inf  # no event to choose it on: always on


def test_an_alarm_is_told_a_window_later():
    alarm = ConformalAlarm(0.5, step=0.1)
    made = Windows(np.array([1.0, 2.0, 3.0]), np.zeros(3, np.bool_), np.zeros(3, np.intp))
    said = []
    for one in said_by(alarm, made):
        said.append((one, alarm.counted))
    assert [counted for _, counted in said] == [0, 1, 2]
    assert alarm.counted == 3


@pytest.mark.slow
def test_the_study_gives_a_row_for_each_alarm_and_the_same_ones_again():
    plan = Plan(family="cut_in", seeds=1, train=4, calibration=12, episodes=12, rounds=20)
    found = run_alarms(plan, workers=1)
    assert len(found.rows) == 3 * 2 * 2
    assert {row.world for row in found.rows} == {"cut_in"}
    for row in found.of("adaptive"):  # one of which nothing is known has no bound
        assert row.most is None or row.errors <= row.most * row.windows + 1e-9
    assert run_alarms(plan, workers=1).rows == found.rows
