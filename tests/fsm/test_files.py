import re
from dataclasses import fields

import numpy as np
import pytest

from evofsm import EvolvingFSM, FSMModel, IntervalActions, Novelty, Paper


def full_model(grown):
    return grown.model(
        actions=IntervalActions(-0.5, 1.0, 0.5, outside="clip"),
        names=("gap", "speed"),
        units=("m", "m/s"),
        dt=0.01,
    )


SITUATIONS = {
    "new": lambda machine: EvolvingFSM(n_actions=3, radius=0.01),
    "with an action pending": lambda machine: machine,
    "without an action": lambda machine: machine.observe([0.1, 0.1]),
    "between episodes": lambda machine: machine.start_episode(),
}


@pytest.mark.parametrize("situation", SITUATIONS.values(), ids=SITUATIONS.keys())
def test_a_loaded_machine_goes_on_bit_for_bit(situation, grown, snapshot, reloaded):
    new = situation(grown)
    machine = new if isinstance(new, EvolvingFSM) else grown
    twin, loaded = machine.copy(), reloaded(machine)
    assert repr(loaded) == repr(machine)
    Z, I = np.random.default_rng(5).normal(size=(100, 2)), np.arange(100) % 3
    traces = [m.learn_many(Z, I, belief=True) for m in (machine, loaded, twin)]
    for a, *others in zip(*traces, strict=True):
        assert {b.tobytes() for b in others} == {a.tobytes()}
    assert snapshot(loaded) == snapshot(machine) == snapshot(twin)


def novel_model(grown):
    machine = EvolvingFSM(3, rule=Novelty(radius=1.5, scales=(2.0, 0.5), spread=0.7))
    machine.learn_many(grown.centers, [0] * grown.n_states, failures=[3])
    return machine.model()


@pytest.mark.parametrize(
    "make", [full_model, novel_model, EvolvingFSM.model, lambda _: EvolvingFSM(2).model()]
)
def test_a_loaded_model_has_every_field_of_the_saved_one(make, grown, reloaded):
    model = make(grown)
    loaded = reloaded(model)
    for field in fields(FSMModel):
        value, expected = getattr(loaded, field.name), getattr(model, field.name)
        if isinstance(expected, np.ndarray):
            assert (value.shape, value.tobytes()) == (expected.shape, expected.tobytes())
            assert not value.flags.writeable
        else:
            assert value == expected
            assert type(value) is type(expected) or field.name == "width"


def test_numbers_of_every_size_are_kept_and_read_again(snapshot, reloaded):
    """What can be learnt can be kept: whatever the observations, the rule, and who is given up."""
    random = np.random.default_rng(0)
    sizes = (0.0, 5e-324, 1e-200, 1e-9, 1.0, 1e9, 1e100)
    machines = [
        EvolvingFSM(2, max_states=3, rule=Novelty(1.0, (1e-20, 1e20))),
        EvolvingFSM(2, max_states=3, rule=Novelty(2.0)),
        EvolvingFSM(2, radius=1e-9, distance_weight=1e50, prior_frequency=1e50),
        EvolvingFSM(2, radius=1e100, spread=1e100, prior_frequency=1e-300),
        EvolvingFSM(2, rule=Paper(), belief_tolerance=1e-3, learning_rate=0.999),
        EvolvingFSM(2, rule=Novelty(2.0), failure_horizon=2),
    ]
    for machine in machines:
        for _ in range(2):
            Z = random.choice(sizes, (60, 2)) * random.uniform(-1.0, 1.0, (60, 2))
            machine.learn_many(Z, random.integers(-1, 2, 60), [7, 31], failures=[6, 59])
            for one in (machine, machine.model()):
                assert snapshot(reloaded(one)) == snapshot(one)


MACHINES = [
    *((name, 1e6, "where it is does not fit") for name in ("n_states", "action", "state")),
    ("place", 7.0, "place of an action"),
    ("n_actions", 10**6, r"has shape \(3,\), not \(1000000,\)"),
    ("failures_told", 2, "failures_told of 2"),
    ("rule", {"name": "magic"}, "rule is .*magic.*; it must be one of paper, novelty"),
    ("rule", {"name": "novelty", "gain": 1.0}, "gain"),
    ("rule", {"name": "novelty", "scales": [1.0]}, "scales"),
]

MODELS = [
    ("visits", -1.0, "visits of -1"),
    ("actions", {"low": -1e308, "high": 0.0, "width": 1e308}, "actions.low of -1e"),
    ("actions", {"low": -0.5, "high": 1.0, "width": 1e-12}, "1 to 100,000 intervals"),
    ("failures_told", {}, "failures_told is {}; it must be of type bool"),
    ("names", {}, r"names is {}; it must be of type list\[str\]"),
]


@pytest.mark.parametrize(
    ("kind", "name", "value", "words"),
    [*((EvolvingFSM, *one) for one in MACHINES), *((FSMModel, *one) for one in MODELS)],
)
def test_what_no_learning_could_have_left_is_refused(
    grown, forge, tmp_path, kind, name, value, words
):
    path = tmp_path / "file"
    (grown if kind is EvolvingFSM else full_model(grown)).save(path)
    forge(path, {name: value})
    with pytest.raises(ValueError, match=f"{re.escape(str(path))}.*{words}"):
        kind.load(path)
