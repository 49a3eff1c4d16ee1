"""Dynamics in files: they go on as if never stopped, and what is damaged is refused."""

import io

import numpy as np
import pytest

from evofsm import store
from evofsm.fsm.dynamics.dynamics import Dynamics
from evofsm.fsm.dynamics.keeping import _KIND, from_bytes, to_bytes
from evofsm.fsm.learnt import MACHINE
from evofsm.fsm.machine import EvolvingFSM
from evofsm.fsm.model import FSMModel


def parts(value):
    """What a thing is made of, to be compared."""
    if isinstance(value, np.ndarray):
        return value.shape, value.tobytes()
    if isinstance(value, list | tuple):
        return [parts(one) for one in value]
    return value


def test_every_attribute_is_kept(taught):
    dynamics = taught(6)
    dynamics.observe(np.array([40.0, 15.0, 15.0]))
    dynamics.act(dynamics.encode(0.5))
    dynamics.observe(np.array([40.0, 15.0, 15.1]))
    again = from_bytes(to_bytes(dynamics))
    assert list(vars(again))
    assert set(vars(again)) == set(vars(dynamics))
    for name, value in vars(dynamics).items():
        if name not in ("latest", "_jumped"):  # for a judge as an episode ends; room to work in
            assert parts(getattr(again, name)) == parts(value), name


def test_they_go_on_bit_for_bit(taught, follow, drive):
    dynamics = taught(5)
    again = from_bytes(to_bytes(dynamics))
    for seed in range(3):
        Z, U = drive(np.random.default_rng(seed), braking=30)
        follow(dynamics, Z, U, failed=seed == 1)
        follow(again, Z, U, failed=seed == 1)
    assert (to_bytes(dynamics) == to_bytes(again)).all()


@pytest.mark.parametrize("cut", [0, 1, 2, 3, 60, 149])
def test_a_machine_goes_on_bit_for_bit_from_anywhere(cart, cut):
    machine, Z, I, U = cart()
    machine.learn_many(Z[:cut], I[:cut], executed=U[:cut])
    file = io.BytesIO()
    machine.save(file)
    again = EvolvingFSM.load(io.BytesIO(file.getvalue()))
    assert repr(again) == repr(machine)
    ends = []
    for each in (machine, again):
        each.learn_many(Z[cut:], I[cut:], executed=U[cut:])
        each.fail()
        file = io.BytesIO()
        each.save(file)
        ends.append(file.getvalue())
    assert ends[0] == ends[1]


def test_a_model_keeps_what_it_is_asked(cart):
    machine, Z, I, U = cart()
    machine.learn_many(Z, I, [0, 70], executed=U)
    model = machine.model()
    file = io.BytesIO()
    model.save(file)
    again = FSMModel.load(io.BytesIO(file.getvalue()))
    for known in (model, again):
        for one, other in zip(known.what_next(0.5, 5), machine.what_next(0.5, 5), strict=True):
            np.testing.assert_array_equal(one, other)
    machine.learn_many(Z, I, executed=U)
    assert model.dynamics.n_episodes == again.dynamics.n_episodes == 1
    part = model.submodel([0])
    assert part.dynamics.n_episodes == 1


def spoilt(dynamics, **changes):
    """A file of dynamics in which something is another."""
    content, arrays = store.read(io.BytesIO(to_bytes(dynamics).tobytes()), _KIND)
    for name, value in changes.items():
        if callable(value):
            arrays[name] = value(arrays[name])
        else:
            content[name] = value
    file = io.BytesIO()
    store.write(file, _KIND, content, arrays)
    return np.frombuffer(file.getvalue(), np.uint8)


def with_first(value):
    def change(array):
        array = array.copy()
        array.flat[0] = value
        return array

    return change


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({"sum_squares": with_first(np.nan)}, "sum_squares of nan"),
        ({"sum_unit": with_first(-1.0)}, "sum_unit of -1"),
        ({"sum_counts": with_first(0.5)}, "fraction"),
        ({"reached": with_first(-2.0)}, "reached of -2"),
        ({"known_weights": with_first(np.nan)}, "known_weights of nan"),
        ({"observations": with_first(np.inf)}, "observations of inf"),
        ({"n_episodes": -1}, "n_episodes"),
        ({"horizon": 0}, "horizon"),
        ({"low": [np.nan]}, "low"),
        ({"low": [3.0]}, "low"),
        ({"ready": 2}, "ready"),
        ({"without": ["wheels"]}, "wheels"),
        ({"low": [-1.0, -1.0], "high": [1.0, 1.0]}, "used has shape"),
        ({"stretches": lambda _: np.zeros((0, 2))}, "stretch_is_of_then has shape"),
        ({"actions": lambda array: array[:0]}, "0 actions after 2 observations"),
        ({"origin": lambda array: array[:2]}, "shape"),
        ({"sum_squares": lambda array: array[:3, :3]}, "shape"),
    ],
)
def test_what_no_learning_could_have_left_is_refused(taught, changes, why):
    dynamics = taught(5)
    for t in range(2):
        dynamics.observe(np.array([40.0, 15.0, 15.0 + t]))
        dynamics.act(dynamics.encode(0.0))
    with pytest.raises((ValueError, TypeError), match=why):
        from_bytes(spoilt(dynamics, **changes))


@pytest.mark.parametrize("where", [0.1, 0.5, 0.9])
def test_a_damaged_file_within_a_machines_file_is_refused(cart, where, tmp_path):
    machine, Z, I, U = cart()
    machine.learn_many(Z, I, executed=U)
    content, arrays = machine._content, machine._kept()
    arrays["dynamics"] = arrays["dynamics"].copy()
    begin = int(where * len(arrays["dynamics"]))
    arrays["dynamics"][begin : begin + 100] ^= 0x55  # more than a local header of the archive
    store.write(tmp_path / "machine", MACHINE, content, arrays)
    with pytest.raises(ValueError, match=str(tmp_path / "machine")):
        EvolvingFSM.load(tmp_path / "machine")


def test_dynamics_of_another_machine_are_refused(cart, tmp_path):
    machine, Z, I, U = cart()
    machine.learn_many(Z, I, executed=U)
    for other in (Dynamics(n_actions=9), None):
        arrays = machine._kept()
        if other is None:
            other = Dynamics(-1.0, 1.0)
            other.observe(np.zeros(5))
        arrays["dynamics"] = to_bytes(other)
        store.write(tmp_path / "machine", MACHINE, machine._content, arrays)
        with pytest.raises(ValueError, match="dynamics"):
            EvolvingFSM.load(tmp_path / "machine")
