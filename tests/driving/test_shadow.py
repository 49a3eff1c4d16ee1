import numpy as np
import pytest

from evofsm.driving import KinematicWorld, Leader, Scenario, guard_for_cars, shadow_drive
from evofsm.driving.drivers import IDM
from evofsm.guard import Mode

HASTY = IDM(2.25, 28.0, 0.8, 0.3, 2.0, lowest=-4.0, highest=2.5)
LEADER = Leader(IDM(1.2, 25.0, 1.0, 1.0, 2.5), brake_decel=9.0, brake_time=9.0)


def recorded():
    """A drive that ended in a collision, a row every quarter of a second."""
    episode = KinematicWorld().run(Scenario(LEADER, 8.0, duration=20.0), HASTY)
    assert episode.collided
    rows = [*range(0, len(episode.time) - 1, 25), len(episode.time) - 1]
    return episode.time[rows], episode.observations[rows], episode.accelerations[rows]


def test_it_decides_on_each_row_and_changes_none():
    time, seen, did = recorded()
    guard = guard_for_cars(low=-8.0, high=4.0, mode=Mode.SHADOW)
    drive = shadow_drive(guard, time, seen, did)
    assert len(drive.decisions) == len(time) - 1
    assert (drive.executed == drive.proposed).all()
    assert drive.collided
    assert not drive.rear_ended
    assert (drive.observations == seen).all()
    assert guard.machine.endings.sum() == 1.0
    advised = np.array([one.revision.advised for one in drive.decisions])
    assert advised[-1] < -2.0


def test_a_failure_may_be_told():
    time, seen, did = (rows[:4] for rows in recorded())
    for failed in (False, True):
        guard = guard_for_cars(low=-8.0, high=4.0, mode=Mode.SHADOW)
        shadow_drive(guard, time, seen, did, failed=failed)
        assert guard.machine.endings.sum() == failed


def test_who_would_act_and_what_is_too_short_is_refused():
    time, seen, did = recorded()
    with pytest.raises(ValueError, match="mode is act"):
        shadow_drive(guard_for_cars(low=-8.0, high=4.0), time, seen, did)
    guard = guard_for_cars(low=-8.0, high=4.0, mode=Mode.SHADOW)
    with pytest.raises(ValueError, match="with T of 2 or more"):
        shadow_drive(guard, time[:1], seen[:1], did[:1])
    with pytest.raises(ValueError, match="have the shapes"):
        shadow_drive(guard, time, seen[:, :2], did)
