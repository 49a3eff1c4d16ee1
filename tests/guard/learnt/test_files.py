"""What no learning could have left in a file is refused; what was, `test_judge.py` goes on with."""

from io import BytesIO

import numpy as np
import pytest

from evofsm import Guard, store
from evofsm.guard.guard import KIND as GUARD
from evofsm.guard.learnt.judge import LearntRisk
from evofsm.guard.learnt.state import KIND


@pytest.fixture(scope="module")
def judge(points):
    """Settings and arrays of a file."""
    points["box"].taught(3).judge.save(file := BytesIO())
    return store.read(BytesIO(file.getvalue()), KIND)


FEWER = dict.fromkeys(("squares", "recent_squares"), lambda one: one[1:, 1:])
FEWER |= dict.fromkeys(("products", "recent_products"), lambda one: one[1:])


def with_first(value):
    def change(array):
        array = array.copy()
        array.flat[0] = value
        return array

    return change


@pytest.mark.parametrize(
    ("settings", "arrays", "why"),
    [
        ({"low": [3.0]}, {}, "below high"),
        ({"n_actions": 4}, {}, "of actions of 1 numbers, but they have 4"),
        ({"low": [-1.0, -1.0], "high": [1.0, 1.0]}, {}, "of actions of 1 numbers, but they have 2"),
        ({}, {"situations": lambda one: one[:, 1:]}, "situations has shape"),
        ({}, {"windows": lambda one: one[:, :, 1:]}, "windows has shape"),
        ({}, {"policies": lambda one: one[:, :, 1:]}, "policies has shape"),
        ({}, FEWER, "squares has"),
        ({}, {"forms": with_first(7.0)}, "forms are of variables that there are not"),
        ({}, {"forms": lambda one: one + 2.0 * np.eye(14)[2]}, "forms are of variables"),
        ({}, {"forms": lambda one: one * (np.arange(14) != 5)}, "units that are not positive"),
        ({}, {"drifts": lambda one: np.full((1, 3), 9.0)}, "drifts are of variables"),
        ({}, {"spans": with_first(999.0)}, "windows have other than 3 to 146 steps"),
    ],
)
def test_a_file_that_contradicts_itself_is_refused(judge, settings, arrays, why):
    bad, (content, own) = BytesIO(), judge
    changed = {name: change(own[name]) for name, change in arrays.items()}
    store.write(bad, KIND, content | settings, own | changed)
    with pytest.raises(ValueError, match=why):
        LearntRisk.load(BytesIO(bad.getvalue()))


def within(of, name, value):
    return lambda told, entries, numbers: told["settings"][of].update({name: value})


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ({"n_actions": 127}, "at most 126 actions"),
        ({"given_horizon": 1e9}, "looks at most 10,000 ahead"),
        ({"settings": []}, r"settings is \[\]"),
        (within("settings", "luck", 1), "luck"),
        (within("settings", "margin", "3"), "margin is '3'"),
    ],
)
def test_a_forged_file_is_refused_before_it_asks_for_memory(points, forge, tmp_path, change, why):
    path = tmp_path / "judge"
    points["choices"].taught(1).judge.save(path)
    forge(path, change)
    with pytest.raises(ValueError, match=why):
        LearntRisk.load(path)


@pytest.mark.parametrize(
    ("tolerance", "why"), [(1e9, "tolerance is 1000000000.0"), (-1, "tolerance"), (None, "float")]
)
def test_a_forged_tolerance_and_a_missing_judge_are_refused(
    points, forge, tmp_path, tolerance, why
):
    def change(told, entries, numbers):
        told["settings"]["reviser"]["settings"]["tolerance"] = tolerance

    path = tmp_path / "guard"
    points["box"].guard().save(path)
    forge(path, change)
    with pytest.raises(ValueError, match=why):
        Guard.load(path)
    settings, arrays = store.read(path, GUARD)
    settings["reviser"]["settings"]["tolerance"] = 0.1
    store.write(path, GUARD, settings, arrays | {"judge": np.zeros(0, np.uint8)})
    with pytest.raises(ValueError, match="what its LearntRisk has learnt is missing"):
        Guard.load(path)


def test_a_judge_of_other_actions_or_variables_is_refused(points, snapshot):
    box, plane = (points[name].taught(3) for name in ("box", "plane"))
    files = [BytesIO(snapshot(guard)) for guard in (box, plane)]
    (told, own), (_, others) = (store.read(file, GUARD) for file in files)
    store.write(mixed := BytesIO(), GUARD, told, own | {"judge": others["judge"]})
    with pytest.raises(ValueError, match=r"made for BoxActions\(.*, but the guard has Interval"):
        Guard.load(BytesIO(mixed.getvalue()))
    with pytest.raises(ValueError, match=r"made for BoxActions\(.*, but the guard has Choices"):
        Guard(n_actions=2, interval=0.1, judge=LearntRisk(0.1, 0.0, 1.0))
    guard = Guard(low=-1.0, high=1.0, interval=0.1, judge=box.judge).copy(states=False)
    guard.learn = False
    with pytest.raises(ValueError, match="observation has 3 variables; it must have 2"):
        guard.decide([0.0, 0.0, 0.0], 0.0)
