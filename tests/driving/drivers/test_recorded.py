import math

import numpy as np
import pytest

from evofsm.driving.drivers.idm import IDM
from evofsm.driving.drivers.recorded import RecordedController
from evofsm.driving.worlds.kinematic import KinematicWorld
from evofsm.driving.worlds.scenario import Body, Leader, Scenario

ANYTHING = np.array([10.0, 5.0, 5.0])
REPLAY = RecordedController([1.0, 2.0, 4.0], [1.5, -2.0, 0.5])


@pytest.mark.parametrize(
    ("time", "action"),
    [(1.0, 1.5), (1.999, 1.5), (2.0, -2.0), (3.999, -2.0), (4.0, 0.5), (1e6, 0.5)],
)
def test_each_value_holds_until_the_next_and_the_last_for_ever(time, action):
    assert REPLAY.propose(ANYTHING, time).action == action


def test_before_the_recording_there_is_nothing_to_propose():
    with pytest.raises(ValueError, match=r"begins at 1 s and says nothing for 0\.5 s"):
        REPLAY.propose(ANYTHING, 0.5)


def test_a_clock_that_is_off_in_its_last_digit_does_not_miss_a_sample():
    times = np.arange(1000) * 0.01
    replay = RecordedController(times, np.arange(1000.0))
    assert [replay.propose(ANYTHING, round(t, 9)).action for t in times] == list(range(1000))
    assert replay.propose(ANYTHING, 0.1 * 3 - 1e-12).action == 30.0


def test_an_episode_is_driven_again_as_it_was():
    idm = IDM(2.25, 28.0, 0.8, 0.6, 2.0, lowest=-4.0, highest=2.5)
    leader = Leader(IDM(1.2, 25.0, 1.0, 1.0, 2.5), brake_decel=6.0, brake_time=9.0)
    body = Body(lowest=-3.0, delay=0.2, jerk=10.0)
    world, scenario = KinematicWorld(), Scenario(leader, initial_gap=10.0, body=body)
    episode = world.run(scenario, idm)
    again = world.run(scenario, RecordedController.of(episode))
    assert np.array_equal(again.record, episode.record)


def test_the_recording_is_a_copy():
    accelerations = np.array([1.0, 2.0])
    replay = RecordedController([0.0, 1.0], accelerations)
    accelerations[:] = 9.0
    assert replay.propose(ANYTHING, 0.0).action == 1.0


@pytest.mark.parametrize(
    ("times", "accelerations", "word"),
    [
        ([0.0, 1.0], [1.0], "2 times and 1 accelerations"),
        ([0.0, 0.0], [1.0, 1.0], "0 s follows 0 s"),
        ([0.0, 2.0, 1.0], [1.0, 1.0, 1.0], "1 s follows 2 s"),
        ([0.0, math.nan], [1.0, 1.0], "times"),
        ([0.0, 1.0], [1.0, math.inf], "accelerations"),
        ([], [], "not empty"),
    ],
)
def test_an_impossible_recording_is_refused(times, accelerations, word):
    with pytest.raises(ValueError, match=word):
        RecordedController(times, accelerations)
