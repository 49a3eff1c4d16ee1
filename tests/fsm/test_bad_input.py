"""What cannot be right is refused with its cause, and the machine is then as it was."""

import numpy as np
import pytest

from evofsm import EvolvingFSM
from one_machine import saved

NAN, INF = float("nan"), float("inf")
RAGGED = [[1.0, 2.0], [3.0]]

# What is wrong with one observation of two variables: the exception and the words that tell.
OBSERVATIONS = {
    "NaN": ([0.0, NAN], ValueError, "observation, variable 1: nan .*finite"),
    "too large": ([0.0, 1e200], ValueError, r"observation, variable 1: 1e\+200 .*at most 1e\+100"),
    "NaN in an array": (np.array([0.0, NAN]), ValueError, "observation, variable 1: nan .*finite"),
    "texts": (["a", "b"], TypeError, "observation has dtype <U1.*text"),
    "nothing": (None, TypeError, "observation has dtype object.*None"),
    "ragged": (RAGGED, ValueError, "observation: rows have different lengths"),
    "two axes": ([[0.0, 1.0]], ValueError, r"observation has shape \(1, 2\).*\(variables,\)"),
    "an empty list": ([], ValueError, r"observation has shape \(0,\).*not empty"),
}
ACTIONS = {
    "a number": (1.0, TypeError, "action is 1.0; it must be an integer index"),
    "nothing": (None, TypeError, "action is None; it must be an integer index"),
    "too high": (3, ValueError, "action is 3; there are actions 0 to 2"),
    "below zero": (-1, ValueError, "action is -1; there are actions 0 to 2"),
}
# Of which the second entry is masked.
HIDDEN = {
    "numbers": np.ma.array([0.5, 7.0], mask=[False, True]),
    "whole numbers": np.ma.array([1, 7], mask=[False, True]),
    "flags": np.ma.array([True, True], mask=[False, True]),
}
# Z, I and episode_starts of a batch.
ROWS = np.array([[0.0, 1.0], [2.0, 3.0], [1.0, 2.0]])
BATCHES = {
    "NaN": ([[0.0, 1.0], [2.0, NAN]], [0, 0], [], ValueError, "row 1, variable 1: nan .*finite"),
    "one axis": ([0.0, 1.0], [0, 0], [], ValueError, r"observations has shape \(2,\).*\(rows, var"),
    "no variables": (np.empty((3, 0)), [0, 0, 0], [], ValueError, r"shape \(3, 0\).*not empty"),
    "too few actions": (ROWS, [0, 0], [], ValueError, r"actions .*\(2,\); 3 observations"),
    "numbers as actions": (ROWS, [0.0, 1.0, 2.0], [], TypeError, "actions .*float64.*integer"),
    "action too low": (ROWS, [0, -2, 1], [], ValueError, "row 1 is -2; .*0 to 2, and -1 for none"),
    "start beyond": (ROWS, [0, 0, 0], [0, 3], ValueError, "episode_starts names row 3.* 3 rows"),
    "numbers as starts": (ROWS, [0, 0, 0], [0.0], TypeError, "episode_starts .*float64.*row"),
    "masked actions": (ROWS[:2], HIDDEN["whole numbers"], [], TypeError, "actions .*masked"),
    "flags as starts": (ROWS, [0] * 3, [True, False, False], TypeError, "episode_starts .*bool"),
}


def cases(table):
    return [pytest.param(*case, id=name) for name, case in table.items()]


@pytest.fixture(params=["new", "grown"])
def machine(request):
    return EvolvingFSM(n_actions=3) if request.param == "new" else request.getfixturevalue("grown")


def refuses(machine, call, error, words):
    """Check that a call fails as it should and that the machine then goes on as if never asked."""
    twin, before = machine.copy(), saved(machine)
    with pytest.raises(error, match=words):
        call(machine)
    assert saved(machine) == before
    Z = np.random.default_rng(5).normal(size=(30, 2))
    traces = [m.learn_many(Z, np.arange(30) % 3, belief=True) for m in (machine, twin)]
    for a, b in zip(*traces, strict=True):
        assert a.tobytes() == b.tobytes()
    assert saved(machine) == saved(twin)


@pytest.mark.parametrize(("z", "error", "words"), cases(OBSERVATIONS))
def test_an_observation_that_cannot_be_right(machine, z, error, words):
    refuses(machine, lambda m: m.observe(z), error, words)
    refuses(machine, lambda m: m.learn_one(z, 1), error, words)


def test_an_observation_or_a_batch_of_another_length(grown):
    words = "observation has 3 variables.*started with 2"
    for z in ([1.0, 2.0, 3.0], np.ones(3)):
        refuses(grown, lambda m, z=z: m.observe(z), ValueError, words)
    refuses(grown, lambda m: m.learn_many(np.ones((1, 3)), [0]), ValueError, words)


@pytest.mark.parametrize(("i", "error", "words"), cases(ACTIONS))
def test_an_action_that_cannot_be_right(machine, i, error, words):
    refuses(machine, lambda m: m.act(i), error, words)
    refuses(machine, lambda m: m.learn_one([0.0, 1.0], i), error, words)
    refuses(machine, lambda m: m.predict(i), error, words)


@pytest.mark.parametrize(("Z", "I", "starts", "error", "words"), cases(BATCHES))
def test_a_batch_that_cannot_be_right(machine, Z, I, starts, error, words):
    refuses(machine, lambda m: m.learn_many(Z, I, starts), error, words)


@pytest.mark.parametrize(
    ("failures", "error", "words"),
    [
        *((rows, ValueError, "failures names row") for rows in ([0, 3], [-1])),
        ([True] * 3, TypeError, "failures has dtype bool"),
        (HIDDEN["whole numbers"], TypeError, "failures .*masked"),
    ],
)
def test_failures_of_a_batch_or_of_an_observation_that_cannot_be_right(
    machine, failures, error, words
):
    refuses(machine, lambda m: m.learn_many(ROWS, [0] * 3, [], failures), error, words)
    refuses(machine, lambda m: m.observe([0.0, 1.0], failed="no"), TypeError, "failed is 'no'")


NO_SIZES = [0.0, -1.0, NAN, INF, "wide", 1j, [0.1, 0.2]]
SETTINGS = {
    **dict.fromkeys(["radius", "spread"], NO_SIZES),
    "distance_weight": [*NO_SIZES, None],
    "prior_frequency": [*NO_SIZES, None],
    "learning_rate": [*NO_SIZES, None, 1.0, 1.5],
    "n_actions": [0, -1, 1.0, 2.5, None, "2", [2]],
    "max_states": [0, 2.5],
    "belief_tolerance": [1.0, -1e-6, NAN],
}


@pytest.mark.parametrize(
    ("name", "value"), [(name, value) for name, values in SETTINGS.items() for value in values]
)
def test_a_setting_that_cannot_be_right(name, value):
    words = r"must be a positive(, finite number| integer)|must lie below 1"
    with pytest.raises(ValueError, match=rf"{name} is .*; it ({words})"):
        EvolvingFSM(**{"n_actions": 2, name: value})
    with pytest.raises(AttributeError, match=f"{name}.* (read only|no setter)"):
        setattr(EvolvingFSM(2), name, value)


@pytest.mark.parametrize("z", HIDDEN.values(), ids=HIDDEN)
def test_a_masked_entry_is_treated_as_nan_is(grown, z):
    twin = grown.copy()
    step = grown.observe(z, partial=True)
    expected = twin.observe([float(z[0]), NAN], partial=True)
    assert step.belief.tobytes() == expected.belief.tobytes()
