"""Targets are judged where the run is long enough, by ours and the controller alone."""

import pytest

pytest.importorskip("scipy")
pytest.importorskip("gymnasium")

from studies.tasks.amounts import Amounts
from studies.tasks.study import Tasks
from studies.tasks.targets import claims


def merging(make_row, failed, speed, episodes=200):
    """Rows of the task of merging: who drives alone crashes in 160 of 200 episodes."""
    alone = make_row("merge", "random", "unrevised")
    ours = make_row("merge", "random", "scene")
    rows = [(alone, 160, 25.0), (ours, failed, speed)]
    return Tasks(
        Amounts(),
        [
            type(row)(**{**vars(row), "failed": count, "episodes": episodes, "speed": pace})
            for row, count, pace in rows
        ],
        [],
    )


def test_crashes_are_compared_with_those_of_the_controller_alone(make_row):
    fewer, speed = claims(merging(make_row, failed=8, speed=23.0))
    assert (fewer.measured, fewer.met) == ("95.0 %", True)
    assert (speed.measured, speed.met) == ("92.0 %", True)
    fewer, speed = claims(merging(make_row, failed=40, speed=20.0))
    assert (fewer.measured, fewer.met) == ("75.0 %", False)
    assert (speed.measured, speed.met) == ("80.0 %", False)


def test_a_short_run_judges_nothing(make_row):
    assert list(claims(merging(make_row, failed=0, speed=25.0, episodes=10))) == []
