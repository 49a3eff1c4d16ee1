"""What was learnt is kept in a file, and goes on from there as if nothing had happened."""

from io import BytesIO

import numpy as np
import pytest

from evofsm import Guard, store
from evofsm.guard.guard import KIND as GUARD
from evofsm.guard.learnt.keeping import KIND
from evofsm.guard.learnt.risk import LearntRisk


def assert_goes_on_alike(point, guard, exactly, content):
    guard.save(file := BytesIO())
    again = Guard.load(BytesIO(file.getvalue()))
    assert content(again) == content(guard)
    for episode in range(40, 43):
        assert exactly(point.play(again, episode)[0]) == exactly(point.play(guard, episode)[0])
        assert content(again) == content(guard)
    again.freeze()
    guard.freeze()
    assert exactly(point.play(again, 50)[0]) == exactly(point.play(guard, 50)[0])


@pytest.mark.parametrize(
    "episodes", [0, *(pytest.param(k, marks=pytest.mark.slow) for k in (1, 3))]
)
def test_saved_and_loaded_it_goes_on_learning_bit_for_bit(point, exactly, content, episodes):
    assert_goes_on_alike(point, point.taught(episodes), exactly, content)


def test_with_noisy_sensors_it_goes_on_bit_for_bit_too(noisy, exactly, content):
    guard = noisy.taught(20)
    assert guard.judge.dynamics.is_noisy
    assert_goes_on_alike(noisy, guard, exactly, content)


def test_a_file_that_contradicts_itself_is_refused(points):
    file = BytesIO()
    points["box"].taught(3).judge.save(file)
    content, arrays = store.read(BytesIO(file.getvalue()), KIND)
    for told, spoilt, what in (
        (content, {"variables": np.zeros(2)}, "variables of the backups"),
        (content | {"n_constant": 99}, {}, "not 99 constant ones"),
        (content | {"without": ["luck"]}, {}, "without names"),
    ):
        bad = BytesIO()
        store.write(bad, KIND, told, arrays | spoilt)
        with pytest.raises(ValueError, match=what):
            LearntRisk.load(BytesIO(bad.getvalue()))
    others = {"variables": np.arange(3.0), "policies": np.zeros((6, 1, 4))}
    with pytest.raises(ValueError, match="variables has shape"):
        store.write(BytesIO(), KIND, content, arrays | others)


def test_a_judge_of_other_actions_or_variables_is_refused(points):
    box, plane = (points[name].taught(3) for name in ("box", "plane"))
    files = []
    for guard in (box, plane):
        files.append(BytesIO())
        guard.save(files[-1])
    (content, own), (_, others) = (store.read(BytesIO(file.getvalue()), GUARD) for file in files)
    mixed = BytesIO()
    store.write(mixed, GUARD, content, own | {"judge": others["judge"]})
    with pytest.raises(ValueError, match="the judge was made for actions from"):
        Guard.load(BytesIO(mixed.getvalue()))
    with pytest.raises(ValueError, match="the judge was made for a range of actions"):
        Guard(n_actions=2, interval=0.1, judge=LearntRisk(0.1, 0.0, 1.0))
    guard = Guard(low=-1.0, high=1.0, interval=0.1, judge=box.judge)
    with pytest.raises(ValueError, match="observation has 3 variables, but the judge learnt of 2"):
        guard.decide([0.0, 0.0, 0.0], 0.0)
