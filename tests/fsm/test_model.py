import dataclasses
import pickle

import numpy as np
import pytest

from evofsm import EvolvingFSM, IntervalActions, Novelty

ACTIONS = IntervalActions(low=-1.0, high=1.0, width=1.0)


# -- A snapshot --------------------------------------------------------------------------------


def test_nothing_in_a_snapshot_can_be_changed(grown):
    model = grown.model()
    again = pickle.loads(pickle.dumps(model))
    for field in dataclasses.fields(model):
        with pytest.raises(dataclasses.FrozenInstanceError):
            setattr(model, field.name, None)
        value = getattr(model, field.name)
        if isinstance(value, np.ndarray):
            assert not getattr(again, field.name).flags.writeable
            with pytest.raises(ValueError, match="read-only"):
                value[...] = 0.0


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"names": ("x",)}, "names are .*2 variables"),
        ({"units": ("m", "m", "s")}, "units are .*2 variables"),
        ({"actions": ACTIONS}, "2 intervals for 3 matrices"),
        ({"dt": 0.0}, "dt of 0 cannot be right"),
    ],
)
def test_parts_that_do_not_fit_each_other_are_refused(grown, change, words):
    with pytest.raises(ValueError, match=words):
        dataclasses.replace(grown.model(), **change)


@pytest.mark.parametrize(
    ("z", "words"),
    [
        ([1.0], r"z has shape \(1,\); a row needs 2 variables"),
        (np.zeros((1, 1, 2)), r"z has shape \(1, 1, 2\)"),
        ([np.nan, 0.0], "variable 0: nan cannot be used"),
        ([0.0, -np.inf], "variable 1: -inf"),
        ([0.0, 1e200], r"variable 1: 1e\+200"),  # its square is infinite
    ],
)
def test_what_cannot_be_recognised_is_refused(grown, z, words):
    with pytest.raises(ValueError, match=words):
        grown.model().recognise(z)


# -- Forecasts ---------------------------------------------------------------------------------


@pytest.fixture
def machine():
    """States at 0 and 1, recognised so sharply that a belief is exactly 0 or 1.

    By hand P is [[1/2, 1/2], [5/6, 1/6]] of action 0, and [[5/14, 9/14], [1/2, 1/2]] of action 1.
    """
    machine = EvolvingFSM(
        n_actions=2, radius=0.5, learning_rate=0.5, prior_frequency=0.25, spread=1e-6
    )
    machine.learn_many([[0.0], [0.0], [2.0], [1.0]], [-1, -1, -1, 0])
    machine.learn_many([[0.0], [0.0], [1.0]], [1, 1, -1])
    return machine


@pytest.mark.parametrize(
    ("action", "horizon", "expected"),
    [
        (0, 1, [5 / 6, 1 / 6]),
        (1, 1, [1 / 2, 1 / 2]),
        (0, 2, [59 / 126, 67 / 126]),
        (0, 3, [1469 / 2646, 1177 / 2646]),
        (1, 2, [23 / 42, 19 / 42]),
    ],
)
def test_the_action_decides_the_first_step_and_all_alike_further_ones(
    machine, action, horizon, expected
):
    assert machine.belief.tolist() == [0.0, 1.0]
    np.testing.assert_allclose(machine.predict(action, horizon), expected, rtol=1e-14)


def test_a_forecast_may_lack_a_beginning_or_an_action(machine):
    machine.start_episode()
    assert machine.belief.tolist() == [0.5, 0.5]
    np.testing.assert_allclose(machine.predict(0), [2 / 3, 1 / 3], rtol=1e-15)
    # Without an action all count alike from the first step on.
    model = dataclasses.replace(machine.model(), decisions=np.array([[3.0, 3.0], [1.0, 1.0]]))
    np.testing.assert_allclose(model.propagate([1.0, 0.0]), [3 / 7, 4 / 7])
    np.testing.assert_allclose([1.0, 0.0] @ model.averaged_matrix, [13 / 28, 15 / 28])


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"belief": [2.0, -1.0]}, "no distribution"),
        ({"belief": [np.nan, 1.0]}, "no distribution"),
        ({"belief": [1.0]}, r"belief has shape \(1,\); the model has 2 states"),
        ({"action": 2}, "action is 2; there are actions 0 to 1"),
        ({"action": -1}, "action is -1"),
        ({"horizon": 0}, "horizon is 0"),
    ],
)
def test_a_forecast_that_makes_no_sense_is_refused(machine, arguments, words):
    with pytest.raises(ValueError, match=words):
        machine.model().propagate(**{"belief": [1.0, 0.0], "action": 0, **arguments})


def test_steps_are_shown_in_a_line():
    machine = EvolvingFSM(n_actions=2, rule=Novelty(radius=0.001))
    machine.learn_many(np.arange(500.0)[:, None], np.zeros(500, int))
    machine.start_episode()
    step = machine.observe([3.2])
    assert repr(step) == "Step(state=500, belief=1 of 501 states, event=CREATED, surprise=nan)"
    step = machine.observe([np.nan], partial=True)
    assert repr(step).endswith("event=NONE, surprise=nan)")
