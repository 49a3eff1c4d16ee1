"""What no learning could have left in a file is refused; what was, `test_judge.py` goes on with."""

from io import BytesIO

import numpy as np
import pytest

from evofsm import Guard, store
from evofsm.guard import LearntRisk, LearntSettings
from evofsm.guard.guard import KIND as GUARD


def without_first(*axes):
    return lambda array: array[tuple(slice(axis in axes, None) for axis in range(array.ndim))]


FEWER = dict.fromkeys(("squares", "recent_squares"), without_first(0, 1))
FEWER |= dict.fromkeys(("products", "recent_products"), without_first(0))


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ({"low": [3.0]}, "below high"),
        ({"n_actions": 4}, "of actions of 1 numbers, but they have 4"),
        ({"n_actions": 127}, "at most 126 actions"),
        ({"low": [-1.0, -1.0], "high": [1.0, 1.0]}, "of actions of 1 numbers, but they have 2"),
        ({"given_horizon": 1e9}, "looks at most 10,000 ahead"),
        ({"settings": []}, r"settings is \[\]"),
        ({"settings": lambda one: one | {"luck": 1}}, "luck"),
        ({"settings": lambda one: one | {"margin": "3"}}, "margin is '3'"),
        ({"situations": without_first(1)}, "situations has shape"),
        ({"windows": without_first(2)}, "windows has shape"),
        ({"policies": without_first(2)}, "policies has shape"),
        (FEWER, "squares has"),
        ({"forms": 7.0}, "forms are of variables that there are not"),
        ({"forms": lambda one: one + 2.0 * np.eye(14)[2]}, "forms are of variables"),
        ({"forms": lambda one: one * (np.arange(14) != 5)}, "units that are not positive"),
        ({"drifts": lambda one: np.full((1, 3), 9.0)}, "drifts are of variables"),
        ({"spans": 999.0}, "windows have other than 3 to 146 steps"),
    ],
)
def test_what_no_learning_could_have_left_is_refused(points, forge, tmp_path, change, why):
    path = tmp_path / "judge"
    points["box"].taught(3).judge.save(path)
    forge(path, change)
    with pytest.raises(ValueError, match=why):
        LearntRisk.load(path)


@pytest.mark.parametrize(
    ("numbers", "why"),
    [
        *(({name: 0}, name) for name in ("n_asked", "n_starts", "max_survived", "ahead")),
        ({"n_mutants": -3}, "n_mutants of -3 cannot be right"),
        ({"n_disturbances": 10.0}, "n_disturbances holds a fraction"),
        ({"margin": np.nan}, "margin of nan"),
        ({"margin": None}, "margin is None"),
    ],
)
def test_settings_that_no_file_holds_are_refused_as_they_are_made(numbers, why):
    with pytest.raises(ValueError, match=why):
        LearntSettings(**numbers)


def test_settings_and_seeds_that_are_taken_can_be_kept_and_others_are_refused():
    numbers = LearntSettings(margin=0, caution=0.0, tries=0, n_asked=np.int64(2), shy=np.float32(9))
    LearntRisk(0.1, -1.0, 1.0, settings=numbers, seed=1 << 53).save(file := BytesIO())
    again = LearntRisk.load(BytesIO(file.getvalue()))
    assert (again.settings, again.seed) == (numbers, 1 << 53)
    for wrong in ({"dt": 0.0}, {"horizon": 0.0}, {"n_actions": 0}):
        with pytest.raises(ValueError, match=next(iter(wrong))):
            LearntRisk(**({"dt": 0.1, "n_actions": 2} | wrong))
    for seed in (-1, 1 << 63, 1 << 128):
        with pytest.raises(ValueError, match=rf"seed is {seed}; it must be from 0 to 2\*\*53"):
            Guard(-1.0, 1.0, interval=0.1, seed=seed)


def with_tolerance(value):
    return {"reviser": lambda one: one | {"settings": one["settings"] | {"tolerance": value}}}


@pytest.mark.parametrize(
    ("change", "why"),
    [
        (with_tolerance(1e9), "tolerance is 1000000000.0"),
        (with_tolerance(-1), "tolerance"),
        (with_tolerance(None), "tolerance is None"),
        ({"judge": lambda array: array[:0]}, "what its LearntRisk has learnt is missing"),
        ({"machine": lambda array: array[:-7]}, "cannot be loaded"),
        ({"reviser": lambda one: one | {"class": "Nobody"}}, "cannot be loaded"),
    ],
)
def test_a_guard_with_a_forged_or_missing_part_is_refused(points, forge, tmp_path, change, why):
    path = tmp_path / "guard"
    points["box"].guard().save(path)
    forge(path, change)
    with pytest.raises(ValueError, match=why):
        Guard.load(path)


def test_a_judge_of_other_actions_or_variables_is_refused(points, snapshot):
    box, plane = (points[name].taught(3) for name in ("box", "plane"))
    files = [BytesIO(snapshot(guard)) for guard in (box, plane)]
    (told, own), (_, others) = (store.read(file, GUARD) for file in files)
    fits_not = r"made for BoxActions\(.*, but the guard has Interval"
    for judge, why in ((others["judge"], fits_not), (own["machine"], "cannot be loaded")):
        store.write(mixed := BytesIO(), GUARD, told, own | {"judge": judge})
        with pytest.raises(ValueError, match=why):
            Guard.load(BytesIO(mixed.getvalue()))
    with pytest.raises(ValueError, match=r"made for BoxActions\(.*, but the guard has Choices"):
        Guard(n_actions=2, interval=0.1, judge=LearntRisk(0.1, 0.0, 1.0))
    guard = Guard(low=-1.0, high=1.0, interval=0.1, judge=box.judge).copy(states=False)
    guard.learn = False
    with pytest.raises(ValueError, match="observation has 3 variables; it must have 2"):
        guard.decide([0.0, 0.0, 0.0], 0.0)
